"""stable-baselines3's PPO on the sequential problem: the paper's learner, one step further."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast, override

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.interface.monitor import Candidate, DecisionPoint, Turn, Watched
from osel_sim.selection.monitors.base import MonitorBase
from osel_sim.selection.monitors.environment import Episode, HandoffEnv, Row
from osel_sim.selection.monitors.features import SIGNALS, signals
from osel_sim.selection.random_streams import RandomStreams
from osel_sim.selection.scaling import RunningComponents

if TYPE_CHECKING:
    import torch
    from stable_baselines3 import PPO

COMPONENTS = 8
"""Of the picture."""
SETTINGS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "n_steps": 32,
    "batch_size": 32,
    "n_epochs": 10,
    "gamma": 1.0,
    "gae_lambda": 0.95,
    "ent_coef": 0.01,
}
"""Of PPO: no discount within an episode, and a larger learning rate and larger rollouts than the paper's, since an episode has several decisions of
which few matter. Everything else is SB3's default."""
LAYERS = (64, 64)


class PPOMonitor(MonitorBase):
    """Networks, sampling, rollout buffer, advantages and training step are SB3's own; the loop of `learn()` is not: the run steps the episodes.

    It trains when an episode is over and the rollout is full, so an episode is driven by one network to its end. What it is shown of a decision
    point: the signals, who drives, and leading components of the picture as they were known at the time.

    Args:
        candidates, picture_dim, seed: see `MonitorBase`.
    """

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int) -> None:
        super().__init__(candidates, picture_dim, seed)
        self._components = RunningComponents(picture_dim, COMPONENTS)
        self._random = RandomStreams(seed)
        self._algorithm = self._build()
        self._episode: list[tuple[Row, int, float, float]] = []  # what was seen, chosen, expected, and the log probability

    @property
    def observation_dim(self) -> int:
        """Length of what the networks see."""
        return SIGNALS + len(self.policies) + COMPONENTS

    @override
    def reset(self, instruction: str, driver: str, seed: tuple[int, ...]) -> None:
        super().reset(instruction, driver, seed)
        self._episode = []

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        import torch

        row = self.row(point)
        network = self._algorithm.policy
        with self._random.in_use(), torch.no_grad():
            action, value, log_probability = network(torch.from_numpy(row[None]))
            distribution = cast("torch.distributions.Categorical", network.action_dist.distribution)
            chances = distribution.probs[0].double()
        index = int(action)
        self._episode.append((row, index, value.item(), log_probability.item()))
        propensities = dict(zip(self.policies, (chances / chances.sum()).tolist(), strict=True))
        return Turn(self.policies[index], "" if self.policies[index] == point.driver else "drawn by the network", propensities)

    @override
    def learn(self, watched: Watched) -> None:
        """Learn from an episode that it watched itself.

        Raises:
            UsageError: it was another's: PPO learns from its own decisions only.
        """
        import torch

        if [turn.policy for turn in watched.turns] != [self.policies[index] for _, index, _, _ in self._episode]:
            raise UsageError("monitor ppo learns from its own decisions only; to start warm take value")
        for point in watched.points:
            self._components.add(point.look.picture())
        ends = [*watched.to_go[1:], 0.0]
        rollout = self._algorithm.rollout_buffer
        for number, (row, index, value, log_probability) in enumerate(self._episode):
            reward = watched.to_go[number] - ends[number]
            over = number == len(self._episode) - 1
            begins = np.array([number == 0], np.float32)
            rollout.add(row, np.array([index]), np.array([reward]), begins, torch.tensor([value]), torch.tensor([log_probability]))
            self._algorithm.num_timesteps += 1
            if rollout.full:
                following = 0.0 if over else self._episode[number + 1][2]
                rollout.compute_returns_and_advantage(torch.tensor([following]), np.array([over], np.float32))
                with self._random.in_use():
                    self._algorithm.train()
                rollout.reset()
        self._episode = []

    def row(self, point: DecisionPoint) -> Row:
        """What the networks see of a decision point, float32 (observation_dim,)."""
        drives = np.array([name == point.driver for name in self.policies], np.float64)
        return np.concatenate([signals(point), drives, self._components.transform(point.look.picture())]).astype(np.float32)

    def _build(self) -> "PPO":
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger

        def nothing(generator: np.random.Generator) -> Episode:
            raise UsageError("SB3 reads the two spaces from this environment; it is never stepped")

        spaces = HandoffEnv(nothing, self.policies, self.observation_dim)
        with self._random.in_use():
            algorithm = PPO("MlpPolicy", spaces, policy_kwargs={"net_arch": list(LAYERS)}, device="cpu", **SETTINGS)
        algorithm.set_logger(Logger(None, []))
        return algorithm
