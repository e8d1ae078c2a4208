"""One check of a LeRobotDataset (format v3) before any work, for measuring and for training: its files are there, and fit together."""

import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.core.parquet import PARQUET_ERRORS, parquet_columns, read_parquet, unreadable
from osel_sim.ingestion.lerobot_files import EPISODES, DatasetFiles

INFO, TASKS, DATA = "meta/info.json", "meta/tasks.parquet", "data"
VERSION = 3


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
