"""What drives the robot: the two-method contract."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Observation = dict[str, Any]
"""LeRobot's names:

- `observation.images.<camera>`: uint8 (H, W, 3), RGB, for each camera the policy file names;
- `observation.state`: float32 (8,): gripper position (3, metres, world), its orientation as axis-angle (3, radians), two finger positions (metres);
- `task`: the instruction.
"""

Actions = NDArray[np.float32]
"""A chunk (T, 7): OSC_POSE deltas (x, y, z, roll, pitch, yaw) and gripper (-1 open, +1 closed), each in [-1, 1], at 20 Hz."""

ACTION_DIM = 7
STATE_DIM = 8
CONTROL_HZ = 20


class Policy(Protocol):
    """A policy: told the instruction once, then asked for chunks of actions."""

    def reset(self, instruction: str) -> None:
        """Start a new episode."""
        ...

    def act(self, observation: Observation) -> Actions:
        """The next chunk of actions, (T, 7) float32 in [-1, 1]."""
        ...
