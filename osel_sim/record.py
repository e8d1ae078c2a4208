"""Record outcomes of every policy on the same instances: `python -m osel_sim.record --task pick_place --instances 200 --out logs/mine`."""

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim import cli, content
from osel_sim.errors import DataError, OselError, UsageError
from osel_sim.run import DEFAULT_PRESET, NOISE_HELP, SPLITS

if TYPE_CHECKING:
    from osel_sim.formats.shards import Shards
    from osel_sim.runtime.workers import Plan

EXAMPLES = """examples:
  python -m osel_sim.record --task pick_place --instances 200 --out logs/mine
  python -m osel_sim.record --task pick_place --instances 200 --out logs/mine --resume     # go on after an interruption
  python -m osel_sim.record --task pick_place --instances 50 --repeats 4 --workers 8 --policies local_small --out logs/small
  python -m osel_sim.record --task all --instances 300 --level 0 1 2 3 --repeats 3 --repeat-every 10 --out logs/suite
  python -m osel_sim.record --summary logs/mine                                            # print the tables of a log again

Writes into --out: run.json, rollouts.parquet (a row an episode) and contexts.npz. Every policy starts from the same state of the same instance. The
files do not depend on the number of workers, nor on interruptions."""


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = parser().parse_args(arguments)
    if options.summary is not None:
        _print_summary(options.summary)
        return 0
    return _record(options)


def parser() -> cli.Parser:
    """Flags of the command."""
    result = cli.Parser("record", "Run every policy on the same instances and write the outcomes to a rollout log.", EXAMPLES)
    add = result.add_argument
    add("--task", nargs="+", default=[], metavar="NAME", help="which tasks: names, tag:TAG, or all")
    add("--instances", type=cli.positive_int, default=200, metavar="N", help="number of instances of each task (default: %(default)s)")
    add("--repeats", type=cli.positive_int, default=1, metavar="R", help="episodes of each policy on an instance (default: %(default)s)")
    add("--repeat-every", type=cli.positive_int, default=1, metavar="K", help="repeat on one in K instances of each level only (default: on all)")
    add("--workers", type=cli.positive_int, default=2, metavar="W", help="processes (default: %(default)s)")
    add("--policies", nargs="+", metavar="NAME", help="policies to run (default: all there are)")
    add("--level", type=cli.non_negative_int, nargs="+", default=[0], help="how hard scenes are perturbed, 0 to 3; several take turns (default: 0)")
    add("--axis", action="append", default=[], metavar="AXIS=LEVEL", help="one axis at a level of its own, such as camera=2; repeatable")
    add("--action-noise", type=cli.non_negative_float, default=0.0, metavar="S", help=NOISE_HELP)
    add("--split", choices=SPLITS, default="test", help="which instances (default: %(default)s)")
    add("--start-seed", type=cli.non_negative_int, default=0, metavar="S", help="seed of the first instance (default: %(default)s)")
    add("--encoder", metavar="NAME", help="osel_small (default), MODEL:TAG of open_clip such as ViT-L-14:openai, MODEL:FILE, or a folder")
    add("--out", type=Path, metavar="DIR", help="where to write")
    add("--resume", action="store_true", help="go on with the recording in --out")
    add("--summary", type=cli.folder, metavar="DIR", help="print the tables of the log in DIR, and leave")
    add("--tasks", type=cli.folder, metavar="DIR", help="folder with task files of your own")
    add("--policies-dir", type=cli.folder, metavar="DIR", help="folder with policy files of your own")
    return result


