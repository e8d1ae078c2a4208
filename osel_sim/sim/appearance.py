"""Puts a perturbation onto a compiled model, and takes it off again to the last bit. Nothing is compiled, so it costs about a millisecond.

An object grows or shrinks as its XML would with another scale: lengths with s, mass with s cubed, inertia with s to the fifth (same density). The
inverse weights that MuJoCo's contact solver uses are those of a free body, the inverses of mass and inertia. Things that stand fast or have more than
one body keep their size. Meshes are scaled in the model's vertices; a renderer has to fetch those anew (`osel_sim.sim.cameras`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.sim import table_tops as tables
from osel_sim.sim.perturbation import CLEAN, CameraShift, Perturbation
from osel_sim.sim.scene import AGENTVIEW_TARGET
from osel_sim.sim.turning import nudged, shifted, turned_light

Array = NDArray[np.float64]

FIELDS = (
    "light_dir", "light_diffuse", "cam_pos", "cam_quat", "cam_fovy",
    "geom_matid", "geom_rgba", "geom_size", "geom_rbound", "geom_aabb", "geom_pos", "site_pos", "mesh_vert", "bvh_aabb",
    "body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_invweight0", "dof_invweight0", "dof_M0",
)  # fmt: skip
"""Arrays of the model that belong to this module; nobody else writes to them."""
TABLE = "table_visual"
DEFAULT_GREY = (0.5, 0.5, 0.5, 1.0)
"""The colour that MuJoCo reads as "take the material's"."""


@dataclass(frozen=True)
class _Thing:
    """What in the model belongs to one thing. `body` is set where its size can change."""

    geoms: NDArray[np.intp]
    body: int | None
    meshes: tuple[int, ...]


class Appearance:
    """The looks of one model. Made on a clean model, before anything is changed in it.

    Args:
        root_bodies: thing -> name of its top body.
        cameras: `agentview` and `wrist` -> their names in the model.

    Attributes:
        perturbation: what it looks like now.
        mesh_sizes: mesh -> factor by which its vertices are scaled now.
    """

    def __init__(self, model: Any, root_bodies: Mapping[str, str], cameras: Mapping[str, str]) -> None:
        self.model = model
        self.root_bodies, self.cameras = dict(root_bodies), dict(cameras)
        self.perturbation = CLEAN
        self.mesh_sizes: dict[int, float] = {}
        self._sizes: dict[str, float] = {}
        self._things = {name: _find(model, model.body(body).id) for name, body in self.root_bodies.items()}
        self._clean = {field: getattr(model, field).copy() for field in FIELDS}
        self._headlight = [getattr(model.vis.headlight, part).copy() for part in ("ambient", "diffuse")]

    def size(self, thing: str) -> float:
        """Factor by which a thing is larger than its file says; exactly 1 when clean."""
        return self._sizes.get(thing, 1.0)

    def apply(self, perturbation: Perturbation) -> None:
        """Make the model look so, whatever it looked like before."""
        if perturbation == self.perturbation:
            return
        for field, clean in self._clean.items():
            getattr(self.model, field)[:] = clean
        self._sizes, self.mesh_sizes = {}, {}
        self.perturbation = perturbation
        self._light(perturbation)
        self._cameras(perturbation)
        self._table(perturbation)
        for name, tint in perturbation.tints:
            self._tint(self._things[name].geoms, tint)
        for name, size in perturbation.sizes:
            self._scale(name, size)

    def _light(self, perturbation: Perturbation) -> None:
        headlight = self.model.vis.headlight
        headlight.ambient[:], headlight.diffuse[:] = (clean * perturbation.ambient for clean in self._headlight)
        if perturbation.lamp_turn == CLEAN.lamp_turn and perturbation.lamp == CLEAN.lamp:
            return
        self.model.light_diffuse[:] *= perturbation.lamp
        for light in range(self.model.nlight):
            self.model.light_dir[light] = turned_light(self.model.light_dir[light].copy(), perturbation.lamp_turn)

    def _cameras(self, perturbation: Perturbation) -> None:
        model = self.model
        if perturbation.camera != CameraShift():
            index = model.camera(self.cameras["agentview"]).id
            position, quaternion = model.cam_pos[index].copy(), model.cam_quat[index].copy()
            model.cam_pos[index], model.cam_quat[index] = shifted(position, quaternion, perturbation.camera, np.array(AGENTVIEW_TARGET))
            model.cam_fovy[index] += perturbation.camera.fovy
        if any(perturbation.wrist):
            index = model.camera(self.cameras["wrist"]).id
            position, quaternion = model.cam_pos[index].copy(), model.cam_quat[index].copy()
            model.cam_pos[index], model.cam_quat[index] = nudged(position, quaternion, perturbation.wrist)

    def _table(self, perturbation: Perturbation) -> None:
        if not perturbation.table:
            return
        geom = self.model.geom(TABLE).id
        self.model.geom_matid[geom] = self.model.material(tables.material(perturbation.table)).id
        self.model.geom_rgba[geom, :3] = perturbation.table_tint

    def _tint(self, geoms: NDArray[np.intp], tint: tuple[float, ...]) -> None:
        model = self.model
        paleness, factors = tint[0], np.array(tint[1:])
        for geom in geoms:
            own = model.geom_rgba[geom].copy()
            if model.geom_matid[geom] >= 0 and np.array_equal(own, DEFAULT_GREY):
                own = model.mat_rgba[model.geom_matid[geom]].copy()
            own[:3] = (own[:3] + paleness * (1.0 - own[:3])) * factors
            model.geom_rgba[geom] = own

    def _scale(self, name: str, size: float) -> None:
        thing, model = self._things[name], self.model
        if thing.body is None:
            return
        self._sizes[name] = size
        for field in ("geom_size", "geom_rbound", "geom_aabb", "geom_pos"):
            getattr(model, field)[thing.geoms] *= size
        model.site_pos[model.site_bodyid == thing.body] *= size
        for mesh in thing.meshes:
            start = model.mesh_vertadr[mesh]
            model.mesh_vert[start : start + model.mesh_vertnum[mesh]] *= np.float32(size)
            _scale_boxes(model, int(model.mesh_bvhadr[mesh]), int(model.mesh_bvhnum[mesh]), size)
            self.mesh_sizes[mesh] = size
        body = thing.body
        _scale_boxes(model, int(model.body_bvhadr[body]), int(model.body_bvhnum[body]), size)
        mass, inertia = size**3, size**5
        model.body_subtreemass[0] += model.body_mass[body] * (mass - 1.0)
        model.body_mass[body] *= mass
        model.body_subtreemass[body] *= mass
        model.body_inertia[body] *= inertia
        model.body_ipos[body] *= size
        model.body_invweight0[body] /= (mass, inertia)
        first = model.body_dofadr[body]
        model.dof_invweight0[first : first + 6] /= np.repeat((mass, inertia), 3)
        model.dof_M0[first : first + 6] *= np.repeat((mass, inertia), 3)


def _find(model: Any, root: int) -> _Thing:
    import mujoco

    bodies = [body for body in range(model.nbody) if _within(model, body, root)]
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    free = len(bodies) == 1 and model.body_jntnum[root] == 1 and model.jnt_type[model.body_jntadr[root]] == mujoco.mjtJoint.mjJNT_FREE
    meshes = {int(model.geom_dataid[geom]) for geom in geoms if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH}
    others = {int(mesh) for mesh in np.delete(model.geom_dataid, geoms)}
    return _Thing(geoms, root if free and not meshes & others else None, tuple(sorted(meshes)))


def _within(model: Any, body: int, root: int) -> bool:
    while body not in (0, root):
        body = int(model.body_parentid[body])
    return body == root


def _scale_boxes(model: Any, first: int, count: int, size: float) -> None:
    if count:
        model.bvh_aabb[first : first + count] *= size
