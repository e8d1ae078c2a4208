"""A recording: every policy on the same instances, for a rollout log."""

from typing import Any

from osel_sim.api.record_settings import RecordConfig
from osel_sim.api.results import RecordResult


def record(config: RecordConfig | None = None, /, **values: Any) -> RecordResult:
    """Run every policy on the same instances and write the outcomes to a rollout log.

    Args:
        config: settings as one object; `values` change some of them.
        values: settings by name, as `RecordConfig` has them.

    Raises:
        OselError: whatever is wrong with the settings, the files they name, or what came of them; the message says what.
    """
    config = RecordConfig.of(**values) if config is None else config.changed(**values)
    from osel_sim.api.record_cluster import is_for_cluster, record_on_cluster
    from osel_sim.api.record_here import record_here

    return record_on_cluster(config) if is_for_cluster(config) else record_here(config)
