"""The monitor of a live run: checked before anything heavy is loaded, made of the run's settings, and shown a log's moments."""

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from osel_sim.api.run_settings import RunConfig
from osel_sim.core.errors import UsageError

if TYPE_CHECKING:
    from osel_sim.episodes.live import LiveRun
    from osel_sim.episodes.watching import RunMonitor
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.interface.encoder import Encoder
    from osel_sim.interface.monitor import Monitor, MonitorFactory
    from osel_sim.selection.reward import RewardWeights

logger = logging.getLogger(__name__)


def check_monitor(config: RunConfig, factory: "MonitorFactory | None", policies: "Sequence[PolicySpec]") -> None:
    """Refuse settings of a monitor that cannot be, before anything heavy is loaded.

    Raises:
        UnknownNameError: no such monitor, or its parameter names none of the policies.
        UsageError: a parameter is wrong, or a setting of a monitor is given without one.
    """
    if config.monitor is not None:
        monitor = _make(config, factory, policies, 1)
        if config.monitor_warm_start is not None:
            from osel_sim.analysis.moment_warm_start import check_can_start_warm

            check_can_start_warm(config.monitor, monitor)
        return
    for flag, given in (("--decide-every", config.decide_every != RunConfig.decide_every), ("--monitor-warm-start", config.monitor_warm_start)):
        if given:
            raise UsageError(f"{flag} does nothing without --monitor; name one (--list shows them)")


def monitor_said(config: RunConfig) -> dict[str, Any]:
    """`monitor` of a run's configuration; nothing where there is none."""
    if config.monitor is None:
        return {}
    said: dict[str, Any] = {"name": config.monitor, "decide_every": config.decide_every}
    if config.monitor_warm_start is not None:
        from osel_sim.core.files import digest
        from osel_sim.formats.moments import MOMENTS

        said["warm_start"] = digest(config.monitor_warm_start / MOMENTS)
    return {"monitor": said}


def make_run_monitor(
    config: RunConfig, factory: "MonitorFactory | None", policies: "Sequence[PolicySpec]", encoder: "Encoder", weights: "RewardWeights"
) -> "RunMonitor | None":
    """The monitor that the settings ask for; None where they ask for none."""
    from osel_sim.episodes.watching import RunMonitor

    if config.monitor is None:
        return None
    monitor = _make(config, factory, policies, encoder.dimension)
    return RunMonitor(monitor, [spec.name for spec in policies], config.decide_every, encoder, weights)


def start_monitor_warm(config: RunConfig, live: "LiveRun", grown_from: int | None) -> None:
    """Show the monitor the moments of a log, except those of instances that this run decides on.

    Args:
        grown_from: decisions that a resumed run was to have, where those are fewer than now.
    """
    if config.monitor_warm_start is None or live.monitor is None:
        return
    from osel_sim.analysis.moment_warm_start import read_warm_start, show_moments
    from osel_sim.api.run_resume import check_still_unseen

    folder = config.monitor_warm_start
    log = read_warm_start(folder, live.encoder.identity, live.monitor.policies)
    own = live.instance_keys(config.episodes)
    if grown_from is not None:
        check_still_unseen(own - live.instance_keys(grown_from), log.whole.keys, folder, config.episodes)
    count = show_moments(live.monitor.monitor, log, live.options.weights, own)
    logger.info("the monitor was shown beforehand: moments of %d instances of %s, none of them of this run", count, folder)


def _make(config: RunConfig, factory: "MonitorFactory | None", policies: "Sequence[PolicySpec]", picture_dim: int) -> "Monitor":
    from osel_sim.interface.monitor import Candidate
    from osel_sim.selection.monitors.registry import make_monitor

    candidates = [Candidate(spec.name, spec.is_remote) for spec in policies]
    if factory is not None:
        return factory(candidates, picture_dim, config.seed)
    return make_monitor(config.monitor or "", candidates, picture_dim, config.seed)
