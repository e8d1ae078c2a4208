"""The moments of a recording: on disk as soon as their instance is there (`moments.jsonl`), and a table when all are."""

import base64
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.episodes.moments import Cuts, Moments
from osel_sim.formats.journal import Lines
from osel_sim.formats.moments import MOMENTS, SIGNALS, MomentRow, Seen, moment_row, read_moments, write_moments
from osel_sim.formats.toml_types import quoted

MOMENT_SHARDS = "moments.jsonl"

OfEpisode = tuple[str, str, int]
"""Instance, first policy, repeat."""


class MomentRecording:
    """What a folder holds of moments: in its table, if it has that already, and in the shards beside it.

    A line of the shards is one episode. It is written before the episode itself is: an episode that is there has its moments.

    Raises:
        DataError: what is there is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._there: dict[OfEpisode, Moments] = _of_table(folder) if (folder / MOMENTS).exists() else {}
        self._lines: Lines | None = None
        if (folder / MOMENT_SHARDS).exists():
            self._open()

    def add(self, moments: Mapping[OfEpisode, Moments]) -> None:
        """Take in episodes, and wait until they are on disk."""
        lines = self._lines or self._open()
        for (instance, first, repeat), own in moments.items():
            rows = [vars(row) for row in own.rows]
            seen = {"pictures": _text(own.pictures, "<f4"), "signals": _text(own.signals, "<f8")}
            lines.append({"instance": instance, "first": first, "repeat": repeat, "rows": rows, **seen})
        self._there |= moments

    def finish(self, episodes: Iterable[OfEpisode], cuts: Cuts, metadata: Mapping[str, Any]) -> None:
        """Turn what is there into the table.

        Args:
            episodes: of the plan, in order; those without moments may be among them.
            metadata: of the table, besides how episodes were cut.
        """
        if (self._folder / MOMENTS).exists():
            # The table's two files change one after the other. Until both have, the shards hold what the old ones held.
            self.add(dict(self._there))
            (self._folder / MOMENTS).unlink()
        found = [self._there[episode] for episode in episodes if episode in self._there and self._there[episode].rows]
        width = found[0].pictures.shape[1] if found else 0
        pictures = np.concatenate([np.zeros((0, width), np.float32), *(own.pictures for own in found)])
        signals = np.concatenate([np.zeros((0, len(SIGNALS))), *(own.signals for own in found)])
        rows = [row for own in found for row in own.rows]
        write_moments(self._folder, rows, Seen(pictures, signals), {**metadata, "every": cuts.every, "most": cuts.most})
        if self._lines is not None:
            self._lines.close()
            self._lines.file.unlink(missing_ok=True)
            self._lines = None

    def _open(self) -> Lines:
        self._lines = Lines(self._folder / MOMENT_SHARDS)
        for number, (data, _) in enumerate(self._lines.rows, 1):
            place = f"{self._lines.file}, line {number}"
            self._there |= _read(data, place)
        self._lines.rows.clear()
        return self._lines


def _of_table(folder: Path) -> dict[OfEpisode, Moments]:
    """The moments of a table, by episode."""
    table = read_moments(folder)
    rows, numbers = dict[OfEpisode, list[MomentRow]](), dict[tuple[str, str, int, int], int]()
    for row in table.rows:
        rows.setdefault(row.moment[:3], []).append(row)
        numbers.setdefault(row.moment, len(numbers))
    result = {}
    for episode, own in rows.items():
        at = [numbers[moment] for moment in dict.fromkeys(row.moment for row in own)]
        result[episode] = Moments(tuple(own), table.seen.pictures[at], table.seen.signals[at])
    return result


def _read(data: Mapping[str, Any], place: str) -> dict[OfEpisode, Moments]:
    """One line of the shards."""
    if set(data) != {"instance", "first", "repeat", "rows", "pictures", "signals"} or not isinstance(data["rows"], list):
        raise DataError(f"{place}: not the moments of an episode, got {quoted(sorted(data))}")
    rows = tuple(moment_row(row, place) for row in data["rows"])
    episode = (data["instance"], data["first"], data["repeat"])
    if any(row.moment[:3] != episode for row in rows):
        raise DataError(f"{place}: not the moments of an episode: a row is of another one than {quoted(list(episode))}")
    moments = len({row.moment for row in rows})
    pictures, signals = _array(data["pictures"], "<f4", moments, place), _array(data["signals"], "<f8", moments, place)
    if signals.shape[1] != len(SIGNALS) or not np.isfinite(pictures).all():
        raise DataError(f"{place}: not the moments of an episode: {moments} of them need finite pictures and {len(SIGNALS)} signals each")
    return {episode: Moments(rows, pictures.astype(np.float32), signals.astype(np.float64))}


def _text(array: NDArray[Any], kind: str) -> str:
    return base64.b64encode(array.astype(kind).tobytes()).decode()


def _array(text: Any, kind: str, rows: int, place: str) -> NDArray[Any]:
    """An array (rows, d) that `_text` wrote."""
    try:
        values = np.frombuffer(base64.b64decode(text, validate=True), kind)
        return values.reshape(rows, -1) if rows else np.zeros((0, len(SIGNALS)))
    except (TypeError, ValueError) as error:
        raise DataError(f"{place}: what was seen cannot be read ({error})") from None
