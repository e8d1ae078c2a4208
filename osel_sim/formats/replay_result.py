"""What a replay leaves in its folder: `replay.json`, `choices.npz` and tables as CSV.

`replay.json` holds what was measured and the verdict, `choices.npz` every choice of every selector, so that any curve can be derived again with the
rollout log at hand. `replay.json` is written last and names the digest of `choices.npz`: where it is there, the rest is there and belongs to it.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.arrays import read_arrays
from osel_sim.core.csv_text import to_csv
from osel_sim.core.errors import DataError, UsageError
from osel_sim.core.files import content_digest, is_partial, read_json, write_bytes, write_json
from osel_sim.core.interrupts import uninterrupted
from osel_sim.formats.moments_result import MOMENTS_RESULT

SCHEMA_VERSION = 2
"""Version 2 has a verdict of three, with its words; intervals are over units. A replay of version 1 is shown as it was written."""
CHANGING_VERSION = 3
"""Of a replay whose streams change, which has `changes` and no verdict of three."""
READABLE = (1, 2, CHANGING_VERSION)
CHANGES = "changes"
OFF_POLICY_VERSION = 1
REPLAY, CHOICES, OFF_POLICY = "replay.json", "choices.npz", "off_policy.json"
PENDING, FRONTIER, SHARING, BUDGET = "pending", "frontier", "sharing", "budget"
"""Key of `replay.json` while not all is replayed: names of the selectors that are missing, and `budget`, `frontier` and `sharing` where those are."""
_PREFIX = "choice."


@dataclass(frozen=True)
class Choices:
    """Who chose what. S seeds, T decisions, N instances, P policies.

    Attributes:
        instances: (N,) keys of the instances that were streamed.
        policies: (P,) names.
        order: int32 (S, T), index into `instances`: which instance was decided on when.
        repeats: int16 (S, T, P), which repeat's outcome (last axis of `LoggedOutcomes`) counted for each policy; the same for all selectors.
        chosen: selector -> int16 (S, T), index into `policies`.
    """

    instances: tuple[str, ...]
    policies: tuple[str, ...]
    order: NDArray[np.int32]
    repeats: NDArray[np.int16]
    chosen: dict[str, NDArray[np.int16]]

    def outcomes(self, table: NDArray[np.float64]) -> NDArray[np.float64]:
        """What each policy's outcome was in each decision, (S, T, P).

        Args:
            table: (N, P, R) rewards, successes, seconds ... of `instances` (`LoggedOutcomes.take` puts them in this order).
        """
        columns = np.arange(len(self.policies))
        return np.asarray(table[self.order[:, :, None], columns, self.repeats], np.float64)

    def received(self, selector: str, table: NDArray[np.float64]) -> NDArray[np.float64]:
        """What a selector received in each decision, (S, T), of a table as `outcomes` takes it."""
        chosen = self.chosen[selector].astype(np.int64)[:, :, None]
        return np.asarray(np.take_along_axis(self.outcomes(table), chosen, axis=2)[:, :, 0], np.float64)


def check_replay_folder(folder: Path, overwrite: bool) -> None:
    """Refuse an output folder that cannot be used, before any work is done.

    Raises:
        UsageError: a file, a folder with something else in it, or one with a replay in it and `overwrite` off.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is a file; give a folder")
    if any((folder / name).exists() for name in (REPLAY, OFF_POLICY, MOMENTS_RESULT)):
        if not overwrite:
            raise UsageError(f"--out {folder} holds a replay; add --overwrite to replace it, or give another folder")
    elif folder.exists() and any(not is_partial(item) and item.name != CHOICES for item in folder.iterdir()):
        raise UsageError(f"--out {folder} is not empty and holds no {REPLAY}; give a new folder")


def write_replay(folder: Path, result: Mapping[str, Any], choices: Choices, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Write a replay, over one that may be there. Each file is written whole or not at all, `replay.json` last, and Ctrl-C waits until all are.

    Args:
        result: what `replay.json` is to hold besides the schema version and the digest; NaN is not allowed, None is null.
        tables: file name without ending -> rows, each a mapping of the same columns.

    Raises:
        UsageError: the folder cannot be written.
        ValueError: NaN or infinity in `result`.
    """
    content = _npz(choices)
    result = {"schema_version": SCHEMA_VERSION, **result, "choices_sha256": content_digest(content)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with uninterrupted():
            for name, rows in tables.items():
                if rows:
                    write_bytes(folder / f"{name}.csv", _csv(rows))
                else:
                    (folder / f"{name}.csv").unlink(missing_ok=True)
            write_bytes(folder / CHOICES, content)
            write_json(folder / REPLAY, result)
            drop_others(folder, REPLAY)
    except OSError as error:
        raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None


def read_replay(folder: Path) -> tuple[dict[str, Any], Choices]:
    """Read what `write_replay` wrote.

    Raises:
        DataError: missing, damaged, of another schema, or two files that do not belong together.
    """
    if not (folder / REPLAY).is_file():
        raise DataError(f"{folder / REPLAY} does not exist; python -m osel_sim.replay LOG --out {folder} writes it")
    result = read_json(folder / REPLAY)
    if result.get("schema_version") not in READABLE:
        raise DataError(f"{folder / REPLAY}: schema_version must be {' or '.join(map(str, READABLE))}, got {result.get('schema_version')}")
    file = folder / CHOICES
    try:
        content = file.read_bytes()
        if content_digest(content) != result.get("choices_sha256"):
            raise DataError(f"{file} is damaged, or does not belong to the {REPLAY} beside it")
        arrays = read_arrays(file, "choices", content)
        chosen = {key.removeprefix(_PREFIX): array for key, array in arrays.items() if key.startswith(_PREFIX)}
        names = {key: tuple(str(value) for value in arrays[key]) for key in ("instances", "policies")}
        choices = Choices(names["instances"], names["policies"], arrays["order"], arrays["repeats"], chosen)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{file}: not a replay's choices ({' '.join(str(error).split())})") from None
    return result, choices


def write_off_policy(folder: Path, found: Mapping[str, Any]) -> None:
    """Write `off_policy.json`, at once or not at all.

    Raises:
        UsageError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / OFF_POLICY, {"schema_version": OFF_POLICY_VERSION, **found})
        drop_others(folder, OFF_POLICY)
    except OSError as error:
        raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None


def drop_others(folder: Path, own: str) -> None:
    """Remove what a replay of another kind, which this one replaced, left in the folder: a page would be of that."""
    for name in (REPLAY, OFF_POLICY, MOMENTS_RESULT):
        if name != own:
            (folder / name).unlink(missing_ok=True)


def _npz(choices: Choices) -> bytes:
    arrays: dict[str, NDArray[Any]] = {
        "instances": np.array(choices.instances, np.str_),
        "policies": np.array(choices.policies, np.str_),
        "order": choices.order.astype(np.int32),
        "repeats": choices.repeats.astype(np.int16),
        **{_PREFIX + name: chosen.astype(np.int16) for name, chosen in choices.chosen.items()},
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    headings = list(rows[0]) if rows else []
    return to_csv([headings, *([row.get(key) for key in headings] for row in rows)]).encode() if rows else b""
