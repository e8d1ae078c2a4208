"""Every policy equally often, at random: the floor of a comparison, and the way to gather unbiased data."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase


class UniformSelector(SelectorBase):
    """Chooses uniformly at random and learns nothing. See `SelectorBase` for the arguments."""

    name: ClassVar[str] = "random"
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int) -> None:
        super().__init__(policies, context_dim, seed)
        self._generator = np.random.default_rng(seed)

    def _select(self, context: Context) -> Choice:
        policy = self.policies[self._generator.integers(len(self.policies))]
        return Choice(policy, dict.fromkeys(self.policies, 1.0 / len(self.policies)))

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        return None

    def _state(self) -> State:
        return {"random": self._generator.bit_generator.state}

    def _load(self, state: State) -> None:
        self._generator.bit_generator.state = state["random"]
