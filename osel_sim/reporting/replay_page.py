"""The page of a replay."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from osel_sim.analysis.clusters import score_of
from osel_sim.analysis.frontier import measured
from osel_sim.analysis.live import is_live_run, read_live
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats, read_log
from osel_sim.analysis.measures import curves
from osel_sim.analysis.oracles import oracles
from osel_sim.analysis.units import units_of
from osel_sim.context.appended import TASK_NAME
from osel_sim.core.errors import DataError, UsageError
from osel_sim.formats.replay_result import CHANGES, PENDING, REPLAY, Choices, read_replay
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.reporting.budget_section import replay_budget
from osel_sim.reporting.changing_page import changing_page, reward_figure
from osel_sim.reporting.charts import Figure, Look
from osel_sim.reporting.cluster_sections import Replayed
from osel_sim.reporting.episodes import Scenes, list_episodes, no_scenes, notes_of
from osel_sim.reporting.log_page import bounds, few, log_facts, log_sections, signed
from osel_sim.reporting.off_policy_section import off_policy_table
from osel_sim.reporting.page import Block, Episodes, Page, Section, Tile, Verdict
from osel_sim.reporting.replay_tables import SINGLES, gaps, oracle_table, paired_tables, selector_table
from osel_sim.reporting.routes import Chosen, route_figure
from osel_sim.reporting.selector_sections import (
    MAIN,
    ORACLES,
    Stream,
    curve_figure,
    gap_figure,
    look_of,
    penalty_figure,
    regret_figure,
    share_figure,
)
from osel_sim.reporting.sharing_section import sharing_sections
from osel_sim.reporting.verdict_tiles import TONES, gain_tiles
from osel_sim.selection.reward import RewardWeights

_MOST_PICKS, _MOST_SHOWN = 4, 3
"""Selectors whose choices are told of each episode, and how many of the best are drawn without being asked for."""


@dataclass(frozen=True)
class ReplayOptions:
    """What a replay's page can show besides what lies in its folder.

    Attributes:
        log: where the rollout log now lies; None: where it was when it was replayed.
        scenes: draws how some of its instances begin.
    """

    log: Path | None = None
    scenes: Scenes = no_scenes


def replay_page(folder: Path, options: ReplayOptions) -> Page:
    """The page of a replay's folder.

    Raises:
        DataError: no replay there, or its log is missing or is another one.
    """
    with _promised_form(folder):
        if (changing := _changing(folder, options.log)) is not None:
            return changing_page(folder, *changing)
        return _page(_read(folder, options.log), options.scenes)


def replay_curve(folder: Path) -> Figure:
    """The learning curves of a replay's folder, as its page has them.

    Raises:
        DataError: no replay there, or its log is missing or is another one.
    """
    with _promised_form(folder):
        if (changing := _changing(folder, None)) is not None:
            return reward_figure(changing[0])
        replay = _read(folder, None)
        return curve_figure(replay.streams, replay.look)


def _changing(folder: Path, log_folder: Path | None) -> tuple[Mapping[str, Any], LoggedOutcomes, RewardWeights] | None:
    """The result of a replay whose streams change, its log and the weights of the reward; None of any other."""
    result, choices = read_replay(folder)
    if CHANGES not in result:
        return None
    return result, _log(folder, result, choices, log_folder), _weights(result)


def _weights(result: Mapping[str, Any]) -> RewardWeights:
    return RewardWeights(**{key: value for key, value in result["reward"].items() if key != "preset"})


@dataclass(frozen=True)
class _Replay:
    """What lies in a replay's folder, and what follows from it.

    Attributes:
        log: the instances of the choices, in their order.
        names: selector -> what it is called on the page.
        streams: what each selector and oracle received, by its name on the page.
        learnable: oracle that bounds what can be learned, by its name on the page.
    """

    folder: Path
    result: Mapping[str, Any]
    choices: Choices
    log: LoggedOutcomes
    weights: RewardWeights
    names: Mapping[str, str]
    streams: Mapping[str, Stream]
    look: Look
    learnable: str

    @property
    def learners(self) -> dict[str, str]:
        """Selectors that are no fixed policies, with their names on the page."""
        return {name: shown for name, shown in self.names.items() if not name.startswith("fixed:")}


@contextmanager
def _promised_form(folder: Path) -> Iterator[None]:
    try:
        yield
    except (KeyError, TypeError, IndexError) as error:
        raise DataError(f"{folder / REPLAY}: does not have the promised form ({error!r})") from None


def _read(folder: Path, log_folder: Path | None) -> _Replay:
    result, choices = read_replay(folder)
    log = _log(folder, result, choices, log_folder)
    weights = _weights(result)
    names = _names(result)
    streams = _streams(log, weights, choices, names)
    always = {shown: name.removeprefix("fixed:") for name, shown in names.items() if name.startswith("fixed:")}
    learnable = ORACLES.get(result["learnable_oracle"]["name"], "")
    keep = {*_ends(result, names), *(names[name] for name in _learners(result)[:_MOST_SHOWN])}
    look = look_of(list(streams), log.policies, always, keep, learnable)
    return _Replay(folder, result, choices, log, weights, names, streams, look, learnable)


def _page(replay: _Replay, scenes: Scenes) -> Page:
    result, choices, log, names, streams = replay.result, replay.choices, replay.log, replay.names, replay.streams
    weights, look, learners = replay.weights, replay.look, replay.learners
    selectors: list[Block] = [curve_figure(streams, look), selector_table(result, names)]
    gap = gap_figure({names[name]: gaps(entry) for name, entry in result["selectors"].items() if entry["kind"] == "learner"}, replay.learnable)
    regret = regret_figure(streams, [*_ends(result, names)[:1], *(word for word in ORACLES.values() if word in streams)], look)
    shares = share_figure({shown: streams[shown] for shown in learners.values()}, log.policies, look)
    penalty = penalty_figure(streams, weights, look, choices.order, units_of(log))
    selectors += [block for block in (gap, regret, penalty, shares) if block is not None]
    selectors += [oracle_table(result), *paired_tables(result, names)]
    selectors += [off_policy_table(result["off_policy"])] if result.get("off_policy") else []
    shared, _ = log_sections(log, weights, Replayed(_points(log, weights, choices, learners), result.get("frontier"), look))
    title = f"{few(result['log']['tasks'])}: {len(learners)} selectors over {choices.order.shape[1]:,} decisions, {len(choices.order)} seeds"
    title += f" so far; still being replayed: {few(result[PENDING])}" if result.get(PENDING) else ""
    who = _speaker(result)
    routes = route_figure(log, weights, _chosen(choices, who, names) if who in names else None)
    sections = [Section("selectors", "Selectors", selectors), *replay_budget(result.get("budget")), *sharing_sections(result), *shared]
    facts, episodes = _facts(replay.folder, result, log, weights), _episodes(log, weights, choices, names, look, scenes(log))
    return Page("Replay", title, _verdict(result), sections, facts, episodes, routes)


def _speaker(result: Mapping[str, Any]) -> str:
    """The selector that the verdict is about; where it names none, the best one that learns; empty where none does."""
    found, learners = result["verdict"].get("selector") or result["verdict"]["stake"].get("selector"), _learners(result)
    return str(found or "") if found in learners or not learners else learners[0]


def _learners(result: Mapping[str, Any]) -> list[str]:
    """Selectors that learn, the best first."""
    entries = result["selectors"]
    return sorted((name for name in entries if entries[name]["kind"] == "learner"), key=lambda name: -float(entries[name]["mean_reward"]))


def _chosen(choices: Choices, who: str, names: Mapping[str, str]) -> Chosen:
    """Whom it chose in the last quarter of its streams, once it has learnt."""
    late = slice(choices.order.shape[1] * 3 // 4, None)
    columns = choices.chosen[who][:, late].astype(np.int64)
    return Chosen(names[who], choices.order[:, late].astype(np.int64), columns, f" in the last quarter of its {len(choices.order)} streams")


def _log(folder: Path, result: Mapping[str, Any], choices: Choices, log_folder: Path | None) -> LoggedOutcomes:
    """The replayed instances, in the order of the choices."""
    source = log_folder or Path(result["log"]["folder"])
    if not source.is_dir():
        raise UsageError(f"the log {source} that {folder} was replayed from is not there; give its folder with --log")
    encoder = result["log"]["encoder"]
    if result["log"].get("context"):
        encoder = encoder.removesuffix(TASK_NAME)  # appended when it was replayed, and not in the log
    log = (read_live(source, encoder).outcomes if is_live_run(source) else read_log(source, encoder)).only(choices.policies)
    row = {key: index for index, key in enumerate(log.keys)}
    missing = [key for key in choices.instances if key not in row]
    if missing:
        raise DataError(f"{source}: {len(missing)} instances of {folder / REPLAY} are not in this log, the first of them {missing[0]!r}")
    return log.take([row[key] for key in choices.instances])


def _names(result: Mapping[str, Any]) -> dict[str, str]:
    """Selector -> what it is called on the page; the best and the worst single policy are fixed policies under a second name, and left out."""
    entries = result["selectors"]
    role = {entries[name]["policy"]: word for name, word in zip(SINGLES, ("best single", "worst single"), strict=True) if name in entries}

    def shown(name: str) -> str:
        policy = name.removeprefix("fixed:")
        if policy == name:
            return name
        return f"always {policy}" + (f" ({role[policy]})" if policy in role else "")

    return {name: shown(name) for name in entries if name not in SINGLES}


def _ends(result: Mapping[str, Any], names: Mapping[str, str]) -> list[str]:
    """The best and the worst single policy as the page calls them."""
    return [names[f"fixed:{result['selectors'][name]['policy']}"] for name in SINGLES if name in result["selectors"]]


def _streams(log: LoggedOutcomes, weights: RewardWeights, choices: Choices, names: Mapping[str, str]) -> dict[str, Stream]:
    """What every selector and oracle received in each decision: of a policy, the mean over its repeats on the instance."""
    rewards = log.rewards(weights)
    score = score_of(log, weights)
    tables = (rewards, log.success, score, score - rewards, log.seconds, log.price)
    means = [mean_over_repeats(table) for table in tables]
    streams = {}
    for name, shown in names.items():
        chosen = choices.chosen[name].astype(np.int64)
        reward, success, own, penalty, seconds, price = (table[choices.order, chosen] for table in means)
        streams[shown] = Stream(reward, success, own, penalty, seconds, price, chosen)
    found = curves(log, weights, choices, oracles(log, weights))
    nothing = np.full(choices.order.shape, np.nan)
    for name, shown in ORACLES.items():
        if name == "hindsight":
            drawn = [choices.outcomes(table) for table in tables]
            best = np.nan_to_num(drawn[0], nan=-np.inf).argmax(axis=2)[:, :, None]
            reward, success, own, penalty, seconds, price = (np.take_along_axis(table, best, axis=2)[:, :, 0] for table in drawn)
            streams[shown] = Stream(reward, success, own, penalty, seconds, price)
        elif name in found.oracles:
            streams[shown] = Stream(found.oracles[name], *[nothing] * 5)
    return streams


def _points(log: LoggedOutcomes, weights: RewardWeights, choices: Choices, names: Mapping[str, str]) -> dict[str, dict[str, float]]:
    """What each selector came to over the last quarter of its streams, once it has learnt."""
    late = slice(choices.order.shape[1] * 3 // 4, None)
    found: dict[str, dict[str, float]] = {}
    for name, shown in names.items():
        received = {key: choices.received(name, table)[:, late] for key, table in measured(log, weights).items()}
        found[shown] = {key: float(np.nanmean(values)) for key, values in received.items() if np.isfinite(values).any()}
    return found


def _verdict(result: Mapping[str, Any]) -> Verdict:
    found = result["verdict"]
    if result["schema_version"] == 1:
        return _first_verdict(result)
    single = result["oracles"]["best_single"]
    tiles = [Tile("best single policy", found["policy"], f"mean reward {single['mean_reward']:.3f}"), *gain_tiles(found), _learnable(found["stake"])]
    return Verdict(found["headline"], found["sentences"], tiles, TONES[found["decision"]])


def _first_verdict(result: Mapping[str, Any]) -> Verdict:
    """Of a replay of version 1, in whose words it was."""
    found = result["verdict"]
    route = found["decision"] == "route"
    headline = f"Route with {found['selector']}" if route else f"Do not route: always use {found['policy']}"
    tiles = [Tile("best single policy", found["policy"], f"mean reward {result['oracles']['best_single']['mean_reward']:.3f}")]
    return Verdict(headline, [str(found["text"])], tiles, "good" if route else "neutral")


def _learnable(stake: Mapping[str, Any]) -> Tile:
    """What could be gained at most."""
    name, ends = stake["learnable_oracle"], stake.get("learnable_gain_ci95")
    if name is None:
        return Tile("learnable gain", "not known", "selectors earned more than the oracles")
    oracle = f"reward a decision: {ORACLES[name]}" + (f", {bounds(*ends)}" if ends else "")
    return Tile("learnable gain", "no gap to close" if ends and ends[0] <= 0.0 else signed(stake["learnable_gain"]), oracle)


def _facts(folder: Path, result: Mapping[str, Any], log: LoggedOutcomes, weights: RewardWeights) -> list[tuple[str, str]]:
    left_out = result["log"]["left_out"]["instances"]
    own = [("replay", str(folder)), ("seeds", str(len(result["seeds"]))), ("decisions a seed", f"{result['decisions']:,}")]
    own += [("instances left out", f"{left_out:,} without an outcome of every policy")] if left_out else []
    own += [("half of the instances", str(result["log"]["half"]))] if result["log"].get("half") else []
    told = [("what policies cost", result.get("expected_costs")), ("what they were made for", result.get("skills"))]
    own += [("told to auto beforehand", ", ".join(what for what, known in told if known is not None) or "nothing")]
    return [*own, ("preset", str(result["reward"].get("preset"))), *log_facts(log, weights)]


def _episodes(
    log: LoggedOutcomes, weights: RewardWeights, choices: Choices, names: Mapping[str, str], look: Look, scenes: Mapping[int, bytes]
) -> Episodes:
    rows = [] if is_live_run(log.source) else read_rollouts(log.source)[0]
    learners = [name for name in names if not name.startswith("fixed:") and name != "random"]
    kept: Sequence[str] = sorted(learners, key=lambda name: (name not in MAIN, names[name] in look.hidden))[:_MOST_PICKS]
    return list_episodes(log, weights, notes=notes_of(rows, log), scenes=scenes, picks={names[name]: _picks(choices, name) for name in kept})


def _picks(choices: Choices, name: str) -> Array:
    """In which share of its decisions each policy was chosen for each instance, (N, P); NaN for instances that no stream showed."""
    count = np.zeros((len(choices.instances), len(choices.policies)))
    np.add.at(count, (choices.order.ravel(), choices.chosen[name].ravel()), 1.0)
    total = count.sum(axis=1, keepdims=True)
    return np.where(total > 0, count / np.maximum(total, 1.0), np.nan)
