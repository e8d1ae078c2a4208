"""The journal of a live run: `episodes.jsonl`, one decision a line, on disk before the next decision starts.

A process killed in the middle of a write leaves at most one torn last line, which is dropped when the journal is opened again. Keys stand in the
order of the dataclass and floats in Python's shortest exact form, so that equal decisions are equal bytes.
"""

import contextlib
import dataclasses
import itertools
import json
import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.core.files import content_digest
from osel_sim.core.shown import escaped
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import DECISION, fault
from osel_sim.interface.instance import instance_key, label
from osel_sim.interface.outcome import Monitored, Outcome, Seconds

logger = logging.getLogger(__name__)
JOURNAL, TIMING = "episodes.jsonl", "timing.jsonl"
LOST = "the journal lost decisions; put it back, or give another folder with --out"
"""What a journal is told that is shorter than what lies beside it."""

OPTIONAL = ("robot", "fallback_steps", "scene", "monitored")
"""Fields of a decision that are not written down where they are None."""
SEEDS_PER_RUN = 1_000_000
"""Decision t of run seed s is made on the instance of seed s * 1,000,000 + t: no two runs share an instance."""


@dataclass(frozen=True)
class Decision:
    """One decision and what came of it.

    Attributes:
        index: 0, 1, 2 ... without gaps.
        propensities: probability of each policy when this one was chosen.
        reward: None when the outcome is an error; nothing is learnt from it then.
        robot: the robot's name, None for the usual one: then it is not written down, as `fallback_steps` is not where no fallback took over.
        scene: digest of how the scene was set up, with the instruction; not written down where nobody told.
        monitored: handoffs, duty and price by policy; not written down where no monitor watched.
        Others: of the instance and of `Outcome`.
    """

    index: int
    task: str
    seed: int
    level: int
    axes: str | None
    split: str
    instruction: str
    phrasing: str
    target: str
    container: str
    policy: str
    propensities: dict[str, float]
    success: bool
    subgoals: float
    steps: int
    seconds: Seconds
    calls: int
    actions: int
    price: float
    reward: float | None
    fallback: str | None
    error: str | None
    robot: str | None = None
    fallback_steps: int | None = None
    scene: str | None = None
    monitored: Monitored | None = None

    def to_dict(self) -> dict[str, Any]:
        """As the journal has it."""
        data = dataclasses.asdict(self)
        data["monitored"] = None if self.monitored is None else self.monitored.to_dict()
        return {key: value for key, value in data.items() if value is not None or key not in OPTIONAL}

    @property
    def instance(self) -> str:
        """Key of its instance."""
        return instance_key(self.task, self.split, label(self.level, self.axes), self.seed, self.robot)

    @property
    def outcome(self) -> Outcome:
        """What came of it, without what it was about."""
        return Outcome(**{field.name: getattr(self, field.name) for field in dataclasses.fields(Outcome)})

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Decision":
        """Raises TypeError or KeyError if a field is missing or unknown."""
        monitored = {"monitored": Monitored.from_dict(data["monitored"])} if data.get("monitored") is not None else {}
        return cls(**{**data, "seconds": Seconds(**data["seconds"]), **monitored})


def to_line(data: dict[str, Any]) -> str:
    """One line of JSON, keys in the order given, floats exact.

    Raises:
        ValueError: a NaN or infinity, which JSON does not have.
    """
    return escaped(json.dumps(data, allow_nan=False, ensure_ascii=False, separators=(", ", ": "))) + "\n"


def as_read(data: dict[str, Any], place: str) -> dict[str, Any]:
    """Data as its line will be read again.

    Raises:
        DataError: naming the place, of what no line of JSON holds.
    """
    try:
        return dict(json.loads(to_line(data)))
    except (ValueError, TypeError) as error:
        raise DataError(f"{place}: cannot be written ({error})") from None


class Lines:
    """An append-only file of JSON lines, each flushed to disk before `append` returns.

    Args:
        keep: drop all lines after the first so many (None: keep all whole ones).
        mend: a line that is no JSON ends what is kept, with a warning, instead of being refused: for files that no result depends on.
    """

    def __init__(self, file: Path, keep: int | None = None, mend: bool = False) -> None:
        self.file = file
        self.rows: list[tuple[dict[str, Any], bytes]] = []
        try:
            for row in itertools.islice(read_lines(file), keep):
                self.rows.append(row)
        except DataError as error:
            if not mend:
                raise
            logger.warning("%s; that line and what follows it are dropped", error)
        good = sum(len(raw) for _, raw in self.rows)
        self._handle = file.open("r+b" if file.exists() else "w+b")
        self._handle.truncate(good)  # the torn line of a killed process, and what lies beyond `keep`
        self._handle.seek(good)
        _sync_folder(file.parent)

    def append(self, data: dict[str, Any]) -> None:
        """Write one line and wait until it is on disk."""
        self._handle.write(to_line(data).encode())
        self._handle.flush()
        os.fsync(self._handle.fileno())

    def close(self) -> None:
        """Close the file."""
        self._handle.close()


