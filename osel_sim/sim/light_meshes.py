"""Light visual meshes: robosuite's Panda has 180,000 mesh faces, of which a 96-pixel image shows none of the finish, and its floor 2,304 squares.

Decimated once with fast-simplification and kept in the user's cache folder. Only meshes no colliding geom uses are touched, so the physics is the
same to the last bit.
"""

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.arrays import read_arrays
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic

KEEP = 0.04
"""Fraction of faces kept."""
FEWEST = 250
"""Meshes with no more faces than this stay as they are."""
MOST = 600
"""Meshes with more faces than this after decimation are welded more coarsely first: those made of thousands of loose pieces do not decimate."""
JOIN = 0.06
"""Metres, four pixels of the robot's pedestal: corners this close become one where a mesh is in pieces."""


def cache_folder() -> Path:
    """Where light meshes are kept: `$XDG_CACHE_HOME/osel_sim`, or under `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "osel_sim"


def lighten(spec: Any, xml: str) -> None:
    """Replace the heavy purely visual meshes of a `mujoco.MjSpec` by light ones.

    Args:
        spec: the spec to change in place, not compiled yet.
        xml: the MJCF text it was made of.
    """
    import mujoco
    import robosuite

    made_of = f"{KEEP} {FEWEST} {MOST} {JOIN} {mujoco.__version__} {robosuite.__version__} {xml}"
    file = cache_folder() / f"light_meshes_{hashlib.sha256(made_of.encode()).hexdigest()[:16]}.npz"
    light = _load(file)
    if light is None:
        light = _make(mujoco.MjModel.from_xml_string(xml))
        _save(file, light)
    for mesh in spec.meshes:
        if f"{mesh.name}.vertices" in light:
            # Given by vertices instead of a file; the file's scale is in them already.
            mesh.file = ""
            mesh.scale, mesh.refpos, mesh.refquat = [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]
            mesh.uservert = light[f"{mesh.name}.vertices"].ravel()
            mesh.userface = light[f"{mesh.name}.faces"].ravel()
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            # The third size is only how finely a plane is divided for light that falls off, which robosuite's does not: its floor has 2,304 squares.
            geom.size[2] = max(geom.size[0], geom.size[1], geom.size[2])


def _make(model: Any) -> dict[str, NDArray[Any]]:
    import fast_simplification

    light: dict[str, NDArray[Any]] = {}
    for i in _heavy(model):
        vertices, faces = _weld(_vertices(model, i), _faces(model, i))
        target = min(max(FEWEST, int(len(faces) * KEEP)), MOST)
        points, triangles = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=target)
        if len(triangles) > MOST:
            # Made of loose pieces, which no decimation joins.
            points, triangles = fast_simplification.simplify(*_join(vertices, faces), target_count=target)
        if len(triangles) >= 4:
            light[f"{model.mesh(i).name}.vertices"] = points.astype(np.float32)
            light[f"{model.mesh(i).name}.faces"] = triangles.astype(np.int32)
    return light


def _heavy(model: Any) -> list[int]:
    """Meshes with many faces that no colliding geom and none with a flat texture uses."""
    import mujoco

    keep = set()
    for geom in range(model.ngeom):
        material = model.geom_matid[geom]
        textures = model.mat_texid[material] if material >= 0 else np.array([-1])
        # Flat textures need the mesh's own coordinates, which decimation loses; cube textures do without.
        flat = any(model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D for texture in textures[textures >= 0])
        if flat or model.geom_contype[geom] or model.geom_conaffinity[geom]:
            keep.add(int(model.geom_dataid[geom]))
    return [i for i in range(model.nmesh) if i not in keep and model.mesh_facenum[i] > FEWEST]


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


def _join(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Merge the vertices within each cell of a grid into the first of them, and faces that then coincide."""
    _, first, inverse = np.unique((vertices / JOIN).round(), axis=0, return_index=True, return_inverse=True)
    joined = _proper(inverse.reshape(-1)[faces])
    _, once = np.unique(np.sort(joined, axis=1), axis=0, return_index=True)
    return vertices[first].astype(np.float32), joined[once]


def _proper(faces: NDArray[Any]) -> NDArray[np.int32]:
    """Faces with three different corners."""
    kept: NDArray[np.int32] = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])].astype(np.int32)
    return kept


def _save(file: Path, light: dict[str, NDArray[Any]]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic(file, shared=True) as partial, partial.open("wb") as handle:
        np.savez(handle, **light)  # type: ignore[arg-type]


def _load(file: Path) -> dict[str, NDArray[Any]] | None:
    try:
        return read_arrays(file, "meshes")
    except DataError:  # missing, or torn by a crash: make it anew
        return None