def _record(options: argparse.Namespace) -> int:
    from osel_sim.context.encoder import DEFAULT_ENCODER, load_encoder
    from osel_sim.formats.levels import parse_axes
    from osel_sim.formats.rollout_log import ROLLOUTS
    from osel_sim.formats.run_config import RUN, check_folder, content_digests, environment, start_or_resume
    from osel_sim.formats.shards import Shards
    from osel_sim.runtime.drivers import choose_policies, with_fallbacks
    from osel_sim.runtime.workers import Plan
    from osel_sim.sim.gl import choose_backend

    tasks = content.select_tasks(options.task, options.tasks)
    policies = choose_policies(options.policies, options.policies_dir)
    everyone = with_fallbacks(policies, options.policies_dir)
    if options.out is None:
        raise UsageError("--out is missing: give the folder to write to")
    folder: Path = options.out
    encoder_name = options.encoder or DEFAULT_ENCODER
    plan = Plan(
        tasks=tuple(tasks),
        policies=tuple(policies),
        everyone=tuple(everyone),
        seeds=range(options.start_seed, options.start_seed + options.instances),
        levels=tuple(options.level),
        split=options.split,
        encoder=encoder_name,
        repeats=options.repeats,
        repeat_every=options.repeat_every,
        axes=parse_axes(options.axis),
        action_noise=options.action_noise,
    )
    axes = sorted({instance.axes for instance in plan.instances.values() if instance.axes})  # refuses an unknown level or axis before anything loads
    configuration: dict[str, Any] = {
        "tasks": [task.name for task in tasks],
        "policies": [spec.name for spec in policies],
        "instances": options.instances,
        "start_seed": options.start_seed,
        "repeats": options.repeats,
        "repeat_every": options.repeat_every,
        "levels": options.level,
        "axes": axes,
        "action_noise": options.action_noise,
        "split": options.split,
        "content": content_digests(tasks, everyone),
    }
    check_folder(folder, configuration, options.resume)
    encoder = load_encoder(encoder_name)
    configuration["encoder"] = encoder.identity
    ran_with = environment(choose_backend(), content.root())
    for warning in start_or_resume(folder, configuration, ran_with, options.resume):
        print(f"warning: {warning}", file=sys.stderr)
    if (folder / ROLLOUTS).exists():
        print(f"{folder} is complete")
    else:
        shards = Shards(folder)
        try:
            _record_missing(plan, shards, options.workers)
        except OselError:
            if not shards.rows:  # the folder is not in use: nothing came of it, such as for want of a checkpoint
                shards.close(remove=True)
                (folder / RUN).unlink()
            raise
        _finish(folder, plan, shards, encoder.identity, configuration)
    _print_summary(folder)
    return 0


def _record_missing(plan: "Plan", shards: "Shards", workers: int) -> None:
    """Record what is not there yet, with a progress bar."""
    from tqdm import tqdm  # type: ignore[import-untyped]

    from osel_sim.runtime.workers import record

    missing = [instance for instance in plan.instances if instance not in shards.rows]
    total, there = (sum(len(plan.episodes(instance)) for instance in instances) for instances in (plan.instances, shards.rows))
    start = time.perf_counter()
    done = successes = 0
    with tqdm(total=total, initial=there, unit="episode", dynamic_ncols=True) as bar:
        for recorded in record(plan, missing, workers):
            if recorded is None:
                bar.update()
                continue
            rows = [recorded.rows[episode] for episode in plan.episodes(recorded.instance)]
            shards.add(recorded.instance, rows, recorded.context)
            done += len(rows)
            successes += sum(row.success for row in rows)
            bar.set_postfix_str(f"success {100 * successes / done:.0f}%, {3600 * done / (time.perf_counter() - start):.0f} episodes/h", refresh=False)
    if done:
        seconds = time.perf_counter() - start
        print(f"{done} episodes in {seconds:.0f} s with {workers} workers: {3600 * done / seconds:.0f} episodes an hour, starting up included")


def _finish(folder: Path, plan: "Plan", shards: "Shards", encoder: str, configuration: dict[str, Any]) -> None:
    """Turn the shards into the rollout log and its contexts."""
    from osel_sim.context.cache import ContextCache
    from osel_sim.formats.rollout_log import write_rollouts

    cache = ContextCache(folder, autosave=0)
    for instance in plan.instances:
        if instance in shards.contexts:
            cache.put(encoder, instance, shards.contexts[instance])
    cache.save()
    write_rollouts(folder, [row for instance in plan.instances for row in shards.rows[instance]], configuration)
    shards.close(remove=True)


def _print_summary(folder: Path) -> None:
    from osel_sim.formats.rollout_log import read_rollouts
    from osel_sim.runtime.rollout_tables import print_rollouts
    from osel_sim.runtime.tables import console
    from osel_sim.selection.reward import preset

    rows, _ = read_rollouts(folder)
    if not rows:
        raise DataError(f"{folder}: the rollout log has no rows")
    weights = preset(DEFAULT_PRESET)
    print_rollouts(console(), rows, weights)
    print(f"reward: success - {weights.alpha_time} log10(seconds) - {weights.alpha_price} cents; episodes with errors count nowhere else")


if __name__ == "__main__":
    sys.exit(main(None))
