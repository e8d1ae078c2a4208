"""Quick pictures of another's MuJoCo model: as `osel_sim.sim.cameras` draws ours, without shadows, reflections, multisampling and heavy meshes.

What is drawn is a model of its own, compiled from the same description with light meshes, onto which poses are copied. So the simulator's is never
touched: its physics are what they are without pictures, to the last bit.
"""

import atexit
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.environment import Image
from osel_sim.interface.robot import LightMeshes
from osel_sim.sim import forking, gl
from osel_sim.sim.light_meshes import decimated, textured

QUALITIES = ("fast", "full")
LARGEST = 1024
"""Pixels; the size of the offscreen buffer, of which an image takes a corner."""
KEPT = 6
"""GL contexts kept in a process; those of environments that nobody looked at for longest are closed, and made again when somebody does."""
POSES = ("body_pos", "body_quat", "site_pos", "site_quat", "geom_pos", "geom_quat", "geom_size", "geom_rgba")
"""Arrays of the model that simulators change to begin an episode."""
STATE = ("qpos", "mocap_pos", "mocap_quat")
MESHES = LightMeshes(keep=0.2, fewest=400, most=3000, join=())

_renderers: "OrderedDict[int, _Renderer]" = OrderedDict()


class MujocoView:
    """Draws one simulator's world.

    Args:
        model, data: the simulator's own.
        describe: gives a new `mujoco.MjSpec` of the model, the same as what the simulator compiled but for what is only looked at.
        upside_down: cameras whose pictures are turned by 180 degrees.
        groups: geom groups that are shown.
        sites: whether sites are.
        make_light: makes the meshes of a spec light; None: every heavy one without a flat texture.
    """

    def __init__(
        self,
        model: Any,
        data: Any,
        describe: Callable[[], Any],
        upside_down: Collection[str] = (),
        groups: Collection[int] = (0, 1, 2),
        sites: bool = True,
        make_light: Callable[[Any], None] | None = None,
    ) -> None:
        self._model, self._data, self._describe = model, data, describe
        self._upside_down = frozenset(upside_down)
        self._shown = _Shown(tuple(groups), sites)
        self._make_light = make_light or (lambda spec: _lighten(spec, model))
        self._look: Callable[[Any], None] = lambda model: None
        self._copies: dict[str, _Copy] = {}
        self.cameras = tuple(model.camera(index).name for index in range(model.ncam))

    def dress(self, look: Callable[[Any], None]) -> None:
        """From now on the world looks otherwise: `look` changes lights, cameras and materials of a model that looks as it was compiled."""
        self._look = look
        for copy in self._copies.values():
            copy.dressed = False

    def render(self, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) of a camera.

        Raises:
            UnknownNameError, UsageError: unknown camera or quality, or an image larger than the buffer.
        """
        if camera not in self.cameras:
            raise UnknownNameError("camera", camera, self.cameras)
        if quality not in QUALITIES or not 0 < max(width, height) <= LARGEST:
            raise UsageError(
                f"quality must be one of {', '.join(QUALITIES)}, sizes within 1 to {LARGEST} pixels; got {quality!r}, {width} x {height}"
            )
        copy = self._followed(quality)
        image = _renderer(copy, quality, self._shown).render(copy.data, self.cameras.index(camera), width, height)
        return np.ascontiguousarray(image[::-1, ::-1]) if camera in self._upside_down else image

    def places(self, camera: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column and row (N, 2) of world points (N, 3) in a camera's square image, within [-1, 1] where they are in it; NaN behind the camera."""
        copy, index = self._followed("fast"), self.cameras.index(camera)
        seen = (points - copy.data.cam_xpos[index]) @ copy.data.cam_xmat[index].reshape(3, 3)
        depth = -seen[:, 2:] * np.tan(np.radians(copy.model.cam_fovy[index]) / 2)
        places: NDArray[np.float64] = seen[:, :2] * (1.0, -1.0) / np.where(depth > 0, depth, np.nan)
        return -places if camera in self._upside_down else places

    def _followed(self, quality: str) -> "_Copy":
        """The model to be looked at, as the world is now."""
        if quality not in self._copies:
            self._copies[quality] = _Copy(self._describe(), quality, self._model, self._make_light)
        copy = self._copies[quality]
        copy.follow(self._model, self._data, self._look)
        return copy

    def close(self) -> None:
        """Give the GL contexts back."""
        for copy in self._copies.values():
            if id(copy) in _renderers:
                _renderers.pop(id(copy)).close()
        self._copies.clear()


