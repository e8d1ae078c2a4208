import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import osel_sim
from osel_sim.core import content
from osel_sim.core.errors import UsageError
from osel_sim.formats.task_file import load_task_file
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance

CAMERAS = ("agentview", "wrist")


@pytest.fixture(scope="module")
def env():
    env = TaskEnv("pick_place")
    yield env
    env.close()


def play(env, instance, steps=1000, look=False):
    """The expert's run on an instance -> states after each step."""
    env.load(instance)
    expert = Expert(env.world)
    states = []
    while not env.done and len(states) < steps:
        if look:
            env.observe(CAMERAS, 64)
        env.advance(expert.act())
        states.append(env.world.data.qpos.copy())
    return np.array(states)


@pytest.mark.filterwarnings("ignore")
def test_passes_the_checkers_of_gymnasium_and_sb3():
    made = gymnasium.make("osel_sim.envs:osel_sim/pick_place-v0", cameras=CAMERAS, image_size=48)
    gymnasium_check_env(made.unwrapped, skip_render_check=True)
    sb3_check_env(made.unwrapped)
    made.close()


def test_sb3_learns_from_its_observations():
    made = osel_sim.make_env("lift", cameras=CAMERAS, image_size=40)
    model = PPO("MultiInputPolicy", made, n_steps=4, batch_size=4, n_epochs=1, device="cpu").learn(4)
    assert model.num_timesteps == 4 and set(made.observation_space) == {"state", "image_agentview", "image_wrist"}
    made.close()


def test_observations_are_those_of_observe_under_names_without_dots(env):
    watched = TaskEnv(env.task, cameras=CAMERAS, image_size=48)
    observation, _ = watched.reset(seed=1)
    shown = watched.observe(CAMERAS, 48)
    np.testing.assert_array_equal(observation["state"], shown["observation.state"])
    for camera in CAMERAS:
        np.testing.assert_array_equal(observation[f"image_{camera}"], shown[f"observation.images.{camera}"])
    watched.close()


@pytest.mark.parametrize(
    "action",
    [np.zeros(6), np.zeros((1, 7)), np.zeros(8), 0.0, None, "up", [0.0] * 6 + ["open"], [[0.0], [0.0, 1.0]], np.zeros(7, bool), np.zeros(7, complex)],
)
def test_an_action_of_another_shape_or_type_is_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(UsageError, match=r"an action must be 7 real numbers of shape \(7,\), got"):
        env.step(action)
    assert env.steps == 0


def test_an_action_of_no_numbers_is_refused_and_a_large_one_is_clipped(env):
    for value in (np.nan, np.inf, -np.inf):
        env.reset(seed=0)
        with pytest.raises(UsageError, match="an action must be finite numbers"):
            env.step([0.0] * 6 + [value])
        assert env.steps == 0 and np.isfinite(env.world.data.qpos).all()
    states = []
    for size in (1.0, 50.0):
        env.reset(seed=0)
        states.append(env.step([size] * 6 + [-size])[0]["state"])
    np.testing.assert_array_equal(*states)


