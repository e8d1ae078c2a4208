"""Our compiled control against robosuite's own, on robosuite's own environment, for every robot."""

import numpy as np
import pytest

from osel_sim.sim.gl import quiet_robosuite

robosuite = quiet_robosuite()

import mujoco  # noqa: E402 (after the backend is chosen)

from osel_sim.sim import osc  # noqa: E402
from osel_sim.sim.control import Control  # noqa: E402
from osel_sim.sim.robots import BUILT_IN, load_robot  # noqa: E402


@pytest.fixture(scope="module", params=sorted(BUILT_IN))
def robot(request):
    return load_robot(request.param)


@pytest.fixture(scope="module")
def stock(robot):
    env = robosuite.make("Lift", robots=robot.name, has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, control_freq=20,
                         initialization_noise=None, horizon=10_000)  # fmt: skip
    yield env
    env.close()


def ours_like(stock, robot):
    """Our control on robosuite's model, in robosuite's state."""
    np.random.seed(0)  # robosuite places things with numpy's global generator
    stock.reset()
    # robosuite's first substep after a reset still uses the mass matrix of before its gripper was set: start after it.
    stock.step(np.zeros(7))
    model = stock.sim.model._model
    data = mujoco.MjData(model)
    control = Control(model, data, robot, stock.robots[0].part_controllers["right"].initial_joint)
    copy_state(stock, model, data)
    return control, model, data


def copy_state(stock, model, data):
    data.qpos[:], data.qvel[:] = stock.sim.data.qpos, stock.sim.data.qvel
    data.qacc_warmstart[:] = stock.sim.data.qacc_warmstart
    mujoco.mj_step1(model, data)


@pytest.mark.parametrize("seed", [0, 1])
def test_torques_equal_robosuites_in_the_same_state(stock, robot, seed):
    control, model, data = ours_like(stock, robot)
    stock_robot = stock.robots[0]
    controller = stock_robot.part_controllers["right"]
    worst = 0.0
    for action in np.random.default_rng(seed).uniform(-1, 1, (40, 7)):
        stock.step(action * [1, 1, 0.3, 1, 1, 1, 1])
        copy_state(stock, model, data)
        stock.sim.step1()
        probe = np.random.default_rng(seed + 1).uniform(-1, 1, 6)
        stock_robot.composite_controller.update_state()
        controller.update(force=False)
        controller.new_update = True
        controller.set_goal(probe)
        controller.new_update = True
        expected = controller.run_controller()
        found = control.torques(*control.goal(np.append(probe, 0.0)))
        worst = max(worst, float(np.abs(found - expected).max()))
    assert worst < 1e-9


@pytest.mark.parametrize(("seed", "actions"), [(0, 120), (1, 50), (2, 50)])
def test_trajectory_equals_robosuites_over_random_actions(stock, robot, seed, actions, monkeypatch):
    control, model, data = ours_like(stock, robot)
    # Half the range, and up a little, so that the arm stays in free space: contacts and joint limits amplify the last bit. Those within a gripper of
    # linkages do so all the time: it is compared without contacts, each step from the same state.
    linkages = robot.gripper.pads is not None
    if linkages:
        monkeypatch.setattr(model.opt, "disableflags", int(mujoco.mjtDisableBit.mjDSBL_CONTACT))
    joints = robot.joints + len(robot.gripper.rest)
    upwards = np.array([0, 0, 0.02, 0, 0, 0, 0])
    for action in np.random.default_rng(seed).uniform(-0.5, 0.5, (actions, 7)) + upwards:
        if linkages:
            copy_state(stock, model, data)
        stock.step(action)
        control.step(action)
        assert np.abs(data.qpos[:joints] - stock.sim.data.qpos[:joints]).max() < 1e-6
        np.testing.assert_allclose(data.ctrl[robot.joints :], stock.sim.data.ctrl[robot.joints :], rtol=0, atol=1e-12)
    assert np.abs(data.qpos[: robot.joints] - control._initial_joint).max() > 0.01  # it did move
    assert len(osc.goal_pose.signatures) == len(osc.osc_torques.signatures) == 1  # what `prepare` compiles is what is used


def test_actions_beyond_the_range_are_clipped(stock, robot):
    control, _, _ = ours_like(stock, robot)
    inside, beyond = control.goal(np.ones(7)), control.goal(np.full(7, 30.0))
    np.testing.assert_array_equal(inside[0], beyond[0])
    np.testing.assert_array_equal(inside[1], beyond[1])
