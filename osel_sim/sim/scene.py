"""The MuJoCo model of a task: a robot, arena and objects of robosuite, with everything the task may use in one model.

An instance only moves things (and parks those it does not use out of sight), so nothing is compiled again between episodes.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from osel_sim.core import content
from osel_sim.core.errors import ContentError
from osel_sim.formats.catalogue import Entity
from osel_sim.interface.robot import Robot

TABLE_HEIGHT = 0.8
TABLE_SIZE = (0.8, 0.8, 0.05)
AGENTVIEW_POSITION = (0.66, 0.0, 1.55)
AGENTVIEW_TARGET = (-0.02, 0.0, 0.85)
AGENTVIEW_FOVY = 41.0
TABLE_COLOUR = "0.55 0.58 0.62 1"


@dataclass(frozen=True)
class Scene:
    """Compiled models of one task.

    Attributes:
        model: `mujoco.MjModel` with light visual meshes; all physics and fast images use it.
        root_bodies: thing -> name of its top body.
        cameras: `agentview` and `wrist` -> their names in the model.
    """

    model: Any
    xml: str
    root_bodies: dict[str, str]
    cameras: Mapping[str, str]


def build_scene(entities: Sequence[Entity], robot: Robot) -> Scene:
    """Compile the scene with light meshes (cached within the process)."""
    return _build(tuple(entities), robot)


@functools.lru_cache(maxsize=8)
def _build(entities: tuple[Entity, ...], robot: Robot) -> Scene:
    import mujoco

    from osel_sim.sim.gl import quiet_robosuite
    from osel_sim.sim.light_meshes import lighten
    from osel_sim.sim.table_tops import add_tables

    quiet_robosuite()
    xml, root_bodies = _compose(entities, robot)
    spec = mujoco.MjSpec.from_string(xml)
    lighten(spec, xml, robot.meshes)
    add_tables(spec)
    return Scene(spec.compile(), xml, root_bodies, {"agentview": "agentview", "wrist": robot.wrist_camera.name})


def full_model(xml: str) -> Any:
    """The same scene with robosuite's own meshes, for videos."""
    import mujoco

    from osel_sim.sim.table_tops import add_tables

    spec = mujoco.MjSpec.from_string(xml)
    add_tables(spec)
    return spec.compile()


def _compose(entities: tuple[Entity, ...], robot: Robot) -> tuple[str, dict[str, str]]:
    """The scene as MJCF text, made of robosuite's parts as its own environments do it."""
    from robosuite.models.arenas import TableArena
    from robosuite.models.bases import robot_base_factory
    from robosuite.models.tasks import ManipulationTask

    arm = _attribute(robot.model)(idn=0)
    arm.add_base(robot_base_factory(arm.default_base, idn=0))
    gripper = _attribute(robot.gripper.model)(idn="0_right")
    if robot.gripper.prepare is not None:
        robot.gripper.prepare(gripper)
    arm.add_gripper(gripper, arm.eef_name["right"])
    x, y, z = arm.base_xpos_offset["table"](TABLE_SIZE[0])
    arm.set_base_xpos((x + robot.nearer, y, z))
    mount_camera(arm, robot)
    arena = TableArena(table_full_size=TABLE_SIZE, table_offset=(0, 0, TABLE_HEIGHT))
    arena.set_origin([0, 0, 0])
    arena.table_visual.set("rgba", TABLE_COLOUR)  # the white plate would vanish on robosuite's white table
    quaternion = _look_at(AGENTVIEW_POSITION, AGENTVIEW_TARGET)
    arena.set_camera("agentview", pos=AGENTVIEW_POSITION, quat=quaternion, camera_attribs={"fovy": str(AGENTVIEW_FOVY)})
    objects = {entity.name: _make_object(entity) for entity in entities}
    task = ManipulationTask(mujoco_arena=arena, mujoco_robots=[arm], mujoco_objects=list(objects.values()))
    return task.get_xml(), {name: thing.root_body for name, thing in objects.items()}


def _attribute(location: str) -> Any:
    """What `module:name` names."""
    module, _, name = location.partition(":")
    return getattr(import_module(module), name)


def mount_camera(arm: Any, robot: Robot) -> None:
    """Move the wrist camera of an arm of robosuite to where the robot's file has it."""
    mount = robot.wrist_camera
    camera = next(camera for camera in arm.root.iter("camera") if camera.get("name") == mount.name)
    for key, value in (("pos", mount.position), ("quat", mount.quaternion)):
        if value is not None:
            camera.set(key, " ".join(map(str, value)))


def _make_object(entity: Entity) -> Any:
    import robosuite.models.objects as robosuite_objects

    if entity.model == "box":
        return robosuite_objects.BoxObject(entity.name, size=list(entity.size), rgba=list(entity.rgba), density=300)
    if entity.model == "cylinder":
        return robosuite_objects.CylinderObject(entity.name, size=list(entity.size), rgba=list(entity.rgba), density=300)
    if entity.model.startswith("robosuite:"):
        kind = entity.model.partition(":")[2]
        if not hasattr(robosuite_objects, kind):
            raise ContentError("assets/objects/objects.toml", f"object.{entity.name}.model", f"robosuite has no object class {kind!r}")
        return getattr(robosuite_objects, kind)(entity.name)
    file = content.root() / "assets" / "objects" / entity.model
    if not file.is_file():
        raise ContentError("assets/objects/objects.toml", f"{entity.kind}.{entity.name}.model", f"{file.name} is not in assets/objects/")
    # They stand fast: without a joint they cost no degrees of freedom, and a reset moves their body.
    thing = robosuite_objects.MujocoXMLObject(str(file), name=entity.name, joints=None, obj_type="all", duplicate_collision_geoms=True)
    for geom in thing.get_obj().iter("geom"):
        if entity.rgba and geom.get("name", "").startswith(f"{entity.name}_painted"):
            geom.set("rgba", " ".join(map(str, entity.rgba)))
    return thing


def _look_at(position: tuple[float, float, float], target: tuple[float, float, float]) -> list[float]:
    """Quaternion (w, x, y, z) of a camera at `position` that looks at `target`, upright."""
    import mujoco
    import numpy as np

    backward = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(backward, right), backward], axis=1).ravel())
    return [float(value) for value in quaternion]