def read_lines(file: Path) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Each whole line of a JSON lines file with its bytes; a torn last line is passed over, a broken one elsewhere refused.

    Raises:
        DataError: naming file and line.
    """
    try:
        raw = file.read_bytes() if file.exists() else b""
    except OSError as error:
        raise DataError(f"{file} cannot be read ({error.strerror or error})") from None
    *lines, torn = raw.split(b"\n")
    for number, line in enumerate(lines, 1):
        yield _parsed(line, f"{file}, line {number}"), line + b"\n"
    if _continues(torn):
        raise DataError(f"{file}, line {len(lines) + 1}: something follows the decision; a line that was cut off ends before its end")


def check_beside(file: Path, decisions: int, complete: bool = False, going_on: bool = False) -> None:
    """Refuse a file that has a line for each decision, and does not fit the journal beside it.

    Its line is written before the journal's, so a run that was killed leaves it one line longer at most. A journal that is much shorter has lost
    decisions. A run that goes on makes lost ones at its end again, to the same bytes; of an empty journal it would overwrite all that is left.

    Args:
        decisions: of the journal.
        complete: refuse one that is shorter as well.
        going_on: take one that is longer where the journal has decisions.

    Raises:
        DataError: naming the file.
    """
    # What is not needed whole is counted, not read: it may be damaged, and is mended.
    lines = sum(1 for _ in read_lines(file)) if complete else file.read_bytes().count(b"\n") if file.exists() else 0
    if lines > decisions + 1 and not (going_on and decisions):
        raise DataError(f"{file} has {lines} lines, {JOURNAL} beside it {decisions}: {LOST}")
    if complete and lines < decisions:
        raise DataError(f"{file}: line {lines + 1} is missing, which the journal has")


def line_digest(data: dict[str, Any]) -> str:
    """Checksum of a line: what `timing.jsonl` has of each of the lines beside it. Journals are the same bytes without."""
    return content_digest(to_line(data))[:16]


def check_digests(file: Path) -> None:
    """Refuse a file of which a line is another than was written: a flipped bit may leave numbers that are as good as any.

    `timing.jsonl` beside it has the checksums; no result depends on that file, so what it lacks, or has lost, is not checked.

    Raises:
        DataError: naming file and line.
    """
    timing = file.with_name(TIMING)
    if not (file.is_file() and timing.is_file()):
        return
    lines = [raw + b"\n" for raw in file.read_bytes().split(b"\n")[:-1]]
    for raw in timing.read_bytes().split(b"\n"):
        with contextlib.suppress(ValueError, RecursionError, TypeError, KeyError, IndexError):
            row = json.loads(raw)
            index, digest = row["index"], row["checksums"][file.name]
            differs = index >= 0 and content_digest(lines[index])[:16] != digest
            if differs:
                raise DataError(f"{file}, line {index + 1}: is not what was written ({TIMING} has its checksum)")


def to_decision(data: dict[str, Any], index: int, file: Path) -> Decision:
    """Check one line.

    Raises:
        DataError: naming file and line.
    """
    place = f"{file}, line {index + 1}"
    if problem := fault(data, DECISION, optional=OPTIONAL):
        raise DataError(f"{place}: not a decision ({problem})")
    decision = Decision.from_dict(data)
    if decision.index != index:
        raise DataError(f"{place}: index must be {index}, got {decision.index}")
    if decision.policy not in decision.propensities:
        raise DataError(f"{place}: {quoted(decision.policy)} is no policy of the run, or has no propensity")
    if (decision.reward is None) != (decision.error is not None):
        raise DataError(f"{place}: reward must be {'a number' if decision.error is None else 'null beside an error'}, got {decision.reward}")
    return decision


def read_journal(file: Path) -> list[Decision]:
    """All whole decisions of a journal.

    Raises:
        DataError: the file is missing or not a journal.
    """
    if not file.is_file():
        raise DataError(f"{file} does not exist; a run writes it as {JOURNAL}")
    return [to_decision(data, index, file) for index, (data, _) in enumerate(read_lines(file))]


def _parsed(line: bytes, place: str) -> dict[str, Any]:
    try:
        data = json.loads(line.decode(), object_pairs_hook=_object, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{place}: not JSON ({error})") from None
    if not isinstance(data, dict):
        raise DataError(f"{place}: expected an object, got {type(data).__name__}")
    return data


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is there twice")
    return found


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON")


def _continues(torn: bytes) -> bool:
    """Whether a last line without its end goes on after a whole object: a killed process does not leave that."""
    text = torn.decode(errors="replace")
    try:
        _, end = json.JSONDecoder().raw_decode(text)
    except (ValueError, RecursionError):
        return False
    return end < len(text)


def _sync_folder(folder: Path) -> None:
    """Make a new file's name survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
