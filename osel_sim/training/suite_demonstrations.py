"""Demonstrations of the scripted experts of other suites, as LeRobotDatasets; with labels where the environment tells of landmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.core.files import read_json
from osel_sim.interface.environment import Environment, EnvironmentSpec, HasExpert, TellsLandmarks
from osel_sim.interface.suite import Task
from osel_sim.training.annotations import ACTIONS, PLACES, POSITIONS, PRESENT, TARGET
from osel_sim.training.demonstrations import BURST_PROBABILITY, BURST_STEPS, NOWHERE, Demonstrate, write_shard

BURST = 0.9
"""Largest push of a burst, as a share of half the range of a motion."""
BURST_HZ = 20.0
"""Control rate at which bursts are as long as they are there; at others they take as many seconds."""
CAMERAS = 2
"""So many of an environment's cameras, the first ones, are recorded where none is named."""


@dataclass(frozen=True)
class SuiteShard:
    """A run of consecutive training seeds of a task of another suite, recorded and saved together.

    Attributes:
        every: control steps a frame: it is looked at so seldom, and the actions between are kept.
    """

    task: Task
    folder: Path
    first_seed: int
    episodes: int
    image_size: int
    levels: tuple[int, ...]
    axes: Mapping[str, int] = field(default_factory=dict)
    cameras: tuple[str, ...] = ()
    every: int = 1

    def __str__(self) -> str:
        return self.folder.name

    def record(self) -> tuple[int, int, list[int]]:
        """Record it, unless it is there already. Runs in a worker process. Returns as `write_shard`."""
        return write_shard(self.folder, range(self.first_seed, self.first_seed + self.episodes), self._begin)

    def _begin(self) -> tuple[dict[str, Any], Demonstrate]:
        env = _env(self.task)
        spec = env.specification

        def demonstrate(seed: int) -> list[dict[str, Any]] | None:
            env.load(self.task.instance(seed, self.levels[seed % len(self.levels)], "train", self.axes))
            return _demonstrate(env, self.cameras, self.image_size, self.every, np.random.default_rng([seed, 1]))

        columns = features(spec, self.cameras, self.image_size, self.every) | label_features(_landmarks_of(env), self.cameras)
        about = {"fps": round(spec.control_hz / self.every), "features": columns, "robot_type": spec.robot.lower()}
        return {"repo_id": f"osel_sim/{self.task.name.replace(':', '_')}", **about}, demonstrate


def check_expert(task: Task, cameras: tuple[str, ...]) -> tuple[str, ...]:
    """The cameras to record.

    Args:
        cameras: those asked for; none: the first that there are.

    Raises:
        UsageError: the task has no scripted expert, or an unknown camera is asked for.
    """
    from osel_sim.core.errors import UnknownNameError

    spec = task.specification
    if not spec.expert:
        raise UsageError(f"task {task.name!r} has no scripted expert, so there is nobody to demonstrate it")
    for camera in cameras:
        if camera not in spec.cameras:
            raise UnknownNameError("camera", camera, spec.cameras, f"the environment of {spec.name}")
    return cameras or spec.cameras[:CAMERAS]


def features(spec: EnvironmentSpec, cameras: tuple[str, ...], image_size: int, every: int = 1) -> dict[str, dict[str, Any]]:
    """The dataset's columns but for labels.

    Args:
        every: control steps a frame; where there are several, a column has the actions of all of them.
    """
    images = {
        f"observation.images.{camera}": {"dtype": "image", "shape": (image_size, image_size, 3), "names": ["height", "width", "channel"]}
        for camera in cameras
    }
    state = {"observation.state": {"dtype": "float32", "shape": (spec.state_size,), "names": None}} if spec.state else {}
    action = {"action": {"dtype": "float32", "shape": (spec.action.dimension,), "names": list(spec.action.names)}}
    between = {ACTIONS: {"dtype": "float32", "shape": (every * spec.action.dimension,), "names": None}} if every > 1 else {}
    return {**images, **state, **action, **between, "annotation.noise": {"dtype": "float32", "shape": (1,), "names": None}}


