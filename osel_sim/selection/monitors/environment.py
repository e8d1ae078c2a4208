"""The sequential problem as a Gymnasium environment, so that any stable-baselines3 algorithm runs on it: who drives on, at each decision point."""

from collections.abc import Callable, Generator, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.selection.environment import policy_index

Row = NDArray[np.float32]
"""What is to be seen at a decision point: float32 (observation_dim,)."""

Episode = Generator[tuple[Row, float], int, float]
"""One episode: yields at each decision point what is to be seen, with the reward since the one before (0 at the first); is sent the index of the
policy that drives on; returns the reward of what is left. They sum to the reward-to-go from the first decision point: nothing is discounted."""

Begin = Callable[[np.random.Generator], Episode]
"""Begins the next episode: of a simulation (`osel_sim.episodes.handoff_episodes`) or a made-up problem. The generator is the environment's, seeded by
`reset(seed=...)`."""

UNTIL = 1_000
"""So many episodes without a decision point in a row are taken for a mistake."""


class HandoffEnv(gymnasium.Env[Row, np.int64]):
    """One episode of the robot an episode: observe a decision point, say who drives on, receive what the time until the next came to (gamma is 1).

    The action is the index of a policy; `info["policy"]` names it. Episodes that end before their first decision point are passed over.

    Args:
        begin: begins the next episode.
        policies: names, in the order of the actions.
        observation_dim: length of what is to be seen.
    """

    def __init__(self, begin: Begin, policies: Sequence[str], observation_dim: int) -> None:
        self.policies = tuple(policies)
        self.observation_space = Box(-np.inf, np.inf, (observation_dim,), np.float32)
        self.action_space = Discrete(len(self.policies))
        self._begin = begin
        self._episode: Episode | None = None
        self._row = np.zeros(observation_dim, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Row, dict[str, Any]]:
        """Begin the next episode and go to its first decision point.

        Raises:
            UsageError: there are options, it knows none; or no episode has a decision point.
        """
        super().reset(seed=seed)
        if options:
            raise UsageError(f"unknown option of reset {next(iter(options))!r}: an episode has none")
        self.close()
        for _ in range(UNTIL):
            episode = self._begin(self.np_random)
            try:
                self._row, _ = next(episode)
            except StopIteration:
                continue
            self._episode = episode
            return self._row.copy(), {}
        raise UsageError(f"{UNTIL} episodes in a row ended before their first decision point: decide more often")

    def step(self, action: np.int64) -> tuple[Row, float, bool, bool, dict[str, Any]]:
        """Say who drives on. At the end of the episode what is returned is what was to be seen last.

        Raises:
            gymnasium.error.ResetNeeded: the episode is over, or none was begun.
            UsageError: the action is no index of a policy.
        """
        index = policy_index(action, len(self.policies))
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset() before the next step")
        told = {"policy": self.policies[index]}
        try:
            self._row, reward = self._episode.send(index)
        except StopIteration as end:
            self._episode = None
            return self._row.copy(), float(end.value), True, False, told
        return self._row.copy(), float(reward), False, False, told

    def close(self) -> None:
        """Give up the episode at hand. May be called twice."""
        if self._episode is not None:
            self._episode.close()
            self._episode = None
