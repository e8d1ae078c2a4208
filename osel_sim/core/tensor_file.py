"""Arrays and plain values in one safetensors file, the values as JSON in its metadata. No pickle: reading a file cannot run code."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.core.files import write_bytes

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class TensorFile:
    """One kind of file.

    Attributes:
        what: what it is called in messages.
        format: identifier in the file's metadata, with a version.
    """

    what: str
    format: str

    def write(self, file: Path, arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> None:
        """Write so that the file is either the old one or the whole new one, whenever the process dies.

        Args:
            values: what JSON can express; keys are sorted.

        Raises:
            DataError: the file cannot be written.
        """
        from safetensors.numpy import save

        contiguous = {name: np.ascontiguousarray(value) if value.ndim else value for name, value in arrays.items()}
        content = save(contiguous, metadata={"format": self.format, "values": json.dumps(values, sort_keys=True)})
        try:
            write_bytes(file, content, sync=True)
        except OSError as error:
            raise DataError(f"{file}: {self.what} cannot be written ({error.strerror})") from None

    def read(self, file: Path) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and values of a file that `write` wrote.

        Raises:
            DataError: missing, unreadable, damaged, or another kind of file.
        """
        from safetensors import SafetensorError, safe_open

        if not file.is_file():
            raise DataError(f"{file}: no such {self.what}")
        try:
            with safe_open(file, framework="numpy") as handle:
                metadata = handle.metadata() or {}
                if metadata.get("format") != self.format:
                    raise DataError(f"{file}: not a {self.what} (format {metadata.get('format')!r}, expected {self.format!r})")
                arrays = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118 (a file handle, not a dict)
            return arrays, dict(json.loads(metadata["values"]))
        except (OSError, SafetensorError, KeyError, ValueError, TypeError, RecursionError) as error:
            raise DataError(f"{file}: {self.what} cannot be read ({error})") from None
