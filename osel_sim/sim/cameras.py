"""Images, rendered only when somebody asks for one.

Two qualities: `fast` (no shadows, no reflections, no multisampling, light robot meshes) for policies and contexts; `full` for videos.
The full one draws a second model from copied poses, so that looking changes nothing.
"""

import atexit
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.sim import forking
from osel_sim.sim.appearance import Appearance
from osel_sim.sim.scene import full_model

Image = NDArray[np.uint8]

QUALITIES = ("fast", "full")
LARGEST = 1024
"""Pixels; the size of the offscreen buffer, of which an image takes a corner."""

UNSEEN_GROUP = 0
"""Geom group that is not drawn; robosuite's collision geoms are in it."""


class Cameras:
    """Renders a world's cameras. A GL context is made at the first image of a quality, and kept."""

    def __init__(self, model: Any, xml: str, appearance: Appearance) -> None:
        self._model, self._xml, self._appearance = model, xml, appearance
        self._renderers: dict[str, _Renderer] = {}
        self._full_data: Any = None

    def render(self, data: Any, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) of `agentview`, `wrist` or any camera of the model.

        Raises:
            UsageError: unknown quality, or an image larger than the buffer.
        """
        if quality not in QUALITIES or not 0 < max(width, height) <= LARGEST:
            raise UsageError(
                f"quality must be one of {', '.join(QUALITIES)}, sizes within 1 to {LARGEST} pixels; got {quality!r}, {width} x {height}"
            )
        if quality not in self._renderers:
            forking.holds(self)
            self._renderers[quality] = _Renderer(self._appearance if quality == "fast" else self._full_appearance(), quality)
            if len(self._renderers) == 1:
                # mujoco takes GL down at exit, before garbage collection reaches the renderers. Last registered runs first, so register after it.
                atexit.register(_close, self._renderers)
        return self._renderers[quality].render(self._copy(data) if quality == "full" else data, camera, width, height)

    def close(self) -> None:
        """Give the GL contexts back."""
        _close(self._renderers)

    def _copy(self, data: Any) -> Any:
        """Poses and looks onto the full model; containers stand where this instance put their bodies."""
        import mujoco

        appearance = self._full_appearance()
        appearance.apply(self._appearance.perturbation)
        full = appearance.model
        if self._full_data is None:
            self._full_data = mujoco.MjData(full)
        full.body_pos[:], full.body_quat[:] = self._model.body_pos, self._model.body_quat
        self._full_data.qpos[:] = data.qpos
        mujoco.mj_kinematics(full, self._full_data)
        mujoco.mj_camlight(full, self._full_data)
        return self._full_data

    def _full_appearance(self) -> Appearance:
        return _full_appearance(self._xml, tuple(self._appearance.root_bodies.items()), tuple(self._appearance.cameras.items()))


@functools.lru_cache(maxsize=2)
def _full_appearance(xml: str, root_bodies: tuple[tuple[str, str], ...], cameras: tuple[tuple[str, str], ...]) -> Appearance:
    """One full model a scene; whoever renders it next makes it look like its own world."""
    return Appearance(full_model(xml), dict(root_bodies), dict(cameras))


class _Renderer:
    """One GL context with one model. `mujoco.Renderer` would need a context for every image size."""

    def __init__(self, appearance: Appearance, quality: str) -> None:
        import mujoco

        from osel_sim.sim import gl

        model = appearance.model
        self._mujoco, self._model, self._appearance, self._quality = mujoco, model, appearance, quality
        visual = model.vis
        visual.global_.offwidth = visual.global_.offheight = LARGEST
        visual.quality.offsamples = 4
        if quality == "fast":
            # Boxes of 4 x 4 quads a side and cylinders of 28 x 16 are most of what is left to draw once the meshes are light.
            visual.quality.offsamples, visual.quality.numquads, visual.quality.numslices, visual.quality.numstacks = 0, 1, 16, 4
            visual.quality.shadowsize = 0  # none is drawn: no map of 4096 x 4096 for them
        self._gl = gl.context(LARGEST, LARGEST)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._mesh_sizes = dict(appearance.mesh_sizes)  # those that the context has
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        if quality == "fast":
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._option = mujoco.MjvOption()
        self._option.geomgroup[UNSEEN_GROUP] = 0
        self._option.sitegroup[:] = 0  # its coloured markers on the gripper
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED

    def render(self, data: Any, camera: str, width: int, height: int) -> Image:
        mujoco = self._mujoco
        self._camera.fixedcamid = self._model.camera(self._appearance.cameras.get(camera, camera)).id
        with self._only_in_view(data, width / height):
            mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        self._gl.make_current()
        self._fetch_meshes()
        corner = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(corner, self._scene, self._context)
        image = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, corner, self._context)
        return np.ascontiguousarray(image[::-1])  # GL counts rows from below

    @contextmanager
    def _only_in_view(self, data: Any, aspect: float) -> Iterator[None]:
        """Geoms that the camera cannot see are not drawn. A full picture draws them all: their shadows may be seen."""
        if self._quality == "full":
            yield
            return
        groups = self._model.geom_group.copy()
        self._model.geom_group[~in_view(self._model, data, self._camera.fixedcamid, aspect)] = UNSEEN_GROUP
        try:
            yield
        finally:
            self._model.geom_group[:] = groups

    def _fetch_meshes(self) -> None:
        """The context keeps its own copy of every mesh: renew those whose size has changed."""
        sizes = self._appearance.mesh_sizes
        for mesh in sizes | self._mesh_sizes:
            if sizes.get(mesh) != self._mesh_sizes.get(mesh):
                self._mujoco.mjr_uploadMesh(self._model, self._context, mesh)
        self._mesh_sizes = dict(sizes)

    def close(self) -> None:
        self._context.free()
        self._gl.free()


def _close(renderers: dict[str, _Renderer]) -> None:
    while renderers:
        renderers.popitem()[1].close()


def in_view(model: Any, data: Any, camera: int, aspect: float) -> NDArray[np.bool_]:
    """Which geoms (ngeom,) may show in a camera's picture: their bounding sphere reaches into the pyramid that it sees.

    Args:
        camera: index in the model.
        aspect: width over height of the picture.
    """
    x, y, backward = ((data.geom_xpos - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
    radius = np.where(model.geom_rbound > 0, 1.01 * model.geom_rbound, np.inf)  # a plane has none
    across, up = aspect * np.tan(np.radians(model.cam_fovy[camera]) / 2), np.tan(np.radians(model.cam_fovy[camera]) / 2)
    seen: NDArray[np.bool_] = (
        (backward < radius) & (np.abs(x) < radius * np.hypot(1, across) - across * backward) & (np.abs(y) < radius * np.hypot(1, up) - up * backward)
    )
    return seen


def project(model: Any, data: Any, points: NDArray[np.float64], index: int, size: int) -> NDArray[np.float64]:
    """Pixel (x, y) of world points (N, 3) in a square image -> (N, 2); x to the right, y down; NaN for what is behind the camera.

    Args:
        index: of the camera in the model.
    """
    seen = (points - data.cam_xpos[index]) @ data.cam_xmat[index].reshape(3, 3)
    depth = np.where(seen[:, 2] < 0.0, seen[:, 2], np.nan)  # a camera looks along its -z
    focal = size / 2 / np.tan(np.radians(model.cam_fovy[index]) / 2)
    pixels: NDArray[np.float64] = np.stack([size / 2 - focal * seen[:, 0] / depth, size / 2 + focal * seen[:, 1] / depth], axis=1)
    return pixels
