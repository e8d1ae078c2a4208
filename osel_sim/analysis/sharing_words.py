"""What is said of robots that share, on the terminal and on the page."""

import shlex
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from osel_sim.analysis.live import LiveLog
    from osel_sim.analysis.live_sharing import RunFleet


def title(sharing: Mapping[str, Any]) -> str:
    """What was replayed to whom."""
    by = f"by {sharing['by']}" if sharing["by"] else "dealt out in turn"
    return f"{sharing['robots']} robots, {sharing['decisions']:,} decisions each, {by}: mean reward"


def about(sharing: Mapping[str, Any]) -> str:
    """What the ways to share are."""
    delay = f", known {sharing['delay']} decisions later" if sharing["delay"] else ""
    exchange = f"{sharing['share']}: exchanged after so many decisions of each{delay}; " if sharing["share"] not in ("none", "all") else ""
    several = next(iter(next(iter(sharing["selectors"].values()))["ways"].values()))["ci95"] is not None
    over = " Intervals are over the orders of the streams." if several else ""
    return f"none: each robot learns alone; {exchange}all: one selector decides for all of them.{over}"


def conclusion(sharing: Mapping[str, Any]) -> str:
    """How much of what one that sees everything has over robots that learn alone sharing closes."""
    entries = {name: entry for name, entry in sharing["selectors"].items() if entry["gap_closed"] is not None}
    if sharing["share"] in ("none", "all"):
        return "Nothing is exchanged in between; --share every:N says what an exchange is worth."
    if not entries:
        return "One that sees everything is not clearly ahead of robots that learn alone here, so that sharing has nothing to close."
    told = ", ".join(f"{name} {100 * entry['gap_closed']:.0f}%" for name, entry in entries.items())
    return f"Of the gap between learning alone and seeing everything, sharing {sharing['share']} closes: {told}."


def live_about(fleet: "RunFleet") -> str:
    """Who the robots of a live run were, and when they were told what."""
    streams = f"Their streams differ in the {fleet.by}." if fleet.by else "Instances were dealt out in turn."
    sharing, robots = fleet.sharing, f"{fleet.count} robots; decision t is robot t mod {fleet.count}'s. {streams}"
    if sharing.central:
        return f"{robots} One selector decided for all of them and knew of every round when it was over."
    if sharing.every is None:
        return f"{robots} Each learned alone and was told nothing."
    later = f", which was known {sharing.delay} decisions later" if sharing.delay else ", which was known at once"
    return f"{robots} After every {sharing.every} decisions of theirs all told what they had learned{later}."


def live_conclusion(live: "LiveLog", sharing: Mapping[str, Any]) -> str:
    """What sharing was worth to the robots of a live run that was played again, and what of that is an estimate."""
    [(name, entry)] = sharing["selectors"].items()
    ways = {"none": "each alone", "all": "one that sees everything"}
    means = ", ".join(f"{ways.get(way, f'sharing {way}')} {found['mean_reward']:.3f}" for way, found in entry["ways"].items())
    orders = f"{sharing['orders']} orders, the run's own first" if sharing["orders"] > 1 else "the run's order"
    return (
        f"Estimated: the same instances, played again to {name} from what every policy came to on them ({orders}; every robot has the instances "
        f"that it had): mean reward of {means}. {conclusion(sharing)}{_otherwise(live)}"
    )


def _otherwise(live: "LiveLog") -> str:
    """In what a run that is played again differs from the run."""
    content, said = live.outcomes.metadata.get("content"), live.outcomes.metadata
    without = [
        word
        for word, there in (
            ("what --warm-start showed beforehand", isinstance(content, Mapping) and "warm_start" in content),
            ("the monitor", said.get("monitor") is not None),
        )
        if there
    ]
    return f" Played again without {' and '.join(without)}." if without else ""


def not_played_again(live: "LiveLog", fleet: "RunFleet", replayable: bool) -> str:
    """The commands that tell what sharing is worth where a live run does not; nothing where none does.

    Args:
        replayable: the run has the outcomes of all policies.
    """
    from osel_sim.selection.registry import SELECTORS, can_share

    if live.selector not in SELECTORS or not can_share(live.selector):
        return ""
    flags = f"--robots {fleet.count} --share {fleet.sharing}" + (f" --share-delay {fleet.sharing.delay}" if fleet.sharing.delay else "")
    flags += f" --robots-by {fleet.by}" if fleet.by else ""
    tasks = " ".join(shlex.quote(task) for task in sorted(set(live.outcomes.labels("task"))))
    if replayable:
        return f" This tells it: python -m osel_sim.replay {shlex.quote(str(live.outcomes.source))} --selectors {live.selector} {flags}"
    return (
        " A run with --counterfactual tells it on its page; so does a log of the same tasks: "
        f"python -m osel_sim.record --task {tasks} --instances 100 --out runs/log, "
        f"then python -m osel_sim.replay runs/log --selectors {live.selector} {flags}"
    )
