"""The selection problem as a Gymnasium environment, so that any stable-baselines3 algorithm runs on it."""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError

Round = tuple[NDArray[np.float32], Callable[[int], float]]
"""A context, float32 (context_dim,), and the reward of choosing policy i for it. Only the chosen one is ever called."""

Draw = Callable[[np.random.Generator], Round]
"""Gives the next round: of a stream of instances, a simulation or a table. The generator is the environment's, seeded by `reset(seed=...)`."""


class SelectionEnv(gymnasium.Env[NDArray[np.float32], np.int64]):
    """One decision an episode: observe a context, choose a policy, receive the reward of that choice.

    The observation is the context, the action the index of a policy; `info["policy"]` names it. `reset` draws the next round.

    Args:
        draw: gives the next round.
        policies: names, in the order of the actions.
        context_dim: length of a context.
    """

    def __init__(self, draw: Draw, policies: Sequence[str], context_dim: int) -> None:
        self.policies = tuple(policies)
        self.observation_space = Box(-np.inf, np.inf, (context_dim,), np.float32)
        self.action_space = Discrete(len(self.policies))
        self._draw = draw
        self._round: Round | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draw the next round; its context is the observation.

        Raises:
            UsageError: there are options; it knows none.
        """
        super().reset(seed=seed)
        if options:
            raise UsageError(f"unknown option of reset {next(iter(options))!r}: a round has none")
        self._round = self._draw(self.np_random)
        return self._round[0].copy(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Choose a policy. Always ends the episode; the observation returned is the same context.

        Raises:
            gymnasium.error.ResetNeeded: called twice without `reset` in between.
            UsageError: the action is no index of a policy.
        """
        index = policy_index(action, len(self.policies))
        if self._round is None:
            raise gymnasium.error.ResetNeeded("an episode is one decision: call reset() before the next")
        (context, reward_of), self._round = self._round, None
        return context.copy(), float(reward_of(index)), True, False, {"policy": self.policies[index]}


def policy_index(action: Any, policies: int) -> int:
    """An action as the index of one of so many policies.

    Raises:
        UsageError: it is none.
    """
    try:
        index = operator.index(-1 if isinstance(action, bool) else action)
    except TypeError:
        index = -1
    if not 0 <= index < policies:
        raise UsageError(f"an action must be the index of a policy, an integer in [0, {policies - 1}], got {action!r}")
    return index


def table_rounds(contexts: ArrayLike, rewards: ArrayLike, in_order: bool = False) -> Draw:
    """Rounds of a table that holds the reward of every policy.

    Args:
        contexts: (instances, context_dim).
        rewards: (instances, policies).
        in_order: go through the rows from the first, and over again; else draw a row at random with replacement.

    Raises:
        UsageError: the shapes do not fit each other, or a number is none, such as the reward of a policy that a log has no outcome of.
    """
    context_rows, reward_rows = np.asarray(contexts, np.float32), np.asarray(rewards, np.float64)
    if context_rows.ndim != 2 or reward_rows.ndim != 2 or len(context_rows) != len(reward_rows) or not len(context_rows):
        raise UsageError(f"contexts (instances, dim) and rewards (instances, policies) do not fit: {context_rows.shape}, {reward_rows.shape}")
    for name, rows in (("contexts", context_rows), ("rewards", reward_rows)):
        wrong = np.argwhere(~np.isfinite(rows))
        if len(wrong):
            row, column = wrong[0].tolist()
            raise UsageError(
                f"{name}[{row}, {column}] is {rows[row, column]} ({len({first for first, _ in wrong.tolist()})} of {len(rows)} rows have such); "
                f"keep the others: np.isfinite({name}).all(axis=1)"
            )
    drawn = 0

    def draw(generator: np.random.Generator) -> Round:
        nonlocal drawn
        row = drawn % len(context_rows) if in_order else int(generator.integers(len(context_rows)))
        drawn += 1
        return context_rows[row], lambda action: float(reward_rows[row, action])

    return draw
