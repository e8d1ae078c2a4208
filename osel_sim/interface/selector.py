"""What a selector is: it chooses a policy for a context and learns from the reward of that choice alone."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UnknownNameError, UsageError

Context = NDArray[np.float32]
"""An instance's context: float32 (context_dim,), finite."""

State = dict[str, Any]
"""A selector's whole state: numpy arrays and values that JSON can hold, by name. `osel_sim.selection.state` writes it to disk."""


@dataclass(frozen=True)
class Choice:
    """What a selector decided for one context.

    Attributes:
        policy: the chosen policy.
        propensities: probability with which each policy that was available would have been chosen; they sum to 1.
        details: what the selector wants back with `update` (PPO: its value estimate and log probability). Lets several choices be in flight at once.
    """

    policy: str
    propensities: dict[str, float]
    details: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.policy not in self.propensities:
            raise UnknownNameError("policy", self.policy, self.propensities, "the propensities of this choice")
        total = math.fsum(self.propensities.values())
        if not abs(total - 1.0) < 1e-6 or min(self.propensities.values()) < 0.0:
            raise UsageError(f"propensities must be >= 0 and sum to 1, got {self.propensities}")


class Selector(Protocol):
    """Chooses among `policies`. `select` and `update` alternate, or lag behind each other where episodes run at once."""

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of those that are available now."""
        ...

    def select(self, context: Context) -> Choice:
        """Choose a policy for an instance."""
        ...

    def update(self, context: Context, choice: Choice, reward: float) -> None:
        """Learn from the reward of an earlier choice for this context."""
        ...

    def state_dict(self) -> State:
        """Everything that decides what comes next, random state included: load it, go on, and the result is bit-identical to not having stopped."""
        ...

    def load_state_dict(self, state: State) -> None:
        """Take over a state of a selector of the same kind, policies and settings."""
        ...

    def add_policy(self, name: str) -> None:
        """Make one more policy available; what was learned of the others stays."""
        ...


@runtime_checkable
class Pays(Protocol):
    """A selector that wants to know what its choices cost, such as one that keeps to a budget."""

    def pay(self, policy: str, price: float) -> None:
        """Told once after each choice, before `update`, and where an error leaves nothing to learn too.

        Args:
            price: cents.
        """
        ...


@runtime_checkable
class Recalls(Protocol):
    """A selector that must be told of a choice that it did not make itself before `update`. Optional: a stranger's selector need not be one."""

    def recall(self, context: Context, policy: str, propensities: Mapping[str, float]) -> Choice:
        """The choice as if it had made it just now, to be passed to `update` next.

        Args:
            policy: that was chosen.
            propensities: with which it was.
        """
        ...


@runtime_checkable
class Shares(Protocol):
    """A selector that learns together with others of its kind, policies and settings, on other robots: they exchange what they learned, never images.

    Messages are numpy arrays and values that JSON can hold, by name, like a `State`. What one holds, and how many bytes, the selector's own docstring
    says.
    """

    def begin(self, first: State | None) -> State:
        """Begin to share, before the first decision; what was learned until now, such as in a warm start, all have in common and none tells.

        Args:
            first: what this returned on the first robot, for all to begin alike; None on the first one itself.

        Returns:
            what the others need to begin like this one; empty where all do so anyway.
        """
        ...

    def share(self) -> State:
        """What it learned from its own decisions since the last call, or since `begin`. It forgets nothing by that."""
        ...

    def absorb(self, messages: Sequence[State], own: int) -> None:
        """Take in what all robots shared at the same time.

        Args:
            messages: one of each robot, in their order.
            own: which of them is this selector's: it knows that one already, and may have decided and learned since.
        """
        ...


@runtime_checkable
class Changes(Protocol):
    """A selector whose policies may come and go while it learns. Optional: a stranger's selector need not be one.

    Contract: `policies` names those that may be chosen now, `select` gives propensities of these and no others, and what was learned of the policies
    that stay is kept. A policy that comes back is at the end of `policies`; whether the selector remembers it is its own affair.
    """

    policies: tuple[str, ...]

    def add_policy(self, name: str) -> None:
        """Make one more policy available, as the last of `policies`."""
        ...

    def retire_policy(self, name: str) -> None:
        """Take a policy out: from now on its probability is exactly 0."""
        ...


SelectorFactory = Callable[[Sequence[str], int, int], Selector]
"""Makes a selector of the policies' names, the length of a context and a seed: a class, or a function."""


def factory_name(factory: Callable[..., Any]) -> str:
    """What a selector, or a monitor, that is none of the registry's is called: by its `name`, else by its class or function."""
    return str(getattr(factory, "name", None) or getattr(factory, "__name__", type(factory).__name__))
