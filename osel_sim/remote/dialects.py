"""What servers that are not ours send: msgpack in several dialects, of which only the actions matter.

Arrays travel as maps, in openpi's form or in msgpack-numpy's (which vLLM's servers use as well), with keys that are text or bytes, in either byte
order. Whatever else is in a message does not matter here: what cannot be read of it is passed over, and named only where it should be the actions.
As in `osel_sim.remote.codec` nothing is trusted: no pickle, no object arrays, and nothing larger than the frame that it came in.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import msgpack  # type: ignore[import-untyped,unused-ignore]
import numpy as np

from osel_sim.core.errors import PolicyError
from osel_sim.remote.codec import MAX_DIMENSIONS, ProtocolError

MAX_ITEMS = 1 << 20
MARKS = {"__ndarray__": "dtype", "__npgeneric__": "dtype", "nd": "type"}
"""Key that marks a map as an array or a numpy scalar -> key of its dtype: openpi's, then msgpack-numpy's."""
SHOWN = 10


@dataclass(frozen=True)
class Unreadable:
    """Something that has no meaning here.

    Attributes:
        reason: why.
        size: bytes that it took.
    """

    reason: str
    size: int = 0


def unpack_any(frame: bytes) -> Any:
    """The message of one frame; keys of maps are text, and what cannot be read is an `Unreadable`.

    Raises:
        ProtocolError: it is no msgpack at all.
    """
    try:
        return msgpack.unpackb(
            frame,
            object_pairs_hook=_map,  # no dictionary of keys that a stranger chose, before they are text
            ext_hook=lambda code, data: Unreadable(f"of the extension type {code}", len(data)),
            strict_map_key=False,
            unicode_errors="replace",
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
            max_str_len=len(frame),
            max_bin_len=len(frame),
            max_ext_len=len(frame),
        )
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise ProtocolError(f"not a msgpack frame ({str(error) or type(error).__name__})") from None


def actions_in(reply: Any, key: str) -> Any:
    """The actions of an answer: an array, or lists of numbers.

    Raises:
        PolicyError: there are none under that name, or they cannot be read; says what there is.
    """
    if isinstance(reply, list) and len(reply) == 1:
        reply = reply[0]  # of a batch of one
    if not isinstance(reply, dict):
        raise PolicyError(f"answered without {key} (it is {_words(reply)})")
    if key not in reply:
        raise PolicyError(f"answered without {key} (it has: {_listing(reply) or 'nothing'}); actions under [mapping] says what they are called")
    value = reply[key]
    if isinstance(value, dict):
        raise PolicyError(f"{key} is a map of {_listing(value)}, where one array (T, N) is needed")
    if isinstance(value, list):
        strange = next((item for item in value if isinstance(item, dict | Unreadable | str | bytes)), None)
        if strange is not None:
            raise PolicyError(f"{key} is a list with {_words(strange)} in it, where numbers are needed")
    elif not isinstance(value, np.ndarray):
        raise PolicyError(f"{key} is {_words(value)}, where an array (T, N) is needed")
    return value


def size_of(message: Any) -> int:
    """Bytes of a message, as far as they do not depend on how it was packed."""
    return len(msgpack.packb(message, default=_stand_in))


def _stand_in(value: Any) -> bytes | None:
    if isinstance(value, Unreadable):
        return bytes(value.size)
    return value.tobytes() if isinstance(value, np.ndarray | np.generic) else None


def _map(pairs: Iterable[tuple[Any, Any]]) -> Any:
    value = {key.decode(errors="replace") if isinstance(key, bytes) else str(key): item for key, item in pairs}
    mark = next((name for name in MARKS if name in value), None)
    return value if mark is None else _array(value, mark)


def _array(value: dict[str, Any], mark: str) -> Any:
    """An array or numpy scalar, or why it is none."""
    name, data, shape = value.get(MARKS[mark]), value.get("data"), value.get("shape", [])
    size = len(data) if isinstance(data, bytes | str) else 0
    words = name.decode(errors="replace") if isinstance(name, bytes) else str(name)
    dtype = np.dtype(words) if re.fullmatch(r"[<>|=]?[biuf][0-9]{1,3}|bool|u?int[0-9]{1,2}|float[0-9]{2}", words) and _known(words) else None
    if dtype is None:
        return Unreadable(f"an array of the dtype {words[:40]!r}", size)
    if mark == "__npgeneric__" and isinstance(data, bool | int | float):
        with np.errstate(over="ignore"):
            return dtype.type(data)
    if not isinstance(data, bytes):
        return Unreadable(f"an array whose data is {type(data).__name__}", size)
    if not isinstance(shape, list | tuple) or len(shape) > MAX_DIMENSIONS or not all(type(part) is int and 0 <= part < 1 << 31 for part in shape):
        return Unreadable(f"an array of the shape {str(shape)[:60]}", size)
    if math.prod(shape) * dtype.itemsize != size:
        return Unreadable(f"an array of shape {tuple(shape)} and dtype {dtype.str} in {size} bytes", size)
    return np.frombuffer(data, dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)


def _known(dtype: str) -> bool:
    try:
        return np.dtype(dtype).itemsize > 0
    except TypeError:
        return False


def _listing(value: dict[str, Any]) -> str:
    names = [f"{name[:40]} ({_words(item)})" for name, item in list(value.items())[:SHOWN]]
    return ", ".join([*names, *(["..."] if len(value) > SHOWN else [])])


def _words(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype.name} {value.shape}"
    if isinstance(value, Unreadable):
        return value.reason
    if isinstance(value, dict):
        return f"a map of {', '.join(name[:40] for name in list(value)[:SHOWN])}" if value else "an empty map"
    return {str: "text", list: "a list", type(None): "nothing"}.get(type(value), type(value).__name__)
