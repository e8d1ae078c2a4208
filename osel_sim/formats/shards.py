"""What a recording has beyond its rollout log: `shards.jsonl`, one instance a line with its context, on disk as soon as it is there.

It goes into the rollout log when all instances are recorded. An instance has several lines if policies or an encoder were added meanwhile.
"""

import base64
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.formats.journal import Lines, read_lines
from osel_sim.formats.rollout_log import Row, row_fault
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import NAME, ROW, TEXT, Kind, fault

SHARDS = "shards.jsonl"
_ROWS = Kind("a list of objects", lambda value: isinstance(value, list) and all(isinstance(item, dict) for item in value))
_SHARD = {"instance": NAME, "rows": _ROWS, "encoder": NAME, "context": TEXT.or_null}


Rows = dict[str, dict[tuple[str, int], Row]]
Contexts = dict[str, dict[str, NDArray[np.float32]]]


def read_shards(folder: Path) -> tuple[Rows, Contexts]:
    """Rows and contexts, as `Shards` has them; nothing is written, so that the folder of a recording that goes on can be read.

    Raises:
        DataError: naming file and line.
    """
    rows: Rows = {}
    contexts: Contexts = {}
    for number, (data, _) in enumerate(read_lines(folder / SHARDS), 1):
        place = f"{folder / SHARDS}, line {number}"
        if problem := fault(data, _SHARD):
            raise DataError(f"{place}: not a recorded instance ({problem})")
        _put(rows, data["instance"], [_row(row, data["instance"], place) for row in data["rows"]])
        if data["context"] is not None:
            contexts.setdefault(data["encoder"], {})[data["instance"]] = _context(data["context"], place)
    return rows, contexts


def _put(known: Rows, instance: str, rows: list[Row]) -> None:
    known.setdefault(instance, {}).update({(row.policy, row.repeat): row for row in rows})


class Shards:
    """Recorded instances by key.

    Attributes:
        rows: instance -> its rows, by policy and repeat.
        contexts: encoder's identity -> instance -> context (d,); absent where a worker died before it was made.
    """

    def __init__(self, folder: Path) -> None:
        self.rows, self.contexts = read_shards(folder)
        self._lines = Lines(folder / SHARDS)

    def add(self, instance: str, rows: list[Row], encoder: str, context: NDArray[np.float32] | None) -> None:
        """Write one instance and wait until it is on disk."""
        encoded = None if context is None else base64.b64encode(context.astype("<f4").tobytes()).decode()
        self._lines.append({"instance": instance, "rows": [vars(row) for row in rows], "encoder": encoder, "context": encoded})
        _put(self.rows, instance, rows)
        if context is not None:
            self.contexts.setdefault(encoder, {})[instance] = context

    def close(self, remove: bool) -> None:
        """Close the file, and delete it once the rollout log holds everything."""
        self._lines.close()
        if remove:
            self._lines.file.unlink(missing_ok=True)


def _row(data: dict[str, Any], instance: str, place: str) -> Row:
    if problem := fault(data, ROW, optional=("score", "axes", "robot", "fallback_steps", "scene")):
        raise DataError(f"{place}: not a recorded instance ({problem})")
    row = Row(**data)
    if row.instance != instance or (problem := row_fault(row)):
        raise DataError(f"{place}: not a recorded instance ({problem if row.instance == instance else f'a row is of {quoted(row.instance)}'})")
    return row


def _context(text: str, place: str) -> NDArray[np.float32]:
    try:
        context = np.frombuffer(base64.b64decode(text, validate=True), "<f4").astype(np.float32)
    except ValueError as error:
        raise DataError(f"{place}: its context cannot be read ({error})") from None
    if not context.size or not np.isfinite(context).all():
        raise DataError(f"{place}: its context is not all finite numbers")
    return context
