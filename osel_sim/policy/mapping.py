"""Applies a policy file's `[mapping]`: our observations in a policy's words, its actions in ours."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import PolicyError
from osel_sim.formats.conventions import STATE_PARTS, Conventions
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.policy import Observation

STATE = "observation.state"
OPEN_FINGER = 0.04
"""Where a finger of the fully open gripper is, metres."""


DERIVED = {"quaternion": "axis_angle", "euler": "axis_angle", "gripper": "fingers"}
"""Parts of a state that can be computed -> of which one."""


def known_parts(environment: EnvironmentSpec) -> dict[str, int]:
    """Parts that a policy's state can be put together from in an environment, with how many numbers each has: its own, and those computed of them."""
    derived = {part: STATE_PARTS[part] for part, source in DERIVED.items() if source in environment.state and part not in environment.state}
    return {**environment.state, **derived}


def wanted_parts(mapping: Conventions, environment: EnvironmentSpec) -> tuple[str, ...]:
    """Parts of the state that a policy wants, in order: those that its file names, else the environment's own."""
    return mapping.state_parts or tuple(environment.state)


def state_size(mapping: Conventions, environment: EnvironmentSpec) -> int:
    """How many numbers the state of a policy has."""
    known = known_parts(environment)
    return sum(known[part] for part in wanted_parts(mapping, environment))


def state_of(observation: Observation, mapping: Conventions, environment: EnvironmentSpec) -> NDArray[np.float32]:
    """The state as the policy wants it, (state_size,)."""
    state, parts, start = np.asarray(observation[STATE], np.float64), dict[str, NDArray[np.float64]](), 0
    for part, size in environment.state.items():
        parts[part] = state[start : start + size]
        start += size
    return np.concatenate([_part(parts, part) for part in wanted_parts(mapping, environment)]).astype(np.float32)


def _part(parts: dict[str, NDArray[np.float64]], part: str) -> NDArray[np.float64]:
    """One part of the state, the environment's own or computed of one."""
    if part in parts:
        return parts[part]
    source = parts[DERIVED[part]]
    if part == "gripper":
        return np.clip((source[:1] - source[1:2]) / (2 * OPEN_FINGER), 0.0, 1.0)
    return orientation(source, part)


def message_of(observation: Observation, mapping: Conventions, cameras: tuple[str, ...], environment: EnvironmentSpec) -> dict[str, Any]:
    """An observation under the policy's own names."""
    message: dict[str, Any] = {mapping.key(camera): observation[f"observation.images.{camera}"] for camera in cameras}
    if cameras:
        shape = observation[f"observation.images.{cameras[0]}"].shape
        message |= {key: np.zeros(shape, np.uint8) for key in mapping.blank}
    if mapping.state and environment.state:
        message[mapping.state] = state_of(observation, mapping, environment)
    message[mapping.prompt] = observation["task"]
    return message


def actions_of(value: Any, mapping: Conventions, action: ActionSpec, name: str = "actions") -> NDArray[Any]:
    """A policy's chunk (T, N), single action (N,), or batch of one (1, T, N), as actions of the environment (T, D).

    Args:
        name: what the policy calls them.

    Raises:
        PolicyError: it is no such array.
    """
    try:
        actions = np.asarray(value)
    except ValueError as error:  # ragged lists
        raise PolicyError(f"{name} are not an array ({error})") from None
    if actions.dtype.kind not in "fiu":
        raise PolicyError(f"{name} must be real numbers, got dtype {actions.dtype}")
    actions = np.atleast_2d(actions)
    while actions.ndim > 2 and len(actions) == 1:
        actions = actions[0]
    if actions.ndim != 2:
        raise PolicyError(f"{name} have the shape {actions.shape}, one chunk (T, {action.dimension}) is needed")
    if not mapping.columns and actions.shape[1] != action.dimension:
        size = action.dimension
        raise PolicyError(f"{name} have the shape {actions.shape}, the robot takes (T, {size}); say in [mapping] columns which those are")
    columns = list(mapping.columns or range(action.dimension))
    if actions.shape[1] <= max(columns):
        raise PolicyError(f"{name} have the shape {actions.shape}, [mapping] columns = {columns} needs more numbers in each")
    result = actions[:, columns].astype(np.float64)
    if has_scale(mapping):
        result[:, action.motions] *= mapping.scale
    if action.gripper_index is not None:
        gripper = result[:, action.gripper_index]
        if mapping.gripper.endswith("_one"):
            gripper = 2 * gripper - 1
        same = mapping.gripper.partition("_")[0] == action.gripper_convention.partition("_")[0]
        result[:, action.gripper_index] = gripper if same else -gripper
    return result


def has_scale(mapping: Conventions) -> bool:
    """Whether a policy's motions are scaled at all."""
    return any(scale != 1.0 for scale in mapping.scale)


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
