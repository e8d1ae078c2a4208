"""The page of a live run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.answer import BUDGET, answer
from osel_sim.analysis.clusters import score_of
from osel_sim.analysis.estimate import mean_of, rate_of
from osel_sim.analysis.evaluation import evaluate
from osel_sim.analysis.live import LiveLog, read_live
from osel_sim.analysis.log import FLAGS, Array, LoggedOutcomes
from osel_sim.analysis.units import units_of
from osel_sim.analysis.verdict_words import in_units
from osel_sim.core.errors import DataError
from osel_sim.formats.journal import Decision
from osel_sim.formats.run_config import read_run
from osel_sim.reporting.budget_section import run_budget
from osel_sim.reporting.changes_section import changes_table
from osel_sim.reporting.charts import Figure, Look, listed
from osel_sim.reporting.curves import Line, curves, thinned
from osel_sim.reporting.encoder_section import encoder_section
from osel_sim.reporting.episodes import Scenes, list_episodes, no_scenes, note_of
from osel_sim.reporting.html_tables import Cell, Column, Table, to_text
from osel_sim.reporting.log_page import few, interval, log_sections, signed
from osel_sim.reporting.log_sections import CREDIT, FALLBACKS, formula
from osel_sim.reporting.monitor_section import monitor_sections
from osel_sim.reporting.off_policy_section import off_policy_table
from osel_sim.reporting.page import Block, Episodes, Page, Section, Tile, Verdict
from osel_sim.reporting.palette import colours
from osel_sim.reporting.robots_section import robots_sections
from osel_sim.reporting.routes import Chosen, route_figure
from osel_sim.reporting.selector_sections import ORACLES, Stream, curve_figure, look_of, penalty_figure, regret_figure
from osel_sim.reporting.verdict_tiles import shown_verdict
from osel_sim.reporting.warnings_section import warnings_section
from osel_sim.selection.registry import RECOMMENDATION, is_recommended
from osel_sim.selection.reward import FLOOR_SECONDS, RewardWeights
from osel_sim.statistics.betting import advantage_bounds

VIDEOS = "videos"
HINDSIGHT = ORACLES["hindsight"]
ERROR = 0.05
"""Probability, at most, that the bounds of the verdict do not hold."""


def run_page(folder: Path, scenes: Scenes = no_scenes, beside: Path | None = None, budget: int = BUDGET) -> Page:
    """The page of a live run's folder.

    Args:
        scenes: draws how some of its instances begin.
        beside: folder of the page, where it is not the run's.
        budget: decisions that are replayed for the verdict, at most.

    Raises:
        DataError: no run there, or no decision in it.
    """
    run = _read(folder)
    selector = run.live.selector
    streams = _streams(run, selector)
    look = _look(run, streams)
    blocks: list[Block] = [curve_figure(streams, look, run.log.policies)]
    if HINDSIGHT in streams:
        blocks += [
            regret_figure(streams, [HINDSIGHT], look),
            penalty_figure(streams, run.weights, look, np.arange(len(run.chosen))[None], units_of(run.log)),
        ]
    blocks += [_propensities(run), _chosen_table(run, selector), *([changes_table(run.live, run.weights)] if run.live.changes else [])]
    if any(decision.reward is not None for decision in run.decisions):
        blocks.append(off_policy_table(evaluate(run.live, run.weights)))
    sections = [*warnings_section(folder), Section("curves", "Learning", blocks), *encoder_section(folder), *run_budget(folder, run.decisions)]
    sections += [*monitor_sections(run.live, run.weights), *robots_sections(run.live, run.weights, budget // 2)]
    try:
        sections += log_sections(run.log, run.weights)[0]
    except DataError as error:  # a run without counterfactual knows too little for some tables
        sections.append(Section("policies", "Policies", [f"Not looked at: {error}."]))
    decisions = f"{len(run.decisions)} decision" + ("s" if len(run.decisions) != 1 else "")
    title = f"{few(sorted(set(run.log.labels('task'))))}: {selector} over {decisions}"
    chosen = Chosen(selector, np.arange(len(run.chosen))[None], run.chosen[None], " of this run")
    routes = route_figure(run.log, run.weights, chosen)
    episodes = _episodes(run, scenes(run.log), beside or folder)
    return Page("Live run", title, _verdict(run, selector, streams, budget), sections, _facts(run), episodes, routes)


def run_curve(folder: Path) -> Figure:
    """The learning curve of a live run's folder, as its page has it.

    Raises:
        DataError: no run there, or no decision in it.
    """
    run = _read(folder)
    streams = _streams(run, run.live.selector)
    return curve_figure(streams, _look(run, streams), run.log.policies)


@dataclass(frozen=True)
class _Run:
    """A live run: its journal, its outcomes as arrays, its reward."""

    folder: Path
    live: LiveLog
    decisions: Sequence[Decision]
    weights: RewardWeights

    @property
    def log(self) -> LoggedOutcomes:
        return self.live.outcomes

    @property
    def chosen(self) -> NDArray[np.int64]:
        return self.live.chosen

    @property
    def configuration(self) -> Mapping[str, Any]:
        return self.log.metadata


def _read(folder: Path) -> _Run:
    live = read_live(folder)
    return _Run(folder, live, live.decisions, RewardWeights(**live.reward))


def _streams(run: _Run, selector: str) -> dict[str, Stream]:
    """The selector, and where every policy ran in a decision what each would have received there, and the best of them."""
    rows, log = np.arange(len(run.chosen)), run.log
    rewards = log.mean_rewards(run.weights)
    tables = _tables(log, run.weights)

    def stream(received: Array, chosen: NDArray[np.int64] | None = None) -> Stream:
        reward, success, own, lost, seconds, price = received[:, None, :]
        return Stream(reward, success, own, lost, seconds, price, chosen)

    streams = {selector: stream(_tables(run.live.received, run.weights)[:, rows, run.chosen], run.chosen[None])}
    complete = np.isfinite(rewards).all(axis=1)
    if complete.any() and len(log.policies) > 1:
        for column, policy in enumerate(log.policies):
            streams[f"always {policy}"] = stream(np.where(complete, tables[:, :, column], np.nan))
        best = np.where(complete, np.nan_to_num(rewards, nan=-np.inf).argmax(axis=1), 0)
        streams[HINDSIGHT] = stream(np.where(complete, tables[:, rows, best], np.nan))
    return streams


def _tables(log: LoggedOutcomes, weights: RewardWeights) -> Array:
    """(6, T, P): reward, success, what the reward credits, what it takes off for time and price, seconds, cents."""
    rewards, score = log.mean_rewards(weights), score_of(log, weights)[:, :, 0]
    return np.stack([rewards, log.success[:, :, 0], score, score - rewards, log.seconds[:, :, 0], log.price[:, :, 0]])


def _look(run: _Run, streams: Mapping[str, Stream]) -> Look:
    return look_of(list(streams), run.log.policies, {f"always {policy}": policy for policy in run.log.policies})


def _propensities(run: _Run) -> Figure:
    at = thinned(len(run.decisions))
    propensities = run.live.propensities
    lines = [Line(policy, propensities[at, column]) for column, policy in enumerate(run.log.policies)]
    panel = curves("", at + 1, lines, Look(colours(run.log.policies)), ("decision", "propensity"), (-0.02, 1.02))
    caption = "Probability with which the selector would choose each policy, as it stood when it decided. Off-policy estimates build on these."
    last = [f"{policy} {value:.2f}" for policy, value in zip(run.log.policies, propensities[-1], strict=True)]
    text = f"Curves of the probability with which each policy would be chosen. In the last decision: {listed(last)}."
    return Figure("propensities", "How sure the selector is", caption, text, [panel])


def _chosen_table(run: _Run, selector: str) -> Table:
    log, rows = run.live.received, []
    rewards = log.mean_rewards(run.weights)
    parts = [(selector, np.ones(len(run.chosen), bool)), *((f"chose {name}", run.chosen == column) for column, name in enumerate(log.policies))]
    for name, mine in parts:
        at = np.flatnonzero(mine), run.chosen[mine]
        row: dict[str, Cell] = {
            **{"who": name, "decisions": int(mine.sum())},
            **{flag: int(getattr(log, flag)[at].sum()) for flag in FLAGS},
            **{"success": rate_of(log.success[at]), "reward": mean_of(rewards[at])},
            **{key: mean_of(values[at]) for key, values in (("steps", log.steps), ("seconds", log.seconds), ("price", log.price))},
        }
        rows.append(row)
    columns = [
        *(Column("who", "", "text"), Column("decisions", "decisions"), Column("errors", "errors"), *FALLBACKS),
        *(Column("success", "success", "percent"), Column("reward", "mean reward", digits=3)),
        *(Column("steps", "steps", digits=0), Column("seconds", "seconds"), Column("price", "price (cents)", digits=None)),
    ]
    caption = f"What was received, with 95% intervals; errors are no failures and count nowhere else. {CREDIT}"
    return Table("chosen", "What the selector received", caption, columns, rows)


def _verdict(run: _Run, selector: str, streams: dict[str, Stream], budget: int) -> Verdict:
    own = streams[selector]
    reward, success = mean_of(own.reward), rate_of(own.success.T)
    rate = f"95% [{100 * success.low:.0f}, {100 * success.high:.0f}]" if success else ""
    tiles = [
        Tile("mean reward", f"{reward.value:.3f}" if reward else "\u2013", f"95% {interval(reward)}" if reward else ""),
        Tile("success", f"{100 * success.value:.0f}%" if success else "\u2013", rate),
        *_mean_tiles(own),
    ]
    hint = [] if is_recommended(selector) else [f"{RECOMMENDATION}."]
    if HINDSIGHT not in streams:
        sentence = "What the other policies would have done is not known: run with --counterfactual to compare."
        return Verdict(f"{selector} received {reward.value:.3f} a decision" if reward else f"{selector} received nothing", [sentence, *hint], tiles)
    found = answer(run.log, run.weights, budget)
    compared = _compared(run, selector, streams)
    if found is None or compared is None:
        return Verdict(f"{selector} cannot be compared", ["No decision has an outcome of both what was chosen and every other policy.", *hint], tiles)
    return shown_verdict(found, [*compared, *hint], tiles)


def _compared(run: _Run, selector: str, streams: Mapping[str, Stream]) -> list[str] | None:
    """How the run's own selector did against the best single policy, where both are known; None where that is nowhere."""
    own, fixed = streams[selector], {name: stream for name, stream in streams.items() if name.startswith("always ")}
    both = np.isfinite(own.reward) & np.isfinite(next(iter(fixed.values())).reward)
    if not both.any():
        return None
    best = max(fixed, key=lambda name: float(fixed[name].reward[both].mean()))
    differences = (own.reward - fixed[best].reward)[both]
    span = float(np.ptp(run.log.rewards(run.weights)[np.isfinite(run.log.rewards(run.weights))]))
    low, high = advantage_bounds(differences, span, ERROR / 2.0) if span > 0.0 else (0.0, 0.0)
    number = f"{len(differences)} decision{'s' if len(differences) > 1 else ''}"
    units = in_units(f"This run's {selector}", _measures(own, both), best.removeprefix("always "), _measures(fixed[best], both))
    return [
        units,
        f"That is {signed(float(differences.mean()))} reward a decision over {number}, its learning included: between {signed(low)} and "
        f"{signed(high)} with 95% confidence, however often one looks while the run goes on.",
    ]


