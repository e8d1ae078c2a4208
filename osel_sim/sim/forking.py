"""Drawing and `fork`: a forked process has its parent's GL, but none of the threads that draw, and would wait for them for ever.

So before a process forks (gymnasium's AsyncVectorEnv does, by default), all GL contexts of ours are closed and EGL is shut down, which ends its
threads; parent and child make new contexts with their next image, which shows the same. Where that cannot be done, since OSMesa has no end, or
somebody else's contexts are in use, the child is told instead of hanging.

Others draw too, by MuJoCo's own modules, before anything of ours does; so forks are watched from when this module is imported.
"""

import contextlib
import gc
import os
import sys
from typing import Any, Protocol
from weakref import WeakSet

from osel_sim.core.errors import DisplayError

_FOREIGN = ("GLContext", "EGLGLContext")
"""Classes of contexts that mujoco and robosuite make, for everybody."""


class Holder(Protocol):
    """Somebody with GL contexts, who makes new ones when they are closed."""

    def close(self) -> None:
        """Give the contexts back."""
        ...


class _State:
    """Of this process.

    Attributes:
        holders: who has contexts.
        backend: that ours draw with, or None where they have drawn nothing.
        left: what the parent could not shut down before it forked, or None.
    """

    def __init__(self) -> None:
        self.holders: WeakSet[Holder] = WeakSet()
        self.backend: str | None = None
        self.left: str | None = None

    def before(self) -> None:
        """In the parent, before it forks."""
        egl = getattr(sys.modules.get("mujoco.egl"), "EGL_DISPLAY", None)  # made when somebody imports the module
        backend = self.backend or ("egl" if egl else "osmesa" if "mujoco.osmesa" in sys.modules and _foreign() else None)
        if backend is None:
            return
        self.left = backend
        with contextlib.suppress(Exception):  # such as a context that another thread is drawing with: then it is left
            for holder in list(self.holders):
                holder.close()
            if backend == "egl" and not _foreign():
                _end_egl()
                self.backend = self.left = None

    def in_child(self) -> None:
        """In the child."""
        self.holders.clear()

    def in_parent(self) -> None:
        """In the parent, after it forked."""
        self.left = None


_state = _State()
os.register_at_fork(before=_state.before, after_in_child=_state.in_child, after_in_parent=_state.in_parent)


def drawing(backend: str) -> None:
    """A context is about to be made.

    Raises:
        DisplayError: it would never draw, since this process was forked from one that drew.
    """
    if _state.left is not None:
        raise DisplayError(
            f"this process was forked from one that had drawn images ({_state.left}), and cannot draw: threads do not come along. Start processes "
            "afresh, by multiprocessing's 'spawn' (gymnasium.make_vec(..., vector_kwargs={'context': 'spawn'})), or draw nothing before"
        )
    _state.backend = backend


def holds(holder: Holder) -> None:
    """Somebody has contexts, to be closed before a fork."""
    _state.holders.add(holder)


def _foreign() -> bool:
    """Whether contexts are in use that no holder of ours closed."""
    return any(type(item).__name__ in _FOREIGN and getattr(item, "_context", None) for item in gc.get_objects())


def _end_egl() -> None:
    from importlib import import_module

    egl: Any = import_module("mujoco.egl")
    if egl.EGL_DISPLAY is not None:
        egl.EGL.eglTerminate(egl.EGL_DISPLAY)
        egl.EGL.eglReleaseThread()
        egl.EGL_DISPLAY = None
