"""Record outcomes of every policy on the same instances: `python -m osel_sim.record --task pick_place --instances 200 --out logs/mine`."""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim import cli
from osel_sim.cli.reward_flags import DEFAULT_PRESET
from osel_sim.core import content
from osel_sim.core.errors import DataError, OselError, UsageError
from osel_sim.formats import library
from osel_sim.run import NOISE_HELP, SPLITS

if TYPE_CHECKING:
    from osel_sim.episodes.recording import Recording

EXAMPLES = """examples:
  python -m osel_sim.record --task pick_place --instances 200 --out logs/mine
  python -m osel_sim.record --resume --out logs/mine                                       # go on after an interruption
  python -m osel_sim.record --resume --out logs/mine --policies another                    # record one more policy on the same instances
  python -m osel_sim.record --resume --out logs/mine --repeats 3 --repeat-every 5          # for a surer expected oracle
  python -m osel_sim.record --resume --out logs/mine --encoder ViT-L-14:openai             # read the log with another encoder from now on
  python -m osel_sim.record --task pick_place --instances 50 --repeats 4 --workers 8 --policies local_small --out logs/small
  python -m osel_sim.record --task all --instances 300 --level 0 1 2 3 --repeats 3 --repeat-every 10 --out logs/suite
  python -m osel_sim.record --summary logs/mine                                            # print the tables of a log again

Writes into --out: run.json, rollouts.parquet (a row an episode) and contexts.npz. Every policy starts from the same state of the same instance. The
files do not depend on the number of workers, nor on interruptions. --resume takes all settings from run.json; policies, more
repeats and an encoder given with it are added to what is there, and the log is read with the encoder given last."""

_FIXED = ("instances", "start_seed", "action_noise", "split")
"""What a recording keeps from its beginning to its end, beside its tasks, levels and axes."""


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
    add("--repeats", type=cli.positive_int, metavar="R", help="episodes of each policy on an instance (default: 1)")
    add("--repeat-every", type=cli.positive_int, metavar="K", help="repeat on one in K instances of each level only (default: on all)")
    add("--workers", type=cli.positive_int, default=2, metavar="W", help="processes (default: %(default)s)")
    add("--policies", nargs="+", metavar="NAME", help="policies to run (default: all there are)")
    add("--level", type=cli.non_negative_int, nargs="+", default=[0], help="how hard scenes are perturbed, 0 to 3; several take turns (default: 0)")
    add("--axis", action="append", default=[], metavar="AXIS=LEVEL", help="one axis at a level of its own, such as camera=2; repeatable")
    add("--action-noise", type=cli.non_negative_float, default=0.0, metavar="S", help=NOISE_HELP)
    add("--split", choices=SPLITS, default="test", help="which instances (default: %(default)s)")
    add("--start-seed", type=cli.non_negative_int, default=0, metavar="S", help="seed of the first instance (default: %(default)s)")
    add("--encoder", metavar="NAME", help="osel_small (default), osel_suite, MODEL:TAG of open_clip such as ViT-L-14:openai, MODEL:FILE, or a folder")
    add("--out", type=Path, metavar="DIR", help="where to write")
    add("--resume", action="store_true", help="go on with the recording in --out, or add policies, repeats or an encoder's contexts to it")
    add("--summary", type=cli.folder, metavar="DIR", help="print the tables of the log in DIR, and leave")
    add("--tasks", type=cli.folder, metavar="DIR", help="folder with task files of your own")
    add("--policies-dir", type=cli.folder, metavar="DIR", help="folder with policy files of your own")
    return result


def _record(options: argparse.Namespace) -> int:
    from osel_sim.context.encoder import DEFAULT_ENCODER, load_encoder
    from osel_sim.core.files import read_json, write_json
    from osel_sim.episodes.declared_skills import declare
    from osel_sim.episodes.drivers import choose_policies, with_fallbacks
    from osel_sim.episodes.recording import Recording
    from osel_sim.episodes.workers import Plan
    from osel_sim.formats.levels import parse_axes
    from osel_sim.formats.run_config import RUN, check_folder, content_digests, environment, start_or_resume
    from osel_sim.sim.gl import choose_backend

    added_encoder = options.encoder is not None  # one given is added; the encoder that was there must not have changed
    if options.resume and not options.task and options.out is not None:
        check_folder(options.out, {}, resume=True)
        _take_settings(options, read_json(options.out / RUN).get("configuration", {}))
    options.repeats, options.repeat_every = options.repeats or 1, options.repeat_every or 1
    tasks = library.select_tasks(options.task, options.tasks)
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
    before = read_json(folder / RUN) if options.resume and (folder / RUN).exists() else None
    known = configuration if before is None else _as_it_began(configuration, before.get("configuration", {}))
    check_folder(folder, known, options.resume)
    encoder = load_encoder(encoder_name)
    skills = declare(policies, encoder, tasks, options.tasks)
    configuration["encoder"] = encoder.identity
    known["encoder"] = before.get("configuration", {}).get("encoder") if before and added_encoder else encoder.identity
    ran_with = environment(choose_backend(), content.root())
    for warning in start_or_resume(folder, known, ran_with, options.resume):
        print(f"warning: {warning}", file=sys.stderr)
    recording = Recording(folder, plan, encoder.identity, skills)
    if recording.complete:
        print(f"{folder} is complete")
    else:
        if before is not None:
            write_json(folder / RUN, before | {"configuration": configuration})
        try:
            if recording.missing():
                _record_missing(recording, options.workers)
        except OselError:
            if not recording.grew:  # nothing came of it, such as for want of a checkpoint: the folder is as it was
                (folder / RUN).unlink() if before is None else write_json(folder / RUN, before)
            raise
        recording.finish(configuration)
    _print_summary(folder)
    return 0