def test_reset_takes_options_for_one_episode_and_no_others(env):
    _, drawn = env.reset(seed=4)
    assert env.reset(seed=4)[1] == drawn and env.instance.level == 0
    _, info = env.reset(options={"seed": np.int64(7), "level": 2, "split": "test"})
    assert info["instance"] == "pick_place/test/2/7" and env.instance == make_instance(env.task, 7, 2, "test")
    _, info = env.reset(options={"seed": 7, "axes": {"camera": 1}})
    assert info["instance"] == make_instance(env.task, 7, 0, "train", {"camera": 1}).key
    assert env.reset(seed=4, options={})[1] == drawn
    assert env.reset(options={"instance": make_instance(env.task, 11)})[1]["instance"] == "pick_place/test/0/11"
    for options, says in (
        ({"lvl": 2}, "unknown option of reset 'lvl': did you mean 'level'"),
        ({"level": 9}, "unknown level 9"),
        ({"level": "2"}, "level must be an integer, got '2'"),
        ({"seed": -1}, "a seed must be 0 or more, got -1"),
        ({"seed": 1.5}, r"seed must be an integer, got 1\.5"),
        ({"seed": True}, "seed must be an integer, got True"),
        ({"split": "tests"}, "unknown split 'tests'"),
        ({"axes": ["camera"]}, "axes must be a mapping"),
        ({"axes": {"camra": 1}}, "did you mean 'camera'"),
        ({"instance": "pick_place/test/0/11"}, "instance must be one of 'pick_place'"),
        ({"instance": make_instance(load_task_file(content.find("tasks", "lift")), 1)}, "instance must be one of 'pick_place' with Panda"),
        ({"instance": make_instance(env.task, 1), "level": 1}, "an instance has its own level"),
    ):
        with pytest.raises(UsageError, match=says):
            env.reset(options=options)
    assert env.instance.seed == 11


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"cameras": ("agentvew",)}, "unknown camera 'agentvew': did you mean 'agentview'"),
        ({"render_mode": "depth"}, "unknown render mode 'depth'"),
        ({"image_size": 0}, r"image_size must be an integer in \[1, 1024\], got 0"),
        ({"level": 5}, "unknown level 5"),
        ({"split": "dev"}, "unknown split 'dev'"),
        ({"robot": "Pnada"}, "did you mean 'Panda'"),
    ],
)
def test_wrong_settings_are_named(settings, says):
    with pytest.raises(UsageError, match=says):
        TaskEnv("lift", **settings)


