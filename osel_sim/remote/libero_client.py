"""Observations of openpi's LIBERO client (its examples/libero/main.py), read as ours.

It has other names, mirrors its images (it turns robosuite's, which are upside down, by half a turn), sends them at another size, and tells the
orientation of the hand's body. The actions that it wants are robosuite's own, which our policies give.
"""

from typing import Any

import numpy as np

from osel_sim.interface.policy import Observation
from osel_sim.interface.specification import STATE as STATE_PARTS
from osel_sim.policy.mapping import grip_orientation
from osel_sim.remote.protocol import IMAGES, STATE, TASK, Greeting, ObservationError

CAMERAS = {"observation/image": "agentview", "observation/wrist_image": "wrist"}
STATE_KEY, PROMPT = "observation/state", "prompt"


def is_libero(message: Any) -> bool:
    """Whether a message has that client's names."""
    return isinstance(message, dict) and any(key in message for key in (*CAMERAS, STATE_KEY))


def read_libero(message: dict[str, Any], greeting: Greeting) -> Observation:
    """Such a message as an observation of ours; keys and shapes that are wrong beyond that are for `check_observation` to name.

    Raises:
        ObservationError: the policy drives in an environment that has no such observations, or a key is missing or no image.
    """
    known = [*CAMERAS, STATE_KEY, PROMPT]
    if not greeting.libero:
        raise ObservationError(f"{', '.join(known)} are what openpi's LIBERO client sends; {greeting.policy} drives in another environment")
    missing = [key for key in known if key not in message and CAMERAS.get(key, greeting.cameras[0]) in greeting.cameras]
    if missing or len(message) > len(known) or not set(message) <= set(known):
        got = ", ".join(sorted(str(key)[:60] for key in list(message)[:20]))
        raise ObservationError(f"expected the keys {', '.join(known)} of openpi's LIBERO client, got {got}")
    images = {IMAGES + camera: _image(message[key], key, greeting.image_size) for key, camera in CAMERAS.items() if camera in greeting.cameras}
    return {**images, STATE: _state(message[STATE_KEY]), TASK: message[PROMPT]}


def _image(value: Any, key: str, size: int) -> np.ndarray[Any, Any]:
    """An image the right way round, at the size that the policy wants."""
    from PIL import Image

    if not isinstance(value, np.ndarray) or value.dtype != np.uint8 or value.ndim != 3 or value.shape[2] != 3 or not 1 <= value.size <= 3 * 1024**2:
        got = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        raise ObservationError(f"{key} must be uint8 of shape (H, W, 3), got {got}")
    upright = np.ascontiguousarray(value[:, ::-1])
    if upright.shape[:2] != (size, size):
        upright = np.asarray(Image.fromarray(upright).resize((size, size), Image.Resampling.BILINEAR))
    return upright


def _state(value: Any) -> np.ndarray[Any, Any]:
    """The state with the grip site's orientation in place of the hand's."""
    size, start = sum(STATE_PARTS.values()), STATE_PARTS["position"]
    state = np.asarray(value) if isinstance(value, np.ndarray | list) else np.empty(0)
    if state.dtype.kind not in "fiu" or state.shape != (size,) or not np.isfinite(state).all():
        raise ObservationError(f"{STATE_KEY} must be {size} finite numbers: position, axis-angle and both fingers")
    state = state.astype(np.float64)
    state[start : start + 3] = grip_orientation(state[start : start + 3])
    return state.astype(np.float32)
