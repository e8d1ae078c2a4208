"""What drives the robot: the two-method contract."""

from collections.abc import Sequence
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Observation = dict[str, Any]
"""LeRobot's names:

- `observation.images.<camera>`: uint8 (H, W, 3), RGB, for each camera the policy file names;
- `observation.state`: float32 (S,): the parts that the environment's specification lists, one after the other; absent where it lists none;
- `task`: the instruction.

Where the policy file asks for a history of n > 1, images are (n, H, W, 3) and the state is (n, S): successive control steps, the newest last.
"""

Actions = NDArray[np.float32]
"""A chunk (T, D) of actions; the environment's specification says what the D components mean, their bounds, and how many steps a second are made."""


class Policy(Protocol):
    """A policy: told the instruction once, then asked for chunks of actions."""

    def reset(self, instruction: str) -> None:
        """Start a new episode."""
        ...

    def act(self, observation: Observation) -> Actions:
        """The next chunk of actions, (T, D) float32."""
        ...


@runtime_checkable
class Batched(Policy, Protocol):
    """A policy whose sessions, which share their weights, can be asked together: a server may do so where several robots ask at once.

    Optional: sessions of a policy without it are asked one after another.
    """

    @classmethod
    def act_batch(cls, sessions: Sequence[Self], observations: Sequence[Observation]) -> Sequence[Actions]:
        """The next chunk of each session, as its `act` would give it for its observation (to 1e-5; a server tries that before it serves).

        If it raises, no session may have changed: each is then asked alone.
        """
        ...
