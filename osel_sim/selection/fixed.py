"""Always the same policy: what a user has who does not select."""

from collections.abc import Sequence
from typing import Any, ClassVar

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase


class FixedSelector(SelectorBase):
    """Chooses `policy`, whatever the context.

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        policy: the one to choose.

    Raises:
        UnknownNameError: `policy` is not among `policies`.
    """

    name: ClassVar[str] = "fixed"
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, *, policy: str) -> None:
        super().__init__(policies, context_dim, seed)
        if policy not in self.policies:
            raise UnknownNameError("policy", policy, self.policies, "the policies to choose from")
        self.policy = policy

    @property
    def settings(self) -> dict[str, Any]:
        """The policy."""
        return {"policy": self.policy}

    def _select(self, context: Context) -> Choice:
        return Choice(self.policy, {name: float(name == self.policy) for name in self.policies})

    def _retire_policy(self, name: str) -> None:
        if name == self.policy:
            others = " or ".join(f"fixed:{policy}" for policy in self.policies if policy != name)
            raise UsageError(f"policy {name!r} is the one that fixed:{name} always chooses: take another selector, such as {others}")

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        return None

    def _state(self) -> State:
        return {}

    def _load(self, state: State) -> None:
        return None
