"""Demonstrations: episodes of the scripted expert, with bursts of noise to recover from, as LeRobotDatasets.

Episodes are written in shards, each a finished LeRobotDataset of its own, so that both cores write and a killed run keeps what is done: a
LeRobotDataset that was not finalised cannot be read.
"""

import functools
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.files import read_json, write_text
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.interface.specification import ACTION_DIM, CAMERAS, CONTROL_HZ, STATE_DIM

BURST_PROBABILITY = 0.04
"""Chance that a burst of noise starts at a step."""
BURST_STEPS = (4, 10)
BURST_SCALE = np.array([0.9, 0.9, 0.6, 0.1, 0.1, 0.3, 0.0])
"""Largest push of a burst, in units of action; the gripper's command is never disturbed."""
NOWHERE = 9.0
"""Column and row of a thing that an image does not show."""
DONE = "done.json"
"""What a finished shard says of itself."""
Demonstrate = Callable[[int], list[dict[str, Any]] | None]
"""Frames of the demonstration of a seed, or None if the expert fails."""
LENGTH_LIMIT = 1.6
"""A demonstration may take this many horizons: recovering takes time."""


@dataclass(frozen=True)
class Shard:
    """A run of consecutive training seeds that is recorded and saved together."""

    task_file: Path
    folder: Path
    first_seed: int
    episodes: int
    image_size: int
    levels: tuple[int, ...]
    axes: Mapping[str, int] = field(default_factory=dict)
    robot: str = DEFAULT_ROBOT

    def __str__(self) -> str:
        return self.folder.name

    def record(self) -> tuple[int, int, list[int]]:
        """Record it (`record_shard`)."""
        return record_shard(self)


def features(task: TaskSpec, image_size: int) -> dict[str, dict[str, Any]]:
    """The dataset's columns. `annotation.*` are labels for training and never inputs of a policy."""
    entities = len(task.entities)
    images = {
        f"observation.images.{camera}": {"dtype": "image", "shape": (image_size, image_size, 3), "names": ["height", "width", "channel"]}
        for camera in CAMERAS
    }
    return {
        **images,
        "observation.state": {"dtype": "float32", "shape": (STATE_DIM,), "names": None},
        "action": {"dtype": "float32", "shape": (ACTION_DIM,), "names": None},
        "annotation.entity_positions": {"dtype": "float32", "shape": (3 * entities,), "names": None},
        "annotation.entity_present": {"dtype": "float32", "shape": (entities,), "names": None},
        **{f"annotation.places.{camera}": {"dtype": "float32", "shape": (2 * entities,), "names": None} for camera in CAMERAS},
        "annotation.target": {"dtype": "int64", "shape": (len(task.roles),), "names": None},
        "annotation.active": {"dtype": "int64", "shape": (2,), "names": None},
        "annotation.noise": {"dtype": "float32", "shape": (1,), "names": None},
    }


def side_file(task: TaskSpec, levels: tuple[int, ...], axes: Mapping[str, int], shards: int, episodes: int, failed: list[int]) -> dict[str, Any]:
    """What a LeRobotDataset has no column for (`meta/osel_sim.json`)."""
    return {
        "task": task.name,
        "task_version": task.version,
        **({} if task.robot == DEFAULT_ROBOT else {"robot": task.robot}),
        "levels": list(levels),
        "axes": dict(axes),
        "split": "train",
        "seeds": episodes,
        "shards": shards,
        "failed_seeds": failed,
        "entities": [{"name": entity.name, "role": entity.kind, "names": list(entity.names)} for entity in task.entities],
        "attributes": [{"name": name, "names": list(names)} for name, names in task.attributes.items()],
        "roles": dict(task.roles),
        "phrasings": {"train": list(task.train)},
    }


def record_shard(shard: Shard) -> tuple[int, int, list[int]]:
    """Record one shard, unless it is there already. Runs in a worker process. Returns as `write_shard`."""

    def begin() -> tuple[dict[str, Any], Demonstrate]:
        from osel_sim.sim.instance import make_instance

        env = _env(shard.task_file, shard.robot)
        task = env.task

        def demonstrate(seed: int) -> list[dict[str, Any]] | None:
            env.load(make_instance(task, seed, shard.levels[seed % len(shard.levels)], "train", shard.axes))
            return _demonstrate(env, shard.image_size, np.random.default_rng([seed, 1]))

        about = {"fps": CONTROL_HZ, "features": features(task, shard.image_size), "robot_type": task.robot.lower()}
        return {"repo_id": f"osel_sim/{task.name}", **about}, demonstrate

    return write_shard(shard.folder, range(shard.first_seed, shard.first_seed + shard.episodes), begin)


