"""What a monitor saw in a live run: `points.jsonl`, a line for each decision of the journal with the decision points of its episode.

Told the lines again, a monitor is what it was when the run was cut off. Pictures are float32, little-endian, in Base64.
"""

import base64
import binascii
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from osel_sim.core.errors import DataError
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import AMOUNT, COUNT, NAME, PROPENSITIES, SHARE, TEXT, Kind, fault, only
from osel_sim.interface.monitor import DecisionPoint, Picture, Told, Turn

POINTS = "points.jsonl"
VERSION = 1
"""Of the form of its lines."""

_LINE = {
    "version": only(VERSION),
    "index": COUNT,
    "points": Kind("a list of objects", lambda value: isinstance(value, list) and all(isinstance(item, dict) for item in value)),
}
_SIGNALS = {
    **{"call": COUNT, "step": COUNT, "seconds": AMOUNT, "price": AMOUNT, "time_used": SHARE, "driver": NAME},
    **{"overlap": AMOUNT.or_null, "moved": AMOUNT.or_null},
}
_LOOKED = {
    "picture": TEXT.or_null,
    "changes": Kind(
        "a list of at most one number in [0, 1] or null",
        lambda value: isinstance(value, list) and len(value) <= 1 and all(item is None or SHARE.fits(item) for item in value),
    ),
    "differences": Kind(
        "an object of numbers", lambda value: isinstance(value, dict) and all(item is None or AMOUNT.fits(item) for item in value.values())
    ),
}
_TURN = {"policy": NAME, "why": TEXT, "propensities": PROPENSITIES.or_null}


@dataclass(frozen=True)
class Points:
    """The decision points of one decision's episode, and who drove on from each."""

    index: int
    points: tuple[DecisionPoint, ...]
    turns: tuple[Turn, ...]

    def to_dict(self) -> dict[str, Any]:
        """As the file has it."""
        rows = [_row(point, turn) for point, turn in zip(self.points, self.turns, strict=True)]
        return {"version": VERSION, "index": self.index, "points": rows}


def to_points(data: dict[str, Any], index: int, file: Path, policies: Sequence[str], instruction: str) -> Points:
    """Check one line.

    Args:
        index: of the decision it must be of.
        policies: of the run.
        instruction: of the decision's instance.

    Raises:
        DataError: naming file and line.
    """
    place = f"{file}, line {index + 1}: not decision points"
    if problem := fault(data, _LINE):
        raise DataError(f"{place} ({problem})")
    if data["index"] != index:
        raise DataError(f"{file}, line {index + 1}: index must be {index}, got {data['index']}")
    points, turns = [], []
    for number, row in enumerate(data["points"]):
        if problem := fault(row, {**_SIGNALS, **_LOOKED, **_TURN}):
            raise DataError(f"{place} (point {number}: {problem})")
        named = {row["driver"], row["policy"], *row["differences"], *(row["propensities"] or {})}
        if wrong := named - set(policies):
            raise DataError(f"{place} (point {number}: {quoted(min(wrong))} is no policy of the run, which has {', '.join(policies)})")
        picture = None if row["picture"] is None else _picture(row["picture"], f"{place} (point {number}: picture")
        told = Told(picture, tuple(row["changes"]), row["differences"])
        points.append(DecisionPoint(**{name: row[name] for name in _SIGNALS}, instruction=instruction, look=told))
        turns.append(Turn(**{name: row[name] for name in _TURN}))
    return Points(index, tuple(points), tuple(turns))


def _row(point: DecisionPoint, turn: Turn) -> dict[str, Any]:
    told = point.look
    if not isinstance(told, Told):
        raise TypeError("what is written down of a decision point is what was looked at")
    picture = None if told.picture_then is None else base64.b64encode(told.picture_then.astype("<f4").tobytes()).decode()
    looked = {"picture": picture, "changes": list(told.changes), "differences": dict(told.differences)}
    propensities = None if turn.propensities is None else dict(turn.propensities)
    return {
        **{name: getattr(point, name) for name in _SIGNALS},
        **looked,
        **{"policy": turn.policy, "why": turn.why, "propensities": propensities},
    }


def _picture(text: str, place: str) -> Picture:
    try:
        picture: Picture = np.frombuffer(base64.b64decode(text, validate=True), "<f4").astype(np.float32)
    except (binascii.Error, ValueError) as error:
        raise DataError(f"{place} is no Base64 of float32: {error})") from None
    if not len(picture) or not np.isfinite(picture).all():
        raise DataError(f"{place} is not all finite numbers)")
    return picture
