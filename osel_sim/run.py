"""Run a selector live: `python -m osel_sim.run --task pick_place`."""

import argparse
import contextlib
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim import cli
from osel_sim.cli.reward_flags import add_reward_flags, weights_of
from osel_sim.core import content
from osel_sim.core.errors import OselError, UnknownNameError
from osel_sim.formats import library

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.episodes.live import LiveRun
    from osel_sim.episodes.tensorboard import TensorBoard
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.formats.task_file import TaskSpec
    from osel_sim.interface.encoder import Encoder
    from osel_sim.selection.reward import RewardWeights

SPLITS = ("train", "validation", "test")
NOISE_HELP = "standard deviation of noise on the motions of every action, in units of action; 1 is 5 cm or half a radian (default: %(default)s)"

EXAMPLES = """examples:
  python -m osel_sim.run --list                                            # tasks and policies there are
  python -m osel_sim.run --task pick_place --episodes 60 --counterfactual  # PPO, compared with what could have been
  python -m osel_sim.run --task tag:short --level 0 2 --episodes 200       # several tasks and levels, mixed
  python -m osel_sim.run --task all --level 0 2 --selector auto --encoder osel_suite --warm-start assets/logs/suite   # it has seen a log's outcomes
  python -m osel_sim.run --task pick_place --selector epsilon_greedy --video 3 --out runs/first
  python -m osel_sim.run --task pick_place --selector epsilon_greedy --video 3 --out runs/first --resume

Writes into --out: run.json (everything it depends on), episodes.jsonl (the journal), timing.jsonl (what things really took), counterfactual.jsonl,
contexts.npz, selector.safetensors, summary.json, curve.png, videos/, and report.html, the page about it, with figures/ and tables/ beside it.
Decision t is made on the instance of seed 1,000,000 * --seed + t."""


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = parser().parse_args(arguments)
    if options.list or options.json:
        from osel_sim.cli.listing import print_listing

        print_listing(options.json, options.tasks, options.policies_dir)
        return 0
    return _run(options)


def parser() -> cli.Parser:
    """Flags of the command."""
    result = cli.Parser("run", "Let a selector choose, live in simulation, which policy handles each instance, and learn from the reward.", EXAMPLES)
    add = result.add_argument
    add("--list", action="store_true", help="show tasks and policies, and leave")
    add("--json", action="store_true", help="with --list: as JSON")
    add("--task", nargs="+", default=[], metavar="NAME", help="which tasks, mixed at random: names, tag:TAG, or all")
    add("--episodes", type=cli.positive_int, default=60, metavar="N", help="number of decisions (default: %(default)s)")
    add("--policies", nargs="+", metavar="NAME", help="policies to choose from (default: all there are)")
    add("--selector", default="ppo", metavar="NAME", help="ppo, epsilon_greedy, random, fixed:POLICY ... (default: %(default)s)")
    add("--warm-start", type=cli.folder, metavar="LOG", help="rollout log whose outcomes the selector is shown first (auto, linucb, thompson ...)")
    add("--seed", type=cli.non_negative_int, default=0, help="of instances and selector (default: %(default)s)")
    add(
        "--level", type=cli.non_negative_int, nargs="+", default=[0], help="how hard scenes are perturbed, 0 to 3; several mix at random (default: 0)"
    )
    add("--axis", action="append", default=[], metavar="AXIS=LEVEL", help="one axis at a level of its own, such as camera=2; repeatable")
    add("--action-noise", type=cli.non_negative_float, default=0.0, metavar="S", help=NOISE_HELP)
    add("--split", choices=SPLITS, default="test", help="which instances (default: %(default)s)")
    add("--encoder", metavar="NAME", help="osel_small (default), osel_suite, MODEL:TAG of open_clip such as ViT-L-14:openai, MODEL:FILE, or a folder")
    add_reward_flags(result, live=True)
    add("--out", type=Path, metavar="DIR", help="where to write (default: runs/TASK-SELECTOR-sSEED)")
    add("--resume", action="store_true", help="go on with the run in --out")
    add("--video", type=cli.non_negative_int, default=0, metavar="K", help="film K decisions, spread evenly over the run (default: none)")
    add("--counterfactual", action="store_true", help="run the other policies as well, from the same state, to compare (nothing is learnt from them)")
    add("--tensorboard", action="store_true", help="also write TensorBoard event files (needs the package tensorboard)")
    add("--realtime", action="store_true", help="sleep so that the robot moves in real time")
    add("--tasks", type=cli.folder, metavar="DIR", help="folder with task files of your own")
    add("--policies-dir", type=cli.folder, metavar="DIR", help="folder with policy files of your own")
    return result


