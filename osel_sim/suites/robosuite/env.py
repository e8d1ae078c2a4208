"""A stock environment of robosuite, stepped by our compiled control and drawn with light meshes.

Physics are robosuite's to the last substep: its scene, its reset, its success; only the Python between the physics steps is ours
(`osel_sim.sim.control`), and nothing is observed or drawn that nobody asked for.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.interface.environment import Image
from osel_sim.interface.policy import Actions
from osel_sim.interface.robot import Gripper, LightMeshes, Robot
from osel_sim.sim.fingerprint import Fingerprint
from osel_sim.sim.gl import quiet_robosuite
from osel_sim.sim.light_meshes import lighten
from osel_sim.suites.base import BaseEnvironment, PlainInstance
from osel_sim.suites.mujoco_view import MujocoView
from osel_sim.suites.robosuite.tasks import CAMERAS, STOCK, parts, specification
from osel_sim.suites.scenes import of_mujoco

SHOWN = (1, 2)
"""Geom groups; robosuite's collision geoms are in group 0."""


class RobosuiteEnvironment(BaseEnvironment):
    """One environment with one arm, of any of its instances.

    Args:
        task: such as `Lift` or `Lift/UR5e`.
    """

    def __init__(self, task: str) -> None:
        robosuite = quiet_robosuite()

        import mujoco

        spec = specification(task)
        super().__init__(spec, int(spec.horizon or 0))
        name, arm = parts(task)
        self._env: Any = robosuite.make(
            name, robots=arm, has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, control_freq=int(spec.control_hz),
            horizon=100_000, ignore_done=True, hard_reset=False,
        )  # fmt: skip
        self._model, self._data = self._env.sim.model._model, self._env.sim.data._data
        self._robot = _description(self._env, arm)
        self._site = self._model.site(self._robot.grip_site).id
        self._control, self._fingerprint = self._new_control(), Fingerprint(self._model)
        xml = self._env.sim.model.get_xml()
        self._view = MujocoView(
            self._model,
            self._data,
            lambda: mujoco.MjSpec.from_string(xml),
            groups=SHOWN,
            sites=False,
            make_light=lambda spec: lighten(spec, xml, LightMeshes()),
        )

    def start(self, instance: PlainInstance) -> None:
        """robosuite's own reset, with all that it draws drawn from the instance's seed."""
        seed = instance.simulator_seed
        self._env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state  # the samplers of its scene hold this very generator
        before = np.random.get_state()
        np.random.seed(seed % 2**32)  # the noise on its arm comes from numpy's own
        try:
            self._env.reset()
        finally:
            np.random.set_state(before)
        self._control = self._new_control()
        self._settle()

    def scene(self) -> str:
        """Digest of where everything is."""
        return of_mujoco(self._fingerprint, self._data.qpos, self.instance)

    def act(self, action: Actions) -> bool:
        """One control step."""
        if self._control is None:
            self._env.step(action)
            self._settle()
        else:
            self._control.step(action)
        return bool(self._env._check_success())

    def state(self) -> Mapping[str, ArrayLike]:
        """The gripper's pose, metres and axis-angle, and the joints of its fingers."""
        import mujoco

        quaternion, vector = np.empty(4), np.empty(3)
        mujoco.mju_mat2Quat(quaternion, self._data.site_xmat[self._site])
        mujoco.mju_quat2Vel(vector, quaternion, 1.0)
        arm, hand = self._robot.joints, len(self._robot.gripper.rest)
        return {
            "position": self._data.site_xpos[self._site],
            "axis_angle": vector,
            "fingers": self._data.qpos[arm : arm + hand],
        }

    def image(self, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) of a camera."""
        return self._view.render(CAMERAS.get(camera, camera), width, height, quality)

    def render(self, camera: str) -> Image:
        """Image of a camera in robosuite's size."""
        return self.image(camera, 256, 256)

    def snapshot(self) -> dict[str, Any]:
        """The state now."""
        import mujoco

        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self._model, kind))
        mujoco.mj_getState(self._model, self._data, state, kind)
        world = {name: getattr(self._model, name).copy() for name in ("body_pos", "body_quat", "site_pos", "site_rgba")}
        arm = (self._control.gripper_command, self._home.copy())
        counts = {"steps": self.steps, "success": self.success}
        return {"instance": self.instance, "scene": self._scene, "state": state, "world": world, "arm": arm, **counts}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Back to a snapshot of this task."""
        import mujoco

        self.instance, self.steps, self.success = snapshot["instance"], snapshot["steps"], snapshot["success"]
        self._scene = snapshot["scene"]
        for name, value in snapshot["world"].items():
            getattr(self._model, name)[:] = value
        mujoco.mj_setState(self._model, self._data, snapshot["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
        command, home = snapshot["arm"]
        self._control = self._new_control(home)
        self._control.gripper_command = command
        mujoco.mj_setState(self._model, self._data, snapshot["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
        self._settle()

    def close(self) -> None:
        """Close it and give the GL contexts back."""
        self._view.close()
        self._env.close()

    def _new_control(self, home: NDArray[np.float64] | None = None) -> Any:
        """Control whose null space pulls towards where the arm is now, as robosuite's does after its reset; None: robosuite's own is to be used."""
        from osel_sim.sim.control import Control

        if self.specification.robot in STOCK:
            return None
        self._home = np.array(self._data.qpos[: self._robot.joints] if home is None else home)
        return Control(self._model, self._data, self._robot, self._home)

    def _settle(self) -> None:
        """Poses and contacts of the state reached: control takes them as they are."""
        import mujoco

        mujoco.mj_step1(self._model, self._data)


def _description(env: Any, arm: str) -> Robot:
    """An arm of robosuite as our control wants to know it."""
    robot = env.robots[0]
    gripper = robot.gripper["right"]
    kept = np.array(gripper.current_action)
    gripper.current_action = np.zeros_like(kept)
    closing = np.sign(np.atleast_1d(gripper.format_action(np.ones(gripper.dof))))
    gripper.current_action = kept
    joints = len(robot.robot_model.joints)
    hand = Gripper("", tuple(map(float, gripper.init_qpos)), tuple(map(float, closing)), (), (), speed=float(gripper.speed))
    return Robot(arm, "", hand, tuple(map(float, robot.init_qpos)), (0.0,) * joints, (0.0,) * joints)
