"""Suites of others: gymnasium's and LeRobot's environments, and the Python environments that suites are made."""

import json

import gymnasium
import numpy as np
import pytest

import osel_sim
from osel_sim.cli.suites_command import main
from osel_sim.core.errors import ContentError, MissingPackageError, UnknownNameError, UsageError
from osel_sim.suites.check import check_task
from osel_sim.suites.environments import PINS, environment, names
from osel_sim.suites.gym.tasks import load_tasks, read_task
from osel_sim.suites.phrasing import words_of
from osel_sim.suites.registry import find_task, select_tasks


def made(name: str) -> pytest.MarkDecorator:
    place = environment(name)
    return pytest.mark.skipif(not place.installed, reason=f"the suite's environment has not been made: {place.command}")


class Point(gymnasium.Env):
    """A point that must get to the right: a box of actions, pictures by render, success in its info."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, render_mode=None, key="is_success"):
        self.render_mode, self.key = render_mode, key

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-0.5, 0.5, 2)
        return self.place.copy(), {}

    def step(self, action):
        self.place = np.clip(self.place + 0.2 * np.asarray(action, np.float64), -1.0, 1.0)
        return self.place.copy(), 0.0, False, False, {self.key: bool(self.place[0] > 0.9)}

    def render(self):
        return np.full((24, 24, 3), int(127 * (1 + self.place[0])), np.uint8)


@pytest.fixture(scope="module", autouse=True)
def _registered():
    for name, arguments, steps in (("Right-v0", {}, 12), ("Nameless-v0", {"key": "done"}, 12), ("Endless-v0", {}, None)):
        gymnasium.register(f"osel_test/{name}", entry_point=Point, kwargs=arguments, max_episode_steps=steps)
    yield
    for name in ("Right", "Nameless", "Endless"):
        del gymnasium.registry[f"osel_test/{name}-v0"]


# -- gymnasium ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_page_of_a_run_says_that_there_are_no_snapshots(tmp_path):
    class East:
        def reset(self, instruction):
            pass

        def act(self, observation):
            return np.array([[1.0, 0.0]], np.float32)

    class West(East):
        def act(self, observation):
            return np.array([[-1.0, 0.0]], np.float32)

    result = osel_sim.run(
        task="gym:osel_test/Right-v0", policies=[East(), West()], selector="random", episodes=2, counterfactual=True, out=tmp_path / "run"
    )
    assert result.page is not None and "started again from the same seed" in result.page.read_text()
    assert all(decision.outcome.success == (decision.policy == "east") for decision in result.journal)


def test_any_gymnasium_environment_that_says_success_is_a_task():
    task = find_task("gym:osel_test/Right-v0")
    check_task(task)
    spec = task.specification
    assert (spec.control_hz, spec.horizon, spec.cameras, dict(spec.state)) == (5.0, 12, ("render",), {"observation": 2})
    assert task.instance(0).instruction == "right"
    env = task.open()
    env.load(task.instance(0))
    while not env.done:
        env.advance(np.array([1.0, 0.0], np.float32))
    assert env.success and env.steps < 12
    env.close()


def test_demonstrations_need_an_expert(tmp_path):
    with pytest.raises(UsageError, match="has no scripted expert, so there is nobody to demonstrate it"):
        osel_sim.collect(task="gym:osel_test/Right-v0", episodes=1, out=tmp_path / "data")
    with pytest.raises(UsageError, match="camera: is for other suites"):
        osel_sim.collect(task="lift", camera="top", episodes=1, out=tmp_path / "data")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Nameless-v0", "its info must say 'is_success' or 'success' or 'succeed', it has: done"),
        ("Endless-v0", r"registered without an end \(max_episode_steps\): say horizon in its file"),
    ],
)
def test_an_environment_that_lacks_something_says_what(name, message):
    with pytest.raises(UsageError, match=message):
        find_task(f"gym:osel_test/{name}")


def test_a_file_says_what_an_environment_does_not(tmp_path):
    (tmp_path / "gym").mkdir()
    (tmp_path / "gym" / "endless.toml").write_text(
        'id = "osel_test/Endless-v0"\nhorizon = 7\ncontrol_hz = 2.5\nactions = ["x", "y"]\ntrain = ["go right"]\nheld_out = ["leave to the right"]\n'
    )
    task = find_task("gym:osel_test/Endless-v0", tmp_path)
    assert (task.specification.horizon, task.specification.control_hz, task.specification.action.names) == (7, 2.5, ("x", "y"))
    assert {task.instance(seed).instruction for seed in range(20)} == {"go right", "leave to the right"}
    assert {task.instance(seed, split="train").instruction for seed in range(20)} == {"go right"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('title = "no id"', "id: is missing"),
        ('id = "A-v0"\nhorizn = 3', "horizn: unknown key: did you mean 'horizon'"),
        ('id = "A-v0"\nhorizon = 0', "horizon: must be positive, got 0"),
        ('id = "A-v0"\nhorizon = true', "horizon: must be int, got True"),
        ('id = "A-v0"\ntrain = "go"', "train: must be a list of texts"),
        ('id = "A-v0"\nhold = "still"', "hold: must be one of zero, state"),
        ('id = "A-v0"\ngripper_convention = "open"', "gripper_convention: must be one of"),
        ("id = ", "TOML: "),
    ],
)
def test_a_wrong_file_is_refused_by_key(text, message, tmp_path):
    (tmp_path / "wrong.toml").write_text(text)
    with pytest.raises(ContentError, match=message):
        read_task(tmp_path / "wrong.toml")


def test_every_file_of_ours_has_phrasings():
    assert all(len(task.train) >= 6 and len(task.held_out) >= 4 for task in load_tasks().values())
    assert [task.name for task in select_tasks(["gym:all"])] == [f"gym:{name}" for name in load_tasks()]
    assert words_of("gym_aloha/AlohaTransferCube-v0") == "aloha transfer cube"


@pytest.mark.slow
@made("gym")
def test_fetch_in_a_process_of_its_own():
    check_task(find_task("gym:FetchReach-v4"))


@made("gym")
def test_fetch_reaches_its_goal_when_driven_there():
    task = find_task("gym:FetchReach-v4")
    env = task.open()
    env.load(task.instance(3))
    while not env.done:
        state = env.observe([], 32)["observation.state"]
        env.advance(np.append(np.clip(8 * (state[-3:] - state[:3]), -1, 1), 0.0).astype(np.float32))
    assert env.success and env.steps < 50 and env.image("render", 40, 30).shape == (30, 40, 3)
    env.close()


# -- LeRobot -----------------------------------------------------------------------------------------------------------


@made("lerobot")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "actions", "cameras"),
    [("pusht/PushT-v0", 2, ("pixels",)), ("aloha/AlohaInsertion-v0", 14, ("top",)), ("so101/SO101PickCube-v0", 4, ("render",))],
)
def test_an_episode_of_each_of_lerobots(name, actions, cameras):
    """PushT and ALOHA as LeRobot brings them, and a third party's plugin."""
    task = find_task(f"lerobot:{name}")
    env = task.open()
    assert env.specification.drives_like(task.specification)
    assert (task.specification.action.dimension, task.specification.cameras) == (actions, cameras)
    instance = task.instance(2)
    env.load(instance)
    first = env.observe(cameras, 48)
    assert first["task"] == instance.instruction and first[f"observation.images.{cameras[0]}"].any()
    while not env.done:
        env.advance_chunk(np.stack([env.hold_action()] * 50))
    assert env.steps == task.info.horizon and not env.success
    env.load(instance)
    again = env.observe(cameras, 48)
    assert all(np.array_equal(first[key], again[key]) for key in first)
    env.close()


