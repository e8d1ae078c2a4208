"""LeRobotDatasets on disk (format v3): one check before any work, for measuring and for training, that names file, frame and column.

The files are read here and not by `LeRobotDataset`, which asks the hub for whatever it misses, converts all columns, wanted or not, and keeps a
second copy of them in its cache. Videos are decoded by LeRobot.
"""

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError, did_you_mean
from osel_sim.core.files import read_json
from osel_sim.core.images import load_image
from osel_sim.core.parquet import PARQUET_ERRORS, parquet_columns, read_parquet, unreadable

INFO, TASKS, EPISODES, DATA = "meta/info.json", "meta/tasks.parquet", "meta/episodes", "data"
VERSION = 3
VIDEO = "videos/{column}/chunk-{chunk:03d}/file-{file:03d}.mp4"
TOLERANCE = 1e-4
"""Seconds by which a video's frame may be off, as LeRobot has it."""
LARGEST = 1e6
"""Larger numbers are damage: no state or action is so large in any unit, and float32 squares overflow not far beyond."""


@dataclass(frozen=True)
class DatasetFiles:
    """A LeRobotDataset whose files fit together.

    Attributes:
        features: column -> what `info.json` says of it.
        files: of the frames, in order.
        firsts: first frame of each file, and the number of frames at the end (files + 1,).
        starts: first frame of each episode, and the number of frames at the end (episodes + 1,).
        task: of each frame, an index into `tasks`.
        tasks: instructions.
        rows: of `meta/episodes`, one an episode.
    """

    folder: Path
    features: Mapping[str, Mapping[str, Any]]
    files: tuple[Path, ...]
    firsts: NDArray[np.int64]
    starts: NDArray[np.int64]
    task: NDArray[np.int64]
    tasks: tuple[str, ...]
    rows: tuple[Mapping[str, Any], ...]
    _read: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)
    """What was read last of each column: frames are asked for in order, and lie in groups."""

    @property
    def frames(self) -> int:
        """How many there are."""
        return int(self.firsts[-1])

    def where(self, frame: int, column: str) -> str:
        """`file, frame 3, column 'action'`."""
        file = self.files[int(np.searchsorted(self.firsts, frame, side="right")) - 1]
        return f"{file}, frame {frame}, column {column!r}"

    def numbers(self, column: str, *, finite: bool = True) -> NDArray[np.float64]:
        """A column of numbers, (frames, N).

        Args:
            finite: refuse NaN, infinities and what is larger than `LARGEST`.

        Raises:
            DataError: naming file, frame and column.
        """
        values = _numbers(self.files, self.firsts, column)
        bad = ~(np.abs(values) <= LARGEST).all(axis=1) if finite else np.zeros(len(values), bool)
        if bad.any():
            frame = int(np.flatnonzero(bad)[0])
            wrong = values[frame][~(np.abs(values[frame]) <= LARGEST)][0]
            others = f" ({int(bad.sum())} frames have such)" if bad.sum() > 1 else ""
            raise DataError(f"{self.where(frame, column)}: must be finite numbers of a possible size, got {wrong:g}{others}")
        return values

    def check_images(self, camera: str, column: str, way: str) -> None:
        """Whether a column holds images.

        Args:
            camera: that they are for.
            way: how to name another column.

        Raises:
            DataError: it does not; names those that do.
        """
        pictures = [name for name, feature in self.features.items() if feature.get("dtype") in ("image", "video")]
        if column not in pictures:
            raise DataError(
                f"{self.folder}: there are no images {column!r} for the policies' camera {camera!r}: {did_you_mean(column, pictures)}"
                f"name one of {', '.join(pictures) or 'none'} with {way}"
            )
        if self.is_video(column):
            for episode in range(len(self.rows)):
                self._video(column, episode)

    def is_video(self, column: str) -> bool:
        """Whether a column's images are in videos."""
        return self.features[column].get("dtype") == "video"

    def image(self, column: str, frame: int) -> NDArray[np.uint8]:
        """An image, uint8 (H, W, 3) RGB.

        Raises:
            DataError: it cannot be read; names file, frame and column.
        """
        if self.is_video(column):
            return self._video_frame(column, frame)
        number = int(np.searchsorted(self.firsts, frame, side="right")) - 1
        return self.decoded(self._cell(self.files[number], column, frame - int(self.firsts[number])), column, frame)

    def decoded(self, cell: Any, column: str, frame: int) -> NDArray[np.uint8]:
        """The image that a cell of an image column holds: its bytes, or a path within the dataset.

        Raises:
            DataError: it cannot be read; names file, frame and column.
        """
        where = self.where(frame, column)
        content, path = (cell.get("bytes"), cell.get("path")) if isinstance(cell, dict) else (cell, None)
        if isinstance(content, bytes):
            return load_image(content, where)
        file = self.folder / path if isinstance(path, str) and path else None
        if file is None or not file.resolve().is_relative_to(self.folder.resolve()):
            raise DataError(f"{where}: holds neither an image's bytes nor a path within the dataset")
        return load_image(file, where)

    def _cell(self, file: Path, column: str, row: int) -> Any:
        import pyarrow.parquet

        place, first, cells = self._read.get(column, (None, 0, ()))
        if place != file or not first <= row < first + len(cells):
            try:
                content = pyarrow.parquet.ParquetFile(file)
                sizes = [content.metadata.row_group(index).num_rows for index in range(content.num_row_groups)]
                edges = np.cumsum([0, *sizes])
                group = int(np.searchsorted(edges, row, side="right")) - 1
                first, cells = int(edges[group]), content.read_row_group(group, columns=[column])[column]
            except PARQUET_ERRORS as error:
                raise unreadable(file, error) from None
            self._read[column] = file, first, cells
        return cells[row - first].as_py()

    def _video(self, column: str, episode: int) -> tuple[Path, float]:
        """The video that an episode's images are in, and where in it the episode begins, seconds."""
        row, keys = self.rows[episode], [f"videos/{column}/{key}" for key in ("chunk_index", "file_index", "from_timestamp")]
        try:
            chunk, number, begin = int(row[keys[0]]), int(row[keys[1]]), float(row[keys[2]])
        except (KeyError, TypeError, ValueError):
            raise DataError(f"{self.folder / EPISODES}: episode {episode} does not say where its video is ({', '.join(keys)})") from None
        file = self.folder / VIDEO.format(column=column, chunk=chunk, file=number)
        if not file.is_file():
            raise DataError(f"{file}: is missing, and episode {episode} has its images {column!r} there")
        return file, begin

    def _video_frame(self, column: str, frame: int) -> NDArray[np.uint8]:
        from lerobot.datasets.video_utils import decode_video_frames

        episode = int(np.searchsorted(self.starts, frame, side="right")) - 1
        file, begin = self._video(column, episode)
        if "timestamp" not in self._read:
            self._read["timestamp"] = self.numbers("timestamp")[:, 0]
        time = float(self._read["timestamp"][frame])
        try:
            image = decode_video_frames(file, [begin + time], TOLERANCE, return_uint8=True)
        except Exception as error:  # of the decoder, whichever is installed
            reason = " ".join(str(error).split())[:200]
            raise DataError(f"{self.where(frame, column)}: video {file} cannot be decoded ({type(error).__name__}: {reason})") from None
        return np.ascontiguousarray(np.asarray(image)[0].transpose(1, 2, 0), np.uint8)