def label_features(landmarks: tuple[str, ...], cameras: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """The columns of labels, none where there are no landmarks."""
    if not landmarks:
        return {}
    count = len(landmarks)
    sizes = {POSITIONS: 3 * count, PRESENT: count, **{PLACES + camera: 2 * count for camera in cameras}}
    columns: dict[str, dict[str, Any]] = {name: {"dtype": "float32", "shape": (size,), "names": None} for name, size in sizes.items()}
    return columns | {TARGET: {"dtype": "int64", "shape": (count,), "names": list(landmarks)}}


def suite_side_file(
    task: Task, levels: tuple[int, ...], axes: Mapping[str, int], shards: Sequence[SuiteShard], episodes: int, failed: list[int]
) -> dict[str, Any]:
    """What a LeRobotDataset has no column for (`meta/osel_sim.json`). Landmarks are things that an instruction is about without naming them."""
    side: dict[str, Any] = {
        "task": task.name,
        "task_version": task.info.digest,
        "robot": task.specification.robot,
        "levels": list(levels),
        "axes": dict(axes),
        "split": "train",
        "seeds": episodes,
        "shards": len(shards),
        "failed_seeds": failed,
    }
    columns = read_json(shards[0].folder / "meta" / "info.json")["features"]
    if TARGET in columns:
        names = columns[TARGET]["names"]
        told = sorted({str(task.instance(seed, levels[seed % len(levels)], "train", axes).instruction) for seed in range(episodes)})
        side |= {
            "entities": [{"name": name, "role": name, "names": [name]} for name in names],
            "roles": {name: name for name in names},
            "phrasings": {"train": told},
        }
    return side


def _env(task: Task) -> Environment:
    """A worker's environment: opening one takes seconds. The last one is kept."""
    if task.name not in _open:
        while _open:
            _open.popitem()[1].close()
        _open[task.name] = task.open()
    return _open[task.name]


_open: dict[str, Environment] = {}


def _landmarks_of(env: Environment) -> tuple[str, ...]:
    """Names of the landmarks that an environment tells of."""
    return env.landmark_names if isinstance(env, TellsLandmarks) else ()


def _demonstrate(env: Environment, cameras: tuple[str, ...], image_size: int, every: int, rng: np.random.Generator) -> list[dict[str, Any]] | None:
    """Frames of one demonstration on the loaded instance, or None if the expert fails. `action` is the expert's clean one, whatever was executed."""
    if not isinstance(env, HasExpert):
        raise UsageError(f"the environment of {env.specification.name} has no scripted expert")
    spec = env.specification
    action_spec, expert = spec.action, env.expert()
    shortest, longest = (round(steps * spec.control_hz / BURST_HZ) for steps in BURST_STEPS)
    rows: list[dict[str, Any]] = []
    burst, left = np.zeros(action_spec.dimension), 0
    while not env.success:
        if env.done:
            return None
        action = action_spec.clip(np.asarray(expert.act(), np.float64))
        if left == 0 and rng.random() < BURST_PROBABILITY * BURST_HZ / spec.control_hz:
            burst = np.zeros(action_spec.dimension)
            burst[action_spec.motions] = BURST * action_spec.half_range[action_spec.motions] * rng.uniform(-1, 1, len(action_spec.motions))
            left = int(rng.integers(shortest, longest))
        if (step := env.steps % every) == 0:
            noise = np.array([float(left > 0)], np.float32)
            rows.append({**env.observe(cameras, image_size), "action": action, "annotation.noise": noise, **_labels(env, cameras)})
            if every > 1:
                rows[-1][ACTIONS] = np.tile(action, every)  # after the last action of an episode it goes on
        elif every > 1:
            rows[-1][ACTIONS][step * len(action) :] = np.tile(action, every - step)
        env.advance(action_spec.clip(action + burst) if left > 0 else action)
        left = max(0, left - 1)
    return rows


def _labels(env: Environment, cameras: tuple[str, ...]) -> dict[str, Any]:
    """Where the landmarks are, and that the instruction is about them."""
    if not isinstance(env, TellsLandmarks) or not env.landmark_names:
        return {}
    found = env.landmarks(cameras)
    there = ~np.isnan(found["positions"]).any(axis=1)
    labels: dict[str, Any] = {
        POSITIONS: np.where(there[:, None], found["positions"], 0.0).astype(np.float32).ravel(),
        PRESENT: there.astype(np.float32),
        TARGET: np.where(there, np.arange(len(there)), -1),
    }
    for camera in cameras:
        seen = (np.abs(found[camera]) <= 1.0).all(axis=1)  # NaN is not
        labels[PLACES + camera] = np.where(seen[:, None], found[camera], NOWHERE).astype(np.float32).ravel()
    return labels
