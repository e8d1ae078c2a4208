"""What an encoder is: it turns an instance into its context."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Context = NDArray[np.float32]
Image = NDArray[np.uint8]


class Encoder(Protocol):
    """Turns an instance into its context c = g(x). The same input gives the same bits.

    Attributes:
        name: what `load_encoder` was asked for.
        identity: the name and a digest of the weights where those can change under the same name; keys the context cache.
        dimension: length d of a context.
        image_size: side in pixels of the square image it works on; a larger or smaller one is resized.
    """

    name: str
    identity: str
    dimension: int
    image_size: int

    def encode(self, images: Sequence[Image], instruction: str) -> Context:
        """Context (d,) float32 of one instance, from one or more uint8 (H, W, 3) RGB images and its instruction."""
        ...


@runtime_checkable
class TextEncoder(Encoder, Protocol):
    """One that reads the instruction only, and many at once faster than one after another."""

    def encode_texts(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Contexts (n, d) of instructions, in one batch: the last bits of each may depend on the others."""
        ...