@made("lerobot")
@pytest.mark.slow
def test_what_lerobot_does_not_have_is_said():
    with pytest.raises(UsageError, match="unknown environment type of LeRobot 'pusth': did you mean 'pusht'"):
        find_task("lerobot:pusth")
    with pytest.raises(MissingPackageError, match="suite 'lerobot' needs the package 'VLABench'"):
        find_task("lerobot:vlabench")


# -- robosuite ---------------------------------------------------------------------------------------------------------

ARMS = ["Lift", "Lift/UR5e", "Lift/IIWA", "Lift/Jaco", "Lift/Kinova3"]
OTHERS = ["Stack", "NutAssembly", "NutAssemblySquare", "NutAssemblyRound", "PickPlace", "PickPlaceMilk", "PickPlaceBread", "PickPlaceCereal"]


def test_robosuites_tasks_are_its_environments_with_its_arms():
    tasks = select_tasks(["robosuite:all"])
    assert {f"robosuite:{name}" for name in [*ARMS, *OTHERS, "PickPlaceCan", "Door", "ToolHang"]} <= {task.name for task in tasks}
    assert {task.specification.robot for task in select_tasks(["robosuite:tag:ur5e"])} == {"UR5e"}
    one, other = find_task("robosuite:Lift").instance(3), find_task("robosuite:Lift/Jaco").instance(3)
    assert one.instruction == other.instruction and one.key != other.key
    with pytest.raises(UnknownNameError, match="did you mean 'robosuite:Lift"):
        find_task("robosuite:Lift/Sawyer")


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_robosuite_moves_as_it_does_with_its_own_control(name):
    task = find_task(f"robosuite:{name}")
    env = task.open()
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 7)).astype(np.float32)
    joints = []
    for step in (env.advance, env._env.step):
        env.load(task.instance(1))
        for action in actions:
            step(action)
        joints.append(env._data.qpos[: env._robot.joints].copy())
    env.close()
    assert np.abs(joints[0] - joints[1]).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Lift/UR5e", "PickPlaceCan", "Door", "NutAssemblySquare", "ToolHang"])
