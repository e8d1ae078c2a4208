"""What an encoder is shown of an instance: the same in a live run and in a recording."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from osel_sim.interface.encoder import Encoder
    from osel_sim.sim.env import TaskEnv

CAMERA = "agentview"


def view(env: "TaskEnv", encoder: "Encoder") -> list[NDArray[np.uint8]]:
    """The scene as it stands, in the encoder's own size: one uint8 (size, size, 3)."""
    return [env.image(CAMERA, encoder.image_size, encoder.image_size, "fast")]
