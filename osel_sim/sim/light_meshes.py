"""Light visual meshes: robosuite's arms have 130,000 to 180,000 mesh faces, of whose finish a 96-pixel image shows none, and its floor 2,304 squares.

Decimated once with fast-simplification and kept in the user's cache folder. Meshes that a colliding geom uses stay as they are, so the physics is the
same to the last bit; where a robot shows such a mesh as well, what it shows becomes a mesh of its own.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.robot import LightMeshes
from osel_sim.sim.kept import kept

ROBOT = ("robot0_", "gripper0_", "fixed_mount0_")
"""How the names of a robot's meshes begin."""
SHOWN = "_shown"
"""How the name of a light mesh ends that is there beside the colliding one."""


def lighten(spec: Any, xml: str, how: LightMeshes) -> None:
    """Replace the heavy purely visual meshes of a `mujoco.MjSpec` by light ones.

    Args:
        spec: the spec to change in place, not compiled yet.
        xml: the MJCF text it was made of.
        how: far.
    """
    import mujoco
    import robosuite

    made_of = f"{how.keep} {how.fewest} {how.most} {how.join} {mujoco.__version__} {robosuite.__version__} {SHOWN} {xml}"
    light = kept("light_meshes", made_of, lambda: _make(mujoco.MjModel.from_xml_string(xml), how))
    for name in [key.removesuffix(".vertices") for key in light if key.endswith(".vertices")]:
        mesh = spec.mesh(name) or spec.add_mesh(name=name)
        # Given by vertices instead of a file; the file's scale is in them already.
        mesh.file = ""
        mesh.scale, mesh.refpos, mesh.refquat = [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]
        mesh.uservert = light[f"{name}.vertices"].ravel()
        mesh.userface = light[f"{name}.faces"].ravel()
    for geom in spec.geoms:
        if f"{geom.meshname}{SHOWN}.vertices" in light and not geom.contype and not geom.conaffinity:
            geom.meshname += SHOWN
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            # The third size is only how finely a plane is divided for light that falls off, which robosuite's does not: its floor has 2,304 squares.
            geom.size[2] = max(geom.size[0], geom.size[1], geom.size[2])


def _make(model: Any, how: LightMeshes) -> dict[str, NDArray[Any]]:
    light: dict[str, NDArray[Any]] = {}
    for i, name in _heavy(model, how.fewest).items():
        points, triangles = decimated(model, i, how)
        if len(triangles) >= 4:
            light[f"{name}.vertices"] = points
            light[f"{name}.faces"] = triangles
    return light


def decimated(model: Any, i: int, how: LightMeshes) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """A light version of mesh `i` of a model: vertices (V, 3) as they were in its file, and triangles (F, 3)."""
    import fast_simplification

    vertices, faces = _weld(_vertices(model, i), _faces(model, i))
    target = min(max(how.fewest, int(len(faces) * how.keep)), how.most)
    points, triangles = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=target)
    for cell in how.join:
        if len(triangles) <= how.most:
            break
        # Made of loose pieces, which no decimation joins.
        points, triangles = _join(vertices, faces, cell)
        if len(triangles) > target:
            points, triangles = fast_simplification.simplify(points, triangles, target_count=target)
    return points.astype(np.float32), triangles.astype(np.int32)


def textured(model: Any) -> set[int]:
    """Meshes that are shown with a flat texture, which needs the mesh's own coordinates: decimation loses them. Cube textures do without."""
    import mujoco

    found = set[int]()
    for geom in range(model.ngeom):
        material = model.geom_matid[geom]
        textures = model.mat_texid[material] if material >= 0 else np.array([-1])
        if any(model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D for texture in textures[textures >= 0]):
            found.add(int(model.geom_dataid[geom]))
    return found


def _heavy(model: Any, fewest: int) -> dict[int, str]:
    """Meshes with many faces that geoms show, none of them with a flat texture -> name of the light one: its own where no geom collides with it."""
    shown, colliding, flat = set[int](), set[int](), textured(model)
    for geom in range(model.ngeom):
        (colliding if model.geom_contype[geom] or model.geom_conaffinity[geom] else shown).add(int(model.geom_dataid[geom]))
    names = {i: model.mesh(i).name for i in range(model.nmesh) if i not in flat and model.mesh_facenum[i] > fewest}
    beside = {i: name + SHOWN for i, name in names.items() if i in shown & colliding and name.startswith(ROBOT)}
    return {i: name for i, name in names.items() if i not in colliding} | beside


def _vertices(model: Any, i: int) -> NDArray[np.float64]:
    """Vertices as they were in the file: MuJoCo recentres them at compilation."""
    import mujoco

    start, count = model.mesh_vertadr[i], model.mesh_vertnum[i]
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.mesh_quat[i])
    vertices: NDArray[np.float64] = model.mesh_vert[start : start + count].astype(np.float64) @ matrix.reshape(3, 3).T + model.mesh_pos[i]
    return vertices


def _faces(model: Any, i: int) -> NDArray[np.int32]:
    start, count = model.mesh_faceadr[i], model.mesh_facenum[i]
    faces: NDArray[np.int32] = model.mesh_face[start : start + count].astype(np.int32)
    return faces


def _weld(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Merge equal vertices: decimation needs a connected surface, OBJ files split it at every normal."""
    unique, inverse = np.unique(vertices.round(6), axis=0, return_inverse=True)
    return unique, _proper(inverse.reshape(-1)[faces])


def _join(vertices: NDArray[np.float64], faces: NDArray[np.int32], cell: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Merge the vertices within each cell of a grid into the first of them, and faces that then coincide."""
    _, first, inverse = np.unique((vertices / cell).round(), axis=0, return_index=True, return_inverse=True)
    joined = _proper(inverse.reshape(-1)[faces])
    _, once = np.unique(np.sort(joined, axis=1), axis=0, return_index=True)
    return vertices[first].astype(np.float32), joined[once]


def _proper(faces: NDArray[Any]) -> NDArray[np.int32]:
    """Faces with three different corners."""
    kept: NDArray[np.int32] = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])].astype(np.int32)
    return kept