@dataclass(frozen=True)
class _Shown:
    """What is drawn of a model."""

    groups: tuple[int, ...]
    sites: bool


class _Copy:
    """A model to be looked at, with the poses of the simulator's."""

    def __init__(self, spec: Any, quality: str, own: Any, make_light: Callable[[Any], None]) -> None:
        import mujoco

        if quality == "fast":
            make_light(spec)
        self.model = spec.compile()
        if (self.model.nbody, self.model.ngeom, self.model.nq) != (own.nbody, own.ngeom, own.nq):
            raise UsageError("the model to be looked at is another than the simulator's")
        visual = self.model.vis
        visual.global_.offwidth = visual.global_.offheight = LARGEST
        if quality == "fast":
            visual.quality.offsamples, visual.quality.numquads, visual.quality.numslices, visual.quality.numstacks = 0, 1, 16, 4
        self.data = mujoco.MjData(self.model)
        self.dressed = False
        self._clean = {name: getattr(self.model, name).copy() for name in ("light_diffuse", "light_dir", "cam_pos", "cam_quat", "cam_fovy")}
        self._clean |= {name: getattr(self.model, name).copy() for name in ("mat_rgba", "geom_matid")}
        self._headlight = [getattr(visual.headlight, part).copy() for part in ("ambient", "diffuse")]

    def follow(self, own: Any, data: Any, look: Callable[[Any], None]) -> None:
        """Take over the simulator's poses, and how the world looks."""
        import mujoco

        for name in POSES:
            getattr(self.model, name)[:] = getattr(own, name)
        for name in STATE:
            getattr(self.data, name)[:] = getattr(data, name)
        if not self.dressed:
            for name, clean in self._clean.items():
                getattr(self.model, name)[:] = clean
            headlight = self.model.vis.headlight
            headlight.ambient[:], headlight.diffuse[:] = self._headlight
            look(self.model)
            self.dressed = True
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


class _Renderer:
    """One GL context with one model."""

    def __init__(self, model: Any, quality: str, shown: _Shown) -> None:
        import mujoco

        self._mujoco, self._model = mujoco, model
        self._gl = gl.context(LARGEST, LARGEST)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        if quality == "fast":
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in shown.groups for group in range(len(self._option.geomgroup))]
        if not shown.sites:
            self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED

    def render(self, data: Any, camera: int, width: int, height: int) -> NDArray[np.uint8]:
        mujoco = self._mujoco
        self._camera.fixedcamid = camera
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        self._gl.make_current()
        corner = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(corner, self._scene, self._context)
        image = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, corner, self._context)
        return np.ascontiguousarray(image[::-1])  # GL counts rows from below

    def close(self) -> None:
        self._context.free()
        self._gl.free()


def _renderer(copy: _Copy, quality: str, shown: _Shown) -> _Renderer:
    """The renderer of a model, made where it has none; the one unused for longest makes room."""
    if id(copy) not in _renderers:
        if not _renderers:
            forking.holds(_HOLDER)
        while len(_renderers) >= KEPT:
            _renderers.popitem(last=False)[1].close()
        _renderers[id(copy)] = _Renderer(copy.model, quality, shown)
        if len(_renderers) == 1:
            # mujoco takes GL down at exit. Last registered runs first, so register after it.
            atexit.unregister(_HOLDER.close)
            atexit.register(_HOLDER.close)
    _renderers.move_to_end(id(copy))
    return _renderers[id(copy)]


class _All:
    """All renderers of this process: closed before it forks, and at its end."""

    def close(self) -> None:
        while _renderers:
            _renderers.popitem()[1].close()


_HOLDER = _All()


def _lighten(spec: Any, model: Any) -> None:
    """Make the heavy meshes of a spec light; those with a flat texture stay as they are."""
    flat = textured(model)
    for index in range(model.nmesh):
        if index in flat or model.mesh_facenum[index] <= MESHES.fewest:
            continue
        vertices, faces = decimated(model, index, MESHES)
        if len(faces) < 4:
            continue
        mesh = spec.mesh(model.mesh(index).name)
        mesh.file = ""
        mesh.scale, mesh.refpos, mesh.refquat = [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]
        mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
