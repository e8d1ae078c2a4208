"""What policies are said to be able to do, as something that a selector can know of a context before its first decision."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.core.files import content_digest
from osel_sim.interface.selector import Context

Array = NDArray[np.float64]

DECLARED, NOT_DECLARED = 0.5, -0.5
"""Reward + cost to expect of a policy where it declares the skill that is asked for, and where it does not: from the centre of all, in standard
deviations of them."""
UNKNOWN = 0.8
"""Of a policy that declares nothing: as if it declared four skills of five."""


@dataclass(frozen=True)
class Skills:
    """Skills with examples of what is asked of them, and who declares which.

    A context is taken for one of the skill whose examples' mean lies nearest. How far that can be relied on is measured on the examples themselves:
    the share that is nearest to its own skill when left out of it.

    Args:
        examples: skill -> contexts (n, D) of instructions that ask for it, all of one (blank) image, so that only what the text does counts.
        able: policy -> the skills that it declares. Policies that are not in it declare nothing.

    Raises:
        UsageError: no skill, one without examples, examples of different length or not finite, or a policy declares a skill that has none.
    """

    examples: Mapping[str, NDArray[np.float32]]
    able: Mapping[str, tuple[str, ...]]

    def __post_init__(self) -> None:
        shapes = {name: np.shape(contexts) for name, contexts in self.examples.items()}
        if not shapes or any(len(shape) != 2 or shape[0] < 1 or shape[1] != next(iter(shapes.values()))[1] for shape in shapes.values()):
            raise UsageError(f"skills need examples (n, D) of one length D, got shapes {shapes}")
        if not all(np.isfinite(contexts).all() for contexts in self.examples.values()):
            raise UsageError("examples of skills must be finite")
        for policy, names in self.able.items():
            if not set(names) <= set(shapes):
                raise UsageError(f"policy {policy!r} declares {', '.join(sorted(set(names) - set(shapes)))}, of which there are no examples")

    @property
    def dimension(self) -> int:
        """Length of a context."""
        return int(next(iter(self.examples.values())).shape[1])

    @cached_property
    def digest(self) -> str:
        """Of everything, for a selector's settings."""
        examples = (name.encode() + b"\0" + np.ascontiguousarray(self.examples[name], np.float32).tobytes() for name in sorted(self.examples))
        return content_digest(*examples, repr(sorted((policy, sorted(names)) for policy, names in self.able.items())))

    @cached_property
    def reliability(self) -> float:
        """Share of the examples, in [0, 1], that are nearest to the mean of their own skill, themselves left out. Single examples are not counted."""
        hits: list[bool] = []
        for index, contexts in enumerate(self._contexts):
            for row in range(len(contexts) if len(contexts) > 1 else 0):
                means = self._means.copy()
                means[index] = np.delete(contexts, row, axis=0).mean(axis=0)
                hits.append(int(_scores(means, contexts[row]).argmax()) == index)
        return float(np.mean(hits)) if hits else 1.0

    def nearest(self, context: Context) -> str:
        """The skill that a context is taken for."""
        return list(self.examples)[self._index(context)]

    def share(self, context: Context, policies: Sequence[str]) -> Array:
        """How far each policy declares what a context asks for, (P,) in [0, 1]."""
        index = self._index(context)
        return np.array([self._columns[policy][index] if policy in self._columns else UNKNOWN for policy in policies])

    def _index(self, context: Context) -> int:
        return int(_scores(self._means, context).argmax())

    @cached_property
    def _contexts(self) -> list[Array]:
        return [np.asarray(contexts, np.float64) for contexts in self.examples.values()]

    @cached_property
    def _means(self) -> Array:
        return np.stack([contexts.mean(axis=0) for contexts in self._contexts])

    @cached_property
    def _columns(self) -> dict[str, Array]:
        """Policy -> how far it declares each skill, (K,)."""
        result = {}
        for policy, names in self.able.items():
            declared = np.array([float(name in names) for name in self.examples])
            result[policy] = self.reliability * declared + (1.0 - self.reliability) * declared.mean()
        return result


def _scores(means: Array, context: NDArray[np.floating]) -> Array:
    """The higher, the nearer; what all means have in common, such as the part of a blank image, does not count."""
    return np.asarray(means @ context.astype(np.float64) - 0.5 * (means**2).sum(axis=1))