def open_dataset(folder: Path) -> DatasetFiles:
    """A dataset's frames, tasks and episodes, checked against each other. Nothing is asked of any network.

    Raises:
        DataError: it is no LeRobotDataset of this format, or a file is missing, damaged or at odds with another.
    """
    features = _features(folder)
    files = tuple(sorted((folder / DATA).glob("*/*.parquet")))
    if not files:
        raise DataError(f"{folder}: has no {DATA}/*/*.parquet, where its frames should be; copy or download the dataset anew")
    firsts, episode, task = _frames(files)
    edges = [0, *(np.flatnonzero(np.diff(episode)) + 1).tolist(), len(episode)]
    tasks = _tasks(folder)
    found = DatasetFiles(folder, features, files, firsts, np.array(edges, np.int64), task, (), ())
    _check_tasks(found, tasks)
    numbers = sorted(tasks)
    rows = _episodes(found, episode[np.array(edges[:-1])])
    return DatasetFiles(
        folder, features, files, firsts, found.starts, np.searchsorted(numbers, task), tuple(tasks[index] for index in numbers), tuple(rows)
    )


def _features(folder: Path) -> dict[str, dict[str, Any]]:
    if not (folder / INFO).is_file():
        raise DataError(f"{folder}: is no LeRobotDataset, it has no {INFO}; python -m osel_sim.collect writes one")
    info = read_json(folder / INFO)
    match = re.fullmatch(r"v?(\d+)(\.\d+)*", str(info.get("codebase_version")))
    if match is None:
        raise DataError(f"{folder / INFO}: codebase_version must be such as 'v{VERSION}.0', got {info.get('codebase_version')!r}")
    if int(match[1]) < VERSION:
        root, name = shlex.quote(str(folder.resolve())), shlex.quote(f"local/{folder.resolve().name}")
        raise DataError(
            f"{folder}: is a LeRobotDataset of format {info['codebase_version']}, and v{VERSION} is read; this converts it in place: "
            f"python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={name} --root={root} --push-to-hub=false"
            + ("" if str(info["codebase_version"]).startswith("v2.1") else " (from v2.1; convert an older one to v2.1 before)")
        )
    if int(match[1]) > VERSION:
        raise DataError(f"{folder}: is a LeRobotDataset of format {info['codebase_version']}, newer than v{VERSION}, which is read")
    features = info.get("features")
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        raise DataError(f"{folder / INFO}: features must be an object with an object for each column")
    return features


