"""What a recording has beyond its rollout log: `shards.jsonl`, one instance a line with its context, on disk as soon as it is there.

It goes into the rollout log when all instances are recorded. An instance has several lines if policies or an encoder were added meanwhile.
"""

import base64
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.formats.journal import Lines, read_lines
from osel_sim.formats.rollout_log import Row

SHARDS = "shards.jsonl"


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
        try:
            key, encoder, context = data["instance"], data["encoder"], data["context"]
            _put(rows, key, [Row(**row) for row in data["rows"]])
            if context is not None:
                contexts.setdefault(encoder, {})[key] = np.frombuffer(base64.b64decode(context), "<f4").astype(np.float32)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{folder / SHARDS}, line {number}: not a recorded instance ({error})") from None
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
