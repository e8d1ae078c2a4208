"""Cameras and lights that are perturbed: turned about what they look at."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def shifted(position: Array, quaternion: Array, shift: Any, pivot: Array) -> tuple[Array, Array]:
    """Pose of a camera turned about what it looks at.

    Args:
        position, quaternion: of the camera (3,), (w, x, y, z).
        shift: an `osel_sim.sim.perturbation.CameraShift`, or what has the same attributes.
        pivot: what it looks at (3,).
    """
    import mujoco

    right = np.empty(3)
    mujoco.mju_rotVecQuat(right, np.array([1.0, 0.0, 0.0]), quaternion)
    turned, moved, both, rolled = np.empty(4), np.empty(3), np.empty(4), np.empty(4)
    mujoco.mju_mulQuat(turned, turn(np.array([0.0, 0.0, shift.azimuth])), turn(-shift.elevation * right))
    mujoco.mju_rotVecQuat(moved, (position - pivot) * shift.distance, turned)
    mujoco.mju_mulQuat(both, turned, quaternion)
    mujoco.mju_mulQuat(rolled, both, turn(np.array([0.0, 0.0, shift.roll])))
    return pivot + moved + np.array(shift.shift), rolled


def nudged(position: Array, quaternion: Array, nudge: Any) -> tuple[Array, Array]:
    """Pose of a camera moved by metres (3) and turned by radians (3) in its own frame; `nudge` are the six numbers."""
    import mujoco

    offset, turned = np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(offset, np.array(nudge[:3]), quaternion)
    mujoco.mju_mulQuat(turned, quaternion, turn(np.array(nudge[3:])))
    return position + offset, turned


def turned_light(direction: Array, angles: Any) -> Array:
    """Direction of a light (3,) turned by radians about x and y."""
    import mujoco

    turned = np.empty(3)
    mujoco.mju_rotVecQuat(turned, direction, turn(np.array([*angles, 0.0])))
    return turned


def turn(vector: Array) -> Array:
    """Quaternion (w, x, y, z) of an axis-angle vector (3,)."""
    import mujoco

    angle = float(np.linalg.norm(vector))
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    if angle:
        mujoco.mju_axisAngle2Quat(quaternion, vector / angle, angle)
    return quaternion
