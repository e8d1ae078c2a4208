"""The monitor of a live run: checked before anything heavy is loaded, made of the run's settings, and shown a log's moments."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from osel_sim.api.run_settings import RunConfig
from osel_sim.core.errors import UsageError

if TYPE_CHECKING:
    from osel_sim.episodes.watching import RunMonitor
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.interface.encoder import Encoder
    from osel_sim.interface.monitor import Monitor, MonitorFactory
    from osel_sim.selection.reward import RewardWeights


def check_monitor(config: RunConfig, factory: "MonitorFactory | None", policies: "Sequence[PolicySpec]") -> None:
    """Refuse settings of a monitor that cannot be, before anything heavy is loaded.

    Raises:
        UnknownNameError: no such monitor, or its parameter names none of the policies.
        UsageError: a parameter is wrong, or a setting of a monitor is given without one.
    """
    if config.monitor is not None:
        _make(config, factory, policies, 1)
    elif config.decide_every != RunConfig.decide_every:
        raise UsageError("--decide-every does nothing without --monitor; name one (--list shows them)")


def monitor_said(config: RunConfig) -> dict[str, Any]:
    """`monitor` of a run's configuration; nothing where there is none."""
    return {} if config.monitor is None else {"monitor": {"name": config.monitor, "decide_every": config.decide_every}}


def make_run_monitor(
    config: RunConfig, factory: "MonitorFactory | None", policies: "Sequence[PolicySpec]", encoder: "Encoder", weights: "RewardWeights"
) -> "RunMonitor | None":
    """The monitor that the settings ask for; None where they ask for none."""
    from osel_sim.episodes.watching import RunMonitor

    if config.monitor is None:
        return None
    monitor = _make(config, factory, policies, encoder.dimension)
    return RunMonitor(monitor, [spec.name for spec in policies], config.decide_every, encoder, weights)


def _make(config: RunConfig, factory: "MonitorFactory | None", policies: "Sequence[PolicySpec]", picture_dim: int) -> "Monitor":
    from osel_sim.interface.monitor import Candidate
    from osel_sim.selection.monitors.registry import make_monitor

    candidates = [Candidate(spec.name, spec.is_remote) for spec in policies]
    if factory is not None:
        return factory(candidates, picture_dim, config.seed)
    return make_monitor(config.monitor or "", candidates, picture_dim, config.seed)
