"""Every robot: what its file says is what robosuite's model says, and the scripted expert can work with it."""

import dataclasses
import sys

import gymnasium
import mujoco
import numpy as np
import pytest

from osel_sim.core import content
from osel_sim.core.errors import ContentError, UnknownNameError, UsageError
from osel_sim.formats.run_config import robots_said
from osel_sim.formats.task_file import load_task_file
from osel_sim.interface.robot import Robot
from osel_sim.sim.control import Control
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance
from osel_sim.sim.perturbation import CLEAN
from osel_sim.sim.robots import BUILT_IN, load_robot, with_robot
from osel_sim.suites.registry import find_task

TASK = load_task_file(content.find("tasks", "pick_place"))
OTHERS = sorted(set(BUILT_IN) - {"Panda"})


@pytest.fixture(scope="module", params=sorted(BUILT_IN))
def env(request):
    env = TaskEnv("pick_place", robot=request.param)
    yield env
    env.close()


def solve(env, seed, level=0):
    """Whether the expert solves an instance."""
    env.load(make_instance(env.task, seed, level))
    expert = Expert(env.world)
    while not env.done:
        env.advance(expert.act())
    return env.success


def test_the_home_pose_is_robosuites_or_the_pandas_with_the_gripper_straight_down(env):
    from importlib import import_module

    world, robot = env.world, env.world.robot
    module, _, name = robot.model.partition(":")
    own = getattr(import_module(module), name)(idn=0).init_qpos
    assert len(own) == robot.joints
    env.load(make_instance(env.task, 0))
    assert np.linalg.norm(world.grip_position - [-0.103, 0.0, 1.011]) < 0.002
    if robot.name == "Panda":
        assert tuple(own) == robot.home
    else:
        assert world.grip_matrix[2, 2] < -0.999 and world.grip_matrix[1, 0] > 0.999
    low, high = world.model.jnt_range[: robot.joints].T
    limited = world.model.jnt_limited[: robot.joints].astype(bool)
    assert ((robot.home > low + 0.3) & (robot.home < high - 0.3))[limited].all()


def test_gains_are_those_of_robosuites_own_configuration(env):
    from robosuite.controllers import load_composite_controller_config

    gains = env.world.robot.gains
    arm = load_composite_controller_config(robot=env.world.robot.model.partition(":")[2])["body_parts"]["right"]
    assert (arm["type"], arm["input_ref_frame"], arm["uncouple_pos_ori"]) == ("OSC_POSE", "base", True)
    assert (gains.kp, gains.damping_ratio, list(gains.output_max)) == (arm["kp"], arm["damping_ratio"], arm["output_max"])


def test_start_lift_is_how_joints_lift_the_hand_at_home(env):
    """The start of the axis `robot` is never lower than the home pose by what these numbers say; they must not drift from it."""
    world, robot = env.world, env.world.robot
    data, jacobian = mujoco.MjData(world.model), np.zeros((3, world.model.nv))
    data.qpos[: robot.joints] = robot.home
    mujoco.mj_kinematics(world.model, data)
    mujoco.mj_comPos(world.model, data)
    mujoco.mj_jacSite(world.model, data, jacobian, None, world.model.site(robot.grip_site).id)
    np.testing.assert_allclose(robot.start_lift, jacobian[2, : robot.joints], atol=0.03)


def test_an_instance_is_the_same_scene_for_every_robot_under_a_key_of_its_own():
    clean = make_instance(TASK, 7, 2)
    assert clean.key == "pick_place/test/2/7" and clean.robot == "Panda"
    for name in OTHERS:
        own = make_instance(with_robot([TASK], name)[0], 7, 2)
        assert own.key == f"pick_place/test/2/7-{name}"
        assert (own.placements, own.instruction, own.roles) == (clean.placements, clean.instruction, clean.roles)
        assert dataclasses.replace(own.perturbation, joints=()) == dataclasses.replace(clean.perturbation, joints=())
        assert len(own.perturbation.joints) == load_robot(name).joints
    assert make_instance(TASK, 7).perturbation == CLEAN


def test_a_perturbed_start_is_as_high_as_the_home_pose(env):
    for seed in range(30):
        offsets = make_instance(env.task, seed, 3).perturbation.joints
        assert np.dot(env.world.robot.start_lift, offsets) >= 0 and np.abs(offsets).max() > 0.06


def test_the_fingers_are_metres_from_the_middle(env):
    env.load(make_instance(env.task, 0))
    for _ in range(10):
        env.advance(np.append(env.hold_action()[:6], -1.0))
    half = env.world.finger_positions[0]
    assert 0.037 < half < 0.044 and env.world.finger_positions[1] == pytest.approx(-half, abs=1e-3)
    for _ in range(20):
        env.advance(np.append(env.hold_action()[:6], 1.0))
    assert np.abs(env.world.finger_positions).max() < 0.002
    state = env.observe((), 8)["observation.state"]
    assert state.shape == (8,) and state.dtype == np.float32
    np.testing.assert_allclose(state[6:], env.world.finger_positions, atol=1e-7)


def test_the_hand_stays_where_it_is_when_told_to(env):
    """Nothing trembles: neither the arm nor the links of the gripper."""
    env.load(make_instance(env.task, 0))
    for _ in range(20):
        env.advance(np.append(env.hold_action()[:6], 1.0))
    start, robot = env.world.grip_position.copy(), env.world.robot
    for _ in range(20):
        env.advance(env.hold_action())
    joints = robot.joints + len(robot.gripper.rest)
    assert np.abs(env.world.data.qvel[:joints]).max() < 0.02
    assert np.linalg.norm(env.world.grip_position - start) < 0.003


