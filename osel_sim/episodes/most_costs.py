"""The most that an episode can cost, from the policies' files alone: what a budget must be able to pay."""

import math
from collections.abc import Mapping, Sequence

from osel_sim.formats.merged_policy import parts_of
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec

OVERHEAD = 65_536
"""Bytes of a question and its answer, at most, besides images and actions: state, instruction, names, the server's own timings."""


def most_costs(policies: Sequence[PolicySpec], everyone: Sequence[PolicySpec], horizon: int, environment: EnvironmentSpec) -> dict[str, float]:
    """Policy -> cents of an episode that goes on to the horizon, and is then driven as long again by the fallback.

    Args:
        policies: to choose from.
        everyone: those and their fallbacks.
        horizon: control steps of the longest task.
        environment: what they drive.
    """
    named = {spec.name: spec for spec in everyone}
    return {spec.name: _alone(spec, horizon, environment) + _fallback(spec, named, horizon, environment) for spec in policies}


def _alone(spec: PolicySpec, horizon: int, environment: EnvironmentSpec) -> float:
    """Of a merge all parts are asked and paid, at every call of it."""
    calls = math.ceil(horizon / spec.execute)
    return sum(part.price.of(horizon, calls, calls * _megabytes(part, horizon, environment)) for part in parts_of(spec))


def _megabytes(spec: PolicySpec, horizon: int, environment: EnvironmentSpec) -> float:
    """What a call moves, at most."""
    images = len(spec.cameras) * 3 * spec.image_size**2 * spec.history
    return 1e-6 * (images + 8 * environment.action.dimension * max(spec.execute, horizon) + OVERHEAD) if spec.is_remote else 0.0


def _fallback(spec: PolicySpec, named: Mapping[str, PolicySpec], horizon: int, environment: EnvironmentSpec) -> float:
    name = spec.remote.fallback if spec.remote else None
    return _alone(named[name], horizon, environment) if name else 0.0