def _run(options: argparse.Namespace) -> int:
    from osel_sim.episodes.drivers import choose_policies, with_fallbacks
    from osel_sim.formats.levels import parse_axes, resolve, split_off
    from osel_sim.formats.run_config import check_folder, environment, start_or_resume

    if options.tensorboard:
        from osel_sim.episodes.tensorboard import check_installed

        check_installed()
    tasks = library.select_tasks(options.task, options.tasks)
    policies = choose_policies(options.policies, options.policies_dir)
    everyone = with_fallbacks(policies, options.policies_dir)
    weights = weights_of(options)[0]
    _check_selector(options.selector, [spec.name for spec in policies], warm=options.warm_start is not None)
    folder = (
        options.out
        or Path("runs") / f"{'-'.join(name.replace(':', '-') for name in options.task)}-{options.selector.replace(':', '-')}-s{options.seed}"
    )
    axes = parse_axes(options.axis)
    above = sorted(
        {label for label in (split_off(resolve(level, axes, task.axes, task.name))[1] for task in tasks for level in options.level) if label}
    )
    configuration = _configuration(options, above, tasks, policies, everyone, weights)
    check_folder(folder, configuration, options.resume)

    from osel_sim.context.encoder import DEFAULT_ENCODER, load_encoder
    from osel_sim.sim.gl import choose_backend

    encoder = load_encoder(options.encoder or DEFAULT_ENCODER)
    configuration["encoder"] = encoder.identity
    seen = _log(options.warm_start, encoder.identity, policies) if options.warm_start else None
    ran_with = environment(choose_backend(), content.root())

    import torch

    from osel_sim.context.cache import ContextCache
    from osel_sim.episodes.drivers import Drivers
    from osel_sim.episodes.live import LiveOptions, LiveRun
    from osel_sim.selection.registry import make_selector
    from osel_sim.sim.task_envs import TaskEnvs

    # The last bits of a matrix product depend on the number of threads; one, so that a run does not depend on how many there are.
    torch.set_num_threads(1)
    known = _declared(options.selector, tasks, policies, weights, encoder, options.tasks)
    if "skills" in known:
        configuration["skills"] = known["skills"].digest if known["skills"] is not None else None
    selector = make_selector(options.selector, [spec.name for spec in policies], encoder.dimension, options.seed, **known)
    print(f"{_title(tasks)}: loading {', '.join(spec.name for spec in everyone)}, starting servers ...", file=sys.stderr)
    with contextlib.ExitStack() as stack:
        drivers = stack.enter_context(Drivers(everyone))
        envs = stack.enter_context(contextlib.closing(TaskEnvs(tasks)))
        # Only now, when all that could be missing is there, is the folder taken into use.
        for warning in start_or_resume(folder, configuration, ran_with, options.resume):
            print(f"warning: {warning}", file=sys.stderr)
        live_options = LiveOptions(
            options.seed, tuple(options.level), options.split, options.counterfactual, _filmed(options), options.realtime, axes, options.action_noise
        )
        live = LiveRun(folder, tasks, envs, encoder, ContextCache(folder), drivers, selector, weights, live_options)
        stack.callback(live.close)
        if seen is not None:
            _start_warm(live, seen, options.episodes, options.seed)
        live.replay()
        board = None
        if options.tensorboard:
            from osel_sim.episodes.tensorboard import TensorBoard

            board = stack.enter_context(TensorBoard(folder))
            board.update(live)
        interrupted = _decide_all(live, options.episodes, board)
    _report(live, options.selector)
    return cli.INTERRUPTED if interrupted else 0


