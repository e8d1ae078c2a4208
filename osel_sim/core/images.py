"""Images of others as arrays: one decoder for tables, datasets and demonstrations, so that all of them see the same pixels."""

import functools
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError

MOST_PIXELS = 89_478_485
"""Pillow's own limit: larger images are taken for decompression bombs."""
_WIDE = ("I", "F")
"""Beginnings of Pillow's modes for more than 8 bits a channel: what is black and what is white is not known of them."""


def load_image(source: Path | bytes, where: str) -> NDArray[np.uint8]:
    """An image file, or its bytes, as uint8 (H, W, 3) RGB, turned as its EXIF tag says.

    Grey becomes RGB of three equal channels; transparency is dropped.

    Args:
        where: what the error begins with: file, row and column of a table, or file, frame and column of a dataset.

    Raises:
        DataError: it is missing, no image, too large, or has more than 8 bits a channel.
    """
    pillow, ops = _pillow()
    name = f"image {source}" if isinstance(source, Path) else "the image"
    try:
        with pillow.open(source if isinstance(source, Path) else io.BytesIO(source)) as image:
            if image.width * image.height > MOST_PIXELS:
                raise DataError(_too_large(where, name, f"{image.width * image.height} pixels"))
            if image.mode.startswith(_WIDE):
                raise DataError(
                    f"{where}: {name} has more than 8 bits a channel (mode {image.mode!r}); save it with 8, scaled to the range that matters"
                )
            upright = ops.exif_transpose(image)
            if "transparency" in upright.info:
                upright = upright.convert("RGBA")  # Pillow warns of palettes with transparency otherwise
            return np.asarray(upright.convert("RGB"), np.uint8)
    except (pillow.DecompressionBombError, pillow.DecompressionBombWarning) as error:
        pixels = re.search(r"\d+ pixels", str(error))
        raise DataError(_too_large(where, name, pixels[0] if pixels else "a decompression bomb")) from None
    # Pillow says SyntaxError for a broken PNG, and others for broken chunks of any format.
    except (OSError, ValueError, SyntaxError, EOFError, IndexError, KeyError, TypeError, OverflowError, MemoryError, ZeroDivisionError) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"{where}: {name} cannot be read ({_without_object(reason)})") from None


def _too_large(where: str, name: str, size: str) -> str:
    return f"{where}: {name} is too large ({size}, at most {MOST_PIXELS}); save a smaller one"


def _without_object(reason: str) -> str:
    """Pillow names the object in memory that an image's bytes are read from, which tells nobody anything."""
    return "its bytes are no image that is known" if "BytesIO" in reason else reason


@functools.cache
def _pillow() -> tuple[Any, Any]:
    """Pillow, with its warning of large images as an error: it decodes them otherwise."""
    import warnings

    from PIL import Image, ImageOps

    warnings.filterwarnings("error", category=Image.DecompressionBombWarning)
    return Image, ImageOps
