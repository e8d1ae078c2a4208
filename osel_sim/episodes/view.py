"""What an encoder is shown of an instance: the same in a live run and in a recording."""

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.encoder import Encoder
from osel_sim.interface.environment import Environment


def view(env: Environment, encoder: Encoder) -> list[NDArray[np.uint8]]:
    """The scene as it stands, in the encoder's own size: one uint8 (size, size, 3)."""
    return [env.image(env.specification.context_camera, encoder.image_size, encoder.image_size, "fast")]
