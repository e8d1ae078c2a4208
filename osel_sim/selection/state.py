"""A selector's state on disk: one safetensors file, arrays as tensors, everything else as JSON in its metadata."""

from pathlib import Path

import numpy as np

from osel_sim.core.tensor_file import TensorFile
from osel_sim.interface.selector import State

FILE = TensorFile("selector state", "osel_sim.selector_state.v1")


def save_state(state: State, path: Path) -> None:
    """Write a state so that the file is either the old one or the whole new one, whenever the process dies.

    Raises:
        DataError: the file cannot be written.
    """
    arrays = {name: value for name, value in state.items() if isinstance(value, np.ndarray)}
    FILE.write(path, arrays, {name: value for name, value in state.items() if name not in arrays})


def load_state(path: Path) -> State:
    """Read what `save_state` wrote.

    Raises:
        DataError: missing, unreadable, damaged, or another kind of file.
    """
    arrays, values = FILE.read(path)
    return {**arrays, **values}