def test_robosuite_keeps_what_a_suite_promises(name):
    check_task(find_task(f"robosuite:{name}"))


# -- Python environments -----------------------------------------------------------------------------------------------


def test_every_list_of_pins_is_whole():
    from packaging.requirements import Requirement

    for name in names():
        pinned = {}
        for line in (PINS / f"{name}.txt").read_text().splitlines():
            requirement = Requirement(line)
            assert [one.operator for one in requirement.specifier] == ["=="] and requirement.url is None, f"{name}: {line}"
            pinned[requirement.name.lower()] = next(iter(requirement.specifier)).version
        for line in (PINS / f"{name}.in").read_text().splitlines():
            if not line.startswith("#"):
                wanted = Requirement(line)
                assert wanted.specifier.contains(pinned[wanted.name.lower()]), f"{name}: {line} is pinned to {pinned[wanted.name.lower()]}"


def test_names_of_environments_get_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean 'metaworld'"):
        environment("metawold")


def test_suites_are_listed_with_what_they_are_and_cannot(capsys):
    assert main(["list", "--json"]) == 0
    found = {suite["name"]: suite for suite in json.loads(capsys.readouterr().out)}
    assert {"gym", "lerobot", "metaworld", "robosuite"} <= set(found)
    assert found["gym"]["cannot"][0].startswith("no snapshots") and found["metaworld"]["cannot"] == []
    assert len(found["metaworld"]["tasks"]) == 50
    assert main(["list", "--suite", "gim"]) == 2 and "did you mean 'gym'" in capsys.readouterr().err
    assert main(["instal"]) == 2 and "unknown action 'instal', known: list, install" in capsys.readouterr().err
    assert main(["install", "nobody"]) == 2 and "unknown suite with an environment of its own 'nobody'" in capsys.readouterr().err