def _frames(files: tuple[Path, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """First frame of each file, and episode and task of each frame."""
    lengths, columns = [], []
    for file in files:
        table = read_parquet(file, ("episode_index", "task_index"))
        lengths.append(len(table))
        columns.append([_integers(file, table, name, sum(lengths[:-1])) for name in ("episode_index", "task_index")])
    firsts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    episode, task = (np.concatenate([part[index] for part in columns]) for index in (0, 1))
    if not len(episode):
        raise DataError(f"{files[0]}: has no frames")
    wrong = np.flatnonzero(np.diff(episode) < 0)
    if len(wrong):
        frame = int(wrong[0]) + 1
        file = files[int(np.searchsorted(firsts, frame, side="right")) - 1]
        raise DataError(f"{file}, frame {frame}, column 'episode_index': episodes are not in order, {episode[frame]} follows {episode[frame - 1]}")
    return firsts, episode, task


def _integers(file: Path, table: Any, name: str, first: int) -> NDArray[np.int64]:
    import pyarrow

    column = table[name].combine_chunks()
    if not pyarrow.types.is_integer(column.type):
        raise DataError(f"{file}: column {name!r} must hold integers, its type is {column.type}")
    if column.null_count:
        frame = first + int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0])
        raise DataError(f"{file}, frame {frame}, column {name!r}: is empty")
    return np.asarray(column.to_numpy(zero_copy_only=False), np.int64)


def _tasks(folder: Path) -> dict[int, str]:
    """Index -> instruction."""
    import pyarrow

    file = folder / TASKS
    if not file.is_file():
        raise DataError(f"{file}: is missing, and holds what each frame's task is in words; copy or download the dataset anew")
    names = parquet_columns(file)
    table = read_parquet(file, names)
    words = [name for name in names if pyarrow.types.is_string(table[name].type) or pyarrow.types.is_large_string(table[name].type)]
    name = next((name for name in ("task", "__index_level_0__", *words) if name in words), None)
    if name is None or "task_index" not in names:
        raise DataError(f"{file}: must have a column 'task' of texts and 'task_index', has {', '.join(names) or 'none'}")
    numbers, texts = _integers(file, table, "task_index", 0).tolist(), _listed(file, table[name])
    for row, number in enumerate(numbers):
        if numbers.index(number) < row:
            raise DataError(f"{file}: task_index {number} is there twice")
    return dict(zip(numbers, ("" if text is None else str(text) for text in texts), strict=True))


