"""Headless OpenGL: which backend works here, found before robosuite is imported.

robosuite sets `MUJOCO_GL=egl` when it is imported unless `osmesa` is set, whether EGL works or not, and a GL library that fails may take the whole
process with it. So each backend is tried in a process of its own, and what was found is handed to child processes through the environment.
"""

import logging
import os
import platform
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

from osel_sim.core.caches import prepare
from osel_sim.core.errors import DisplayError
from osel_sim.sim import forking

BACKENDS = ("cgl",) if platform.system() == "Darwin" else ("egl", "osmesa", "glfw")
HEADLESS = tuple(backend for backend in BACKENDS if backend != "glfw")
PACKAGES = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
PROBE_SECONDS = 60.0
# Set beside MUJOCO_GL once a backend has drawn a picture, so that a child process need not try again: "<backend> <found how>".
CHECKED = "OSEL_SIM_GL_CHECKED"
PLATFORM, DEVICE = "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID"

logger = logging.getLogger(__name__)

_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light pos="0 0 2"/><geom type="sphere" size="0.3"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
    renderer.update_scene(data)
    if renderer.render().max() == 0:
        raise SystemExit('the rendered image is black')
"""


@dataclass(frozen=True)
class Backend:
    """A backend that has drawn a picture on this machine, and `how` it came to be used: `probed`, or the variable that asks for it."""

    name: str
    how: str


def choose_backend() -> str:
    """The GL backend to render with: `egl`, `osmesa`, or what the environment asks for.

    `MUJOCO_GL` in the environment wins, then `PYOPENGL_PLATFORM`, then `MUJOCO_EGL_DEVICE_ID`, which only EGL has; else EGL, then OSMesa, is tried in
    a subprocess (about half a second each, once a run), and a warning says where it is not EGL. `MUJOCO_GL` and `PYOPENGL_PLATFORM` are set to the
    finding, for MuJoCo, robosuite and child processes.

    Raises:
        DisplayError: neither works, or what a variable asks for does not, or two contradict each other; names the variable, or packages to install.
    """
    return find_backend().name


def find_backend() -> Backend:
    """`choose_backend`, with how the backend was found.

    Raises:
        DisplayError: as `choose_backend`.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    checked = os.environ.get(CHECKED, "").split()
    if len(checked) == 2 and checked[0] == wanted:
        return Backend(*checked)
    platform_wanted = os.environ.get(PLATFORM, "").strip().lower()
    if checked and checked[0] == platform_wanted:
        platform_wanted = ""  # ours, of an earlier finding
    if wanted in BACKENDS and platform_wanted in HEADLESS and platform_wanted != wanted:
        raise DisplayError(f"MUJOCO_GL={wanted} and {PLATFORM}={platform_wanted} contradict each other: unset one of them")
    if wanted:
        return _use(wanted, "MUJOCO_GL")
    if platform_wanted in HEADLESS:
        return _use(platform_wanted, PLATFORM)
    if os.environ.get(DEVICE) and "egl" in HEADLESS:
        return _use("egl", DEVICE)
    if platform_wanted:
        logger.warning("%s=%s draws on a display, which nothing here needs; it is not used", PLATFORM, platform_wanted)
    complaints: list[str] = []
    for name in HEADLESS:
        problem = probe(name)
        if problem is None:
            if complaints:
                logger.warning("%s; images are drawn by %s instead (MUJOCO_GL=%s asks for it)", "; ".join(complaints), name, name)
            return _remember(Backend(name, "probed"))
        complaints.append(f"{name}: {problem}")
    raise DisplayError(f"no headless OpenGL works ({'; '.join(complaints)}). {_advice(*HEADLESS)}")


@cache
def probe(backend: str) -> str | None:
    """Draw one small picture with this backend in a process of its own; None if that works, else what went wrong, in one line."""
    environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": _platform(backend)}
    if not environment["PYOPENGL_PLATFORM"]:
        del environment["PYOPENGL_PLATFORM"]
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PROBE_SECONDS
        )
    except subprocess.TimeoutExpired:
        return f"no picture within {PROBE_SECONDS:.0f} s"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    # The first error is the cause; what follows are half-built objects complaining while they are torn down.
    errors = [line for line in lines if re.match(r"[\w.]+(Error|Exception): ", line)]
    return (errors or lines[-1:] or [f"its process ended with code {done.returncode}"])[0].partition(". ")[0].rstrip(".")


def context(width: int, height: int) -> Any:
    """A new GL context of the chosen backend, whatever `MUJOCO_GL` was when mujoco was imported (the only time mujoco itself looks).

    Args:
        width: largest image to be rendered, pixels (OSMesa allocates its buffer from it).
        height: likewise.

    Raises:
        DisplayError: as `choose_backend`; or this process was forked from one that had drawn.
    """
    from importlib import import_module

    backend = choose_backend()
    forking.drawing(backend)
    return import_module(f"mujoco.{backend}").GLContext(width, height)


def quiet_robosuite() -> ModuleType:
    """Import robosuite after a backend is chosen, without its start-up warnings (private macros, optional robots, old string escapes)."""
    choose_backend()
    prepare()
    logging.getLogger("robosuite_logs").addFilter(_errors_only)
    chosen = os.environ["MUJOCO_GL"]
    device = os.environ.pop(DEVICE, None)  # robosuite insists that it is one of CUDA_VISIBLE_DEVICES, which numbers devices otherwise than EGL
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import robosuite
    finally:
        os.environ["MUJOCO_GL"] = chosen  # robosuite writes egl over glfw
        if device is not None:
            os.environ[DEVICE] = device
    return robosuite  # type: ignore[no-any-return]


def _errors_only(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR


def _use(wanted: str, how: str) -> Backend:
    if wanted not in BACKENDS:
        raise DisplayError(f"MUJOCO_GL={wanted!r} is not a rendering backend, known: {', '.join(BACKENDS)} (unset it to have one found)")
    problem = probe(wanted)
    if problem is None:
        return _remember(Backend(wanted, how))
    device = os.environ.get(DEVICE)
    if wanted == "egl" and device is not None:
        raise DisplayError(f"{DEVICE}={device}: that device cannot be had ({problem}). Name another one, or unset {DEVICE} to have one found")
    raise DisplayError(f"{how}={wanted} does not work ({problem}). {_advice(wanted)}, or unset {how} to have a backend found")


def _remember(backend: Backend) -> Backend:
    os.environ["MUJOCO_GL"] = backend.name
    if _platform(backend.name):
        os.environ["PYOPENGL_PLATFORM"] = _platform(backend.name)
    else:
        os.environ.pop("PYOPENGL_PLATFORM", None)
    os.environ[CHECKED] = f"{backend.name} {backend.how}"
    return backend


def _platform(backend: str) -> str:
    """PyOpenGL's name of the backend; empty where PyOpenGL is to choose by itself."""
    return backend if backend in ("egl", "osmesa") else ""


def _advice(*backends: str) -> str:
    choices = [PACKAGES[backend] for backend in backends if backend in PACKAGES]
    if not choices:
        return "It needs a display"
    return "On Debian and Ubuntu: " + " or ".join(f"apt-get install {packages}" for packages in choices)
