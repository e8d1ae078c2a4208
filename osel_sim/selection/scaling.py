"""Contexts as a small network or a linear model likes them: few numbers of like size, learned from the contexts seen so far."""

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import Context, State
from osel_sim.selection.features import Components, Sketch

SEEN, TURN = "scale.seen", "scale.turn"
"""Keys of the state: the contexts so far, and how fitted components are turned."""

FIRST, LAST = 16, 2048
"""Components are fitted when so many contexts have been seen, whenever their number has doubled since, and for the last time at the second number."""


class RunningComponents:
    """Leading principal components of the contexts so far, half whitened, with a mean square of 1.

    A CLIP context's hundreds of dimensions are small and say mostly the same; a network with random weights then sees next to nothing of what tells
    instances apart. A new fit is turned (orthogonal Procrustes) so that contexts look as they did before as nearly as can be: what was learned on the
    old components holds on the new ones. Before the first fit all is 0.

    Args:
        context_dim: length of a context.
        components: how many numbers to make of it; those that the contexts do not fill are 0.

    Attributes:
        fits: how often they were fitted; what was transformed before the last time looks different now.
    """

    fits = 0

    def __init__(self, context_dim: int, components: int) -> None:
        self.dim = components
        self._sketch = Sketch(context_dim)
        self._seen = np.zeros((0, self._sketch.dim), np.float32)
        self._fitted = Components(components, 0.5)
        self._turn = np.zeros((0, components))

    def add(self, context: Context) -> None:
        """Take one more context into account."""
        if len(self._seen) < LAST:
            self._seen = np.concatenate([self._seen, self._sketch(context)[None].astype(np.float32)])
            if len(self._seen) >= FIRST and len(self._seen) & (len(self._seen) - 1) == 0:
                self._fit()

    def transform(self, contexts: NDArray[np.float32]) -> NDArray[np.float32]:
        """Components (..., dim) of contexts (..., context_dim)."""
        sketched = np.atleast_2d(self._sketch(contexts)).astype(np.float64)
        return self._features(sketched).astype(np.float32).reshape(*contexts.shape[:-1], self.dim)

    def stream(self, contexts: NDArray[np.float32]) -> NDArray[np.float32]:
        """Components of each of (T, context_dim) as they are when it has just been added; this object does not change."""
        copy = RunningComponents.__new__(RunningComponents)
        copy.dim, copy._sketch, copy._fitted = self.dim, self._sketch, Components(self.dim, 0.5)
        copy.load(self.state())
        found = np.empty((len(contexts), self.dim), np.float32)
        for row, context in enumerate(contexts):
            copy.add(context)
            found[row] = copy.transform(context)
        return found

    def state(self) -> State:
        """Arrays and values, copied."""
        fitted = {f"scale.fitted.{key}": value for key, value in self._fitted.state().items()}
        return {SEEN: self._seen.copy(), TURN: self._turn.copy(), **fitted}

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        self._seen, self._turn = state[SEEN].copy(), state[TURN].copy()
        prefix = "scale.fitted."
        self._fitted.load({key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)})

    def _fit(self) -> None:
        seen = self._seen.astype(np.float64)
        before = self._features(seen)
        fitted = Components(self.dim, 0.5)
        fitted.fit(seen)
        wide = np.eye(fitted.dim, self.dim) * np.sqrt(max(1, fitted.dim))  # as many numbers as there are to be, each of mean square 1
        if before.any():
            left, _, right = np.linalg.svd((fitted.transform(seen) @ wide).T @ before)
            wide = wide @ (left @ right)
        self._fitted, self._turn = fitted, np.ascontiguousarray(wide)
        self.fits += 1

    def _features(self, sketched: NDArray[np.float64]) -> NDArray[np.float64]:
        if not len(self._turn):
            return np.zeros((len(sketched), self.dim))
        return np.asarray(self._fitted.transform(sketched) @ self._turn, np.float64)
