"""Demonstrations in memory: a LeRobotDataset's columns as arrays, its images decoded once into files that are mapped, not read.

A PNG decoded each time a frame is fetched takes about 1 ms a frame and camera; training on a processor would wait for that more
than for its own arithmetic. Images live in `<dataset>/.cache/<fingerprint>/`, written under another name first and renamed when whole.
"""

import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic, content_digest, is_partial, read_json
from osel_sim.core.parquet import PARQUET_ERRORS, open_parquet, unreadable
from osel_sim.core.progress import progress as progress_bar
from osel_sim.formats.dataset_mapping import ACTION, STATE, DatasetMapping
from osel_sim.ingestion.lerobot_check import INFO, open_dataset
from osel_sim.ingestion.lerobot_files import DatasetFiles
from osel_sim.ingestion.lerobot_numbers import actions, states
from osel_sim.interface.instance import SUITE_SEPARATOR
from osel_sim.policy.mapping import turned_over
from osel_sim.training.annotations import ACTIONS, SIDE_FILE, Annotations, load_annotations

DECODE_ROWS = 512


@dataclass(frozen=True)
class Demonstrations:
    """A dataset's frames in order.

    Attributes:
        images: camera -> uint8 (frames, H, W, 3), mapped from disk.
        state, action: float32 (frames, state) and (frames * every, action); of our tasks 8 and 7 numbers, of others as their environment has them.
        every: control steps a frame, each with an action of its own.
        task: the instruction of each frame's episode, as an index into `tasks`.
        starts: first frame of each episode, and the number of frames at the end: (episodes + 1,).
        annotations: None where the dataset has none; then only actions are learned.
        name: the task that the side file names, else the folder's name.
    """

    folder: Path
    fingerprint: str
    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    action: NDArray[np.float32]
    task: NDArray[np.int64]
    tasks: tuple[str, ...]
    starts: NDArray[np.int64]
    annotations: Annotations | None
    name: str
    every: int = 1

    @property
    def episodes(self) -> int:
        """How many there are."""
        return len(self.starts) - 1


def load_demonstrations(folder: Path, cameras: tuple[str, ...], progress: bool = True, mapping: DatasetMapping | None = None) -> Demonstrations:
    """Read a LeRobotDataset (v3, images in its Parquet files, not videos).

    Args:
        mapping: the dataset's own names and conventions; None: it has ours.

    Raises:
        DataError: not such a dataset, or a camera, the state or the action is missing, of another shape or no number; names file, frame and column.
    """
    mapping = mapping or DatasetMapping()
    files = open_dataset(folder)
    for camera in cameras:
        files.check_images(camera, mapping.camera(camera), f"images = {{ {camera} = COLUMN }} in a mapping file (--map)")
        if files.is_video(mapping.camera(camera)):
            raise DataError(f"{folder}: its images {mapping.camera(camera)!r} are videos; training reads images that are stored without video")
    columns = {name: files.numbers(name, finite=False) for name in files.features if name.startswith("annotation.")}
    fingerprint = _fingerprint(folder, files.files, mapping)
    task = task_of(folder)
    if task is not None and SUITE_SEPARATOR in task:  # of another suite: its environment says what the numbers are, and its policies know no other
        state, action = (files.numbers(name).astype(np.float32) for name in (STATE, ACTION))
    else:
        state, action = states(files, mapping), actions(files, mapping)
    between = columns.pop(ACTIONS, None)
    if between is not None:
        action = between.astype(np.float32).reshape(-1, action.shape[1])
    return Demonstrations(
        folder=folder,
        fingerprint=fingerprint,
        images={camera: _images(files, camera, mapping, fingerprint, progress) for camera in cameras},
        state=state,
        action=action,
        task=files.task,
        tasks=files.tasks,
        starts=files.starts,
        annotations=load_annotations(folder, columns),
        name=task or folder.resolve().name,
        every=len(action) // len(state),
    )


def task_of(folder: Path) -> str | None:
    """The task that a dataset's side file says its demonstrations are of, or None."""
    side = folder / "meta" / SIDE_FILE
    task = read_json(side).get("task") if side.is_file() else None
    return task if isinstance(task, str) else None


def dataset_folders(given: Sequence[Path]) -> list[Path]:
    """Folders of datasets: each one given, or where it is none, those within it, by name.

    Raises:
        DataError: there is no dataset in one of them.
    """
    found: list[Path] = []
    for folder in given:
        within = sorted(file.parents[1] for file in folder.glob(f"*/{INFO}"))
        inside = [folder] if (folder / INFO).is_file() else [one for one in within if not is_partial(one)]
        if not inside:
            raise DataError(f"{folder}: no LeRobotDataset in it ({INFO}); python -m osel_sim.collect writes one")
        found += inside
    for folder in found:
        if sum(folder.resolve() == other.resolve() for other in found) > 1:
            raise DataError(f"{folder}: is given twice")
    return found


def _fingerprint(folder: Path, files: Sequence[Path], mapping: DatasetMapping) -> str:
    stats = [(file.relative_to(folder), file.stat()) for file in files]
    told = [] if mapping == DatasetMapping() else [repr(mapping)]
    return content_digest((folder / INFO).read_bytes(), *(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in stats), *told)[:16]


def _images(files: DatasetFiles, camera: str, mapping: DatasetMapping, fingerprint: str, progress: bool) -> NDArray[np.uint8]:
    """The decoded images of one camera, from the cache or into it."""
    cache = files.folder / ".cache"
    home = cache / fingerprint
    target = home / f"{camera}.npy"
    if not target.is_file():
        for stale in cache.glob("*"):  # caches of what the dataset was before; a running reader keeps its open files
            if stale.name != fingerprint:
                shutil.rmtree(stale, ignore_errors=True)
        home.mkdir(parents=True, exist_ok=True)
        with atomic(target) as partial:
            column = mapping.camera(camera)
            shape = files.image(column, 0).shape
            array = np.lib.format.open_memmap(partial, mode="w+", dtype=np.uint8, shape=(files.frames, *shape))
            _decode(files, column, array, mapping.flip.get(camera), f"decoding {camera}", progress)
            array.flush()
            del array
    mapped: NDArray[np.uint8] = np.load(target, mmap_mode="r", allow_pickle=False)
    return mapped


def _decode(files: DatasetFiles, column: str, out: NDArray[np.uint8], flip: str | None, label: str, progress: bool) -> None:
    def decode(position: int, cell: Any) -> None:
        image = files.decoded(cell, column, position)
        if image.shape != out.shape[1:]:
            size, first = (f"{shape[1]} x {shape[0]}" for shape in (image.shape, out.shape[1:]))
            raise DataError(f"{files.where(position, column)}: the image has {size} pixels, the first one {first}")
        out[position] = turned_over(image, flip)

    position = 0
    with ThreadPoolExecutor() as pool, progress_bar(len(out), "frame", label, quiet=not progress) as bar:
        for file in files.files:
            for cells in _batches(file, column):
                list(pool.map(decode, range(position, position + len(cells)), cells))
                position += len(cells)
                bar.update(len(cells))


def _batches(file: Path, column: str) -> Iterator[list[Any]]:
    try:
        for batch in open_parquet(file).iter_batches(batch_size=DECODE_ROWS, columns=[column]):
            yield batch.column(0).to_pylist()
    except PARQUET_ERRORS as error:
        raise unreadable(file, error) from None
