"""Applies a policy file's `[mapping]`: our observations in a policy's words, its actions in ours."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import PolicyError
from osel_sim.formats.mapping import Mapping
from osel_sim.interface.policy import ACTION_DIM, Observation

STATE = "observation.state"
OPEN_FINGER = 0.04
"""Where a finger of the fully open gripper is, metres."""


def state_of(observation: Observation, mapping: Mapping) -> NDArray[np.float32]:
    """The state as the policy wants it, (state_size,)."""
    state = np.asarray(observation[STATE], np.float64)
    return np.concatenate([_part(state, part) for part in mapping.state_parts]).astype(np.float32)


def _part(state: NDArray[np.float64], part: str) -> NDArray[np.float64]:
    """One of `STATE_PARTS` of our state (8,)."""
    if part == "gripper":
        return np.clip((state[6:7] - state[7:8]) / (2 * OPEN_FINGER), 0.0, 1.0)
    if part in ("quaternion", "euler"):
        return orientation(state[3:6], part)
    return {"position": state[:3], "axis_angle": state[3:6], "fingers": state[6:8]}[part]


def message_of(observation: Observation, mapping: Mapping, cameras: tuple[str, ...]) -> dict[str, Any]:
    """An observation under the policy's own names."""
    message: dict[str, Any] = {mapping.key(camera): observation[f"observation.images.{camera}"] for camera in cameras}
    if cameras:
        shape = observation[f"observation.images.{cameras[0]}"].shape
        message |= {key: np.zeros(shape, np.uint8) for key in mapping.blank}
    if mapping.state:
        message[mapping.state] = state_of(observation, mapping)
    message[mapping.prompt] = observation["task"]
    return message


def actions_of(value: Any, mapping: Mapping) -> NDArray[Any]:
    """A policy's chunk (T, N), or single action (N,), as OSC_POSE actions (T, 7).

    Raises:
        PolicyError: it is no such array.
    """
    try:
        actions = np.asarray(value)
    except ValueError as error:  # ragged lists
        raise PolicyError(f"actions are not an array ({error})") from None
    if actions.dtype.kind not in "fiu":
        raise PolicyError(f"actions must be real numbers, got dtype {actions.dtype}")
    actions = np.atleast_2d(actions)
    if actions.ndim != 2 or (not mapping.columns and actions.shape[1] != ACTION_DIM):
        raise PolicyError(f"actions have the shape {actions.shape}, the robot takes (T, {ACTION_DIM}); say in [mapping] columns which those are")
    columns = list(mapping.columns or range(ACTION_DIM))
    if actions.shape[1] <= max(columns):
        raise PolicyError(f"actions have the shape {actions.shape}, [mapping] columns = {columns} needs more numbers in each")
    result = actions[:, columns].astype(np.float64)
    result[:, :6] *= mapping.scale
    gripper = result[:, 6]
    if mapping.gripper.endswith("_one"):
        gripper = 2 * gripper - 1
    result[:, 6] = -gripper if mapping.gripper.startswith("open") else gripper
    return result


def orientation(axis_angle: NDArray[np.float64], form: str) -> NDArray[np.float64]:
    """Axis-angle (3,) in another form.

    Args:
        form: `quaternion` (x, y, z, w) with w >= 0, or `euler`: roll, pitch and yaw in radians, turned about the fixed x, then y, then z axis; at a
            pitch of 90 degrees, where roll and yaw mean the same turn, yaw is 0.
    """
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(axis_angle)
    if form == "quaternion":
        return np.asarray(rotation.as_quat(canonical=True), np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at that pitch
        return np.asarray(rotation.as_euler("xyz"), np.float64)
