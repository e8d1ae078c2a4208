"""Whether a task keeps what its suite promises: for the tests of whoever writes a suite."""

from contextlib import closing
from itertools import islice
from typing import Any

import numpy as np

from osel_sim.core.errors import OselError
from osel_sim.interface.environment import Environment, HasExpert, TellsScene
from osel_sim.interface.suite import Task

STEPS = 12


class SuiteError(OselError):
    """A suite does not keep what it promises."""


def check_task(task: Task, seed: int = 0) -> None:
    """Load an instance, act at random, and look at everything the episode loop will use.

    Args:
        seed: of the instance, and of the actions.

    Raises:
        SuiteError: saying what is not as promised.
    """
    instance = task.instance(seed)
    _hold(instance.task == task.name, f"an instance of {task.name} says it is of task {instance.task!r}")
    _hold(task.instance(seed).key == instance.key, f"{instance.key}: the same arguments gave another instance, {task.instance(seed).key}")
    _hold(bool(instance.instruction), f"{instance.key}: has no instruction")
    keys = {task.instance(number, split=split).key for number in range(3) for split in task.suite.spec.splits}
    _hold(len(keys) == 3 * len(task.suite.spec.splits), f"{task.name}: different seeds and splits must have different keys, got {sorted(keys)}")
    with closing(task.open()) as env:
        spec = env.specification
        _hold(spec.drives_like(task.specification), f"{task.name}: its environment's specification is another than the suite says: {spec}")
        _hold(not spec.expert or isinstance(env, HasExpert), f"{task.name}: promises an expert and has none")
        first = _play(env, task, seed)
        env.load(task.instance(seed + 1))
        _hold(
            _play(env, task, seed) == first, f"{instance.key}: the same actions led elsewhere the second time: load must forget all that was before"
        )
        if isinstance(env, TellsScene):
            _check_scenes(env, env, task, seed)
        if spec.snapshots:
            _check_snapshot(env, task, seed)


def _play(env: Environment, task: Task, seed: int) -> list[Any]:
    """Load the instance, act at random, and give what there was to see, as plain data."""
    env.load(task.instance(seed))
    _hold(env.steps == 0, f"{task.name}: a loaded instance has made {env.steps} steps")
    seen = [_look(env)]
    for number, action in enumerate(islice(_actions(env, seed), min(STEPS, task.info.horizon)), 1):
        if env.done:
            break
        env.advance(action)
        _hold(env.steps == number, f"{task.name}: {number} steps were made, it counts {env.steps}")
        _hold(0.0 <= env.subgoal_fraction <= 1.0, f"{task.name}: subgoal_fraction must lie in [0, 1], got {env.subgoal_fraction}")
        seen.append(_look(env))
    return seen


def _look(env: Environment) -> Any:
    spec, size = env.specification, 48
    observation = env.observe(spec.cameras, size)
    images = {f"observation.images.{camera}": (size, size, 3) for camera in spec.cameras}
    expected = {*images, "task", *(["observation.state"] if spec.state else [])}
    _hold(observation.keys() == expected, f"{spec.name}: an observation must have {sorted(expected)}, got {sorted(observation)}")
    for key, shape in images.items():
        image = np.asarray(observation[key])
        _hold(image.dtype == np.uint8 and image.shape == shape, f"{spec.name}: {key} must be uint8 {shape}, got {image.dtype} {image.shape}")
    state = np.asarray(observation.get("observation.state", ()), np.float64)
    _hold(
        state.shape == (spec.state_size,) and bool(np.isfinite(state).all()), f"{spec.name}: a state must be {spec.state_size} numbers, got {state}"
    )
    picture = env.image(spec.context_camera, 2 * size, size)
    _hold(picture.shape == (size, 2 * size, 3), f"{spec.name}: an image 96 wide and 48 high has the shape {picture.shape}")
    return state.tolist(), bool(env.success), {key: np.asarray(observation[key]).tobytes() for key in images}


def _actions(env: Environment, seed: int) -> Any:
    spec, random = env.specification.action, np.random.default_rng(seed)
    hold = env.hold_action()
    _hold(hold.shape == (spec.dimension,) and np.array_equal(spec.clip(hold), hold), f"hold_action must be an action, got {hold}")
    while True:
        yield spec.clip(spec.middle + spec.half_range * random.uniform(-1, 1, spec.dimension))


def _check_scenes(env: Environment, teller: TellsScene, task: Task, seed: int) -> None:
    told = []
    for number in (seed, seed + 1, seed):
        env.load(task.instance(number))
        told.append(teller.scene_digest())
    if told == ["", "", ""]:
        return  # it cannot be told after all
    first, other, again = told
    _hold(isinstance(first, str) and first != "", f"{task.name}: a scene's digest must be text, empty of all scenes or of none, got {first!r}")
    _hold(first == again and first != other, f"{task.name}: a scene's digest must tell the instances of two seeds apart, and nothing else: {told}")


def _check_snapshot(env: Environment, task: Task, seed: int) -> None:
    env.load(task.instance(seed))
    snapshot = env.snapshot()
    before = _look(env)
    for action in islice(_actions(env, seed), 3):
        env.advance(action)
    env.restore(snapshot)
    _hold(_look(env) == before and env.steps == 0, f"{task.name}: restore does not go back to the snapshot")


def _hold(kept: bool, problem: str) -> None:
    if not kept:
        raise SuiteError(problem)
