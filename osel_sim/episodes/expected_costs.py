"""What a policy is expected to cost, from its file alone: the part of its reward that need not be learned."""

import math
from collections.abc import Sequence

from osel_sim.core.errors import UsageError
from osel_sim.formats.merged_policy import parts_of
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.remote.network import NetworkModel, profile
from osel_sim.selection.reward import RewardWeights, charge, counted_time

DRAWS = 1000
"""Calls over which the delays of a network are averaged."""


def expected_costs(policies: Sequence[PolicySpec], weights: RewardWeights, actions: int, environment: EnvironmentSpec) -> dict[str, float]:
    """Policy -> alpha_time * time + alpha_price * price of an episode that goes as declared: `expected_costs` of a selector.

    Declared are price, inference time, actions executed per call, and the network. An episode that fails goes on for longer than one that succeeds
    and so costs more; that difference comes with the success and is learned with it.

    Args:
        policies: validated policy files.
        weights: of the reward.
        actions: that a successful episode executes.
        environment: what the policies drive.

    Raises:
        UsageError: `actions` is not positive.
    """
    if actions < 1:
        raise UsageError(f"actions of an episode must be at least 1, got {actions}")
    return {spec.name: _cost(spec, weights, actions, environment) for spec in policies}


def _cost(spec: PolicySpec, weights: RewardWeights, actions: int, environment: EnvironmentSpec) -> float:
    calls = math.ceil(actions / spec.execute)
    parts = [(part, *_call(part, environment)) for part in parts_of(spec)]  # of a merge all are asked and paid, and the slowest is waited for
    steps = actions + calls * max(waiting for _, waiting, _ in parts)
    time = counted_time(weights, steps, steps / environment.control_hz)
    return float(charge(weights, time, sum(part.price.of(actions, calls, calls * megabytes) for part, _, megabytes in parts)))


def _call(spec: PolicySpec, environment: EnvironmentSpec) -> tuple[float, float]:
    """Control steps that pass in one call, on average, and the megabytes it moves."""
    if spec.remote is None:
        steps = _steps(spec.inference_seconds, environment)
        return (float(steps) if steps > 1 else 0.0), 0.0  # on the robot an answer within the step delays nothing: osel_sim.episodes.loop
    up, down = len(spec.cameras) * 3 * spec.image_size**2, 4 * environment.action.dimension * spec.execute
    network = NetworkModel(profile(spec.remote.network), (0,))
    delays = [min(network.delays(up, spec.inference_seconds, down).total, spec.remote.deadline) for _ in range(DRAWS)]
    # Where the robot finishes its chunk meanwhile, only what a call takes beyond the chunk is waited for.
    busy = spec.execute if spec.remote.mode == "async" else 0
    return sum(max(_steps(delay, environment) - busy, 0) for delay in delays) / DRAWS, 1e-6 * (up + down)


def _steps(seconds: float, environment: EnvironmentSpec) -> int:
    return math.ceil(round(seconds * environment.control_hz, 6))
