"""Ways of choosing of one's own, of which off-policy estimates say what they would have earned."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from osel_sim.analysis.live import LiveLog
from osel_sim.analysis.log import Array, LoggedInstance
from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.formats.toml_types import quoted
from osel_sim.interface.encoder import Context

Target = Callable[[LoggedInstance, Context], Mapping[str, float]]
"""Of an instance and its context: with which probability each policy is chosen; one that is not named has none."""

CLOSE = 1e-6
"""Probabilities sum to 1 to so much; they are then made to sum to it."""


def probabilities_of(name: str, target: Target, live: LiveLog) -> Array:
    """Probabilities (T, P) with which a target chooses in a run's decisions.

    Raises:
        UsageError: they are no probabilities, or do not sum to 1; names the target and the decision.
        UnknownNameError: a policy that the run could not choose.
    """
    log = live.outcomes
    found = np.zeros((len(log), len(log.policies)))
    for row, (instance, context) in enumerate(zip(log.instances, log.contexts, strict=True)):
        answer = target(instance, context)
        place = f"target {name!r}, decision {row} ({instance.key})"
        if not isinstance(answer, Mapping):
            raise UsageError(f"{place}: must return policy -> probability, got {quoted(answer)}")
        for policy, value in answer.items():
            if policy not in log.policies:
                raise UnknownNameError("policy", str(policy), log.policies, place)
            try:
                found[row, log.policies.index(policy)] = value
            except (TypeError, ValueError):
                raise UsageError(f"{place}: the probability of {policy!r} must be a number, got {quoted(value)}") from None
        total = float(found[row].sum())
        if not (found[row] >= 0.0).all() or not abs(total - 1.0) <= CLOSE:
            raise UsageError(f"{place}: probabilities must be >= 0 and sum to 1, got {quoted(dict(answer))}")
        found[row] /= total
    return found


def check_names(names: Iterable[str], policies: Iterable[str]) -> None:
    """Refuse names of targets that stand for something else.

    Raises:
        UsageError: one is taken, or there twice.
    """
    taken = {"random", "greedy", *(f"fixed:{policy}" for policy in policies)}
    for name in names:
        if name in taken:
            raise UsageError(f"a target of your own cannot be called {name!r}: another one has that name")
        taken.add(name)