def _decide_all(live: "LiveRun", episodes: int, board: "TensorBoard | None") -> bool:
    """Make all decisions, with a progress bar. Returns whether Ctrl-C ended it: the decision at hand is finished first."""
    from tqdm import tqdm  # type: ignore[import-untyped]

    interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("\nfinishing this decision; Ctrl-C again leaves at once", file=sys.stderr)

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        with tqdm(total=episodes, initial=len(live.decisions), unit="episode", dynamic_ncols=True) as bar:
            while len(live.decisions) < episodes and not interrupted:
                live.decide()
                if board is not None:
                    board.update(live)
                bar.set_postfix_str(_progress(live), refresh=False)
                bar.update()
    finally:
        signal.signal(signal.SIGINT, before)
    return interrupted


def _progress(live: "LiveRun") -> str:
    decisions = live.decisions
    rewards = [decision.reward for decision in decisions if decision.reward is not None]
    successes = [decision.success for decision in decisions if decision.error is None]
    shares = (f"{name} {100 * sum(decision.policy == name for decision in decisions) / len(decisions):.0f}%" for name in live.selector.policies)
    mean = (f"reward {sum(rewards) / len(rewards):.3f}, success {100 * sum(successes) / len(successes):.0f}%",) if rewards else ()
    return ", ".join((*mean, *shares))


def _report(live: "LiveRun", selector: str) -> None:
    """Write summary, curve, page and the selector's state, and print the table."""
    from osel_sim.cli.console import console, run_table
    from osel_sim.core.files import write_json
    from osel_sim.formats.summary import summarise
    from osel_sim.reporting.page import write_page
    from osel_sim.reporting.run_page import run_page
    from osel_sim.selection.state import save_state

    if not live.decisions:
        print("no decision was made", file=sys.stderr)
        return
    policies = live.selector.policies
    chosen = [policies.index(decision.policy) for decision in live.decisions]
    summary = {"task": _title(live.tasks), **summarise(live.decisions, policies, selector)}
    if live.options.counterfactual:
        summary |= _comparison(live, chosen)
    write_json(live.folder / "summary.json", summary)
    save_state(live.selector.state_dict(), live.folder / "selector.safetensors")
    console().print(run_table(summary))
    for decision in [decision for decision in live.decisions if decision.error][:3]:
        print(f"error in episode {decision.index}: {decision.error}", file=sys.stderr)
    try:
        write_page(run_page(live.folder), live.folder)
        shutil.copyfile(live.folder / "figures" / "curves.png", live.folder / "curve.png")  # what one looks for first
    except OselError as problem:  # the run itself is complete; python -m osel_sim.report tries again
        print(f"warning: no report.html: {problem}", file=sys.stderr)
        print(f"written to {live.folder}")
    else:
        print(f"written to {live.folder}; report.html shows it")


def _comparison(live: "LiveRun", chosen: list[int]) -> dict[str, Any]:
    """What could have been, over the decisions in which every policy has a reward."""
    import numpy as np

    from osel_sim.selection.oracle import compare

    rewards, policies = live.rewards, live.selector.policies
    complete = np.isfinite(rewards).all(axis=1)
    if not complete.any():
        return {}
    result = compare(rewards, chosen)
    return {
        "compared_decisions": result.instances,
        "best_single": result.best_single_reward,
        "best_single_policy": policies[result.best_single],
        "hindsight_oracle": result.hindsight_oracle,
        "regret": result.regret,
        "always": dict(zip(policies, rewards[complete].mean(axis=0).tolist(), strict=True)),
    }


