"""What predicates of goals and skills of the scripted expert are. Task files name them, as `opened(drawer)`.

Another package adds one through the entry-point group `osel_sim.predicates` or `osel_sim.skills`: `NAME = "module:attribute"`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Signature = tuple[tuple[str, ...], ...]
"""Kinds of things that each argument may be of, of `osel_sim.formats.terms.KINDS`."""


@dataclass(frozen=True)
class Predicate:
    """What can be true of a world, and called as a function says whether it is.

    Attributes:
        kinds: of its arguments.
        holds: of an `osel_sim.sim.world.World` and the names of the things that fill the arguments.
    """

    kinds: Signature
    holds: Callable[..., bool]

    def __call__(self, world: Any, *things: str) -> bool:
        """Whether it is true now; arguments as those of `holds`."""
        return bool(self.holds(world, *things))


def predicate(*kinds: tuple[str, ...]) -> Callable[[Callable[..., bool]], Predicate]:
    """Make a predicate of a function; give the kinds that each argument may be of."""
    return lambda holds: Predicate(kinds, holds)


@dataclass(frozen=True)
class Skill:
    """What the scripted expert can do, one action at a time. It should depend on the state alone, so that it can be learned from observations.

    Attributes:
        kinds: of its arguments.
        act: of an `osel_sim.sim.expert.Expert` and the names of the things that fill the arguments: the action (7,), which is clipped to [-1, 1],
            and whether the skill is done, in which case the action is not taken.
        achieved: of the same arguments, whether what the skill is for has been reached already; then it is passed over, with what leads to it.
    """

    kinds: Signature
    act: "Callable[..., tuple[NDArray[np.float64], bool]]"
    achieved: Callable[..., bool] | None = None
