"""Demonstrations of the scripted expert, recorded in shards by several processes and joined into LeRobotDatasets."""

import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from osel_sim.core.errors import DataError, UsageError, WorkerError
from osel_sim.core.files import atomic_folder, read_json, write_text
from osel_sim.core.processes import Lost, Work, run_jobs
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.suite import Task
from osel_sim.training.annotations import SIDE_FILE
from osel_sim.training.demonstrations import DONE, Shard, side_file

if TYPE_CHECKING:
    from osel_sim.training.suite_demonstrations import SuiteShard

logger = logging.getLogger(__name__)

SHARD = 20
UNSAID = {"every": 1}
"""Settings of folders that were begun before there were such."""


def shards_folder(out: Path) -> Path:
    """Where the shards of a dataset lie until they are joined; absolute, since to Parquet's writers `12:30` at the beginning would be an address."""
    return out.absolute().with_name(out.name + ".shards")


def seeds(out: Path) -> int | None:
    """How many seeds the dataset is of, or None where there is none."""
    side = out / "meta" / SIDE_FILE
    return read_json(side).get("seeds") if side.is_file() else None


def check_settings(folder: Path, settings: dict[str, object]) -> None:
    """A resumed dataset must be of one kind."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "settings.json"
    if file.is_file():
        before = read_json(file)
        for key, value in settings.items():
            if (earlier := before.get(key, UNSAID.get(key))) != value:
                raise UsageError(f"{folder}: was collected with {key} = {earlier!r}, not {value!r}")
    write_text(file, json.dumps(settings))


def collect(task: TaskSpec, out: Path, episodes: int, levels: tuple[int, ...], axes: Mapping[str, int], image_size: int, workers: int) -> str:
    """Record all missing shards of a task of ours with `workers` processes, then join them into one dataset at `out`. Says in words what was done."""
    from osel_sim.sim.gl import choose_backend
    from osel_sim.sim.osc import prepare

    choose_backend()
    prepare()
    shards = [
        Shard(task.file, shards_folder(out) / f"{first:06d}-{count}", first, count, image_size, levels, axes, task.robot)
        for first, count in _parts(episodes)
    ]
    return _collect(task.name, shards, out, workers, lambda failed: side_file(task, levels, axes, len(shards), episodes, failed))


def collect_suite(task: Task, out: Path, episodes: int, shard: "SuiteShard", workers: int) -> str:
    """The same of a task of another suite, whose environment has a scripted expert.

    Args:
        shard: what all shards have in common; folder and seeds are set here.
    """
    from osel_sim.training.suite_demonstrations import suite_side_file

    shards = [
        replace(shard, folder=shards_folder(out) / f"{first:06d}-{count}", first_seed=first, episodes=count) for first, count in _parts(episodes)
    ]
    return _collect(task.name, shards, out, workers, lambda failed: suite_side_file(task, shard.levels, shard.axes, shards, episodes, failed))


class Recordable(Protocol):
    """A run of consecutive training seeds that is recorded and saved together."""

    @property
    def folder(self) -> Path:
        """Where to."""
        ...

    @property
    def episodes(self) -> int:
        """How many seeds."""
        ...

    def record(self) -> tuple[int, int, list[int]]:
        """Frames, episodes, and seeds that the expert failed on."""
        ...


def _parts(episodes: int) -> list[tuple[int, int]]:
    """First seed and number of seeds of each shard."""
    return [(first, min(SHARD, episodes - first)) for first in range(0, episodes, SHARD)]


def _collect(name: str, shards: Sequence[Recordable], out: Path, workers: int, side: Callable[[list[int]], dict[str, Any]]) -> str:
    from osel_sim.core.progress import progress

    logger.info("%s: starting %d workers ...", name, workers)
    _quiet_lerobot()
    episodes, frames = sum(shard.episodes for shard in shards), 0
    failed: list[int] = []
    with progress(episodes, "episode", name) as bar:
        for shard, shard_frames, shard_failed in _record_shards(shards, workers, bar.begin):
            frames, failed = frames + shard_frames, failed + shard_failed
            bar.note(f"frames={frames}, failed={len(failed)}")
            bar.update(shard.episodes)
    if len(failed) == episodes:
        raise DataError(f"{name}: the expert failed on every seed; there is nothing to make a dataset of")
    kept = [shard.folder for shard in shards if read_json(shard.folder / DONE)["episodes"]]
    _join(name, out, kept, side(sorted(failed)))
    return f"{out}: {episodes - len(failed)} demonstrations, {frames} frames; the expert failed on {len(failed)} of {episodes} seeds"


def _record_shards(shards: Sequence[Recordable], workers: int, ready: Callable[[], None]) -> Iterator[tuple[Recordable, int, list[int]]]:
    """Record shards in worker processes, unless they are there already: each with its number of frames and the seeds that the expert failed on.

    Raises:
        WorkerError: a worker died twice on a shard; after the others have been recorded.
        Exception: what a shard raised, such as OSError where the disk is full.
    """
    lost: list[Lost[Recordable]] = []
    with closing(run_jobs(_recorder, shards, workers, ready=ready)) as events:
        for event in events:
            if isinstance(event, Lost):
                if event.error is not None:
                    raise event.error
                lost.append(event)
            else:
                frames, _, failed = event.value
                yield event.job, frames, failed
    if lost:
        raise WorkerError(f"{len(lost)} shards were lost with their worker processes, the first of them {lost[0].job} ({lost[0].cause})")


def _recorder() -> Work[Recordable, tuple[int, int, list[int]]]:
    """What a worker does. Workers share the cores: one thread each, for numpy, torch and Mesa's rasteriser. The progress bar is the parent's."""
    os.environ.update(OMP_NUM_THREADS="1", LP_NUM_THREADS="1", HF_DATASETS_DISABLE_PROGRESS_BARS="1")
    _quiet_lerobot()
    return lambda shard, _: [shard.record()]


def _quiet_lerobot() -> None:
    """LeRobot warns, in every process, that it cannot decode videos the usual way; the images are PNG."""
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


def _join(task: str, out: Path, folders: list[Path], side: dict[str, Any]) -> None:
    """Make one dataset out of shards, with a side file, put in place only when it is whole."""
    from lerobot.datasets.aggregate import aggregate_datasets

    with atomic_folder(out.absolute()) as partial:
        name = f"osel_sim/{task.replace(':', '_')}"
        aggregate_datasets([name] * len(folders), name, roots=folders, aggr_root=partial, concatenate_data=False)
        (partial / "meta" / SIDE_FILE).write_text(json.dumps(side, indent=1))
