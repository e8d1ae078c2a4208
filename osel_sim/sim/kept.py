"""What takes long to make of a scene's parts is made once on a machine, and kept in the user's cache folder."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.arrays import read_arrays
from osel_sim.core.caches import prepare
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic, content_digest

Arrays = dict[str, NDArray[Any]]


def kept(name: str, made_of: str, make: Callable[[], Arrays]) -> Arrays:
    """What `make` gives, or gave before of the same.

    Args:
        name: how the file's begins.
        made_of: all that the arrays depend on, versions of libraries included.
    """
    file = prepare() / "osel_sim" / f"{name}_{content_digest(made_of)[:16]}.npz"
    try:
        return read_arrays(file, name)
    except DataError:  # missing, or torn by a crash: make it anew
        arrays = make()
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic(file, shared=True) as partial, partial.open("wb") as handle:
        np.savez(handle, **arrays)  # type: ignore[arg-type]
    return arrays