def _listed(file: Path, column: Any) -> list[Any]:
    try:
        values: list[Any] = column.to_pylist()
    except PARQUET_ERRORS as error:  # text that is no UTF-8
        raise unreadable(file, error) from None
    return values


def _check_tasks(found: DatasetFiles, tasks: Mapping[int, str]) -> None:
    for number in np.unique(found.task).tolist():
        frame, file = int(np.flatnonzero(found.task == number)[0]), found.folder / TASKS
        if number not in tasks:
            there = f"those of {min(tasks)} to {max(tasks)}" if tasks else "none"
            raise DataError(f"{found.where(frame, 'task_index')}: task {number} is not in {file}, which has {there}")
        if not tasks[number].strip():
            raise DataError(f"{file}: task {number} is empty, and frame {frame} has it; policies need an instruction")


def _episodes(found: DatasetFiles, numbers: NDArray[np.int64]) -> list[Mapping[str, Any]]:
    """Rows of `meta/episodes`, which say of each episode what the frames say."""
    files = sorted((found.folder / EPISODES).glob("*/*.parquet"))
    if not files:
        raise DataError(f"{found.folder / EPISODES}: has no */*.parquet, which say where each episode is; copy or download the dataset anew")
    rows: dict[int, Mapping[str, Any]] = {}
    wanted = ("episode_index", "dataset_from_index", "dataset_to_index")
    for file in files:
        videos = [name for name in parquet_columns(file) if name.startswith("videos/")]
        table = read_parquet(file, (*wanted, *videos))
        columns = [_integers(file, table, name, 0).tolist() for name in wanted]
        for number, first, end, row in zip(*columns, table.select(videos).to_pylist() if videos else [{}] * len(table), strict=True):
            rows[number] = {**row, "first": first, "end": end, "file": file}
    for position, number in enumerate(numbers.tolist()):
        first, end = found.starts[position : position + 2].tolist()
        if number not in rows:
            raise DataError(f"{files[-1]}: there is no episode {number}, and frame {first} of {found.folder / DATA} is of it")
        told = rows[number]
        if (told["first"], told["end"]) != (first, end):
            says = f"episode {number} is frames {told['first']} to {told['end']}"
            raise DataError(f"{told['file']}: says that {says}, in {found.folder / DATA} it is {first} to {end}")
    lacking = sorted(rows.keys() - set(numbers.tolist()))
    if lacking:
        raise DataError(f"{found.folder / DATA}: has no frames of episode {lacking[0]}, which {rows[lacking[0]]['file']} lists; files are missing")
    return [rows[number] for number in numbers.tolist()]


def _numbers(files: tuple[Path, ...], firsts: NDArray[np.int64], name: str) -> NDArray[np.float64]:
    """A column of numbers, or of lists of them that are all as long, (frames, N)."""
    import pyarrow
    import pyarrow.compute

    parts: list[NDArray[np.float64]] = []
    for file, first in zip(files, firsts.tolist(), strict=False):
        column = read_parquet(file, (name,))[name].combine_chunks()
        types, kind = pyarrow.types, column.type
        nested = types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
        missing = np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))
        if len(missing):
            raise DataError(f"{file}, frame {first + int(missing[0])}, column {name!r}: is empty")
        try:
            values = column.flatten() if nested else column
            if not (types.is_integer(values.type) or types.is_floating(values.type) or types.is_boolean(values.type)):
                raise DataError(f"{file}: column {name!r} must hold numbers, its type is {kind}")
            numbers = np.asarray(values.to_numpy(zero_copy_only=False), np.float64)
            lengths = pyarrow.compute.list_value_length(column).to_numpy(zero_copy_only=False) if nested else np.ones(len(column), np.int64)
        except PARQUET_ERRORS as error:
            raise unreadable(file, error) from None
        width = parts[0].shape[1] if parts else int(lengths[0]) if len(lengths) else 0
        uneven = np.flatnonzero(lengths != width)
        if len(uneven):
            frame = int(uneven[0])
            raise DataError(f"{file}, frame {first + frame}, column {name!r}: has {int(lengths[frame])} numbers, those before have {width}")
        if len(column):
            parts.append(numbers.reshape(len(column), width))
    return np.concatenate(parts)
