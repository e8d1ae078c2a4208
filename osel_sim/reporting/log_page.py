"""The page of a rollout log, and the sections that the pages of replays and live runs share with it."""

from collections.abc import Sequence

from osel_sim.analysis.answer import answer
from osel_sim.analysis.clusters import complete_rows
from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.evaluation import evaluate
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.logged_choices import choices_of, has_choices
from osel_sim.analysis.outcomes import overall, remote_policies
from osel_sim.core.errors import DataError
from osel_sim.formats.rollout_log import Row, read_rollouts
from osel_sim.reporting.cluster_sections import Replayed, Routing, analyse, cluster_blocks, frontier_figure, weights_blocks
from osel_sim.reporting.episodes import Scenes, list_episodes, no_scenes, notes_of
from osel_sim.reporting.log_sections import context_figure, formula, policy_blocks, rates_table, time_figure
from osel_sim.reporting.off_policy_section import off_policy_table, off_policy_verdict
from osel_sim.reporting.page import Block, Page, Section, Tile, Verdict
from osel_sim.reporting.routes import route_figure
from osel_sim.reporting.verdict_tiles import shown_verdict
from osel_sim.selection.reward import RewardWeights


def log_page(log: LoggedOutcomes, weights: RewardWeights, scenes: Scenes = no_scenes, rows: Sequence[Row] | None = None) -> Page:
    """The page of a rollout log: what its policies came to, and whether there is something to route by.

    Args:
        scenes: draws how some of its instances begin.
        rows: of the log; None: read from its folder.

    Raises:
        DataError: the log lacks what the weights ask for.
    """
    sections, _ = log_sections(log, weights)
    found = evaluate(choices_of(log), weights) if has_choices(log) else None
    if found is not None:
        sections.insert(0, Section("off_policy", "Other ways of choosing", [off_policy_table(found)]))
    title = f"{few(sorted(set(log.labels('task'))))}: {len(log):,} instances, {len(log.policies)} policies"
    rows = read_rollouts(log.source)[0] if rows is None else rows
    episodes = list_episodes(log, weights, notes=notes_of(rows, log), scenes=scenes(log))
    verdict = off_policy_verdict(found) if found is not None else _verdict(log, weights)
    return Page("Rollout log", title, verdict, sections, log_facts(log, weights), episodes, route_figure(log, weights))


def log_sections(log: LoggedOutcomes, weights: RewardWeights, replayed: Replayed | None = None) -> tuple[list[Section], Routing | None]:
    """Policies, clusters, weights, frontier, contexts and times of a log; and the clusters, None where there is too little for them.

    Args:
        replayed: selectors that stand on the frontier.
    """
    policies: list[Block] = [formula(weights) + ".", *policy_blocks(log, weights)]
    routing, reason = None, ""
    several = len(log.policies) > 1
    if several:
        remote, why = remote_policies(log)
        rates = rates_table(log, remote, why)
        policies += [rates] if rates else []
        try:
            routing = analyse(log, weights, remote)
        except DataError as error:
            reason = str(error)
    times = time_figure(log)
    sections = [Section("policies", "Policies", [*policies, *([times] if times else [])])]
    if routing is not None:
        frontier = frontier_figure(log, weights, routing, replayed or Replayed())
        weighed: list[Block] = [*weights_blocks(log, weights, remote, routing), *([frontier] if frontier else [])]
        sections += [
            Section("weights", "Time, price and success", weighed),
            Section("clusters", "What the context tells", cluster_blocks(log, routing)),
        ]
    elif several:
        sections.append(Section("clusters", "What the context tells", [f"Not looked at: {reason}."]))
    contexts = context_figure(log, weights)
    if contexts is not None:
        sections.append(Section("contexts", "Contexts", [contexts]))
    return sections, routing


def log_facts(log: LoggedOutcomes, weights: RewardWeights) -> list[tuple[str, str]]:
    """What a log was made from."""
    facts = [
        *(("log", str(log.source)), ("tasks", ", ".join(sorted(set(log.labels("task"))))), *_robots(log), ("policies", ", ".join(log.policies))),
        *(("instances", f"{len(log):,}"), ("repeats", str(log.repeats)), ("encoder", log.encoder), ("reward", formula(weights))),
    ]
    return facts + [(name, digest[:12]) for name, digest in dict(log.metadata.get("content") or {}).items()]


def _robots(log: LoggedOutcomes) -> list[tuple[str, str]]:
    """Which robots there are, where it is not the usual one alone."""
    names = sorted(set(log.labels("robot")) - {""})
    return [("robots", ", ".join(names))] if names else []


def few(names: Sequence[str], most: int = 3) -> str:
    """`a, b, c and 11 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def signed(value: float, digits: int = 3) -> str:
    """`+0.012`, `−0.100`."""
    return f"{value:+.{digits}f}".replace("-", "\u2212")


def interval(estimate: Estimate) -> str:
    """`[−0.010, 0.020]`."""
    return bounds(estimate.low, estimate.high)


def bounds(low: float, high: float) -> str:
    """`[−0.010, 0.020]`."""
    return f"[{low:.3f}, {high:.3f}]".replace("-", "\u2212")


def _verdict(log: LoggedOutcomes, weights: RewardWeights) -> Verdict:
    rewards = log.mean_rewards(weights)[complete_rows(log, weights)]
    best = int(rewards.mean(axis=0).argmax())
    always = overall(log, weights)[best]  # as the table of policies has it
    reward, success = always.reward, always.success
    rate = f"95% [{100 * success.low:.0f}, {100 * success.high:.0f}]" if success else ""
    tiles = [
        Tile("best single policy", log.policies[best], f"mean reward {reward.value:.3f}, 95% {interval(reward)}" if reward else ""),
        Tile("its success", f"{100 * success.value:.0f}%" if success else "\u2013", rate),
    ]
    found = answer(log, weights)
    if found is None:
        return Verdict(
            f"There is one policy: {log.policies[best]}", ["With a second one the page says whether routing between them is worth it."], tiles
        )
    return shown_verdict(found, tiles=tiles)
