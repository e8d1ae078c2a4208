"""The MuJoCo model of a task: robosuite's Panda, arena and objects, with everything the task may use in one model.

An instance only moves things (and parks those it does not use out of sight), so nothing is compiled again between episodes.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from osel_sim.core import content
from osel_sim.core.errors import ContentError
from osel_sim.formats.catalogue import Entity

TABLE_HEIGHT = 0.8
TABLE_SIZE = (0.8, 0.8, 0.05)
CAMERA_NAMES = {"agentview": "agentview", "wrist": "robot0_eye_in_hand"}
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
    """

    model: Any
    xml: str
    root_bodies: dict[str, str]
    initial_qpos: tuple[float, ...]


def build_scene(entities: Sequence[Entity]) -> Scene:
    """Compile the scene with light meshes (cached within the process)."""
    return _build(tuple(entities))


@functools.lru_cache(maxsize=8)
def _build(entities: tuple[Entity, ...]) -> Scene:
    import mujoco

    from osel_sim.sim.gl import quiet_robosuite
    from osel_sim.sim.light_meshes import lighten
    from osel_sim.sim.table_tops import add_tables

    quiet_robosuite()
    xml, root_bodies, initial_qpos = _compose(entities)
    spec = mujoco.MjSpec.from_string(xml)
    lighten(spec, xml)
    add_tables(spec)
    return Scene(spec.compile(), xml, root_bodies, initial_qpos)


def full_model(xml: str) -> Any:
    """The same scene with robosuite's own meshes, for videos."""
    import mujoco

    from osel_sim.sim.table_tops import add_tables

    spec = mujoco.MjSpec.from_string(xml)
    add_tables(spec)
    return spec.compile()


def _compose(entities: tuple[Entity, ...]) -> tuple[str, dict[str, str], tuple[float, ...]]:
    """The scene as MJCF text, made of robosuite's parts as its own environments do it."""
    from robosuite.models.arenas import TableArena
    from robosuite.models.bases import robot_base_factory
    from robosuite.models.grippers import gripper_factory
    from robosuite.models.robots import Panda
    from robosuite.models.tasks import ManipulationTask

    robot = Panda(idn=0)
    robot.add_base(robot_base_factory(robot.default_base, idn=0))
    robot.add_gripper(gripper_factory("PandaGripper", idn="0_right"), robot.eef_name["right"])
    robot.set_base_xpos(robot.base_xpos_offset["table"](TABLE_SIZE[0]))
    arena = TableArena(table_full_size=TABLE_SIZE, table_offset=(0, 0, TABLE_HEIGHT))
    arena.set_origin([0, 0, 0])
    arena.table_visual.set("rgba", TABLE_COLOUR)  # the white plate would vanish on robosuite's white table
    quaternion = _look_at(AGENTVIEW_POSITION, AGENTVIEW_TARGET)
    arena.set_camera("agentview", pos=AGENTVIEW_POSITION, quat=quaternion, camera_attribs={"fovy": str(AGENTVIEW_FOVY)})
    objects = {entity.name: _make_object(entity) for entity in entities}
    task = ManipulationTask(mujoco_arena=arena, mujoco_robots=[robot], mujoco_objects=list(objects.values()))
    return task.get_xml(), {name: thing.root_body for name, thing in objects.items()}, tuple(float(q) for q in robot.init_qpos)


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
