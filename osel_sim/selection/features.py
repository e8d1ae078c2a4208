"""Low-dimensional features of a context, fitted to contexts alone: whitened components, and the similarity to landmarks among them."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh

from osel_sim.core.errors import UsageError
from osel_sim.core.files import content_digest
from osel_sim.interface.selector import State

Array = NDArray[np.float64]

SKETCH = 256
"""Contexts longer than this are projected to this length first, at random but always in the same way: distances survive it, and a fit stays quick."""

WARM = 2000
"""Of more warm contexts than these, evenly spaced ones are taken."""

NEGLIGIBLE = 1e-6
"""Components with less than this part of the largest variance are rounding, not context."""


class Features(Protocol):
    """What a context looks like to a linear model. Nothing here ever sees a reward, except where `fit` of a subclass says so."""

    @property
    def dim(self) -> int:
        """How many there are."""
        ...

    def fit(self, contexts: Array) -> None:
        """Learn the features from contexts (n, sketched dim); `dim` may change."""
        ...

    def transform(self, contexts: Array) -> Array:
        """Features (n, dim) of contexts (n, sketched dim)."""
        ...

    def state(self) -> State:
        """Arrays by name."""
        ...

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        ...


class Sketch:
    """Random projection (Johnson-Lindenstrauss) of long contexts; short ones pass through.

    The matrix depends on the length alone, not on a selector's seed: a state loads into a selector of any seed.

    Args:
        parts: lengths of the parts of a context, each of which is projected by itself; empty where it is one whole.

    Attributes:
        parts: what their lengths become.
    """

    def __init__(self, context_dim: int, parts: Sequence[int] = ()) -> None:
        parts = parts or (context_dim,)
        self.parts = tuple(min(part, SKETCH) for part in parts)
        self.dim = sum(self.parts)
        self._ends = np.cumsum([0, *parts]).tolist()
        self._matrices = [_projection(part) if part > SKETCH else None for part in parts]

    def __call__(self, contexts: NDArray[np.float32]) -> NDArray[np.float32]:
        """Contexts (..., sum of parts) -> (..., dim)."""
        if all(matrix is None for matrix in self._matrices):
            return contexts
        parts = [contexts[..., start:end] for start, end in pairwise(self._ends)]
        short = [part if matrix is None else part @ matrix for part, matrix in zip(parts, self._matrices, strict=True)]
        return short[0] if len(short) == 1 else np.concatenate(short, axis=-1)


def warm_table(contexts: ArrayLike | None, context_dim: int, sketch: Sketch) -> tuple[Array, str | None]:
    """Contexts to learn features from before the first decision, sketched, and a digest of all of them; none where there are none.

    Args:
        contexts: (n, context_dim).

    Raises:
        UsageError: contexts of another form.
    """
    if contexts is None:
        return np.zeros((0, sketch.dim)), None
    table = np.ascontiguousarray(contexts, np.float32)
    if table.ndim != 2 or table.shape[1] != context_dim or not len(table) or not np.isfinite(table).all():
        raise UsageError(f"warm_contexts must be a finite table (n, {context_dim}), got shape {table.shape}")
    few = table[np.linspace(0, len(table) - 1, min(WARM, len(table))).astype(np.int64)]
    return sketch(few).astype(np.float64), content_digest(table.tobytes())


def _projection(length: int) -> NDArray[np.float32]:
    return np.random.default_rng(length).normal(size=(length, SKETCH)).astype(np.float32) / np.float32(np.sqrt(SKETCH))


class Part:
    """Features of some columns of a context.

    Args:
        features: fresh ones.
        columns: of the sketched context.
    """

    def __init__(self, features: Features, columns: slice) -> None:
        self._features, self._columns = features, columns

    @property
    def dim(self) -> int:
        """Of the features."""
        return self._features.dim

    def fit(self, contexts: Array) -> None:
        """Learn from these columns."""
        self._features.fit(contexts[:, self._columns])

    def transform(self, contexts: Array) -> Array:
        """Features of these columns."""
        return self._features.transform(contexts[:, self._columns])

    def state(self) -> State:
        """Of the features."""
        return self._features.state()

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        self._features.load(state)


class Components:
    """Leading principal components, whitened in part and scaled to a mean squared length of 1.

    Args:
        components: how many at most.
        whitening: 1 gives every component the same variance, 0 leaves the variances as they are.
    """

    def __init__(self, components: int, whitening: float) -> None:
        self._components, self._whitening = components, whitening
        self.dim = 0
        self._mean, self._matrix = np.zeros(0), np.zeros((0, 0))

    def fit(self, contexts: Array) -> None:
        """Constant contexts have no components: `dim` is then 0."""
        self._mean = contexts.mean(axis=0)
        centred = contexts - self._mean
        length = contexts.shape[1]
        leading = (max(length - self._components, 0), length - 1)
        variances, directions = eigh(centred.T @ centred / len(contexts), subset_by_index=leading, check_finite=False)
        kept = variances > max(NEGLIGIBLE * variances[-1], np.finfo(np.float32).eps * float(self._mean @ self._mean))
        variances, directions = variances[kept], directions[:, kept]
        self.dim = len(variances)
        scaled = directions * variances ** (-0.5 * self._whitening) / np.sqrt(max((variances ** (1.0 - self._whitening)).sum(), 1e-300))
        # In the order that a loaded state has: products of arrays in another order round differently.
        self._matrix = np.ascontiguousarray(scaled)

    def transform(self, contexts: Array) -> Array:
        """(n, sketched dim) -> (n, dim)."""
        return np.asarray((contexts - self._mean) @ self._matrix) if self.dim else np.zeros((len(contexts), 0))

    def state(self) -> State:
        """Mean and matrix."""
        return {"mean": self._mean.copy(), "matrix": self._matrix.copy()}

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        self._mean, self._matrix = state["mean"].copy(), state["matrix"].copy()
        self.dim = self._matrix.shape[1]


class Landmarks:
    """A Gaussian kernel on the components, in coordinates: features whose inner products are the kernel's (Nystroem).

    Contexts that lie together share what is learned, those far apart do not, whatever shape the regions have that a policy is good in. Landmarks are
    the contexts that the ones before them explain least (pivoted Cholesky decomposition of the kernel matrix), so that a few dozen tight
    clusters need a few dozen features.

    Args:
        components, whitening: see `Components`.
        width: of the kernel, where 1 is the root mean squared distance of a context from the mean of all.
        landmarks: how many at most.
    """

    tolerance = 0.02
    """No more landmarks once every context is explained to this part of its variance."""

    def __init__(self, components: int, whitening: float, width: float, landmarks: int) -> None:
        self._space = Components(components, whitening)
        self._width, self._most = width, landmarks
        self.dim = 0
        self._landmarks, self._solve = np.zeros((0, 0)), np.zeros((0, 0))

    def fit(self, contexts: Array) -> None:
        """Components first, then landmarks among these contexts."""
        self._space.fit(contexts)
        points = self._space.transform(contexts)
        unexplained, chosen = np.ones(len(points)), list[int]()
        columns = np.zeros((len(points), min(self._most, len(points)) if self._space.dim else 0))
        for column in range(columns.shape[1]):
            pivot = int(unexplained.argmax())
            if unexplained[pivot] < self.tolerance:
                break
            similarity = self._kernel(points, points[pivot : pivot + 1])[:, 0]
            columns[:, column] = (similarity - columns[:, :column] @ columns[pivot, :column]) / np.sqrt(unexplained[pivot])
            unexplained = np.maximum(unexplained - columns[:, column] ** 2, 0.0)
            chosen.append(pivot)
        self.dim = len(chosen)
        self._landmarks = points[chosen]
        self._solve = np.linalg.inv(columns[chosen, : self.dim]).T.copy()

    def transform(self, contexts: Array) -> Array:
        """(n, sketched dim) -> (n, dim), each row of length 1 at most."""
        return self._kernel(self._space.transform(contexts), self._landmarks) @ self._solve if self.dim else np.zeros((len(contexts), 0))

    def state(self) -> State:
        """Components, landmarks and their factor."""
        return {**self._space.state(), "landmarks": self._landmarks.copy(), "solve": self._solve.copy()}

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        self._space.load(state)
        self._landmarks, self._solve = state["landmarks"].copy(), state["solve"].copy()
        self.dim = len(self._landmarks)

    def _kernel(self, first: Array, second: Array) -> Array:
        squared = (first**2).sum(axis=1)[:, None] + (second**2).sum(axis=1) - 2.0 * first @ second.T
        return np.asarray(np.exp(np.maximum(squared, 0.0) / (-2.0 * self._width**2)))
