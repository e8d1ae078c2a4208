"""Demonstrations in memory: a LeRobotDataset's columns as arrays, its images decoded once into files that are mapped, not read.

LeRobotDataset decodes a PNG each time a frame is fetched, about 1 ms a frame and camera; training on a processor would wait for that more
than for its own arithmetic. Images live in `<dataset>/.cache/<fingerprint>/`, written under another name first and renamed when whole.
"""

import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as parquet
from numpy.typing import NDArray

from osel_sim.core.arrays import check_rows, local
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic, content_digest, is_partial, read_json
from osel_sim.core.progress import progress as progress_bar
from osel_sim.sim.specification import ACTION_DIM, STATE_DIM
from osel_sim.training.annotations import SIDE_FILE, Annotations, load_annotations

IMAGES = "observation.images."
INFO = "meta/info.json"
DECODE_ROWS = 512


@dataclass(frozen=True)
class Demonstrations:
    """A dataset's frames in order.

    Attributes:
        images: camera -> uint8 (frames, H, W, 3), mapped from disk.
        state, action: float32 (frames, 8) and (frames, 7).
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

    @property
    def episodes(self) -> int:
        """How many there are."""
        return len(self.starts) - 1


def load_demonstrations(folder: Path, cameras: tuple[str, ...], progress: bool = True) -> Demonstrations:
    """Read a LeRobotDataset (v3, images as PNG in its Parquet files).

    Raises:
        DataError: not such a dataset, or a camera, the state or the action missing or of another shape.
    """
    info = read_json(folder / INFO, "is it a LeRobotDataset? python -m osel_sim.collect writes one")
    features = info.get("features", {})
    for name, shape in {"observation.state": [STATE_DIM], "action": [ACTION_DIM]}.items():
        if features.get(name, {}).get("shape") != shape:
            raise DataError(f"{folder}: feature {name!r} must have the shape {shape}, got {features.get(name, {}).get('shape', 'none')}")
    for camera in cameras:
        feature = features.get(IMAGES + camera)
        if feature is None or feature["dtype"] != "image":
            have = ", ".join(name.removeprefix(IMAGES) for name in features if name.startswith(IMAGES)) or "none"
            raise DataError(f"{folder}: no images (stored without video) of the camera {camera!r}; it has: {have}")
    files = sorted((folder / "data").glob("*/*.parquet"))
    if not files:
        raise DataError(f"{folder}: no data/*/*.parquet")
    for file in files:
        check_rows(file)
    wanted = ["observation.state", "action", "episode_index", "task_index"]
    wanted += [name for name in features if name.startswith("annotation.")]
    columns = _columns(files, wanted)
    episode = columns["episode_index"].reshape(-1)
    if (np.diff(episode) < 0).any():
        raise DataError(f"{folder}: episodes are not in order")
    starts = np.concatenate([[0], np.flatnonzero(np.diff(episode)) + 1, [len(episode)]]).astype(np.int64)
    tasks = sorted(parquet.read_table(local(folder / "meta" / "tasks.parquet")).to_pylist(), key=lambda row: row["task_index"])
    fingerprint = _fingerprint(folder, files)
    shapes = {camera: tuple(features[IMAGES + camera]["shape"]) for camera in cameras}
    return Demonstrations(
        folder=folder,
        fingerprint=fingerprint,
        images={camera: _images(folder, files, camera, shapes[camera], len(episode), fingerprint, progress) for camera in cameras},
        state=columns["observation.state"].astype(np.float32),
        action=columns["action"].astype(np.float32),
        task=columns["task_index"].reshape(-1).astype(np.int64),
        tasks=tuple(str(row.get("task", row.get("__index_level_0__"))) for row in tasks),
        starts=starts,
        annotations=load_annotations(folder, columns),
        name=task_of(folder) or folder.resolve().name,
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


def _columns(files: list[Path], names: list[str]) -> dict[str, NDArray[Any]]:
    tables = [parquet.read_table(local(file), columns=names) for file in files]
    arrays: dict[str, NDArray[Any]] = {}
    for name in names:
        parts = []
        for table in tables:
            column = table[name].combine_chunks()
            values = column.flatten() if hasattr(column, "flatten") and column.type.num_fields else column
            parts.append(values.to_numpy(zero_copy_only=False).reshape(len(column), -1))
        arrays[name] = np.concatenate(parts)
    return arrays


def _fingerprint(folder: Path, files: list[Path]) -> str:
    stats = [(file.relative_to(folder), file.stat()) for file in files]
    return content_digest((folder / INFO).read_bytes(), *(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in stats))[:16]


def _images(folder: Path, files: list[Path], camera: str, shape: tuple[int, ...], frames: int, fingerprint: str, progress: bool) -> NDArray[np.uint8]:
    """The decoded images of one camera, from the cache or into it."""
    home = folder / ".cache" / fingerprint
    target = home / f"{camera}.npy"
    if not target.is_file():
        for stale in (folder / ".cache").glob("*"):  # caches of what the dataset was before; a running reader keeps its open files
            if stale.name != fingerprint:
                shutil.rmtree(stale, ignore_errors=True)
        home.mkdir(parents=True, exist_ok=True)
        with atomic(target) as partial:
            array = np.lib.format.open_memmap(partial, mode="w+", dtype=np.uint8, shape=(frames, *shape))
            _decode(files, IMAGES + camera, array, f"decoding {camera}", progress)
            array.flush()
            del array
    mapped: NDArray[np.uint8] = np.load(target, mmap_mode="r", allow_pickle=False)
    return mapped


def _decode(files: list[Path], column: str, out: NDArray[np.uint8], label: str, progress: bool) -> None:
    def decode(position: int, data: bytes) -> None:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image is None or image.shape != out.shape[1:]:
            raise DataError(f"{column}: frame {position} is not an image of shape {out.shape[1:]}")
        cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
        out[position] = image

    position = 0
    with ThreadPoolExecutor() as pool, progress_bar(len(out), "frame", label, quiet=not progress) as bar:
        for file in files:
            for batch in parquet.ParquetFile(local(file)).iter_batches(batch_size=DECODE_ROWS, columns=[column]):
                encoded = batch.column(0).field("bytes").to_pylist()
                list(pool.map(decode, range(position, position + len(encoded)), encoded))
                position += len(encoded)
                bar.update(len(encoded))