def write_shard(folder: Path, seeds: range, begin: Callable[[], tuple[dict[str, Any], Demonstrate]]) -> tuple[int, int, list[int]]:
    """Write the demonstrations of some seeds as a LeRobotDataset, unless it is there already.

    Args:
        begin: called where it is not; gives what the dataset is (arguments of `LeRobotDataset.create`), and who demonstrates a seed.

    Returns:
        Frames recorded, episodes recorded, and the seeds the expert failed on (those are left out).
    """
    done = folder / DONE
    if done.is_file():
        report = read_json(done)
        return report["frames"], report["episodes"], report["failed"]
    shutil.rmtree(folder, ignore_errors=True)

    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    about, demonstrate = begin()
    dataset = LeRobotDataset.create(**about, root=folder, use_videos=False)
    frames, episodes, failed = 0, 0, []
    for seed in seeds:
        rows = demonstrate(seed)
        if rows is None:
            failed.append(seed)
            continue
        for row in rows:
            dataset.add_frame(row)
        dataset.save_episode()
        frames, episodes = frames + len(rows), episodes + 1
    dataset.finalize()
    write_text(done, json.dumps({"frames": frames, "episodes": episodes, "failed": failed}))
    return frames, episodes, failed


@functools.lru_cache(maxsize=1)
def _env(task_file: Path, robot: str) -> Any:
    """A worker's environment: a scene takes seconds to compile."""
    from osel_sim.formats.task_file import load_task_file
    from osel_sim.sim.env import TaskEnv

    return TaskEnv(load_task_file(task_file), robot=robot)


def _demonstrate(env: Any, image_size: int, rng: np.random.Generator) -> list[dict[str, Any]] | None:
    """Frames of one demonstration on the loaded instance, or None if the expert fails. `action` is the expert's clean one, whatever was executed."""
    from osel_sim.sim.expert import Expert

    task: TaskSpec = env.task
    names = [entity.name for entity in task.entities]
    nameable = names + list(task.attributes)
    target = np.array([nameable.index(env.instance.roles[role]) for role in task.roles], dtype=np.int64)
    expert = Expert(env.world)
    rows: list[dict[str, Any]] = []
    burst, left = np.zeros(ACTION_DIM), 0
    while not env.success:
        if env.steps >= LENGTH_LIMIT * task.horizon:
            return None
        action = expert.act()
        if left == 0 and rng.random() < BURST_PROBABILITY:
            burst, left = rng.uniform(-1, 1, ACTION_DIM) * BURST_SCALE, int(rng.integers(*BURST_STEPS))
        positions, present = _labels(env, names)
        active, goes_to = expert.focus
        rows.append(
            {
                **env.observe(CAMERAS, image_size),
                "action": action,
                "annotation.entity_positions": positions,
                "annotation.entity_present": present,
                **{f"annotation.places.{camera}": _places(env, names, positions, present, camera) for camera in CAMERAS},
                "annotation.target": target,
                "annotation.active": np.array([names.index(active), names.index(goes_to) if goes_to != active else -1], dtype=np.int64),
                "annotation.noise": np.array([float(left > 0)], dtype=np.float32),
            }
        )
        env.advance(np.clip(action + burst, -1, 1) if left > 0 else action)
        left = max(0, left - 1)
    return rows


def _labels(env: Any, names: list[str]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    there = env.entity_positions()
    positions = np.concatenate([there.get(name, np.zeros(3)) for name in names]).astype(np.float32)
    return positions, np.array([name in there for name in names], dtype=np.float32)


def _places(env: Any, names: list[str], positions: NDArray[np.float32], present: NDArray[np.float32], camera: str) -> NDArray[np.float32]:
    """Column and row of everything in a camera's image, in [-1, 1] (2 * entities,); `NOWHERE` for what is not in view."""
    places = env.project(positions.reshape(len(names), 3).astype(np.float64), camera, 2) - 1.0
    seen = (present > 0) & (np.abs(places) <= 1.0).all(axis=1)
    return np.where(seen[:, None], places, NOWHERE).astype(np.float32).ravel()