def test_an_instance_of_another_robot_is_refused(env):
    other = "Panda" if env.world.robot.name != "Panda" else "UR5e"
    with pytest.raises(UsageError, match=f"is for the robot {other}, this world has {env.world.robot.name}"):
        env.load(make_instance(with_robot([TASK], other)[0], 0))


def test_same_seed_same_bits_also_from_a_snapshot(env):
    ends = []
    for _ in range(2):
        env.load(make_instance(env.task, 3, 3))
        expert = Expert(env.world)
        for step in range(24):
            if step == 12:
                middle = env.snapshot()
            action = expert.act()
            env.advance(action)
        ends.append(env.world.data.qpos.copy())
    np.testing.assert_array_equal(*ends)
    env.restore(middle)
    assert env.steps == 12 and env.world.gripper_command == middle.world.gripper_command


def test_the_expert_picks_and_places(env):
    assert [solve(env, seed) for seed in (0, 1)] == [True, True]


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("task", ["lift", "pick_place", "stack"])
def test_the_expert_solves_18_of_20_instances(task, name):
    env = TaskEnv(task, robot=name)
    solved = sum(solve(env, seed) for seed in range(2000, 2020))
    env.close()
    assert solved >= 18


def test_gymnasium_makes_a_task_with_a_robot():
    made = gymnasium.make("osel_sim.envs:osel_sim/lift-v0", robot="UR5e").unwrapped
    observation, info = made.reset(seed=0)
    assert made.world.robot.name == "UR5e" and info["instance"].endswith("-UR5e")
    assert observation["state"].shape == (8,)
    made.close()


def test_a_task_file_may_name_its_robot(tmp_path):
    text = TASK.file.read_text()
    file = tmp_path / "pick_place.toml"
    file.write_text(text.replace("version = 1", 'version = 1\nrobot = "UR5e"', 1))
    task = load_task_file(file)
    assert make_instance(task, 0).robot == "UR5e" and with_robot([task])[0].robot == "UR5e"
    assert with_robot([task], "Kinova3")[0].robot == "Kinova3"
    file.write_text(text.replace("version = 1", 'version = 1\nrobot = "UR5"', 1))
    with pytest.raises(ContentError, match=r"pick_place\.toml: robot: unknown robot 'UR5': did you mean 'UR5e'\?"):
        with_robot([load_task_file(file)])


def test_an_unknown_robot_is_refused_with_the_nearest():
    with pytest.raises(UnknownNameError, match="unknown robot 'Kinova': did you mean 'Kinova3'"):
        with_robot([TASK], "Kinova")
    with pytest.raises(UnknownNameError, match="UR5e"):
        TaskEnv("lift", robot="ur5e")


def test_run_json_says_only_what_is_unusual():
    usual, other = find_task("pick_place"), find_task("lift", robot="UR5e")
    assert robots_said([usual]) == robots_said([find_task("lift", robot="Panda")]) == {}
    assert robots_said([other]) == {"robot": "UR5e"}
    assert robots_said([usual, other]) == {"robot": {"pick_place": "Panda", "lift": "UR5e"}}


def test_other_packages_offer_robots(tmp_path, monkeypatch):
    info = tmp_path / "their_robots-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-robots\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[osel_sim.robots]\nTheirs = their_robots:THEIRS\nPanda = their_robots:THEIRS\nOther = their_robots:THEIRS\nWrong = their_robots:WRONG\n"
    )
    (tmp_path / "their_robots.py").write_text(
        "from dataclasses import replace\nfrom osel_sim.sim.robots.panda import PANDA\nTHEIRS, WRONG = replace(PANDA, name='Theirs'), 1\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert load_robot("Theirs").name == "Theirs"
    assert load_robot("Panda").name == "Panda", "a built-in robot cannot be replaced"
    assert make_instance(with_robot([TASK], "Theirs")[0], 1).key == "pick_place/test/0/1-Theirs"
    with pytest.raises(UsageError, match="must be a Robot, it is a int"):
        load_robot("Wrong")
    with pytest.raises(UsageError, match=r"'Other'.* calls itself 'Theirs'"):
        load_robot("Other")
    sys.modules.pop("their_robots", None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"name": "a/b"}, "letters, digits"), ({"home": (0.0,) * 6}, "start_weights must have 6"), ({"start_lift": ()}, "start_lift must have 7")],
)
def test_a_robot_that_does_not_fit_itself_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(load_robot("Panda"), **changes)


def test_a_base_that_turns_is_refused(env):
    """robosuite's IIWA has its base frame behind the first joint: its actions would mean something else in every pose."""
    turning = next(site for site in range(env.world.model.nsite) if env.world.model.body_weldid[env.world.model.site_bodyid[site]])
    robot: Robot = dataclasses.replace(env.world.robot, base_site=env.world.model.site(turning).name)
    with pytest.raises(UsageError, match="moves with a joint"):
        Control(env.world.model, mujoco.MjData(env.world.model), robot, np.array(robot.home))


def test_a_wrist_camera_can_be_mounted_elsewhere():
    from robosuite.models.robots import Panda

    from osel_sim.sim.scene import mount_camera

    panda, arm = load_robot("Panda"), Panda(idn=0)
    mount = dataclasses.replace(panda.wrist_camera, position=(0.07, 0.0, 0.01), quaternion=(0.0, 1.0, 0.0, 0.0))
    camera = next(camera for camera in arm.root.iter("camera") if camera.get("name") == mount.name)
    before = dict(camera.attrib)
    mount_camera(arm, panda)
    assert camera.attrib == before, "it stays where robosuite has it"
    mount_camera(arm, dataclasses.replace(panda, wrist_camera=mount))
    assert (camera.get("pos"), camera.get("quat")) == ("0.07 0.0 0.01", "0.0 1.0 0.0 0.0")
