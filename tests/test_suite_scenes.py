"""Scenes of other suites are told by digests: the same for the same instance wherever it is loaded, another for another one."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest

from osel_sim.episodes.start import Start
from osel_sim.sim.fingerprint import Fingerprint
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.gymnasium_env import GymEnvironment, GymSettings
from osel_sim.suites.registry import find_task
from osel_sim.suites.scenes import DECIMALS, mujoco_of, of_mujoco, of_numbers

INSTANCE = PlainInstance("reach", 3, "test", "reach for it")
MODEL = "<mujoco><worldbody><body name='a'><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"


def test_a_digest_does_not_depend_on_last_bits_and_on_everything_else():
    import mujoco

    model = mujoco.MjModel.from_xml_string(MODEL)
    positions = np.array([0.1234, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])
    first = of_mujoco(Fingerprint(model), positions, INSTANCE)
    assert first == of_mujoco(Fingerprint(model), positions + 1e-10, INSTANCE) and len(first) == 16
    others = [
        of_mujoco(Fingerprint(model), positions + 10.0**-DECIMALS, INSTANCE),
        of_mujoco(Fingerprint(model), positions, PlainInstance("reach", 3, "test", "reach for that")),
        of_mujoco(Fingerprint(model), positions, PlainInstance("reach", 3, "test", "reach for it", details={"light": 0.5})),
    ]
    model.geom_size[0] *= 2
    others.append(of_mujoco(Fingerprint(model), positions, INSTANCE))
    assert len({first, *others}) == 5
    assert of_numbers([], INSTANCE) == ""
    assert of_numbers([("agent", np.array([-0.0]))], INSTANCE) == of_numbers([("agent", np.array([0.0]))], INSTANCE)


def test_mujoco_is_found_where_environments_keep_it():
    import mujoco

    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    gymnasiums = SimpleNamespace(model=model, data=data)
    gym_hils = SimpleNamespace(_model=model, _data=data)
    aloha = SimpleNamespace(_env=SimpleNamespace(physics=SimpleNamespace(model=SimpleNamespace(ptr=model), data=SimpleNamespace(ptr=data))))
    simulation = SimpleNamespace(model=SimpleNamespace(_model=model), data=SimpleNamespace(_data=data))
    libero = SimpleNamespace(_env=SimpleNamespace(env=SimpleNamespace(sim=simulation)))
    for env in (gymnasiums, gym_hils, aloha, libero):
        assert mujoco_of(env) == (model, data)
    assert mujoco_of(SimpleNamespace(model="a text", data=None)) is None


class Point:
    """A gymnasium environment without MuJoCo."""

    metadata = {"render_fps": 10}  # noqa: RUF012
    render_mode, spec, _max_episode_steps = "rgb_array", None, 5

    def __init__(self):
        import gymnasium

        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        self.unwrapped = self

    def reset(self, seed=0, options=None):
        self.at = np.random.default_rng(seed).uniform(size=2)
        return self.at, {"is_success": False}

    def step(self, action):
        self.at = self.at + action
        return self.at, 0.0, False, False, {"is_success": False}

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)

    def close(self):
        pass


def test_what_is_observed_tells_where_something_else_simulates():
    env = GymEnvironment(Point(), GymSettings("point"))
    first, other = (Start(env, PlainInstance("point", seed, "test", "go")) for seed in (1, 2))
    env.advance(np.ones(2, np.float32))
    assert first.scene and other.scene and first.scene != other.scene == env.scene_digest(), "as it was loaded, whatever has moved since"
    assert Start(env, PlainInstance("point", 1, "test", "go")).scene == first.scene


@pytest.mark.slow
@pytest.mark.parametrize("name", ["metaworld:drawer-open-v3", "gym:FetchPush-v4", "lerobot:aloha/AlohaInsertion-v0", "robosuite:Lift"])
def test_real_suites_tell_their_scenes(name):
    try:
        task = find_task(name)
        env = task.open()
    except Exception as error:
        pytest.skip(f"{name} is not here: {error}")
    with contextlib.closing(env):
        told = [Start(env, task.instance(seed)).scene for seed in (7, 8, 7)]
        env.advance(env.hold_action())
        assert told[0] == told[2] == env.scene_digest() and told[0] != told[1] and all(told)
