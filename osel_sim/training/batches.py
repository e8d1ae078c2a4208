"""Batches of one or several datasets: a pure function of (seed, step), so that a resumed run sees what an uninterrupted one would have seen."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from osel_sim.training.dataset import Demonstrations
from osel_sim.training.recipe import Augmentation
from osel_sim.training.source import SampleSource, Wanted

STATE_FLOOR = 0.005
"""Least standard deviation (metres, radians) the state is normalised by: one that hardly varies in the demonstrations must not blow up."""
ACTION_FLOOR = 0.1
"""The same for actions, in their own units."""

Statistics = dict[str, dict[str, Tensor]]


def frames_of(data: Demonstrations, episodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """All frames of these episodes."""
    parts = [np.arange(data.starts[episode], data.starts[episode + 1]) for episode in episodes]
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def statistics_of(data: Sequence[Demonstrations], frames: Sequence[NDArray[np.int64]]) -> Statistics:
    """LeRobot statistics of state and action over the training frames of all datasets."""
    result: Statistics = {}
    for key, floor in ((OBS_STATE, STATE_FLOOR), (ACTION, ACTION_FLOOR)):
        columns = [one.state if key == OBS_STATE else one.action[:: one.every] for one in data]
        values = np.concatenate([column[own] for column, own in zip(columns, frames, strict=True)])
        spread = np.maximum(values.std(axis=0), floor)
        result[key] = {"mean": torch.from_numpy(values.mean(axis=0)), "std": torch.from_numpy(spread)}
    return result


class Batches:
    """Assembles batches of raw observations (images float in [0, 1], `task` strings) with their labels.

    An epoch has as many samples as there are frames. Each dataset gets its share of them by weight: some of its frames several times, or some not
    at all, drawn anew for each epoch; with one dataset, an epoch sees every frame once.

    Args:
        frames: training frames of each dataset.
        weights: share of each dataset, in any unit; None: all alike.
    """

    def __init__(
        self,
        data: Sequence[Demonstrations],
        frames: Sequence[NDArray[np.int64]],
        statistics: Statistics,
        wanted: Wanted,
        augmentation: Augmentation,
        seed: int,
        weights: Sequence[float] | None = None,
    ) -> None:
        center, spread = (statistics[OBS_STATE][key].numpy() for key in ("mean", "std"))
        self._sources = [SampleSource(one, wanted, augmentation, center, spread) for one in data]
        self._frames, self._seed = list(frames), seed
        shares = np.array([1.0] * len(self._sources) if weights is None else weights, np.float64)
        edges = np.round(np.cumsum(shares) / shares.sum() * sum(map(len, frames))).astype(np.int64)
        self._counts = np.diff(edges, prepend=0)
        self._order: tuple[int, NDArray[np.int64]] = (-1, np.zeros((0, 2), np.int64))

    def training(self, step: int, size: int) -> dict[str, Any]:
        """The augmented batch of a step, samples of one dataset beside each other."""
        positions = np.arange(step * size, (step + 1) * size)
        drawn = np.array([self._shuffled(int(epoch))[offset] for epoch, offset in zip(*divmod(positions, self._counts.sum()), strict=True)])
        parts = []
        for index, source in enumerate(self._sources):
            frames = drawn[drawn[:, 0] == index, 1]
            if len(frames):
                parts.append(source.training(frames, np.random.default_rng([self._seed, 1, step, index])))
        return collate(parts)

    def validation(self, index: int, start: int, size: int) -> dict[str, Any]:
        """Frames start .. start + size of a dataset in order, not augmented, with their recorded instructions."""
        return self._sources[index].validation(self._frames[index][start : start + size])

    def _shuffled(self, epoch: int) -> NDArray[np.int64]:
        """The (dataset, frame) of every sample of an epoch."""
        if self._order[0] != epoch:
            random = np.random.default_rng([self._seed, 0, epoch])
            parts = []
            for index, (frames, count) in enumerate(zip(self._frames, self._counts, strict=True)):
                repeats = -(-int(count) // max(len(frames), 1))
                chosen = np.concatenate([random.permutation(frames) for _ in range(repeats)])[:count] if repeats else frames[:0]
                parts.append(np.stack([np.full(count, index), chosen], axis=1))
            self._order = (epoch, random.permutation(np.concatenate(parts)))
        return self._order[1]


def collate(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Several batches as one. Only what all of them have: labels that some dataset lacks cannot be used for the others either."""
    if len(parts) == 1:
        return parts[0]
    keys = [key for key in parts[0] if all(key in part for part in parts)]
    joined: dict[str, Any] = {key: torch.cat([part[key] for part in parts]) for key in keys if key != "task"}
    return {**joined, "task": [text for part in parts for text in part["task"]]}
