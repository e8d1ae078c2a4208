"""What may be shown of a text that others wrote: no control character gets to a terminal, and no secret anywhere.

Errors, terminal tables, the outcomes of a journal and the report's page all go through here.
"""

import json
import os
import re
from collections.abc import Iterator
from typing import Any

TOKEN_VARIABLE = "OSEL_SIM_TOKEN"
HIDDEN = "***"

_CONTROL = re.compile(
    "["
    "\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 but tab and newline, DEL, C1: what terminals obey
    "\u202a-\u202e\u2066-\u2069"  # embeddings, overrides and isolates, which turn the order of what follows around
    "\u2028\u2029"  # line ends to some, and none to others
    "\ufffe\uffff"  # no characters: no XML holds them, and a drawing with one ends this process
    "\ud800-\udfff"  # halves of a character, as of file names that are not UTF-8: no output takes them
    "\U000e0000-\U000e007f"  # tags, which nobody sees
    "]"
)
_URL = re.compile(r"(?P<scheme>\b[a-zA-Z][a-zA-Z0-9+.-]*://)(?P<rest>[^\s\"'<>]+)")
_PLACE = re.compile(r"\[.*\]|[^:]*|.*:\d*|.*\]:\d*")
_TRAILING = ":,;.)]}"


def shown(text: str) -> str:
    """A text without control characters and secrets. Ordinary text, with its tabs and newlines, stays as it is; doing it twice changes nothing."""
    return printable(hidden(text))


def printable(text: str) -> str:
    """A text with control characters as visible escapes, such as `\\x1b`."""
    return _CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def escaped(text: str) -> str:
    """JSON of the same value, with control characters written as JSON's own escapes."""
    return _CONTROL.sub(lambda match: json.dumps(match[0])[1:-1], text)


def hidden(text: str) -> str:
    """A text without secrets: who logs in at an address (`user:password@`), its query and fragment, and the token of `OSEL_SIM_TOKEN`."""
    token = os.environ.get(TOKEN_VARIABLE, "")
    if len(token) >= 4 and token in text:
        text = text.replace(token, HIDDEN)
    return _URL.sub(_masked, text) if "://" in text else text


def all_shown(value: Any) -> Any:
    """Plain data with all its texts as `shown`."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, dict):
        return {all_shown(key): all_shown(item) for key, item in value.items()}
    return [all_shown(item) for item in value] if isinstance(value, list | tuple) else value


def unprintable(data: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Key (`table.key`) and text, made printable, of whatever in plain data holds a control character."""
    if isinstance(data, dict):
        for name, value in data.items():
            if _CONTROL.search(name):
                yield printable(f"{key}{name}"), printable(name)
            yield from unprintable(value, f"{key}{name}.")
    elif isinstance(data, list | tuple):
        for value in data:
            yield from unprintable(value, key)
    elif isinstance(data, str) and _CONTROL.search(data):
        yield printable(key.removesuffix(".")), printable(data)


def _masked(match: re.Match[str]) -> str:
    rest = match["rest"]
    place = re.split(r"[/?#]", rest, maxsplit=1)[0]
    cut = place.rfind("@") + 1
    if not cut and not _PLACE.fullmatch(place):
        cut = rest.rfind("@") + 1  # a password with one of /?# in it
    end = next((index for index in range(cut, len(rest)) if rest[index] in "?#"), len(rest))
    trailing = rest[len(rest.rstrip(_TRAILING)) :]
    return match["scheme"] + (f"{HIDDEN}@" if cut else "") + rest[cut:end] + (rest[end] + HIDDEN + trailing if end < len(rest) else "")
