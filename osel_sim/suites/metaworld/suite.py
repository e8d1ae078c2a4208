"""Meta-World's 50 tasks as a suite: `metaworld:drawer-open-v3`."""

import functools
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from osel_sim.core.files import content_digest
from osel_sim.formats.levels import LEVELS, resolve, split_off
from osel_sim.interface.environment import Environment, EnvironmentSpec
from osel_sim.interface.instance import SPLITS
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.interface.suite import SuiteSpec, TaskInfo
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.environments import environment
from osel_sim.suites.hosted import open_environment
from osel_sim.suites.metaworld.tasks import AXES, HORIZON, SPECIFICATION, TABLE_TOPS, load_tasks
from osel_sim.suites.phrasing import phrase, stream

NAME = "metaworld"
TABLE_TINT = (0.0, 0.1, 0.2, 0.3)
"""Share by which a colour of the table may be darker, level by level."""


class Metaworld:
    """The suite."""

    spec = SuiteSpec(
        NAME,
        "Meta-World 3: 50 tasks of a Sawyer arm",
        LEVELS,
        SPLITS,
        AXES,
        packages=("metaworld", "mujoco", "numpy"),
        install=environment(NAME).command,
        opengl=True,
        environments=(NAME,),
    )

    @functools.cached_property
    def tasks(self) -> Mapping[str, TaskInfo]:
        """Its tasks by name."""
        return {
            name: TaskInfo(task.title, HORIZON, f"3-{content_digest(repr(asdict(task)))[:12]}", task.tags, AXES)
            for name, task in load_tasks().items()
        }

    def specification(self, task: str) -> EnvironmentSpec:
        """What the environment of any task offers policies."""
        environment(NAME).require(NAME)
        return SPECIFICATION

    def instance(self, task: str, seed: int, level: int, split: str, axes: Mapping[str, int]) -> PlainInstance:
        """Draw an instance. Training and validation instructions use the training phrasings; half of the test instructions use held-out ones."""
        from osel_sim.sim.perturbation import HELD_OUT

        levels = resolve(level, axes, AXES, f"{NAME}:{task}")

        def of(axis: str) -> np.random.Generator:
            return stream(task, seed, split, int(content_digest(axis)[:8], 16), levels[axis])

        text, more = load_tasks()[task], HELD_OUT[levels["phrasing"]]
        phrasing, instruction = phrase(text.train, text.held_out, split, stream(task, seed, split), more, of("phrasing"))
        lowest, above = split_off(levels)
        return PlainInstance(f"{NAME}:{task}", seed, split, instruction, lowest, above, phrasing, details=_details(levels, of))

    def open(self, task: str) -> Environment:
        """Make the environment of a task."""
        return open_environment(NAME, task)


def _details(levels: Mapping[str, int], stream: Any) -> dict[str, Any]:
    """How the scene looks and where things may start, as plain data; nothing where it is clean."""
    from osel_sim.sim.perturbation import WIDER, draw
    from osel_sim.sim.robots import load_robot

    details: dict[str, Any] = {}
    looks = {axis: levels[axis] for axis in ("light", "camera")}
    if any(looks.values()):
        drawn = asdict(draw(looks, (), (), load_robot(DEFAULT_ROBOT), stream))
        if looks["light"]:
            details["light"] = {key: _plain(drawn[key]) for key in ("lamp", "lamp_turn", "ambient")}
        if looks["camera"]:
            details["camera"] = {key: _plain(drawn[key]) for key in ("camera", "wrist")}
    if level := levels["texture"]:
        rng, tops = stream("texture"), TABLE_TOPS[level]
        details["texture"] = {
            "table": tops[int(rng.integers(len(tops)))],
            "tint": [1.0 - float(rng.uniform(0.0, TABLE_TINT[level])) for _ in range(3)],
        }
    if level := levels["start"]:
        details["wider"] = WIDER[level]
    return details


def _plain(value: Any) -> Any:
    """Tuples as lists, as they are after a journey."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
