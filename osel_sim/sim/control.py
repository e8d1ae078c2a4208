"""Control of a robosuite arm, step for step what robosuite does, without its Python between the physics steps."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.robot import Robot

Array = NDArray[np.float64]

SUBSTEPS = 25
"""Physics steps of 2 ms in a control step of 50 ms (robosuite's)."""


class Control:
    """OSC_POSE and gripper of a robot in a model that robosuite composed.

    Args:
        model, data: MuJoCo's. The arm's joints must be the first ones, as in every robosuite model.
        initial_joint: posture (n,) that the null space pulls towards; robosuite takes the one after its reset.

    Raises:
        UsageError: the robot's base is no fixed one.

    Attributes:
        gripper_command: how far the gripper was told to close, -1 (open) to 1 (closed).
    """

    def __init__(self, model: Any, data: Any, robot: Robot, initial_joint: Array) -> None:
        import mujoco

        from osel_sim.sim import osc

        osc.prepare()
        self._mujoco, self._osc = mujoco, osc
        self._model, self._data = model, data
        self._initial_joint = np.array(initial_joint, dtype=np.float64)
        mujoco.mj_forward(model, data)
        self._gripper = robot.gripper
        self._site = model.site(robot.grip_site).id
        # Views into the data's arrays, which MuJoCo never moves: looking them up anew costs more than the arithmetic.
        self.position, self.matrix = data.site_xpos[self._site], data.site_xmat[self._site]
        base = model.site(robot.base_site).id
        if model.body_weldid[model.site_bodyid[base]]:
            raise UsageError(f"robot {robot.name!r}: its base_site {robot.base_site!r} moves with a joint, so that actions would mean other things")
        self._base_matrix = data.site_xmat[base].reshape(3, 3).copy()
        self._qpos, self._qvel, self._bias, self._inertia = data.qpos, data.qvel, data.qfrc_bias, data.qM
        arm, gripper = slice(robot.joints), slice(robot.joints, robot.joints + len(robot.gripper.closing))
        self._arm_control, self._gripper_control = data.ctrl[arm], data.ctrl[gripper]
        self._torque_low, self._torque_high = model.actuator_ctrlrange[arm].T.copy()
        low, high = model.actuator_ctrlrange[gripper].T
        self._gripper_middle, self._gripper_reach = 0.5 * (high + low), 0.5 * (high - low)
        self._closing = np.array(robot.gripper.closing)
        self._jacobian_position, self._jacobian_rotation = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self._addresses = _inertia_addresses(model, robot.joints)
        kp, null_kp = float(robot.gains.kp), float(robot.gains.null_kp)
        self._gains = (kp, 2.0 * math.sqrt(kp) * robot.gains.damping_ratio, null_kp, 2.0 * math.sqrt(null_kp))
        self._output_max = np.array(robot.gains.output_max)
        self.gripper_command = 0.0

    def step(self, action: NDArray[Any]) -> None:
        """One control step (50 ms) of a 7-d action in [-1, 1].

        The data must be up to date with its positions (`mj_step1`), and is again afterwards.
        """
        mujoco, model, data = self._mujoco, self._model, self._data
        action = np.asarray(action, dtype=np.float64)
        goal = self.goal(action)
        self._command_gripper(float(action[6]))
        for _ in range(SUBSTEPS):
            torques = self.torques(*goal)
            np.minimum(torques, self._torque_high, out=torques)  # np.clip takes four times as long
            np.maximum(torques, self._torque_low, out=self._arm_control)
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)  # last, so that poses and contacts are those of the state reached when somebody looks

    def goal(self, action: Array) -> tuple[Array, Array]:
        """World pose (3,), (3, 3) that an action asks for."""
        goal: tuple[Array, Array] = self._osc.goal_pose(action[:6], self._output_max, self.position, self.matrix.reshape(3, 3), self._base_matrix)
        return goal

    def torques(self, goal_position: Array, goal_matrix: Array) -> Array:
        """Joint torques (n,) towards a pose, before the actuators' limits."""
        self._mujoco.mj_jacSite(self._model, self._data, self._jacobian_position, self._jacobian_rotation, self._site)
        torques: Array = self._osc.osc_torques(
            goal_position, goal_matrix, self.position, self.matrix, self._jacobian_position, self._jacobian_rotation,
            self._inertia, self._addresses, self._qpos, self._qvel, self._bias, self._initial_joint, self._gains,
        )  # fmt: skip
        return torques

    def _command_gripper(self, command: float) -> None:
        """As robosuite's two-finger grippers: only the sign counts, and the command creeps towards it."""
        self.gripper_command = float(np.clip(self.gripper_command + self._gripper.speed * np.sign(command), -1.0, 1.0))
        self._gripper_control[:] = self._gripper_middle + self._gripper_reach * (self._closing * self.gripper_command)


def _inertia_addresses(model: Any, joints: int) -> NDArray[np.int32]:
    """Where the arm's mass matrix (n, n) lies in MuJoCo's sparse `qM`: each row runs up the chain of parent degrees of freedom."""
    addresses = np.zeros((joints, joints), dtype=np.int32)
    for row in range(joints):
        address, column = int(model.dof_Madr[row]), row
        while column >= 0:
            addresses[row, column] = addresses[column, row] = address
            address, column = address + 1, int(model.dof_parentid[column])
    return addresses
