"""The physics of one task: instances loaded into MuJoCo, and what predicates and the expert ask about them."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import ContentError, UsageError
from osel_sim.formats.task_file import TaskSpec
from osel_sim.sim.appearance import Appearance
from osel_sim.sim.control import Control
from osel_sim.sim.fingerprint import Fingerprint
from osel_sim.sim.instance import Instance
from osel_sim.sim.robots import load_robot
from osel_sim.sim.scene import TABLE_HEIGHT, build_scene

Array = NDArray[np.float64]

SETTLE_STEPS = 4
"""Control steps a new scene is given to come to rest."""
PARKED = -3.0
"""Height at which things that are not in the scene hang, under the floor."""


@dataclass(frozen=True)
class Snapshot:
    """Everything that the future of a world depends on."""

    physics: Array
    gripper_command: float
    instance: Instance


class World:
    """One task's MuJoCo world, with the robot that the task names. `load` an instance, then `step`."""

    def __init__(self, task: TaskSpec) -> None:
        import mujoco

        self._mujoco = mujoco
        self.task, self.robot = task, load_robot(task.robot)
        self.scene = build_scene(task.entities, self.robot)
        # Containers are moved through the model, so every world needs its own.
        self.model = mujoco.MjModel.__copy__(self.scene.model)
        self.data = mujoco.MjData(self.model)
        self.instance: Instance = None  # type: ignore[assignment]  # until the first load()
        self._home = np.array(self.robot.home)
        self._control = Control(self.model, self.data, self.robot, self._home)
        self._start_heights: dict[str, float] = {}
        self._find()
        self.appearance = Appearance(self.model, self.scene.root_bodies, self.scene.cameras)
        self._fingerprint, self._set_up = Fingerprint(self.model), self.data.qpos.copy()

    # -- what is where -------------------------------------------------------------------------------------------------

    @property
    def grip_position(self) -> Array:
        """Grip site in the world (3,), metres."""
        position: Array = self._control.position
        return position

    @property
    def grip_matrix(self) -> Array:
        """Orientation of the grip site (3, 3)."""
        matrix: Array = self._control.matrix.reshape(3, 3)
        return matrix

    def grip_rotation_vector(self) -> Array:
        """Orientation of the grip site as axis-angle (3,), radians.

        A gripper that points down is half a turn away from the identity, where axis-angle jumps between v and -v. Of the two quaternions that mean
        the same, the one with a positive x is taken, and angles run up to a whole turn, so that the jump is far from where the robot works;
        scipy's Rotation stops at half a turn.
        """
        quaternion = np.empty(4)
        self._mujoco.mju_mat2Quat(quaternion, self._control.matrix)
        if quaternion[1] < 0:
            quaternion = -quaternion
        length = float(np.linalg.norm(quaternion[1:]))
        vector: Array = quaternion[1:] * (2 * np.arctan2(length, quaternion[0]) / max(length, 1e-12))
        return vector

    @property
    def finger_positions(self) -> Array:
        """How far each finger is from the middle (2,), metres, the second as a negative number: about (0.04, -0.04) open, (0, 0) closed."""
        if not self._pads:
            arm = self.robot.joints
            positions: Array = self.data.qpos[arm : arm + 2]
            return positions
        across = self.grip_matrix[:, 0]
        apart = [side * float(across @ (self.data.geom_xpos[pad] - self.grip_position)) - half for pad, side, half in self._pads]
        return np.array([apart[0], -apart[1]])

    @property
    def gripper_command(self) -> float:
        """How far the gripper was told to close, -1 (open) to 1 (closed)."""
        return self._control.gripper_command

    def position(self, thing: str) -> Array:
        """Origin of a thing in the world (3,), metres."""
        position: Array = self.data.xpos[self._bodies[thing]]
        return position

    def yaw(self, thing: str) -> float:
        """Turn of what is grasped of a thing about the vertical, radians."""
        handle = self._handles.get(thing)
        matrix = (self.data.xmat[self._bodies[thing]] if handle is None else self.data.site_xmat[handle]).reshape(3, 3)
        return float(np.arctan2(matrix[1, 0], matrix[0, 0]))

    def grasp_point(self, thing: str) -> Array:
        """Where the expert grasps or presses a thing (3,): its handle, or above its origin."""
        handle = self._handles.get(thing)
        point: Array = self.position(thing) if handle is None else self.data.site_xpos[handle]
        raised: Array = point + np.array([0.0, 0.0, self._entities[thing].grasp * self.appearance.size(thing)])
        return raised

    def landmark(self, thing: str) -> Array:
        """What to look at to handle a thing (3,): its handle, or its origin."""
        handle = self._handles.get(thing)
        point: Array = self.position(thing) if handle is None else self.data.site_xpos[handle]
        return point

    def place_point(self, thing: str) -> Array:
        """Where something is put that goes into or onto a thing (3,): the inside of a receptacle, the top of an object."""
        inside = self._insides.get(thing)
        if inside is not None:
            point: Array = self.data.site_xpos[inside].copy()
        else:
            point = self.position(thing).copy()
            if self._entities[thing].kind == "object":
                point[2] = self.highest_point(thing)
        return point

    def opening(self, thing: str) -> float:
        """How far a thing's moving part has moved: 0 (shut, not pressed) to 1, a share of its travel."""
        address, low, high = self._parts[thing]
        return float((self.data.qpos[address] - low) / (high - low))

    def opening_direction(self, thing: str) -> Array:
        """Direction in which a thing's handle moves when it opens (3,), a unit vector in the world."""
        handle, jacobian = self._handles[thing], np.zeros((3, self.model.nv))
        self._mujoco.mj_jacSite(self.model, self.data, jacobian, None, handle)
        joint = self.model.joint(f"{thing}_{self._entities[thing].joint}")
        column: Array = jacobian[:, int(joint.dofadr[0])]
        return column / np.linalg.norm(column)

    def start_height(self, thing: str) -> float:
        """Height of a thing's origin once the scene had settled, metres."""
        return self._start_heights[thing]

    def lowest_point(self, thing: str) -> float:
        """Height of the lowest corner of the thing's bounding boxes, metres; of its origin, if nothing can touch it."""
        return min((low for low, _ in self._extents(thing)), default=float(self.position(thing)[2]))

    def highest_point(self, thing: str) -> float:
        """Height of the highest corner of the thing's bounding boxes, metres; of its origin, if nothing can touch it."""
        return max((high for _, high in self._extents(thing)), default=float(self.position(thing)[2]))

    def _extents(self, thing: str) -> Iterator[tuple[float, float]]:
        """Lowest and highest point of each colliding geom's bounding box."""
        for geom in self._collisions[thing]:
            matrix = self.data.geom_xmat[geom].reshape(3, 3)
            centre = self.data.geom_xpos[geom] + matrix @ self.model.geom_aabb[geom, :3]
            half = float(np.abs(matrix[2]) @ self.model.geom_aabb[geom, 3:])
            yield float(centre[2]) - half, float(centre[2]) + half

    def touches(self, finger: str, thing: str) -> bool:
        """Whether the `left` or `right` finger is in contact with the thing."""
        return self._in_contact(self._fingers[finger], self._collisions[thing])

    def in_contact(self, one: str, other: str) -> bool:
        """Whether two things touch."""
        return self._in_contact(self._collisions[one], self._collisions[other])

    def _in_contact(self, some: Collection[int], others: Collection[int]) -> bool:
        pairs = self.data.contact.geom[: self.data.ncon]
        return any((a in some and b in others) or (b in some and a in others) for a, b in pairs.tolist())

    # -- changing it ---------------------------------------------------------------------------------------------------

    def load(self, instance: Instance) -> None:
        """Reset to an instance: poses and looks only, no compilation.

        Raises:
            UsageError: it is another robot's.
        """
        if instance.robot != self.robot.name:
            raise UsageError(f"{instance.key} is for the robot {instance.robot}, this world has {self.robot.name}")
        mujoco, model, data, arm = self._mujoco, self.model, self.data, self.robot.joints
        mujoco.mj_resetData(model, data)
        self.appearance.apply(instance.perturbation)
        data.qpos[:arm] = self._home + (instance.perturbation.joints or 0.0)  # the null space still pulls towards the unperturbed posture
        data.qpos[arm : arm + len(self.robot.gripper.rest)] = self.robot.gripper.rest
        self._control.gripper_command = 0.0
        self.instance = instance
        present = {placement.entity: placement for placement in instance.placements}
        self._set_present(present)
        for name, placement in present.items():
            half = placement.yaw / 2
            height = TABLE_HEIGHT + self._bottoms[name] * self.appearance.size(name) + 0.001
            pose = [placement.x, placement.y, height, np.cos(half), 0.0, 0.0, np.sin(half)]
            self._set_pose(name, pose)
            if name in self._parts:
                address, low, high = self._parts[name]
                data.qpos[address] = low + placement.opening * (high - low)
        self._set_up = data.qpos.copy()
        mujoco.mj_step1(model, data)
        hold = np.zeros(7)
        hold[6] = -1.0
        for _ in range(SETTLE_STEPS):
            self.step(hold)
        self._start_heights = {name: float(self.position(name)[2]) for name in present}

    def step(self, action: NDArray[Any]) -> None:
        """One control step (50 ms) of a 7-d OSC_POSE action in [-1, 1]."""
        self._control.step(action)

    def scene_digest(self) -> str:
        """What tells the scene that was loaded from others: all that is there, where and how it was put, its looks and the instruction."""
        return self._fingerprint.of(self._set_up, self.instance.instruction)

    def snapshot(self) -> Snapshot:
        """The state now; `restore` goes on from it to the same bits."""
        spec = self._mujoco.mjtState.mjSTATE_INTEGRATION
        physics = np.empty(self._mujoco.mj_stateSize(self.model, spec))
        self._mujoco.mj_getState(self.model, self.data, physics, spec)
        return Snapshot(physics, self._control.gripper_command, self.instance)

    def restore(self, snapshot: Snapshot) -> None:
        """Back to a snapshot, of this world or of another one of the same task."""
        if self.instance is not snapshot.instance:
            self.load(snapshot.instance)
        self._mujoco.mj_setState(self.model, self.data, snapshot.physics, self._mujoco.mjtState.mjSTATE_INTEGRATION)
        self._control.gripper_command = snapshot.gripper_command
        self._mujoco.mj_step1(self.model, self.data)

    # -- inside --------------------------------------------------------------------------------------------------------

    def _set_present(self, present: Mapping[str, Any]) -> None:
        """Things that are not in this scene neither collide nor fall; they hang under the floor."""
        model, data = self.model, self.data
        for index, entity in enumerate(self.task.entities):
            name, body = entity.name, self._bodies[entity.name]
            here = name in present
            for geom, (contype, conaffinity) in self._collisions[name].items():
                model.geom_contype[geom], model.geom_conaffinity[geom] = (contype, conaffinity) if here else (0, 0)
            data.xfrc_applied[body, 2] = 0.0 if here else -model.opt.gravity[2] * model.body_subtreemass[body]
            if not here:
                self._set_pose(name, [index, 0.0, PARKED, 1.0, 0.0, 0.0, 0.0])

    def _set_pose(self, name: str, pose: list[float]) -> None:
        address = self._joints.get(name)
        if address is None:
            body = self._bodies[name]
            self.model.body_pos[body], self.model.body_quat[body] = pose[:3], pose[3:]
        else:
            self.data.qpos[address : address + 7] = pose

    def _find(self) -> None:
        """Addresses of everything by name."""
        model, data = self.model, self.data
        self._bodies = {name: model.body(body).id for name, body in self.scene.root_bodies.items()}
        self._joints = {name: int(model.jnt_qposadr[model.body_jntadr[body]]) for name, body in self._bodies.items() if model.body_jntnum[body]}
        self._collisions: dict[str, dict[int, tuple[int, int]]] = {name: {} for name in self._bodies}
        owners = {body: name for name, body in self._bodies.items()}
        for geom in range(model.ngeom):
            name = owners.get(int(model.body_rootid[model.geom_bodyid[geom]]))
            if name is not None and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                self._collisions[name][geom] = (int(model.geom_contype[geom]), int(model.geom_conaffinity[geom]))
        self._entities = {entity.name: entity for entity in self.task.entities}
        self._handles = {name: self._site(name, entity.handle) for name, entity in self._entities.items() if entity.handle}
        self._insides = {name: self._site(name, entity.inside) for name, entity in self._entities.items() if entity.inside}
        self._parts = {name: self._part(name, entity.joint) for name, entity in self._entities.items() if entity.joint}
        self._bottoms = {name: float(data.xpos[body][2] - self.lowest_point(name)) for name, body in self._bodies.items()}
        gripper = self.robot.gripper
        self._fingers = {side: frozenset(model.geom(name).id for name in geoms) for side, geoms in (("left", gripper.left), ("right", gripper.right))}
        self._pads = [self._pad(model.geom(name).id) for name in gripper.pads or ()]

    def _site(self, thing: str, site: str) -> int:
        """Index of a thing's site."""
        try:
            return int(self.model.site(f"{thing}_{site}").id)
        except KeyError:
            raise ContentError("assets/objects/objects.toml", thing, f"its model has no site {site!r}") from None

    def _pad(self, geom: int) -> tuple[int, float, float]:
        """A finger's pad: its geom, on which side of the middle it is (1 or -1), and half of how thick it is, metres."""
        side = np.sign(self.grip_matrix[:, 0] @ (self.data.geom_xpos[geom] - self.grip_position))
        return geom, float(side), float(self.model.geom_size[geom].min())

    def _part(self, thing: str, joint: str) -> tuple[int, float, float]:
        """Address and range of a thing's moving part."""
        try:
            found = self.model.joint(f"{thing}_{joint}")
        except KeyError:
            raise ContentError("assets/objects/objects.toml", f"{thing}.joint", f"its model has no joint {joint!r}") from None
        return int(found.qposadr[0]), float(found.range[0]), float(found.range[1])
