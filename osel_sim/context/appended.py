"""What is appended to a context besides its text and images: the task's name, and columns of a table.

A selector is told how long the first part is and how long the appended one (`parts_of`), and finds out by itself which of them help.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.names import TASK
from osel_sim.core.files import content_digest
from osel_sim.interface.encoder import Context

LENGTH = 16
"""Of the part that a name becomes."""
TASK_NAME = f"+{TASK}#{LENGTH}"
"""What an encoder's identity is followed by where the task is appended."""
_PART = re.compile(r"\+[\w,]+(?:@[0-9a-f]+)?#(\d+)(?=\+|$)")


@dataclass(frozen=True)
class Appended:
    """Appended parts of some instances.

    Attributes:
        name: what the encoder's identity is followed by.
        parts: float32 (N, d).
    """

    name: str
    parts: NDArray[np.float32]


def name_part(value: str) -> Context:
    """A name as a pseudo-random vector (LENGTH,) of length one: the same everywhere, and different names are about orthogonal."""
    digest = content_digest(value)
    vector = np.random.default_rng(int(digest[:16], 16)).normal(size=LENGTH)
    return np.asarray(vector / np.linalg.norm(vector), np.float32)


def task_parts(tasks: Sequence[str]) -> Appended:
    """The names of tasks (N,), to be appended."""
    known = {task: name_part(task) for task in set(tasks)}
    return Appended(TASK_NAME, np.array([known[task] for task in tasks], np.float32).reshape(-1, LENGTH))


def column_parts(columns: Mapping[str, Sequence[str | float | None]]) -> Appended:
    """Columns (N,) of a table, to be appended. Numbers are standardised, and what is not there is their mean; another value becomes a `name_part`,
    and nothing where it is not there. A column is one of numbers where it has nothing else.
    """
    parts = [_numbers(values) if all(not isinstance(value, str) for value in values) else _names(values) for values in columns.values()]
    table = np.concatenate(parts, axis=1)
    name = ",".join(re.sub(r"\W", "_", column) for column in columns)
    own = "" if list(columns) == [TASK] else f"@{content_digest(table.tobytes())[:12]}"
    return Appended(f"+{name}{own}#{table.shape[1]}", table)


def parts_of(identity: str, dimension: int) -> tuple[int, ...]:
    """Lengths of the encoder's own part of a context and of what is appended to it; empty where nothing is."""
    appended = sum(int(length) for length in _PART.findall(identity))
    return (dimension - appended, appended) if appended else ()


def own_encoder(identity: str) -> str:
    """Identity of the encoder alone, without what is appended to its contexts."""
    return _PART.sub("", identity)


def _numbers(values: Sequence[str | float | None]) -> NDArray[np.float32]:
    numbers = np.array([np.nan if value is None else float(value) for value in values], np.float64)
    known = np.isfinite(numbers)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = np.abs(numbers[known]).max(initial=0.0)
        scaled = numbers / (largest or 1.0)  # squares of the largest numbers would be infinite
    centred = np.where(known, scaled - (scaled[known].mean() if known.any() else 0.0), 0.0)
    deviation = float(centred[known].std()) if known.any() else 0.0
    return np.asarray(centred / (deviation if deviation > 1e-9 else 1.0), np.float32)[:, None]


def _names(values: Sequence[str | float | None]) -> NDArray[np.float32]:
    known = {str(value): name_part(str(value)) for value in set(values) - {None}}
    return np.array([np.zeros(LENGTH) if value is None else known[str(value)] for value in values], np.float32).reshape(-1, LENGTH)