def test_registration_imports_nothing_heavy():
    code = """import gymnasium, osel_sim.envs, sys
assert "osel_sim/pick_place-v0" in gymnasium.registry
print({"mujoco", "torch", "robosuite"} & set(sys.modules))"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


def test_same_instance_same_bits_with_or_without_images(env):
    instance = make_instance(env.task, 11)
    first = play(env, instance)
    play(env, make_instance(env.task, 12))
    np.testing.assert_array_equal(play(env, instance, look=True), first)


def test_images_are_the_same_each_time_and_differ_between_scenes(env):
    def images(seed):
        env.load(make_instance(env.task, seed))
        return env.observe(CAMERAS, 64)

    first, other, again = images(1), images(2), images(1)
    for camera in CAMERAS:
        key = f"observation.images.{camera}"
        np.testing.assert_array_equal(first[key], again[key])
        assert (first[key] != other[key]).any()
        assert first[key].shape == (64, 64, 3) and first[key].dtype == np.uint8
    assert first["observation.state"].shape == (8,) and np.isfinite(first["observation.state"]).all()
    assert first["task"] == make_instance(env.task, 1).instruction


def test_a_scene_is_told_by_all_that_an_episode_depends_on(env):
    task = env.task
    plain = make_instance(task, 3)
    env.load(plain)
    digest, world = env.scene_digest(), env.world
    env.advance(np.ones(7))
    assert env.scene_digest() == digest, "what happens later is not how it began"
    twin = TaskEnv(task)
    twin.load(make_instance(task, 4))
    snapshot = twin.snapshot()
    other = twin.scene_digest()
    twin.load(plain)
    assert twin.scene_digest() == digest != other
    twin.restore(snapshot)
    assert twin.scene_digest() == other
    twin.close()
    moved = replace(plain, placements=(replace(plain.placements[0], x=plain.placements[0].x + 1e-4), *plain.placements[1:]))
    last_bits = replace(plain, placements=(replace(plain.placements[0], x=plain.placements[0].x + 1e-15), *plain.placements[1:]))
    named = replace(plain, instruction="do something else")
    perturbed = [make_instance(task, 3, axes={axis: 3}) for axis in task.axes if axis != "phrasing"]
    told = {digest}
    for instance in (moved, named, make_instance(task, 3, split="train"), *perturbed):
        env.load(instance)
        told.add(env.scene_digest())
    assert len(told) == 4 + len(perturbed), "every axis shows"
    env.load(last_bits)
    assert env.scene_digest() == digest, "the last bit does not"
    for field in ("body_mass", "geom_friction"):
        array = getattr(world.model, field)
        was = array.copy()
        array *= 1.1
        assert env.scene_digest() != digest, field
        array[:] = was
    assert env.scene_digest() == digest


def test_a_snapshot_goes_on_to_the_same_bits_also_in_another_environment(env):
    instance = make_instance(env.task, 5)
    env.load(instance)
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 7)).astype(np.float32)
    for action in actions[:20]:
        env.advance(action)
    snapshot = env.snapshot()
    for action in actions[20:]:
        env.advance(action)
    expected = env.world.data.qpos.copy()
    twin = TaskEnv(env.task)
    play(twin, make_instance(env.task, 9), steps=15)
    for there in (env, twin):
        there.restore(snapshot)
        assert there.steps == 20
        for action in actions[20:]:
            there.advance(action)
        np.testing.assert_array_equal(there.world.data.qpos, expected)
    twin.close()


def test_the_expert_solves_unseen_instances_with_subgoals_in_order(env):
    solved = 0
    for seed in range(1000, 1010):
        env.load(make_instance(env.task, seed))
        assert env.subgoal_fraction == 0.0 and not env.success
        expert, fractions = Expert(env.world), []
        while not env.done:
            env.advance(expert.act())
            fractions.append(env.subgoal_fraction)
        assert fractions == sorted(fractions)
        solved += env.success
        if env.success:
            assert fractions[-1] == 1.0
    assert solved >= 9


@pytest.mark.slow
def test_the_expert_solves_97_of_100_test_instances(env):
    solved = sum(bool(len(play(env, make_instance(env.task, seed))) and env.success) for seed in range(200))
    assert solved >= 194


def test_a_wrong_goal_is_no_success(env):
    """The expert fulfils another instruction about the same scene."""
    instance = make_instance(env.task, 1001)
    env.load(instance)
    other = "bowl" if instance.container != "bowl" else "plate"
    expert = Expert(env.world)
    env.world.instance = type(instance)(**{**instance.__dict__, "roles": {**instance.roles, "container": other}})
    while env.steps < 150 and not env.success:
        env.advance(expert.act())
    assert env.success  # of the other goal
    env.world.instance = instance
    assert not env.success


def test_holding_still_changes_nothing_but_time(env):
    env.load(make_instance(env.task, 3))
    before = env.world.grip_position.copy()
    for _ in range(40):
        env.advance(env.hold_action())
    assert np.abs(env.world.grip_position - before).max() < 0.01
    assert not env.success and env.steps == 40


def test_cameras_see_what_is_named(env):
    for seed in range(20):
        instance = make_instance(env.task, seed)
        env.load(instance)
        positions = env.entity_positions()
        pixels = env.project(np.array([positions[instance.target], positions[instance.container]]), "agentview", 96)
        assert ((pixels > 0) & (pixels < 96)).all(), instance.key


def test_projection_agrees_with_rendering(env):
    """A red cube's projected place is red in the image."""
    seed = next(seed for seed in range(500) if make_instance(env.task, seed).target == "red_cube")
    env.load(make_instance(env.task, seed))
    x, y = env.project(env.world.position("red_cube")[None], "agentview", 200)[0].astype(int)
    red, green, blue = env.image("agentview", 200, 200)[y, x].astype(int)
    assert red > 2 * green and red > 2 * blue


def test_fast_and_full_images_show_the_same_scene(env):
    env.load(make_instance(env.task, 4))
    fast, full = (env.image("agentview", 128, 128, quality).astype(float) for quality in ("fast", "full"))
    assert np.abs(fast - full).mean() < 12  # of 255: shadows and edges differ, nothing else
    assert (fast != full).any()


def test_memory_does_not_grow_over_resets(env):
    import psutil

    def cycle(count):
        for seed in range(count):
            env.load(make_instance(env.task, seed))
            env.image("agentview", 64, 64)
        return psutil.Process().memory_info().rss / 2**20

    cycle(50)
    before = cycle(20)
    assert cycle(250) - before < 5  # MiB
