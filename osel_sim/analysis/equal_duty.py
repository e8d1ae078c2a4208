"""Blind and random handovers of the same duty as a monitor's: what switching as much, but without looking, would have come to.

Duty is the share of control steps that remote policies drive. Blind handovers have it in steps, one for each decision point and target. Two of them
of the same target, mixed by the toss of a coin, have any duty between theirs; chance has any by how likely it is to hand over.
"""

from dataclasses import dataclass

import numpy as np

from osel_sim.analysis.handovers import Handovers, blind, by_chance, never, outcomes, with_starts
from osel_sim.analysis.log import Array
from osel_sim.analysis.moment_log import MomentLog

_CLOSE = 1e-4
_HALVINGS = 20


@dataclass(frozen=True)
class Arm:
    """Handovers that do not look.

    Attributes:
        name: in words.
        handovers: (N, P, R, M, P).
        duty: of theirs.
    """

    name: str
    handovers: Handovers
    duty: float


def blind_arms(log: MomentLog, wanted: float, share: Array) -> list[Arm]:
    """Mixtures of blind handovers to each policy, and of none, that come to a duty; of each target the one whose two parts lie closest to it.

    Args:
        wanted: the duty.
        share: (N, P), how likely the start selector is to choose each first policy.

    Returns:
        one arm a target that can come to that duty at all.
    """
    arms = []
    for to, name in enumerate(log.policies):
        parts = {"never": never(log)} | {f"blind:{call}:{name}": blind(log, call, to) for call in log.calls}
        driven = {label: _driven(log, handovers, share) for label, handovers in parts.items()}
        below = [label for label, found in driven.items() if found.duty <= wanted + _CLOSE]
        above = [label for label, found in driven.items() if found.duty >= wanted - _CLOSE]
        if not below or not above:
            continue
        low, high = max(below, key=lambda label: driven[label].duty), min(above, key=lambda label: driven[label].duty)
        if low == high == "never":
            continue  # that is no handover at all
        weight = _weight(driven[low], driven[high], wanted)
        label = high if low == high else f"{low} or {high}"
        arms.append(Arm(label, (1.0 - weight) * parts[low] + weight * parts[high], wanted))
    return arms


def random_arm(log: MomentLog, wanted: float, share: Array) -> Arm | None:
    """Chance that hands over at each decision point, to one of the policies that bring duty to what is wanted. None where none can."""
    start = _driven(log, never(log), share).duty
    targets = [column for column, remote in enumerate(log.remote) if bool(remote) == (wanted > start)]

    def short(chance: float) -> bool:
        return (_driven(log, by_chance(log, chance, targets), share).duty - wanted) * (start - wanted) > 0.0

    if not targets or abs(wanted - start) < _CLOSE or short(1.0):
        return None
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if short(middle) else (low, middle)
    return Arm(f"random:{high:.2f}", by_chance(log, high, targets), wanted)


@dataclass(frozen=True)
class _Driven:
    """Control steps of all instances together, each the mean over its repeats, and those of them that remote policies drive."""

    steps: float
    remote: float

    @property
    def duty(self) -> float:
        return self.remote / self.steps if self.steps else 0.0


def _driven(log: MomentLog, handovers: Handovers, share: Array) -> _Driven:
    found = outcomes(log, handovers, ("steps", "remote_steps"))
    return _Driven(*(float(np.nansum(with_starts(found[name], share))) for name in ("steps", "remote_steps")))


def _weight(low: _Driven, high: _Driven, wanted: float) -> float:
    """Weight of the second in a mixture of that duty, which is a ratio of two means."""
    change = high.remote - low.remote - wanted * (high.steps - low.steps)
    return float(np.clip((wanted * low.steps - low.remote) / change, 0.0, 1.0)) if abs(change) > 1e-9 else 0.0