def _measures(stream: Stream, rows: NDArray[np.bool_]) -> dict[str, float | None]:
    def mean(values: Array) -> float | None:
        known = values[rows][np.isfinite(values[rows])]
        return float(known.mean()) if known.size else None

    seconds = mean(stream.seconds)
    return {
        "success_rate": mean(stream.success),
        "mean_price": mean(stream.price),
        "mean_seconds": seconds if seconds is not None and seconds >= FLOOR_SECONDS else None,
    }


def _mean_tiles(stream: Stream) -> list[Tile]:
    def mean(values: Array) -> float | None:
        known = values[np.isfinite(values)]
        return float(known.mean()) if known.size else None

    seconds, price = mean(stream.seconds), mean(stream.price)
    tiles = [Tile("seconds an episode", f"{seconds:.1f}")] if seconds is not None and seconds >= FLOOR_SECONDS else []
    return tiles + ([Tile("cents an episode", to_text(price, Column("", "", digits=None)))] if price is not None else [])


def _facts(run: _Run) -> list[tuple[str, str]]:
    ran_with = read_run(run.folder)["environment"]
    own = {key: value for key, value in run.configuration.items() if key not in ("reward", "content")}
    facts = [("folder", str(run.folder)), *((key, _words(value)) for key, value in own.items()), ("reward", formula(run.weights))]
    facts += [(name, str(digest)[:12]) for name, digest in dict(run.configuration.get("content") or {}).items()]
    versions = ", ".join(f"{name} {version}" for name, version in dict(ran_with.get("versions") or {}).items())
    facts += [(f"suite {name}", f"it has {cannot}") for name, cannot in dict(ran_with.get("suites") or {}).items()]
    return [*facts, ("versions", versions), ("git", str(ran_with.get("git"))), ("OpenGL", str(ran_with.get("gl")))]


def _words(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _episodes(run: _Run, scenes: Mapping[int, bytes], beside: Path) -> Episodes:
    notes = {
        (index, int(run.chosen[index]), 0): note_of(decision) for index, decision in enumerate(run.decisions) if decision.fallback or decision.error
    }
    videos = {}
    for index, decision in enumerate(run.decisions):
        file = run.folder / VIDEOS / f"{index:05d}-{decision.policy}.mp4"
        if file.is_file():
            videos[index, int(run.chosen[index])] = file
    return list_episodes(run.live.received, run.weights, run.chosen, notes, scenes, videos, beside=beside)
