"""`python -m osel_sim.collect`: demonstrations of the scripted expert as a LeRobotDataset."""

import json
import logging
import multiprocessing
import os
import shutil
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from osel_sim import cli
from osel_sim.core.errors import UsageError
from osel_sim.core.processes import end_with_parent
from osel_sim.formats import library
from osel_sim.formats.levels import parse_axes, resolve
from osel_sim.formats.task_file import TaskSpec
from osel_sim.training.annotations import SIDE_FILE, read_json

SHARD = 20
EXAMPLES = """examples:
  python -m osel_sim.collect --task pick_place --episodes 1500 --out data/pick_place
  python -m osel_sim.collect --task all --episodes 200 --level 0 1 --out data/suite
  python -m osel_sim.collect --task pick_place --episodes 3000 --out data/pick_place --resume     (goes on after an interruption, or adds to it)
"""


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Collect demonstrations."""
    parser = cli.Parser("collect", "Record the scripted expert, disturbed now and then, into a LeRobotDataset.", EXAMPLES)
    parser.add_argument("--task", nargs="+", required=True, help="tasks to demonstrate: names, tag:TAG, or all; several get a folder each in --out")
    parser.add_argument("--episodes", type=cli.positive_int, required=True, help="training instances to demonstrate (seeds 0 to N-1)")
    parser.add_argument("--out", type=Path, required=True, help="folder of the dataset")
    parser.add_argument(
        "--level", type=cli.non_negative_int, nargs="+", default=[0], help="how hard scenes are perturbed, 0 to 3; several take turns (default: 0)"
    )
    parser.add_argument(
        "--axis", action="append", default=[], metavar="AXIS=LEVEL", help="one axis at a level of its own, such as camera=2; repeatable"
    )
    parser.add_argument("--image-size", type=cli.positive_int, default=96, help="pixels, square (default 96)")
    parser.add_argument("--workers", type=cli.positive_int, default=os.cpu_count() or 1, help="processes (default: one a core)")
    parser.add_argument("--resume", action="store_true", help="go on with --out: finished shards are kept")
    parser.add_argument("--tasks", type=cli.folder, default=None, help="folder with task files of your own")
    options = parser.parse_args(arguments)

    tasks = library.select_tasks(options.task, options.tasks)
    axes = parse_axes(options.axis)
    outs = [options.out] if len(tasks) == 1 else [options.out / task.name for task in tasks]
    for task, out in zip(tasks, outs, strict=True):
        if (out.exists() or _shards_folder(out).exists()) and not options.resume:
            raise UsageError(f"{out} is there already: give --resume to go on with it, or another --out")
        for level in options.level:
            resolve(level, axes, task.axes, task.name)  # refuses an unknown level or axis before anything is written
    for task, out in zip(tasks, outs, strict=True):
        settings = {"task": task.name, "task_version": task.version, "levels": options.level, "axes": axes, "image_size": options.image_size}
        _check_settings(_shards_folder(out), settings)
        if _seeds(out) == options.episodes:
            print(f"{out} is complete")  # and stays as it is: training tells datasets apart by when their files were written, too
            continue
        collect(task, out, options.episodes, tuple(options.level), axes, options.image_size, options.workers)
    return 0


def _shards_folder(out: Path) -> Path:
    return out.with_name(out.name + ".shards")


def _seeds(out: Path) -> int | None:
    """How many seeds the dataset is of, or None where there is none."""
    side = out / "meta" / SIDE_FILE
    return read_json(side).get("seeds") if side.is_file() else None


def _check_settings(folder: Path, settings: dict[str, object]) -> None:
    """A resumed dataset must be of one kind."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "settings.json"
    if file.is_file():
        before = json.loads(file.read_text())
        for key, value in settings.items():
            if before.get(key) != value:
                raise UsageError(f"{folder}: was collected with {key} = {before.get(key)!r}, not {value!r}")
    file.write_text(json.dumps(settings))


def collect(task: TaskSpec, out: Path, episodes: int, levels: tuple[int, ...], axes: Mapping[str, int], image_size: int, workers: int) -> None:
    """Record all missing shards with `workers` processes, then join them into one dataset at `out`."""
    from tqdm import tqdm  # type: ignore[import-untyped]

    from osel_sim.sim.gl import choose_backend
    from osel_sim.training.demonstrations import Shard, record_shard, side_file

    choose_backend()
    _quiet_lerobot()
    shards = [
        Shard(task.file, _shards_folder(out) / f"{first:06d}-{count}", first, count, image_size, levels, axes)
        for first in range(0, episodes, SHARD)
        for count in (min(SHARD, episodes - first),)
    ]
    frames = 0
    failed: list[int] = []
    context = multiprocessing.get_context("spawn")  # a forked GL or numba state is a crash waiting to happen
    with (
        ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare) as pool,
        tqdm(total=episodes, unit="episode", desc=task.name) as bar,
    ):
        futures = {pool.submit(record_shard, shard): shard for shard in shards}
        try:
            for future in as_completed(futures):
                shard_frames, _, shard_failed = future.result()
                frames, failed = frames + shard_frames, failed + shard_failed
                bar.update(futures[future].episodes)
                bar.set_postfix(frames=frames, failed=len(failed))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    _join(task, out, [shard.folder for shard in shards])
    side = side_file(task, levels, axes, len(shards), episodes, sorted(failed))
    (out / "meta" / SIDE_FILE).write_text(json.dumps(side, indent=1))
    print(f"{out}: {episodes - len(failed)} demonstrations, {frames} frames; the expert failed on {len(failed)} of {episodes} seeds")


def _prepare() -> None:
    """Workers share the cores: one thread each, for numpy, torch and Mesa's rasteriser. The progress bar is ours."""
    end_with_parent()
    os.environ.update(OMP_NUM_THREADS="1", LP_NUM_THREADS="1", HF_DATASETS_DISABLE_PROGRESS_BARS="1")
    _quiet_lerobot()


def _quiet_lerobot() -> None:
    """LeRobot warns, in every process, that it cannot decode videos the usual way; the images are PNG."""
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


def _join(task: TaskSpec, out: Path, folders: list[Path]) -> None:
    """One dataset out of the shards, put in place only when it is whole."""
    from lerobot.datasets.aggregate import aggregate_datasets

    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    aggregate_datasets([f"osel_sim/{task.name}"] * len(folders), f"osel_sim/{task.name}", roots=folders, aggr_root=part, concatenate_data=False)
    shutil.rmtree(out, ignore_errors=True)
    part.rename(out)


if __name__ == "__main__":
    sys.exit(main(None))
