"""A suite in a few dozen lines: a point on a plane must reach the goal of the colour that the instruction names.

`Reach` is any gymnasium environment. `ReachEnvironment` puts it behind osel_sim's interface, and `Toy` lists its tasks and draws their instances.
"""

from dataclasses import replace

import gymnasium
import numpy as np

from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.instance import SeededInstance
from osel_sim.interface.suite import SuiteSpec, TaskInfo
from osel_sim.suites.base import BaseEnvironment

COLOURS = {"red": (220, 40, 40), "green": (40, 180, 60), "blue": (40, 80, 220)}
SIZE, SPEED, NEAR = 64, 0.05, 0.06


class Reach(gymnasium.Env):
    """Observations are pictures (64, 64, 3), actions velocities (2,) in [-1, 1]; done when the point is at the goal of colour `goal`."""

    observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.goal = (options or {}).get("goal", "red")
        self.point = self.np_random.uniform(0.1, 0.9, 2)
        self.places = dict(zip(COLOURS, self.np_random.uniform(0.1, 0.9, (len(COLOURS), 2)), strict=True))
        return self.render(), {}

    def step(self, action):
        self.point = np.clip(self.point + SPEED * np.asarray(action, np.float64), 0.0, 1.0)
        reached = bool(np.linalg.norm(self.places[self.goal] - self.point) < NEAR)
        return self.render(), float(reached), reached, False, {}

    def render(self):
        picture = np.full((SIZE, SIZE, 3), 245, np.uint8)
        y, x = np.mgrid[:SIZE, :SIZE] / (SIZE - 1)
        for place, colour in [(self.point, (0, 0, 0)), *((self.places[name], rgb) for name, rgb in COLOURS.items())]:
            picture[np.hypot(x - place[0], y - place[1]) < 0.05] = colour
        return picture


SPECIFICATION = EnvironmentSpec(
    name="toy",
    control_hz=10,
    action=ActionSpec(names=("x", "y"), low=(-1.0, -1.0), high=(1.0, 1.0)),
    state={"position": 2},
    cameras=("top",),
    context_camera="top",
    robot="point",
    expert=True,
)


class ReachEnvironment(BaseEnvironment):
    """`Reach` as the episode loop drives it."""

    def __init__(self, horizon):
        super().__init__(SPECIFICATION, horizon)
        self.gym = Reach()

    def start(self, instance):
        self.gym.reset(seed=instance.simulator_seed, options={"goal": instance.target})

    def act(self, action):
        return self.gym.step(action)[2]

    def render(self, camera):
        return self.gym.render()

    def state(self):
        return {"position": self.gym.point}

    def expert(self):
        return StraightAhead(self.gym)


class StraightAhead:
    """The scripted expert: it knows where the goal is."""

    def __init__(self, reach):
        self.reach = reach

    def act(self):
        return np.clip((self.reach.places[self.reach.goal] - self.reach.point) / SPEED, -1.0, 1.0).astype(np.float32)


TASKS = {
    "reach": TaskInfo("Reach the goal of the colour named", horizon=30, digest="1", tags=("easy",)),
    "hurry": TaskInfo("Reach the goal of the colour named, quickly", horizon=15, digest="1"),
}


class Toy:
    """The suite."""

    spec = SuiteSpec("toy", "A point on a plane", packages=("toy-suite",), install="pip install toy-suite")
    tasks = TASKS

    def specification(self, task):
        return SPECIFICATION

    def instance(self, task, seed, level, split, axes):
        instance = SeededInstance(f"toy:{task}", seed, split, instruction="")
        colour = list(COLOURS)[np.random.default_rng(instance.simulator_seed).integers(len(COLOURS))]
        return replace(instance, instruction=f"move to the {colour} goal", target=colour)

    def open(self, task):
        return ReachEnvironment(TASKS[task].horizon)