def _take_settings(options: argparse.Namespace, configuration: dict[str, Any]) -> None:
    """Set the options to those that a recording began with; policies, repeats and encoder that were given come in addition."""
    try:
        options.task = configuration["tasks"]
        options.axis = [part for axes in configuration["axes"] for part in axes.split(",")]
        options.policies = list(dict.fromkeys([*configuration["policies"], *(options.policies or [])]))
        options.encoder = options.encoder or configuration["encoder"].partition("@")[0]
        for name in ("repeats", "repeat_every"):
            setattr(options, name, getattr(options, name) or configuration[name])
        flags = parser()
        for name, began in (("level", configuration["levels"]), *((name, configuration[name]) for name in _FIXED)):
            given = getattr(options, name)
            if given not in (began, flags.get_default(name)):
                flag = f"--{name.replace('_', '-')} {' '.join(map(str, given)) if isinstance(given, list) else given}"
                raise UsageError(f"{flag}: {options.out / 'run.json'} began with {began}; leave it out, or give another --out")
            setattr(options, name, began)
    except KeyError as missing:
        raise DataError(
            f"{options.out / 'run.json'}: not of a recording by this version, it has no {missing}; give all flags it was made with"
        ) from None


def _as_it_began(configuration: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """The configuration as it would have been without the policies and the repeats that a recording is given later on.

    Args:
        before: what the recording began with.
    """
    known = dict(configuration)
    policies, content_then = before.get("policies", []), before.get("content", {})
    added = set(configuration["policies"]) - set(policies)
    if added and set(policies) < set(configuration["policies"]):
        digests = {key: value for key, value in configuration["content"].items() if key in content_then or key.partition(" ")[2] not in added}
        known |= {"policies": policies, "content": digests}
    repeats, every = before.get("repeats", 1), before.get("repeat_every", 1)
    # More of them: every episode there was is still asked for.
    if configuration["repeats"] >= repeats and (repeats == 1 or every % configuration["repeat_every"] == 0):
        known |= {"repeats": repeats, "repeat_every": every}
    return known


def _record_missing(recording: "Recording", workers: int) -> None:
    """Record what is not there yet, with a progress bar, and add it."""
    from tqdm import tqdm  # type: ignore[import-untyped]

    from osel_sim.episodes.workers import record

    plan, missing = recording.plan, recording.missing()
    total, left = sum(len(plan.episodes(instance)) for instance in plan.instances), sum(map(len, missing.values()))
    unit = "episode" if left else "context"
    start = time.perf_counter()
    done = successes = 0
    with tqdm(total=total if left else len(missing), initial=total - left if left else 0, unit=unit, dynamic_ncols=True) as bar:
        for recorded in record(plan if left else replace(plan, everyone=()), missing, workers):  # contexts alone need no policy
            if recorded is None:
                bar.update()
                continue
            rows = recording.add(recorded)
            if not left:
                bar.update()
                continue
            done += len(rows)
            successes += sum(row.success for row in rows)
            bar.set_postfix_str(f"success {100 * successes / done:.0f}%, {3600 * done / (time.perf_counter() - start):.0f} episodes/h", refresh=False)
    if done:
        seconds = time.perf_counter() - start
        print(f"{done} episodes in {seconds:.0f} s with {workers} workers: {3600 * done / seconds:.0f} episodes an hour, starting up included")


def _print_summary(folder: Path) -> None:
    from osel_sim.cli.console import console
    from osel_sim.cli.rollout_tables import print_rollouts
    from osel_sim.formats.rollout_log import read_rollouts
    from osel_sim.selection.reward import preset

    rows, _ = read_rollouts(folder)
    if not rows:
        raise DataError(f"{folder}: the rollout log has no rows")
    weights = preset(DEFAULT_PRESET)
    print_rollouts(console(), rows, weights)
    print(f"reward: success - {weights.alpha_time} log10(seconds) - {weights.alpha_price} cents; episodes with errors count nowhere else")


if __name__ == "__main__":
    sys.exit(main(None))
