"""A policy at the wheel: what fixes its chance, and what it has used up."""

import hashlib
from dataclasses import dataclass

from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Caller


@dataclass(frozen=True)
class Driver:
    """A policy ready to drive: its file and whom to ask."""

    spec: PolicySpec
    caller: Caller


@dataclass
class Tally:
    """What one driver has used up since it took over.

    Attributes:
        began: control steps of the episode when it took over.
        paid: cents beyond the price in its file (`osel_sim.interface.call.Call.paid`).
        paid_per_action: the same for an action of the chunk at hand.
    """

    spec: PolicySpec
    began: int = 0
    calls: int = 0
    actions: int = 0
    megabytes: float = 0.0
    paid: float = 0.0
    paid_per_action: float = 0.0

    @property
    def price(self) -> float:
        """Cents."""
        return self.spec.price.of(self.actions, self.calls, self.megabytes) + self.paid

    def made(self, actions: int) -> None:
        """Count actions of its chunk that were executed."""
        self.actions += actions
        self.paid += actions * self.paid_per_action


def episode_seed(instance_key: str, policy: str, repeat: int) -> tuple[int, ...]:
    """What fixes an episode's chance (network delays, noise on actions): the instance, the policy and the repeat, never the order of episodes."""
    return (*(int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") for text in (instance_key, policy)), repeat)


def monitor_seed(instance: str, policy: str, repeat: int = 0) -> tuple[int, ...]:
    """What fixes a monitor's chance in an episode: the instance, the policy that drives first, and the repeat."""
    return (*episode_seed(instance, policy, repeat), 2)
