"""Decisions as a regression sees them: what a selector with a context has to share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import State
from osel_sim.selection.features import Sketch

FRESH = "fresh."
"""How the keys begin under which a state holds what is not yet shared."""


def part_of(state: State, prefix: str) -> State:
    """What of a state stands under names that begin so, without that beginning."""
    return {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}


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


class SharedRows:
    """Makes a regression that keeps its decisions one that shares them (`osel_sim.interface.selector.Shares`).

    From them each robot computes what one that saw everything would: `Rows` says what is sent and how large it is. How far the context matters, which
    features are used (`auto` weighs several by their evidence) and what was forgotten follow from them on every robot alike.
    """

    _sketch: Sketch
    _guess: NDArray[np.float64]
    _costs: NDArray[np.float64]
    _contexts: list[NDArray[np.float32]]
    _heads: list[NDArray[np.float64]]
    _chosen: list[int]
    _targets: list[float]
    _counts: NDArray[np.int64]
    _known: int
    _fresh: Rows | None = None  # of its own decisions since the last exchange; None where it does not share

    def begin(self, first: State | None) -> State:
        """Nothing is needed to begin alike: see `Rows`."""
        self._fresh = Rows()
        return {}

    def share(self) -> State:
        """Its decisions since the last call, as `Rows` says."""
        message = (self._fresh or Rows()).message(self._sketch.dim, len(self._guess))
        self._fresh = Rows()
        return message

    def absorb(self, messages: Sequence[State], own: int) -> None:
        """Learn from the others' decisions as from its own. Where nothing was learned since, all stand in the order of the robots, so that each
        comes to the very same numbers."""
        rows = [Rows.of(message) for message in messages]
        mine = len(rows[own].chosen)
        if mine and self._known <= len(self._chosen) - mine and self._chosen[-mine:] == rows[own].chosen and not self._newer():
            for seen in (self._contexts, self._heads, self._chosen, self._targets):
                del seen[-mine:]
        else:
            rows[own] = Rows()
        for row in rows:
            self._contexts += row.contexts
            self._heads += row.heads
            self._chosen += row.chosen
            self._targets += row.targets
        self._counts = np.bincount(np.array(self._chosen, np.int64), minlength=len(self._costs))

    def _newer(self) -> bool:
        """Whether it decided since it last shared."""
        return self._fresh is not None and bool(self._fresh.chosen)

    def _note(self) -> None:
        """Keep its last decision for the next exchange."""
        if self._fresh is not None:
            self._fresh.add(self._contexts[-1], self._heads[-1], self._chosen[-1], self._targets[-1])

    def _fresh_state(self) -> State:
        """What is not yet shared, under the keys of a selector's state."""
        return {} if self._fresh is None else self._fresh.state(self._sketch.dim, len(self._guess))

    def _load_fresh(self, state: State) -> None:
        shared = part_of(state, FRESH)
        self._fresh = Rows.of(shared) if shared else None
