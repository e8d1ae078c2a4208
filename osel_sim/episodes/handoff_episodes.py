"""Real episodes as the sequential problem that `osel_sim.selection.monitors.environment.HandoffEnv` is made of."""

from collections.abc import Callable, Sequence

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.episodes.handoffs import Course, Handoffs
from osel_sim.episodes.loop import course
from osel_sim.interface.environment import Environment
from osel_sim.interface.instance import Instance
from osel_sim.interface.monitor import DecisionPoint, Turn
from osel_sim.interface.outcome import Outcome
from osel_sim.selection.monitors.environment import Begin, Episode, Row
from osel_sim.selection.reward import RewardWeights, reward, to_go

See = Callable[[DecisionPoint], Row]
"""What a learner is shown of a decision point."""


def handoff_episodes(
    env: Environment, instances: Sequence[Instance], handoffs: Handoffs, weights: RewardWeights, see: See, action_noise: float = 0.0
) -> Begin:
    """Begins episodes on instances drawn at random, a policy drawn at random driving first.

    Args:
        env: of the instances' task.
        handoffs: who may drive; its monitor is not asked.
        weights: of the reward.
        see: what the learner is shown.
        action_noise: as `run_episode` takes it.
    """

    def begin(generator: np.random.Generator) -> Episode:
        instance = instances[int(generator.integers(len(instances)))]
        driver = handoffs.drivers[handoffs.policies[int(generator.integers(len(handoffs.policies)))]]
        repeat = int(generator.integers(2**31))
        env.load(instance)
        return _rewarded(course(env, instance, driver, None, (), repeat, action_noise, handoffs), handoffs, weights, see)

    return begin


def _rewarded(running: Course[Outcome], handoffs: Handoffs, weights: RewardWeights, see: See) -> Episode:
    """The episode with what is taken off for time and price at each decision point, and the rest of its reward at its end."""
    taken = 0.0  # off the reward, up to the decision point before
    try:
        point, since = next(running), 0  # control steps of the decision point before; at the first nothing has passed since
        while True:
            (now,) = to_go(0.0, [point.seconds], [point.step], [point.price], weights)
            policy = yield see(point), (taken - now if since else 0.0)
            taken, since = now, point.step
            point = running.send(Turn(handoffs.policies[policy]))
    except StopIteration as end:
        outcome: Outcome = end.value
    if outcome.error is not None:
        raise UsageError(f"an episode ended in error: {outcome.error}")
    return reward(outcome, weights) + taken
