"""Decisions as a regression sees them: what a selector with a context has to share."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import State

FRESH = "fresh."
"""How the keys begin under which a state holds what is not yet shared."""


@dataclass
class Rows:
    """Decisions, one a row: sketched context, constants of the chosen policy's row, its index, and reward plus declared cost.

    Exchanged: these, of the robot's own decisions since the last exchange. The sketch is a random projection of the encoder's vector to 256 numbers
    at most (`osel_sim.selection.features.Sketch`), never an image. A message of n decisions has n * (4 * min(D, 256) + 8 * H + 16) bytes, where D
    is the length of a context (each part of it by itself) and H is 1, or 2 with declared skills: some 1,050 bytes a decision.

    For given features a regression's sufficient statistics are sums over rows, `Moments`, which add up. But features are fitted anew as contexts come
    in, those of a kernel or a network not by sums at all, and of a linear one only by sums in the sketch: 256 * 256 numbers a policy, which is more
    than the rows of 500 decisions. So the rows are what is sufficient for all of them, and the smaller message.
    """

    contexts: list[NDArray[np.float32]] = field(default_factory=list)
    heads: list[NDArray[np.float64]] = field(default_factory=list)
    chosen: list[int] = field(default_factory=list)
    targets: list[float] = field(default_factory=list)

    def add(self, context: NDArray[np.float32], head: NDArray[np.float64], chosen: int, target: float) -> None:
        """Append a decision."""
        self.contexts.append(context)
        self.heads.append(head)
        self.chosen.append(chosen)
        self.targets.append(target)

    def message(self, dimension: int, constants: int) -> State:
        """`contexts` float32 (n, dimension), `heads` float64 (n, constants), `chosen` int64 (n,), `targets` float64 (n,)."""
        return {
            "contexts": np.array(self.contexts, np.float32).reshape(-1, dimension),
            "heads": np.array(self.heads, np.float64).reshape(-1, constants),
            "chosen": np.array(self.chosen, np.int64),
            "targets": np.array(self.targets, np.float64),
        }

    def state(self, dimension: int, constants: int) -> dict[str, Any]:
        """The same under the keys of a selector's state."""
        return {f"{FRESH}{key}": value for key, value in self.message(dimension, constants).items()}

    @classmethod
    def of(cls, message: Mapping[str, Any]) -> "Rows":
        """What a message holds."""
        return cls(list(message["contexts"]), list(message["heads"]), message["chosen"].tolist(), message["targets"].tolist())
