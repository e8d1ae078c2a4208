"""What all monitors share."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.monitor import Candidate, DecisionPoint, Turn, Watched


class MonitorBase(ABC):
    """A monitor that learns nothing, unless `learn` is overridden.

    Args:
        candidates: the policies that may drive, each once.
        picture_dim: length of a picture.
        seed: of everything random in it, >= 0.

    Attributes:
        policies: names of the candidates.
        chance: random numbers of the episode at hand.

    Raises:
        UsageError: no candidates, or one named twice.
    """

    off_policy: ClassVar[bool] = False
    """Whether it may learn from episodes that it did not watch itself, such as those of a log."""

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int) -> None:
        self.candidates, self.picture_dim, self.seed = tuple(candidates), picture_dim, seed
        self.policies = tuple(candidate.name for candidate in candidates)
        if not self.policies or len(set(self.policies)) < len(self.policies):
            raise UsageError(f"a monitor needs at least one policy, each named once, got {list(self.policies)}")
        self.remote = frozenset(candidate.name for candidate in candidates if candidate.remote)
        self.chance = np.random.default_rng(seed)

    def reset(self, instruction: str, driver: str, seed: tuple[int, ...]) -> None:
        """A new episode."""
        self.chance = np.random.default_rng((self.seed, *seed))

    @abstractmethod
    def drives_on(self, point: DecisionPoint) -> Turn:
        """Who drives on."""

    def learn(self, watched: Watched) -> None:
        """Nothing is learnt."""
        return None

    def other(self, driver: str) -> str:
        """Whom to hand over to where nobody is named: the first on the other side of the network, else the first other one; itself if it is alone."""
        others = [name for name in self.policies if name != driver]
        across = [name for name in others if (name in self.remote) != (driver in self.remote)]
        return (across or others or [driver])[0]

    def known(self, policy: str, parameter: str) -> str:
        """A policy's name that a parameter gives.

        Raises:
            UnknownNameError: it is none of the candidates.
        """
        if policy not in self.policies:
            raise UnknownNameError("policy", policy, self.policies, f"{parameter} must be one of those that may drive")
        return policy


def number(text: str, parameter: str, low: float, high: float = float("inf"), whole: bool = False) -> float:
    """A parameter that is a number within bounds.

    Raises:
        UsageError: naming the parameter and what it must be.
    """
    try:
        value = float(int(text) if whole else text)
    except (ValueError, OverflowError):
        value = float("nan")
    if not (low <= value <= high and value < float("inf")):
        kind = "an integer" if whole else "a number"
        bounds = f"of at least {low:g}" if high == float("inf") else f"in [{low:g}, {high:g}]"
        raise UsageError(f"{parameter} must be {kind} {bounds}, got {text!r}")
    return value
