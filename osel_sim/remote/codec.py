"""Bytes <-> dicts with numpy arrays: msgpack in openpi's wire form.

An array travels as the map `{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [..]}` and a numpy scalar as
`{b"__npgeneric__": True, b"data": number, b"dtype": "<f4"}` (openpi_client.msgpack_numpy). Nothing of a frame is trusted: only plain number types,
shapes that agree with the bytes that are there, and containers of a bounded size are read. No pickle, no object arrays.
"""

import math
from typing import Any

import msgpack  # type: ignore[import-untyped,unused-ignore]
import numpy as np

from osel_sim.core.errors import RemoteError

DTYPES = {name: np.dtype(name) for name in ("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")}
NAMES = {dtype: name for name, dtype in DTYPES.items()}
MAX_DIMENSIONS = 8
MAX_ITEMS = 4096  # of a list or map; numbers in bulk travel as arrays
MAX_STRING = 1 << 16


class ProtocolError(RemoteError):
    """A frame that is not what the protocol says."""


def pack(message: Any) -> bytes:
    """One frame.

    Raises:
        ProtocolError: the message holds something that has no wire form.
    """
    try:
        packed: bytes = msgpack.packb(message, default=_to_wire)
    except (TypeError, ValueError, OverflowError) as error:
        raise ProtocolError(f"cannot be sent: {error}") from None
    return packed


def unpack(frame: bytes | memoryview) -> Any:
    """The message of one frame. Its arrays are read-only, and share no memory with the frame.

    Raises:
        ProtocolError: saying what is wrong with it.
    """
    try:
        return msgpack.unpackb(
            frame,
            object_hook=_from_wire,
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
            max_str_len=MAX_STRING,
            max_bin_len=len(frame),
            max_ext_len=0,
        )
    except ProtocolError:
        raise
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise ProtocolError(f"not a msgpack frame ({str(error) or type(error).__name__})") from None


def _to_wire(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, (np.ndarray, np.generic)):
        raise TypeError(f"{type(value).__name__} has no wire form")
    name = NAMES.get(value.dtype)
    if name is None:
        raise TypeError(f"dtype {value.dtype} has no wire form")
    if isinstance(value, np.ndarray):
        data = value.data if value.flags.c_contiguous else value.tobytes()
        return {b"__ndarray__": True, b"data": data, b"dtype": name, b"shape": value.shape}
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": name}


def _from_wire(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return _array(_dtype(value), value.get(b"data"), value.get(b"shape"))
    if b"__npgeneric__" in value:
        data = value.get(b"data")
        if not isinstance(data, bool | int | float):
            raise ProtocolError(f"a numpy scalar must hold a number, got {type(data).__name__}")
        with np.errstate(over="ignore"):  # becomes infinity, which whoever reads it refuses
            return _dtype(value).type(data)
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    name = value.get(b"dtype")
    if not isinstance(name, str) or name not in DTYPES:
        raise ProtocolError(f"dtype {str(name)[:40]!r} is not allowed; allowed: {', '.join(sorted(DTYPES))}")
    return DTYPES[name]


def _array(dtype: np.dtype[Any], data: Any, shape: Any) -> np.ndarray[Any, Any]:
    if not isinstance(data, bytes):
        raise ProtocolError(f"an array's data must be bytes, got {type(data).__name__}")
    if type(shape) is not list or len(shape) > MAX_DIMENSIONS or not all([type(size) is int and 0 <= size < 1 << 31 for size in shape]):
        raise ProtocolError(f"an array's shape must be at most {MAX_DIMENSIONS} non-negative integers, got {str(shape)[:60]}")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ProtocolError(f"an array of shape {tuple(shape)} and dtype {dtype.str} has {math.prod(shape) * dtype.itemsize} bytes, got {len(data)}")
    return np.ndarray(shape, dtype, data)
