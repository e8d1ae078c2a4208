"""What a recording has beyond its rollout log: `shards.jsonl`, one instance a line with its context, on disk as soon as it is there.

It goes into the rollout log when all instances are recorded. An instance has several lines if policies or an encoder were added meanwhile.
"""

import base64
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.formats.journal import Lines
from osel_sim.formats.rollout_log import Row

SHARDS = "shards.jsonl"


class Shards:
    """Recorded instances by key.

    Attributes:
        rows: instance -> its rows, by policy and repeat.
        contexts: encoder's identity -> instance -> context (d,); absent where a worker died before it was made.
    """

    def __init__(self, folder: Path) -> None:
        self._lines = Lines(folder / SHARDS)
        self.rows: dict[str, dict[tuple[str, int], Row]] = {}
        self.contexts: dict[str, dict[str, NDArray[np.float32]]] = {}
        for number, (data, _) in enumerate(self._lines.rows, 1):
            try:
                key, encoder, context = data["instance"], data["encoder"], data["context"]
                self._put(key, [Row(**row) for row in data["rows"]])
                if context is not None:
                    self.contexts.setdefault(encoder, {})[key] = np.frombuffer(base64.b64decode(context), "<f4").astype(np.float32)
            except (KeyError, TypeError, ValueError) as error:
                raise DataError(f"{self._lines.file}, line {number}: not a recorded instance ({error})") from None

    def add(self, instance: str, rows: list[Row], encoder: str, context: NDArray[np.float32] | None) -> None:
        """Write one instance and wait until it is on disk."""
        encoded = None if context is None else base64.b64encode(context.astype("<f4").tobytes()).decode()
        self._lines.append({"instance": instance, "rows": [vars(row) for row in rows], "encoder": encoder, "context": encoded})
        self._put(instance, rows)
        if context is not None:
            self.contexts.setdefault(encoder, {})[instance] = context

    def _put(self, instance: str, rows: list[Row]) -> None:
        self.rows.setdefault(instance, {}).update({(row.policy, row.repeat): row for row in rows})

    def close(self, remove: bool) -> None:
        """Close the file, and delete it once the rollout log holds everything."""
        self._lines.close()
        if remove:
            self._lines.file.unlink(missing_ok=True)