def _declared(
    selector: str, tasks: "list[TaskSpec]", policies: "list[PolicySpec]", weights: "RewardWeights", encoder: "Encoder", extra: Path | None
) -> dict[str, Any]:
    """Settings by which a selector is told what policies declare, as far as it wants to know: what they cost, and what they were made for.

    Args:
        extra: folder with the user's own task files.
    """
    from osel_sim.episodes.declared_skills import declare
    from osel_sim.episodes.expected_costs import expected_costs
    from osel_sim.selection.registry import setting_names

    wanted, known = setting_names(selector), dict[str, Any]()
    if "expected_costs" in wanted:
        # Half of the horizon is about what a success takes; how costs differ from task to task is learned.
        actions = sum(task.horizon for task in tasks) // (2 * len(tasks))
        known["expected_costs"] = expected_costs(policies, weights, max(1, actions))
    if "skills" in wanted:
        known["skills"] = declare(policies, encoder, tasks, extra)
    return known


def _log(folder: Path, encoder: str, policies: "list[PolicySpec]") -> "LoggedOutcomes":
    """The rollout log of a warm start."""
    from osel_sim.analysis.log import read_log

    return read_log(folder, encoder).only([spec.name for spec in policies])


def _start_warm(live: "LiveRun", log: "LoggedOutcomes", episodes: int, seed: int) -> None:
    """Show the selector the outcomes of a rollout log, except those of instances that this run decides on."""
    from osel_sim.analysis.warm_start import Beforehand, show

    own = live.instance_keys(episodes)
    log = log.take([row for row, key in enumerate(log.keys) if key not in own])
    count = show(live.selector, Beforehand(log.contexts, log.rewards(live.weights)), live.selector.policies, seed)
    print(f"shown beforehand: {count} outcomes of {len(log)} instances of {log.source}, none of them of this run", file=sys.stderr)


def _check_selector(name: str, policies: list[str], warm: bool) -> None:
    """Refuse an unknown selector before anything heavy is loaded."""
    from osel_sim.selection.registry import selector_locations

    kind, _, policy = name.partition(":")
    if kind not in selector_locations():
        raise UnknownNameError("selector", name, selector_locations(), "fixed:POLICY for always the same one")
    if kind == "fixed" and policy not in policies:
        raise UnknownNameError("policy", policy, policies, "give --selector fixed:POLICY")
    if warm:
        from osel_sim.analysis.warm_start import check_can_start_warm

        check_can_start_warm(kind)


def _title(tasks: "Sequence[TaskSpec]") -> str:
    return tasks[0].name if len(tasks) == 1 else f"{len(tasks)} tasks"


def _filmed(options: argparse.Namespace) -> frozenset[int]:
    """Indices of the decisions to film: the first, the last, and evenly between."""
    count = min(options.video, options.episodes)
    if count == 1:
        return frozenset({0})
    return frozenset(round(number * (options.episodes - 1) / (count - 1)) for number in range(count))


def _configuration(
    options: argparse.Namespace,
    above: list[str],
    tasks: "list[TaskSpec]",
    policies: "list[PolicySpec]",
    everyone: "list[PolicySpec]",
    weights: "RewardWeights",
) -> dict[str, Any]:
    """Everything the journal depends on but the encoder, content of files included. `above`: axes at levels of their own."""
    from dataclasses import asdict

    from osel_sim.core.files import digest
    from osel_sim.formats.rollout_log import ROLLOUTS
    from osel_sim.formats.run_config import content_digests

    warm = {"warm_start": digest(options.warm_start / ROLLOUTS)} if options.warm_start else {}
    return {
        "tasks": [task.name for task in tasks],
        "episodes": options.episodes,
        "policies": [spec.name for spec in policies],
        "selector": options.selector,
        "seed": options.seed,
        "levels": options.level,
        "axes": above,
        "action_noise": options.action_noise,
        "split": options.split,
        "reward": asdict(weights),
        "counterfactual": options.counterfactual,
        "content": {**content_digests(tasks, everyone), **warm},
    }


if __name__ == "__main__":
    sys.exit(main(None))
