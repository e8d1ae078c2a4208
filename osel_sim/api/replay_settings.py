"""The settings of a replay."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from osel_sim.api.robot_settings import RobotSettings
from osel_sim.api.settings import MAIN, OTHER, Count, Files, Folder, LoggedRewardSettings, Names, NonNegative, settings
from osel_sim.core.errors import UnknownNameError, UsageError


@settings
class ReplayConfig(RobotSettings, LoggedRewardSettings):
    """Replay a rollout log to selectors: how far from the oracle is each, and is routing worth it?"""

    log: Folder
    """folder of a rollout log, of one with moments, or of a live run"""
    selectors: Annotated[Names | None, MAIN] = None
    """ppo, ucb1, auto ... (default: all there are)"""
    policies: Annotated[Names | None, MAIN] = None
    """policies to choose from (default: all of the log)"""
    seeds: Annotated[Count, MAIN] = 20
    """number of random orders"""
    monitors: Annotated[Names | None, MAIN] = None
    """of a log with moments: stall, value, blind:6:remote_large ... (default: stall, disagreement and value)"""
    decisions: Annotated[Count | None, MAIN] = None
    """length of a stream (default: all instances)"""
    half: Annotated[Literal["choose", "score"] | None, MAIN] = None
    """only this half of the instances: one to choose settings by, the other to report (default: all)"""
    out: Annotated[Path | None, MAIN] = None
    """where to write (default: runs/replay-LOG)"""
    overwrite: Annotated[bool, MAIN] = False
    """replace a replay that is in --out"""
    open: Annotated[bool, MAIN] = False
    """write its page too and show it in the browser, as soon as there is a verdict; reload it as more is replayed"""
    workers: Annotated[Count, MAIN] = 2
    """processes; the result does not depend on how many"""
    unknown_costs: Annotated[bool, OTHER] = False
    """let all selectors learn what policies cost (default: auto is told their mean cost)"""
    unknown_skills: Annotated[bool, OTHER] = False
    """do not tell auto what policies were made for (default: it is told what the log says of it)"""
    no_frontier: Annotated[bool, OTHER] = False
    """do not replay selectors at other weights of time and price as well"""
    margin: Annotated[NonNegative, OTHER] = 0.02
    """a gain in reward a decision that is not worth routing for"""
    route_with: Annotated[Names | None, OTHER] = None
    """selectors that the verdict may advise (default: auto, with --half auto:warm too)"""
    budget_cents: Annotated[NonNegative | None, OTHER] = None
    """replay within budgets, too: this one in cents, and quarters to four times of it, against the best that could be had for as much"""
    budget_per: Annotated[Count | None, OTHER] = None
    """with --budget-cents: a budget for each so many decisions, one after the other (default: one for the whole stream)"""
    join: Annotated[Names, OTHER] = ()
    """POLICY@DECISION: a policy that is not there before that decision of a stream; what selectors make of it is reported"""
    leave: Annotated[Names, OTHER] = ()
    """POLICY@DECISION: a policy that is not there from that decision on"""
    drift: Annotated[Names, OTHER] = ()
    """from a decision on a price changes, price:POLICY:x2@DECISION, or a policy comes to what another of the log came to, POLICY=OTHER@DECISION"""
    encoder: Annotated[str | None, OTHER] = None
    """whose contexts, where the log has several, or auto: those that predict rewards best, by the choosing half (default: the one it was recorded
    with)"""
    targets: Annotated[Files, OTHER] = ()
    """of a live run or logged decisions: tables of how you would choose (columns policy, probability, and decision or instance); what each would have
    earned is estimated too"""
    context: Annotated[Literal["task"] | None, OTHER] = None
    """append the task's name to the contexts; auto finds out whether it helps"""

    @property
    def folder(self) -> Path:
        """Where to write."""
        return self.out or Path("runs") / f"replay-{self.log.resolve().name}"


def choose_selectors(names: Sequence[str] | None, halved: bool = False) -> list[str]:
    """Names of selectors to replay: those given, each once, else all that are installed. Fixed policies are left out: they are always added.

    Args:
        halved: whether there is another half of the log, whose outcomes a selector named `NAME:warm` is shown.

    Raises:
        UnknownNameError: no such selector.
        UsageError: it needs a package that is not installed, or cannot start warm.
    """
    from osel_sim.analysis.engine import WARM
    from osel_sim.analysis.result import REFERENCES
    from osel_sim.analysis.warm_start import check_can_start_warm
    from osel_sim.selection.registry import selector_locations
    from osel_sim.selection.vowpal import available

    locations = selector_locations()
    if names is None:
        # `auto` is another name of one of them, which need not run twice.
        twins = {name for name, place in locations.items() if place == locations.get("auto") and name != "auto"}
        names = sorted(name for name in locations if name not in twins and (available() or not name.startswith("vw_")))
        names += [f"auto{WARM}"] if halved else []
    for name in names:
        kind = name.partition(":")[0]
        if kind not in locations and name not in REFERENCES:
            raise UnknownNameError("selector", name, {*locations, *REFERENCES} - {"fixed"})
        if name.startswith("vw_") and not available():
            raise UsageError(f"selector {name!r} needs the package vowpalwabbit: pip install 'osel-sim[vw]'")
        if name.endswith(WARM) and kind != "fixed":
            if not halved:
                raise UsageError(f"selector {name!r} is shown the outcomes of the log's other half beforehand: say which half to replay with --half")
            check_can_start_warm(kind)
    return [name for name in dict.fromkeys(names) if name.partition(":")[0] != "fixed" and name not in REFERENCES]
