"""What the files of a LeRobotDataset hold, numbers and images; what is wrong with them is named with file, frame and column.

The files are read here and not by `LeRobotDataset`, which asks the hub for whatever it misses, converts all columns, wanted or not, and keeps a
second copy of them in its cache. Videos are decoded by LeRobot.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError, did_you_mean
from osel_sim.core.images import load_image
from osel_sim.core.parquet import PARQUET_ERRORS, open_parquet, read_parquet, unreadable

EPISODES = "meta/episodes"
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
        place, first, cells = self._read.get(column, (None, 0, ()))
        if place != file or not first <= row < first + len(cells):
            try:
                content = open_parquet(file)
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
