"""What policy server and client say to each other.

As in openpi (websocket_policy_server.py): the server greets with a metadata map, then answers each observation map with a map that holds `actions`
(T, D); a text message is an error. On top of that a server of ours says so in its greeting (`protocol`), and then understands `{"osel_sim/reset":
instruction}`, answered with the same map. A client without that word works as well: a session starts over by itself when the observation's `task`
changes.
"""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from osel_sim.core.errors import OselError, UsageError
from osel_sim.core.shown import TOKEN_VARIABLE as TOKEN_VARIABLE  # where others look for it
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.policy import Observation
from osel_sim.interface.specification import CAMERAS, specification
from osel_sim.interface.specification import STATE as STATE_PARTS
from osel_sim.remote.codec import ProtocolError

PROTOCOL = "osel_sim/1"
RESET = "osel_sim/reset"
HEALTH = "/healthz"
MAX_INSTRUCTION = 2000  # characters
IMAGES = "observation.images."
STATE = "observation.state"
TASK = "task"


class ObservationError(OselError):
    """An observation does not have the form the policy's file promises."""


@dataclass(frozen=True)
class Greeting:
    """What a server of ours says first.

    Attributes:
        cameras, image_size: what it wants to be shown (square, pixels).
        action_dim, state_dim: how many numbers its actions have, and the states it wants; 0: no state.
        action: bounds that the server clips actions to; None: clients do. It is not sent.
        libero: whether clients of openpi's LIBERO example are understood: the environment has the cameras and the state that they send. Not sent.
        history: how many successive observations it wants at a call; sent where it is more than one.
    """

    policy: str
    cameras: tuple[str, ...]
    image_size: int
    action_dim: int
    state_dim: int
    action: ActionSpec | None = field(default=None, compare=False, repr=False)
    libero: bool = field(default=False, compare=False, repr=False)
    history: int = 1

    @classmethod
    def of(cls, spec: PolicySpec, environment: EnvironmentSpec | None = None) -> "Greeting":
        """The greeting of the server of one policy file, which drives in an environment; None: one of ours."""
        environment = environment or specification()
        ours = dict(environment.state) == STATE_PARTS and list(environment.state) == list(STATE_PARTS) and set(spec.cameras) <= set(CAMERAS)
        action = environment.action
        return cls(spec.name, spec.cameras, spec.image_size, action.dimension, environment.state_size, action, ours, spec.history)

    def to_dict(self) -> dict[str, Any]:
        """The metadata map as it is sent."""
        return {
            "protocol": PROTOCOL,
            "policy": self.policy,
            "cameras": list(self.cameras),
            "image_size": self.image_size,
            "action_dim": self.action_dim,
            "state_dim": self.state_dim,
            "reset": RESET,
            **({"history": self.history} if self.history > 1 else {}),
        }

    @classmethod
    def parse(cls, metadata: Any) -> "Greeting | None":
        """Read a metadata map; None for a server that only speaks plain openpi.

        Raises:
            ProtocolError: it is no map, or a greeting of ours that we cannot work with.
        """
        if not isinstance(metadata, dict):
            raise ProtocolError(f"the greeting must be a map, got {type(metadata).__name__}")
        protocol = metadata.get("protocol")
        if not (isinstance(protocol, str) and protocol.startswith("osel_sim/")):
            return None
        if protocol != PROTOCOL:
            raise ProtocolError(f"the server speaks {protocol[:40]!r}, this client {PROTOCOL!r}")
        policy, cameras = metadata.get("policy"), metadata.get("cameras")
        sizes: list[Any] = [metadata.get(key) for key in ("image_size", "action_dim", "state_dim")]
        history = metadata.get("history", 1)
        if (
            not isinstance(policy, str)
            or not isinstance(cameras, list)
            or not all(isinstance(item, str) for item in cameras)
            or not all(type(size) is int for size in [*sizes, history])
        ):
            raise ProtocolError("the greeting lacks policy, cameras, image_size, action_dim or state_dim")
        return cls(policy, tuple(cameras), sizes[0], sizes[1], sizes[2], history=history)


def select_observation(observation: Observation, cameras: tuple[str, ...], state: bool = True) -> Observation:
    """Only what goes over the wire: the policy's own cameras, state and task.

    Args:
        state: whether the environment has one.

    Raises:
        ObservationError: one of them is missing.
    """
    keys = [*(IMAGES + camera for camera in cameras), *([STATE] if state else []), TASK]
    missing = [key for key in keys if key not in observation]
    if missing:
        raise ObservationError(f"the observation lacks {', '.join(missing)}")
    return {key: observation[key] for key in keys}


