"""The robots of a live run on its page: what each earned, when it was told of the others, and what sharing was worth."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import mean_of, rate_of
from osel_sim.analysis.live import LiveLog
from osel_sim.analysis.live_sharing import RunFleet, fleet_of, played_again
from osel_sim.analysis.sharing_words import live_about, live_conclusion, not_played_again
from osel_sim.reporting.charts import Figure, Look, listed
from osel_sim.reporting.curves import Line, curves, settled_domain, thinned
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Block, Section
from osel_sim.reporting.selector_sections import running_mean
from osel_sim.reporting.sharing_section import sharing_figure, sharing_table
from osel_sim.selection.reward import RewardWeights

_MOST_MARKS = 30
_MOST_LINES = 8


def robots_sections(live: LiveLog, weights: RewardWeights, budget: int) -> list[Section]:
    """The section of a run of several robots; none of another.

    Args:
        weights: of the run's reward.
        budget: decisions that are replayed at most, to say what sharing was worth.

    Raises:
        DataError: `run.json` says something else of robots than a run does.
    """
    fleet = fleet_of(live)
    if fleet is None:
        return []
    rewards = live.received.mean_rewards(weights)[np.arange(len(live.chosen)), live.chosen]
    blocks: list[Block] = [live_about(fleet), _figure(fleet, rewards), _table(live, fleet, rewards)]
    worth = played_again(live, fleet, weights, budget)
    if isinstance(worth, str):
        blocks.append(f"What sharing was worth is not told here. {worth}{not_played_again(live, fleet, live.has_all_outcomes(weights))}")
    else:
        figure, table = sharing_figure(worth), sharing_table(worth)
        blocks += [
            live_conclusion(live, worth),
            replace(figure, title=f"Estimated: what sharing is worth to {figure.title}", caption=f"The run played again. {figure.caption}"),
            replace(table, title="Estimated: what sharing is worth"),
        ]
    return [Section("robots", "Robots that share", blocks)]


def _figure(fleet: RunFleet, rewards: NDArray[np.float64]) -> Figure:
    own = {f"robot {robot}": running_mean(rewards[robot :: fleet.count]) for robot in range(fleet.count) if robot < len(rewards)}
    rounds = max(map(len, own.values()))
    at, arrivals = thinned(rounds), fleet.arrivals(rounds)
    shown = dict(list(own.items())[:_MOST_LINES])
    lines = [Line(name, np.append(values, np.full(rounds - len(values), np.nan))[at]) for name, values in shown.items()]
    look = Look({name: f"c{number}" for number, name in enumerate(shown)})
    marks = arrivals if len(arrivals) <= _MOST_MARKS else []
    panel = curves("", at + 1, lines, look, ("decision of the robot", "mean reward so far"), settled_domain(at + 1, lines), marks=marks)
    caption = "Mean reward of each robot up to each decision of its own." + (
        " Upright lines: what the others told was known from there on." if marks else ""
    )
    if len(shown) < len(own):
        caption += f" The first {len(shown)} of {len(own)} robots; the table has all."
    ends = listed([f"{name} {values[-1]:.3f}" for name, values in own.items()])
    return Figure("robots", "Measured: what each robot earned up to each decision", caption, f"A curve a robot. In the end: {ends}.", [panel])


def _table(live: LiveLog, fleet: RunFleet, rewards: NDArray[np.float64]) -> Table:
    log, total, rows = live.received, np.arange(len(rewards)), list[dict[str, Cell]]()
    arrivals = fleet.arrivals(len(rewards) // fleet.count)
    for robot in [*range(fleet.count), None]:
        mine = total if robot is None else total[robot :: fleet.count]
        if not len(mine):
            continue
        at = mine, live.chosen[mine]
        row: dict[str, Cell] = {"robot": "all" if robot is None else f"robot {robot}", "decisions": len(mine), "success": rate_of(log.success[at])}
        if fleet.by is not None:
            labels = sorted({str(getattr(live.outcomes.instances[index], fleet.by)) for index in mine.tolist()})
            row["stream"] = listed(labels) if robot is not None else ""
        row |= {key: mean_of(values[at]) for key, values in (("seconds", log.seconds), ("price", log.price))}
        row["reward"] = mean_of(rewards[mine])
        if arrivals:
            knew = mine // fleet.count >= arrivals[0]
            row |= {"before": mean_of(rewards[mine[~knew]]), "since": mean_of(rewards[mine[knew]])}
        rows.append(row)
    columns = [
        Column("robot", "", "text"),
        *([Column("stream", fleet.by, "text")] if fleet.by is not None else []),
        *(Column("decisions", "decisions"), Column("success", "success", "percent"), Column("reward", "mean reward", digits=3)),
        *([Column("before", "reward before it was told", digits=3), Column("since", "since then", digits=3)] if arrivals else []),
        *(Column("seconds", "seconds"), Column("price", "price (cents)", digits=None)),
    ]
    caption = "What each robot received, with 95% intervals; errors count nowhere but among decisions. " + (
        f"It was first told of the others after {arrivals[0]} decisions of its own; the selector also learns by itself, so that what came since is "
        "not what sharing was worth."
        if arrivals
        else "Decision t is robot t mod R's."
    )
    return Table("robots", "Measured: what each robot earned", caption, columns, rows)
