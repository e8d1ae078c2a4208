"""Control of a robosuite Panda, step for step what robosuite does, without its Python between the physics steps."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SUBSTEPS = 25
"""Physics steps of 2 ms in a control step of 50 ms (robosuite's)."""
GRIPPER_SPEED = 0.2
"""robosuite's PandaGripper moves its command by this much a control step."""


class Control:
    """OSC_POSE and gripper of the Panda in a model that robosuite composed.

    Args:
        model, data: MuJoCo's. The arm's seven joints must be the first ones, as in every robosuite model.
        initial_joint: posture (7,) that the null space pulls towards; robosuite takes the one after its reset.
    """

    def __init__(self, model: Any, data: Any, initial_joint: Array) -> None:
        import mujoco

        from osel_sim.sim import osc

        self._mujoco, self._osc = mujoco, osc
        self._model, self._data = model, data
        self._initial_joint = np.array(initial_joint, dtype=np.float64)
        mujoco.mj_forward(model, data)
        self._site = model.site("gripper0_right_grip_site").id
        # Views into the data's arrays, which MuJoCo never moves: looking them up anew costs more than the arithmetic.
        self.position, self.matrix = data.site_xpos[self._site], data.site_xmat[self._site]
        base = model.site("robot0_right_center").id
        self._base_position, self._base_matrix = data.site_xpos[base].copy(), data.site_xmat[base].reshape(3, 3).copy()
        self._qpos, self._qvel, self._bias, self._inertia = data.qpos, data.qvel, data.qfrc_bias, data.qM
        self._arm_control, self._gripper_control = data.ctrl[:7], data.ctrl[7:9]
        self._torque_low, self._torque_high = model.actuator_ctrlrange[:7].T.copy()
        self._gripper_low, self._gripper_high = model.actuator_ctrlrange[7:9].T.copy()
        self._jacobian_position, self._jacobian_rotation = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self._addresses = _inertia_addresses(model)
        self.gripper_command = np.zeros(2)

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
        goal: tuple[Array, Array] = self._osc.goal_pose(action[:6], self.position, self.matrix.reshape(3, 3), self._base_position, self._base_matrix)
        return goal

    def torques(self, goal_position: Array, goal_matrix: Array) -> Array:
        """Joint torques (7,) towards a pose, before the actuators' limits."""
        self._mujoco.mj_jacSite(self._model, self._data, self._jacobian_position, self._jacobian_rotation, self._site)
        torques: Array = self._osc.osc_torques(
            goal_position, goal_matrix, self.position, self.matrix, self._jacobian_position, self._jacobian_rotation,
            self._inertia, self._addresses, self._qpos, self._qvel, self._bias, self._initial_joint,
        )  # fmt: skip
        return torques

    def _command_gripper(self, command: float) -> None:
        """robosuite's PandaGripper: only the sign counts, and the command creeps towards it."""
        low, high = self._gripper_low, self._gripper_high
        self.gripper_command += np.array([-1.0, 1.0]) * GRIPPER_SPEED * np.sign(command)
        np.clip(self.gripper_command, -1.0, 1.0, out=self.gripper_command)
        self._gripper_control[:] = 0.5 * (high + low) + 0.5 * (high - low) * self.gripper_command


def _inertia_addresses(model: Any) -> NDArray[np.int32]:
    """Where the arm's 7 x 7 mass matrix lies in MuJoCo's sparse `qM`: each row runs up the chain of parent degrees of freedom."""
    addresses = np.zeros((7, 7), dtype=np.int32)
    for row in range(7):
        address, column = int(model.dof_Madr[row]), row
        while column >= 0:
            addresses[row, column] = addresses[column, row] = address
            address, column = address + 1, int(model.dof_parentid[column])
    return addresses