def check_observation(value: Any, greeting: Greeting) -> Observation:
    """An observation as it came over the wire, checked.

    Raises:
        ObservationError: naming the key and what would be right.
    """
    if not isinstance(value, dict):
        raise ObservationError(f"an observation must be a map, got {type(value).__name__}")
    expected = {*(IMAGES + camera for camera in greeting.cameras), *([STATE] if greeting.state_dim else []), TASK}
    if value.keys() != expected:
        got = ", ".join(sorted(str(key)[:60] for key in list(value)[:20])) or "none"
        raise ObservationError(f"expected the keys {', '.join(sorted(expected))}, got {got}")
    stack = (greeting.history,) if greeting.history > 1 else ()
    shape = (*stack, greeting.image_size, greeting.image_size, 3)
    for camera in greeting.cameras:
        _array(value, IMAGES + camera, ("uint8",), shape)
    checked = {**value, TASK: check_instruction(value[TASK])}
    if not greeting.state_dim:
        return checked
    with np.errstate(over="ignore"):
        state = _array(value, STATE, ("float32", "float64"), (*stack, greeting.state_dim)).astype(np.float32)
    if not np.isfinite(state).all():
        raise ObservationError(f"{STATE} contains NaN or infinity")
    return {**checked, STATE: state}


def check_instruction(value: Any) -> str:
    """An instruction as it came over the wire.

    Raises:
        ObservationError: it is no string or too long.
    """
    if not isinstance(value, str):
        raise ObservationError(f"an instruction must be a string, got {type(value).__name__}")
    if len(value) > MAX_INSTRUCTION:
        raise ObservationError(f"an instruction has at most {MAX_INSTRUCTION} characters, got {len(value)}")
    return value


def example_observation(greeting: Greeting) -> Observation:
    """Zeros in the right form: to warm a policy up, and for tests."""
    size, stack = greeting.image_size, (greeting.history,) if greeting.history > 1 else ()
    images = {IMAGES + camera: np.zeros((*stack, size, size, 3), np.uint8) for camera in greeting.cameras}
    state = {STATE: np.zeros((*stack, greeting.state_dim), np.float32)} if greeting.state_dim else {}
    return {**images, **state, TASK: "pick up the can"}


def differing_observations(greeting: Greeting, count: int) -> list[Observation]:
    """Noise in the right form, each with another instruction: to try whether what is answered together is what is answered alone."""
    random, found = np.random.default_rng(0), list[Observation]()
    for number in range(count):
        example = example_observation(greeting)
        for key, value in example.items():
            if key.startswith(IMAGES):
                example[key] = random.integers(0, 256, value.shape, np.uint8)
            elif key == STATE:
                example[key] = random.normal(0.0, 0.3, value.shape).astype(np.float32)
        found.append({**example, TASK: f"pick up the can and put it into bowl {number}"})
    return found


def largest_observation(greeting: Greeting) -> int:
    """Bytes of the largest message a client may send, with room for a longer one to be answered instead of cut off."""
    return 2 * greeting.history * len(greeting.cameras) * 3 * greeting.image_size**2 + (1 << 20)


def check_token(token: str) -> str:
    """A token that fits into an HTTP header.

    Raises:
        UsageError: it does not.
    """
    if not re.fullmatch(r"[\x21-\x7e]{8,256}", token):
        raise UsageError("a token must be 8 to 256 printable ASCII characters without spaces")
    return token


def check_header(token: str) -> str:
    """A token of another's server, which need not be as long as ours, but has to fit into an HTTP header.

    Raises:
        UsageError: it does not; says where, and not what.
    """
    ends = (0, len(token) - 1)  # HTTP drops spaces there
    wrong = next((at for at, character in enumerate(token) if not " " <= character <= "~" or (character == " " and at in ends)), None)
    if wrong is not None:
        code = ord(token[wrong])
        control = code < 0x20 or 0x7F <= code < 0xA0
        kind = {0x0A: "a line end", 0x0D: "a line end", 0x20: "a space"}.get(code, "a control character" if control else "no ASCII character")
        raise UsageError(
            f"the token in {TOKEN_VARIABLE} cannot be sent: character {wrong + 1} of {len(token)} is {kind}; "
            "did a line end or a quotation mark come with it?"
        )
    return token


def _array(value: Observation, key: str, dtypes: tuple[str, ...], shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    array = value[key]
    if not isinstance(array, np.ndarray):
        raise ObservationError(f"{key} must be an array, got {type(array).__name__}")
    if array.dtype.name not in dtypes or array.shape != shape:
        raise ObservationError(f"{key} must be {' or '.join(dtypes)} of shape {shape}, got {array.dtype.name} of shape {array.shape}")
    return array
