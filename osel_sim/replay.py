"""Replay a rollout log to selectors: `python -m osel_sim.replay assets/logs/pick_place`."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim import cli
from osel_sim.cli.reward_flags import add_reward_flags, weights_of
from osel_sim.core.errors import DataError, UnknownNameError, UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.engine import Setup
    from osel_sim.analysis.live import LiveLog
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.selection.reward import RewardWeights

COSTS, SKILLS = "expected_costs", "skills"
"""Settings of selectors that are told what policies cost, and what they were made for, rather than learn it."""

EXAMPLES = """examples:
  python -m osel_sim.replay assets/logs/pick_place                                   # every selector there is, 20 seeds
  python -m osel_sim.replay assets/logs/pick_place --selectors ppo ucb1 --preset waymo --out runs/ppo
  python -m osel_sim.replay assets/logs/suite --half score --selectors auto auto:warm   # without and with the outcomes of the other half beforehand
  python -m osel_sim.replay logs/mine --alpha-time 0.1 --alpha-price 0.005 --seeds 5 --decisions 500 --no-frontier   # a quick look
  python -m osel_sim.replay runs/pick_place-ppo-s0                                   # a live run: off-policy estimates from its propensities

Shows the log's instances in random orders without replacement to every selector, which sees only the outcome of its choice, and says how far each
stays from the oracles and whether routing is worth it. Fixed policies, the best and the worst of them, and the oracles are always included.
Instances on which some policy has no valid outcome are left out and counted. The result does not depend on --workers.
A log has no price lists: what policies cost, auto is told from the other half where --half is given, else from the log itself.
With --half a selector that learns off-policy can be shown all outcomes of the other half before its stream begins: auto:warm, linucb:warm ...

Once that is said and written, selectors are replayed at other weights of time and price too, for the frontier: about half as long again.

