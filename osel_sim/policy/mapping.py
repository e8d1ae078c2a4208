"""Applies a policy file's `[mapping]`: our observations in a policy's words, its actions in ours."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import PolicyError
from osel_sim.formats.conventions import STATE_PARTS, Conventions
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.policy import Observation
from osel_sim.policy.history import split, stacked

IMAGES, STATE = "observation.images.", "observation.state"
HAND_TURN = np.pi / 2
"""From the grip site to the hand's body, about the approach axis, radians: the same for all grippers of robosuite that are used here."""
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
    if mapping.state_frame == "hand":
        parts |= hand_orientation(parts["axis_angle"])
    return np.concatenate([_part(parts, part) for part in wanted_parts(mapping, environment)]).astype(np.float32)


def image_of(observation: Observation, camera: str, mapping: Conventions) -> NDArray[np.uint8]:
    """The image of a camera as the policy wants it, uint8 (H, W, 3): resized, then turned over."""
    image: NDArray[np.uint8] = observation[IMAGES + camera]
    if mapping.resize is not None and mapping.resize != len(image):
        from PIL import Image

        image = np.asarray(Image.fromarray(image).resize((mapping.resize, mapping.resize), Image.Resampling.BILINEAR))
    return turned_over(image, mapping.flip.get(camera))


def turned_over(image: NDArray[np.uint8], flip: str | None) -> NDArray[np.uint8]:
    """An image (H, W, C) turned over in one of the ways of `FLIPS`, or as it is."""
    if flip in ("vertical", "both"):
        image = image[::-1]
    if flip in ("horizontal", "both"):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def hand_orientation(grip: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Orientation of the hand's body, from that of the grip site as axis-angle (3,): `axis_angle` (3,) and `quaternion` (x, y, z, w).

    As robosuite gives it (`robot0_eef_quat`), and as openpi and LeRobot make axis-angle of it for LIBERO. Of the two quaternions that mean the same
    orientation, the one with a positive x is taken, which is the Panda's own as it works: then the angle is about half a turn for a gripper that
    points down, and may be more.
    """
    quaternion = _turned(grip, HAND_TURN)
    return {"axis_angle": _axis_angle(quaternion), "quaternion": quaternion}


def grip_orientation(hand: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orientation of the grip site as axis-angle (..., 3), as our environments have it, from that of the hand's body as axis-angle (..., 3)."""
    return _axis_angle(_turned(hand, -HAND_TURN))


def _turned(axis_angle: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """Orientations (..., 3) turned about their own z axis, as quaternions (x, y, z, w) with x >= 0, (..., 4)."""
    from scipy.spatial.transform import Rotation

    quaternions: NDArray[np.float64] = (Rotation.from_rotvec(axis_angle) * Rotation.from_euler("z", turn)).as_quat()
    return np.where(quaternions[..., :1] < 0, -quaternions, quaternions)


def _axis_angle(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axis-angle (..., 3) of quaternions (x, y, z, w), with angles up to a whole turn."""
    half = np.arccos(np.clip(quaternions[..., 3:], -1.0, 1.0))
    sine = np.sin(half)
    return np.where(sine > 1e-9, quaternions[..., :3] * (2 * half / np.maximum(sine, 1e-9)), 0.0)


def _part(parts: dict[str, NDArray[np.float64]], part: str) -> NDArray[np.float64]:
    """One part of the state, the environment's own or computed of one."""
    if part in parts:
        return parts[part]
    source = parts[DERIVED[part]]
    if part == "gripper":
        return np.clip((source[:1] - source[1:2]) / (2 * OPEN_FINGER), 0.0, 1.0)
    return orientation(source, part)


def message_of(observation: Observation, mapping: Conventions, cameras: tuple[str, ...], environment: EnvironmentSpec) -> dict[str, Any]:
    """An observation, or a stack of successive ones, under the policy's own names."""
    if len(single := split(observation)) > 1:
        return stacked([message_of(one, mapping, cameras, environment) for one in single])
    message: dict[str, Any] = {mapping.key(camera): image_of(observation, camera, mapping) for camera in cameras}
    if cameras:
        message |= {key: np.zeros_like(message[mapping.key(cameras[0])]) for key in mapping.blank}
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
