"""A selector's state on disk: one safetensors file, arrays as tensors, everything else as JSON in its metadata. No pickle."""

import json
import os
from pathlib import Path

import numpy as np

from osel_sim.core.errors import DataError
from osel_sim.interface.selector import State

FORMAT = "osel_sim.selector_state.v1"


def save_state(state: State, path: Path) -> None:
    """Write a state so that the file is either the old one or the whole new one, whenever the process dies.

    Raises:
        DataError: the file cannot be written.
    """
    from safetensors.numpy import save

    arrays = {name: np.ascontiguousarray(value) if value.ndim else value for name, value in state.items() if isinstance(value, np.ndarray)}
    values = {name: value for name, value in state.items() if name not in arrays}
    content = save(arrays, metadata={"format": FORMAT, "values": json.dumps(values, sort_keys=True)})
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as handle:
            handle.write(content)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise DataError(f"{path}: selector state cannot be written ({error.strerror})") from None


def load_state(path: Path) -> State:
    """Read what `save_state` wrote.

    Raises:
        DataError: missing, unreadable, damaged, or another kind of file.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise DataError(f"{path}: no such selector state")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise DataError(f"{path}: not a selector state (format {metadata.get('format')!r}, expected {FORMAT!r})")
            state: State = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (a file handle, not a dict)
        state.update(json.loads(metadata["values"]))
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise DataError(f"{path}: selector state cannot be read ({error})") from None
    return state