Writes into --out: replay.json, choices.npz (every choice), selectors.csv, oracles.csv, paired.csv, frontier.csv. Of a live run's folder it estimates
what each fixed policy, random choice and a linear model would have earned (off_policy.json), and replays if the run has --counterfactual outcomes."""


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = parser().parse_args(arguments)
    from osel_sim.analysis.live import is_live_run, read_live
    from osel_sim.analysis.log import read_log
    from osel_sim.formats.replay_result import check_folder

    selectors = choose_selectors(options.selectors, halved=options.half is not None)
    folder: Path = options.out or Path("runs") / f"replay-{options.log.resolve().name}"
    check_folder(folder, options.overwrite)
    if not is_live_run(options.log):
        log = read_log(options.log, options.encoder)
        _replay(options, folder, selectors, log, *weights_of(options, log.metadata))
    else:
        live = read_live(options.log, options.encoder)
        weights, preset = weights_of(options, recorded=live.reward)
        found = _off_policy(options, live, weights)
        if live.has_all_outcomes(weights):
            _replay(options, folder, selectors, live.outcomes, weights, preset, found)
        else:
            _write_off_policy(folder, found)
    print(f"written to {folder}")
    return 0


def parser() -> cli.Parser:
    """Flags of the command."""
    result = cli.Parser("replay", "Replay a rollout log to selectors: how far from the oracle is each, and is routing worth it?", EXAMPLES)
    add = result.add_argument
    add("log", type=cli.folder, metavar="LOG", help="folder of a rollout log, or of a live run")
    add("--selectors", nargs="+", metavar="NAME", help="ppo, ucb1, auto ... (default: all there are)")
    add("--policies", nargs="+", metavar="NAME", help="policies to choose from (default: all of the log)")
    add("--seeds", type=cli.positive_int, default=20, metavar="N", help="number of random orders (default: %(default)s)")
    add("--decisions", type=cli.positive_int, metavar="N", help="length of a stream (default: all instances)")
    add("--half", choices=("choose", "score"), help="only this half of the instances: one to choose settings by, the other to report (default: all)")
    add_reward_flags(result)
    add("--unknown-costs", action="store_true", help="let all selectors learn what policies cost (default: auto is told their mean cost)")
    add("--unknown-skills", action="store_true", help="do not tell auto what policies were made for (default: it is told what the log says of it)")
    add("--no-frontier", action="store_true", help="do not replay selectors at other weights of time and price as well")
    add("--encoder", metavar="NAME", help="whose contexts, where the log has several (default: the one it was recorded with)")
    add("--workers", type=cli.positive_int, default=2, metavar="W", help="processes (default: %(default)s)")
    add("--out", type=Path, metavar="DIR", help="where to write (default: runs/replay-LOG)")
    add("--overwrite", action="store_true", help="replace a replay that is in --out")
    return result


def _replay(
    options: argparse.Namespace,
    folder: Path,
    selectors: Sequence[str],
    log: "LoggedOutcomes",
    weights: "RewardWeights",
    preset: str | None,
    off_policy: "dict[str, Any] | None" = None,
) -> None:
    """Replay, write and print."""
    from tqdm import tqdm  # type: ignore[import-untyped]

    from osel_sim.analysis.engine import replay
    from osel_sim.analysis.frontier import selector_frontiers
    from osel_sim.analysis.oracles import oracles
    from osel_sim.analysis.result import build, tables, with_fixed
    from osel_sim.analysis.streams import complete_instances
    from osel_sim.cli.console import console
    from osel_sim.cli.replay_tables import print_replay
    from osel_sim.formats.replay_result import write_replay
    from osel_sim.formats.rollout_log import DECLARED
    from osel_sim.selection.skills import Skills

    if options.policies:
        log = log.only(options.policies)
    others = log
    if options.half:
        mine = log.half(options.half)
        if not mine.any():
            raise UsageError(f"--half {options.half}: none of the {len(log)} instances of {log.source} is in that half; leave the flag out")
        log, others = log.take(mine), log.take(~mine)
    log, left_out = complete_instances(log, weights)
    if left_out.instances:
        print(f"warning: {left_out.instances} instances without an outcome of every policy are left out", file=sys.stderr)
    if log.skills is None and log.metadata.get(DECLARED) and not options.unknown_skills:
        print(
            f"warning: auto is not told what policies were made for: {log.source} lacks examples of it in the contexts of {log.encoder}; "
            f"python -m osel_sim.record --resume --out {log.source} --encoder {log.encoder.partition('@')[0]} adds them",
            file=sys.stderr,
        )
    setup = _setups(log, others, selectors, options)
    here = setup(weights)
    told = here.settings.values()
    best = oracles(log, weights)
    decisions = len(log) if options.decisions is None else options.decisions
    with tqdm(total=len(selectors) * options.seeds * decisions, unit="decision", unit_scale=True, dynamic_ncols=True) as bar:
        (chosen,) = replay(log, [here], selectors, range(options.seeds), options.decisions, options.workers, bar.update)
    choices = with_fixed(chosen, best)
    result = build(log, weights, preset, choices, best, left_out, range(options.seeds))
    result["log"]["half"] = options.half
    result["off_policy"] = off_policy
    result["expected_costs"] = next((dict(settings[COSTS]) for settings in told if COSTS in settings), None)
    skills: Skills | None = next((settings[SKILLS] for settings in told if SKILLS in settings), None)
    result["skills"] = None if skills is None else {policy: list(names) for policy, names in skills.able.items()}
    write_replay(folder, result, choices, tables(result))
    print_replay(console(), result)
    learners = [name for name in selectors if name != "random"]
    if options.no_frontier or not learners:
        return
    with tqdm(desc="at other weights", unit="decision", unit_scale=True, dynamic_ncols=True) as bar:

        def show(made: int, total: int) -> None:
            bar.total = total
            bar.update(made - bar.n)

        try:
            result["frontier"] = selector_frontiers(log, setup, weights, learners, options.seeds, options.decisions, options.workers, show)
        except DataError as error:
            bar.close()
            print(f"warning: no frontier of selectors: {error}", file=sys.stderr)
            return
    write_replay(folder, result, choices, tables(result))


def _off_policy(options: argparse.Namespace, live: "LiveLog", weights: "RewardWeights") -> dict[str, Any]:
    """Estimates from a live run's propensities, printed."""
    from osel_sim.analysis.evaluation import evaluate
    from osel_sim.cli.console import console
    from osel_sim.cli.replay_tables import print_off_policy

    if options.policies or options.half:
        raise UsageError("--policies and --half are for rollout logs: a live run is evaluated as it was made")
    found = evaluate(live, weights)
    print_off_policy(console(), found)
    return found


def _write_off_policy(folder: Path, found: dict[str, Any]) -> None:
    from osel_sim.formats.replay_result import write_off_policy

    write_off_policy(folder, found)
    print("The run has the outcomes of what was chosen only, so selectors cannot be replayed on it; run it with --counterfactual for that.")


def _setups(
    log: "LoggedOutcomes", others: "LoggedOutcomes", selectors: Sequence[str], options: argparse.Namespace
) -> "Callable[[RewardWeights], Setup]":
    """Under what to replay at any weights: what selectors are told, and shown beforehand.

    Args:
        log: what is replayed.
        others: what costs are known from, and what selectors named `NAME:warm` are shown: the other half, where it is a half that is replayed.
    """
    from osel_sim.analysis.engine import Setup
    from osel_sim.analysis.warm_start import Beforehand
    from osel_sim.selection.registry import wanted_of

    def setup(weights: "RewardWeights") -> Setup:
        known: dict[str, Any] = {} if options.unknown_costs else {COSTS: others.expected_costs(weights)}
        if log.skills is not None and not options.unknown_skills:
            known[SKILLS] = log.skills
        beforehand = Beforehand(others.contexts, others.rewards(weights)) if options.half else None
        return Setup(weights, {name: wanted_of(name, known) for name in selectors}, beforehand)

    return setup


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


if __name__ == "__main__":
    sys.exit(main(None))
