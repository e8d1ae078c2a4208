"""Policies that joined or left a live run while it went on: `events.jsonl`, one change a line, on disk before the decision that it comes before.

A line has its own checksum. The file is there only where something changed; it is written whole or not at all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.core.files import content_digest, write_bytes, write_json
from osel_sim.formats.journal import LOST, read_lines, to_line
from osel_sim.formats.run_config import RUN, read_run
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import COUNT, NAME, TEXTS, Kind, fault

EVENTS = "events.jsonl"
NOTED = "events"
"""Key of `run.json` that repeats what happened, without checksums."""

What = Literal["add", "retire"]
_KINDS = {
    "before": COUNT,
    "event": Kind(f"one of {', '.join(get_args(What))}", lambda value: value in get_args(What)),
    **{"policy": NAME, "content": TEXTS, "checksum": NAME},
}


@dataclass(frozen=True)
class PolicyChange:
    """One policy joined or left.

    Attributes:
        before: index of the first decision that is made with it.
        event: which of the two.
        content: of one that joined, digests of its files, as `run.json` has them of the others.
    """

    before: int
    event: What
    policy: str
    content: Mapping[str, str | None]

    @property
    def words(self) -> str:
        """In words: `remote_large joins before decision 60`."""
        return f"{self.policy} {'joins' if self.event == 'add' else 'retires'} before decision {self.before}"

    def to_dict(self) -> dict[str, Any]:
        """As the file has it, without the checksum."""
        return {**asdict(self), "content": dict(self.content)}


def read_changes(folder: Path, initial: Sequence[str]) -> tuple[PolicyChange, ...]:
    """The changes of a live run's folder in their order; none where the file is not there.

    Args:
        initial: policies that the run began with.

    Raises:
        DataError: naming file and line: damaged, out of order, or one that cannot be, such as a policy that leaves twice.
    """
    file = folder / EVENTS
    found: list[PolicyChange] = []
    for number, (data, raw) in enumerate(read_lines(file), 1):
        place = f"{file}, line {number}"
        if problem := fault(data, _KINDS):
            raise DataError(f"{place}: not a change of policies ({problem})")
        rest = {key: value for key, value in data.items() if key != "checksum"}
        if raw != _line(rest):
            raise DataError(f"{place}: is not what was written (it has its own checksum)")
        change = PolicyChange(**rest)
        if found and change.before < found[-1].before:
            raise DataError(f"{place}: before must be {found[-1].before} or more, that of the line above, got {change.before}")
        try:
            check_change(change, available(initial, found))
        except UsageError as error:
            raise DataError(f"{place}: {error}") from None
        found.append(change)
    if file.exists() and not file.read_bytes().endswith(b"\n") and file.stat().st_size:
        raise DataError(f"{file}: its last line is cut off; it is written whole or not at all")
    if len(found) < len(noted := _noted(folder)):
        raise DataError(f"{file} has {len(found)} lines, {RUN} beside it names {len(noted)} events: {LOST}")
    return tuple(found)


def write_changes(folder: Path, changes: Sequence[PolicyChange]) -> None:
    """Write all changes of a run, at once or not at all, and note them in `run.json`.

    Raises:
        DataError: its `run.json` cannot be read.
    """
    write_bytes(folder / EVENTS, b"".join(_line(change.to_dict()) for change in changes), sync=True)
    note_changes(folder, changes)


def note_changes(folder: Path, changes: Sequence[PolicyChange]) -> None:
    """Name the changes in `run.json`, where it does not name them yet: a run may have been killed in between."""
    told = [{"before": change.before, "event": change.event, "policy": change.policy} for change in changes]
    if told != _noted(folder):
        write_json(folder / RUN, read_run(folder) | {NOTED: told})


def check_change(change: PolicyChange, there: Sequence[str]) -> None:
    """Refuse a change that cannot be made.

    Args:
        there: policies that are available before it.

    Raises:
        UnknownNameError: a policy is to leave that is not there.
        UsageError: one is to join that is there, or the last one is to leave.
    """
    if change.event == "add" and change.policy in there:
        raise UsageError(f"policy {change.policy!r} is already among those to choose from ({', '.join(there)}): it cannot join once more")
    if change.event == "retire" and change.policy not in there:
        raise UnknownNameError("policy", change.policy, there, "the policies to choose from")
    if change.event == "retire" and len(there) == 1:
        raise UsageError(f"policy {change.policy!r} is the last one to choose from: add another before it retires")


def available(initial: Sequence[str], changes: Sequence[PolicyChange], index: int | None = None) -> tuple[str, ...]:
    """Policies to choose from in a decision, in the order that a selector has them; None: after all changes."""
    there = list(initial)
    for change in changes:
        if index is not None and change.before > index:
            break
        if change.event == "add":
            there.append(change.policy)
        else:
            there.remove(change.policy)
    return tuple(there)


def ever(initial: Sequence[str], changes: Sequence[PolicyChange]) -> tuple[str, ...]:
    """All policies that the run has had, in the order in which they first joined."""
    return tuple(dict.fromkeys([*initial, *(change.policy for change in changes)]))


def _line(data: Mapping[str, Any]) -> bytes:
    return to_line({**data, "checksum": content_digest(to_line(dict(data)).encode())[:16]}).encode()


def _noted(folder: Path) -> list[Any]:
    noted = read_run(folder).get(NOTED, []) if (folder / RUN).is_file() else []
    if not isinstance(noted, list):
        raise DataError(f"{folder / RUN}: {NOTED} must be a list, got {quoted(noted)}")
    return noted
