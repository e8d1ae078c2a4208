"""Demonstrations of the scripted expert, recorded in shards by several processes and joined into LeRobotDatasets."""

import json
import logging
import multiprocessing
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from osel_sim.core.errors import UsageError
from osel_sim.core.processes import end_with_parent
from osel_sim.formats.task_file import TaskSpec
from osel_sim.training.annotations import SIDE_FILE, read_dataset_json

SHARD = 20


def shards_folder(out: Path) -> Path:
    """Where the shards of a dataset lie until they are joined."""
    return out.with_name(out.name + ".shards")


def seeds(out: Path) -> int | None:
    """How many seeds the dataset is of, or None where there is none."""
    side = out / "meta" / SIDE_FILE
    return read_dataset_json(side).get("seeds") if side.is_file() else None


def check_settings(folder: Path, settings: dict[str, object]) -> None:
    """A resumed dataset must be of one kind."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "settings.json"
    if file.is_file():
        before = json.loads(file.read_text())
        for key, value in settings.items():
            if before.get(key) != value:
                raise UsageError(f"{folder}: was collected with {key} = {before.get(key)!r}, not {value!r}")
    file.write_text(json.dumps(settings))


def collect(task: TaskSpec, out: Path, episodes: int, levels: tuple[int, ...], axes: Mapping[str, int], image_size: int, workers: int) -> str:
    """Record all missing shards with `workers` processes, then join them into one dataset at `out`. Returns what was done, in words."""
    from tqdm.auto import tqdm  # type: ignore[import-untyped]

    from osel_sim.sim.gl import choose_backend
    from osel_sim.training.demonstrations import Shard, record_shard, side_file

    choose_backend()
    _quiet_lerobot()
    shards = [
        Shard(task.file, shards_folder(out) / f"{first:06d}-{count}", first, count, image_size, levels, axes)
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
    return f"{out}: {episodes - len(failed)} demonstrations, {frames} frames; the expert failed on {len(failed)} of {episodes} seeds"


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
