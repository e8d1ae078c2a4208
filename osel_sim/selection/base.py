"""Checks that all selectors share."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.interface.selector import Choice, Context, State


class SelectorBase(ABC):
    """Checks that all selectors share. One overrides `_select`, `_update`, `_state`, `_load` and, where it keeps numbers by policy, `_add_policy`.

    Policies may come and go. Numbers by policy are kept for all that ever were, `known`, in an order that only grows; `columns` says which of them
    may be chosen now. So a policy that comes back is remembered.

    Args:
        policies: names to choose from, each once.
        context_dim: length of a context.
        seed: of everything random in the selector, in [0, 2**32).

    Raises:
        UsageError: no policies, one named twice, or a number out of range.
    """

    name: ClassVar[str]
    off_policy: ClassVar[bool] = False
    """Whether it may learn from outcomes of choices that it did not make itself, such as those of a log."""
    charges: Mapping[str, float] = MappingProxyType({})
    """What the choice of each policy is charged for, in reward, beyond what is learned: nothing unless a budget says so (`selection.budget`)."""

    retires: ClassVar[bool] = False
    """Whether it heeds `columns`, so that policies may retire."""

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int) -> None:
        self.policies = tuple(policies)
        self.known = self.policies
        self.columns: NDArray[np.int64] = np.arange(len(self.policies))
        if not self.policies or len(set(self.policies)) < len(self.policies):
            raise UsageError(f"a selector needs at least one policy, each named once, got {list(self.policies)}")
        if context_dim < 1:
            raise UsageError(f"context_dim must be at least 1, got {context_dim}")
        if not 0 <= seed < 2**32:
            raise UsageError(f"seed must lie in [0, 2**32), got {seed}")
        self.context_dim = context_dim
        self.seed = seed

    @property
    def settings(self) -> dict[str, Any]:
        """Hyper-parameters (JSON values); a state is only taken over by a selector of equal settings."""
        return {}

    def select(self, context: Context) -> Choice:
        """Choose a policy for an instance.

        Args:
            context: float32 (context_dim,).

        Raises:
            UsageError: wrong shape or type, or not finite.
        """
        self._check_context(context)
        return self._select(context)

    def update(self, context: Context, choice: Choice, reward: float) -> None:
        """Learn from the reward of an earlier choice for this context.

        Raises:
            UsageError: a context of the wrong form or a reward that is not finite.
            UnknownNameError: the choice is of a policy this selector does not have.
        """
        self._check_context(context)
        if choice.policy not in self.known:  # one that retired meanwhile may still come to an end
            raise UnknownNameError("policy", choice.policy, self.known, "the policies of this selector")
        if not math.isfinite(reward):
            raise UsageError(f"a reward must be finite, got {reward}; an episode that ended in error has none")
        self._update(context, choice, float(reward))

    def recall(self, context: Context, policy: str, propensities: Mapping[str, float]) -> Choice:
        """A choice that somebody else made, to be passed to `update` next: the selector counts it as one of its own.

        Args:
            policy: that was chosen.
            propensities: with which it was.

        Raises:
            UsageError: a context of the wrong form.
            UnknownNameError: it does not have the policy.
        """
        self._check_context(context)
        if policy not in self.policies:
            raise UnknownNameError("policy", policy, self.policies, "the policies of this selector")
        return self._recall(context, Choice(policy, dict(propensities)))

    def expected(self, context: Context) -> NDArray[np.float64] | None:
        """Expected reward of each policy for a context, (P,), up to a constant that all have; None of a selector that has none, and heeds no charges.

        Raises:
            UsageError: wrong shape or type, or not finite.
        """
        self._check_context(context)
        found = self._expected(context)
        return None if found is None else found[self.columns]

    def state_dict(self) -> State:
        """The whole state, as `Selector.state_dict` promises. Arrays are copies."""
        return {**self._header(), **self._state()}

    def load_state_dict(self, state: State) -> None:
        """Take over a state.

        Raises:
            DataError: it belongs to another kind of selector, other policies or settings, or lacks something.
        """
        for key, mine in {"known": None, **self._header()}.items():
            if state.get(key) != mine:
                raise DataError(f"selector state: {key} is {state.get(key)!r}, but this selector has {mine!r}")
        try:
            self._load(state)
        except (KeyError, ValueError, RuntimeError, TypeError) as error:
            raise DataError(f"selector state is incomplete or damaged ({type(error).__name__}: {error})") from None

    def add_policy(self, name: str) -> None:
        """Make one more policy available, as the last of `policies`. One that was there before is remembered.

        Raises:
            UsageError: it is there already.
        """
        if name in self.policies:
            raise UsageError(f"policy {name!r} is already among {', '.join(self.policies)}")
        self._add_policy(name)
        if name not in self.known:
            self.known = (*self.known, name)
        self._set_policies((*self.policies, name))

    def retire_policy(self, name: str) -> None:
        """Take a policy out: from now on it is not chosen, and propensities do not name it. What was learned is kept.

        Raises:
            UnknownNameError: it is not there.
            UsageError: it is the last one, or this selector cannot do without a policy that it had.
        """
        if not self.retires:
            raise UsageError(f"selector {self.name!r} cannot retire policies: its class says `retires = True` once it chooses among `columns` only")
        if name not in self.policies:
            raise UnknownNameError("policy", name, self.policies, "the policies of this selector")
        if len(self.policies) == 1:
            raise UsageError(f"policy {name!r} is the last one: add another before it retires")
        self._retire_policy(name)
        self._set_policies(tuple(policy for policy in self.policies if policy != name))

    def tell(self, told: Mapping[str, Any]) -> None:
        """Hear what policies declare, from now on: settings as the constructor takes them. Most selectors want to know nothing.

        Called before `add_policy`, of all policies, the new one included.
        """
        return None

    def _header(self) -> State:
        changed = {} if self.known == self.policies else {"known": list(self.known)}
        return {"selector": self.name, "policies": list(self.policies), "context_dim": self.context_dim, "settings": self.settings, **changed}

    def _set_policies(self, policies: tuple[str, ...]) -> None:
        self.policies = policies
        self.columns = np.array([self.known.index(policy) for policy in policies], np.int64)

    def _check_context(self, context: Context) -> None:
        if not isinstance(context, np.ndarray) or context.shape != (self.context_dim,) or context.dtype != np.float32:
            got = f"{context.dtype} {context.shape}" if isinstance(context, np.ndarray) else type(context).__name__
            raise UsageError(f"a context must be a float32 array ({self.context_dim},), got {got}")
        if not np.isfinite(context).all():
            raise UsageError("a context must be finite, got NaN or infinity")

    @abstractmethod
    def _select(self, context: Context) -> Choice: ...

    def _recall(self, context: Context, choice: Choice) -> Choice:
        """What `_select` notes besides choosing; returns the choice with the details that `_update` wants."""
        return choice

    @abstractmethod
    def _update(self, context: Context, choice: Choice, reward: float) -> None: ...

    def _expected(self, context: Context) -> NDArray[np.float64] | None:
        """The same of all known policies, in their order; overridden by selectors that subtract `_charged` from what they compare."""
        return None

    @property
    def _charged(self) -> NDArray[np.float64]:
        """The charges of all known policies, in their order."""
        return np.array([self.charges.get(name, 0.0) for name in self.known])

    @abstractmethod
    def _state(self) -> State: ...

    @abstractmethod
    def _load(self, state: State) -> None: ...

    def _add_policy(self, name: str) -> None:
        """Called before the name joins `policies`; it may be among `known`."""
        return None

    def _retire_policy(self, name: str) -> None:
        """Called before the name leaves `policies`."""
        return None
