"""Rows of an outcome table as rows of the rollout log."""

import contextlib
import math
from collections.abc import Callable, Collection, Iterable, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from osel_sim.context.names import TASK
from osel_sim.core.errors import DataError, did_you_mean
from osel_sim.formats.rollout_log import Row
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.columns import NUMBERS, UNITS, Columns, PolicyColumns, Success, Term, fill, threshold
from osel_sim.ingestion.records import Record, listed, number, price, text
from osel_sim.ingestion.units import with_unit

_TRUE, _FALSE = ("true", "yes", "y", "t", "1", "1.0"), ("false", "no", "n", "f", "0", "0.0")
_LONGEST = 2**53
"""Integers beyond this are not exact in the numbers that tables hold, nor are they steps or repeats of anything."""
_WAITING = ("upload", "inference", "download")
_COUNTS: dict[str, Callable[[str], int]] = {"characters": len, "words": lambda value: len(value.split())}


@dataclass(frozen=True)
class Source:
    """What an instance's context is made from.

    Attributes:
        images: files, in order.
        context: values of the columns that are part of the context.
        record: where it was read first.
    """

    key: str
    task: str
    text: str
    images: tuple[Path, ...]
    context: tuple[str | float | None, ...]
    record: Record


@dataclass(frozen=True)
class Converted:
    """A table as a rollout log.

    Attributes:
        rows: in the order instance, policy, repeat.
        sources: an entry for each instance, in the order of the table.
        policies: names in the log, in the order in which they are named, or of their appearance.
        dropped: rows that were left out as duplicates.
        differing: those of them whose outcome is another than that of the row that was kept.
        propensities: of each row, with which probability its policy was chosen; None where the table does not say.
    """

    rows: list[Row]
    sources: list[Source]
    policies: list[str]
    dropped: int
    differing: int
    propensities: list[float] | None


def convert(columns: Columns, records: Sequence[Record]) -> Converted:
    """The outcomes that a table holds.

    An empty cell of success means that the policy did not run on the instance: no row comes of it.

    Raises:
        DataError: a cell, row or policy that is not as `columns` says; names file, row and column.
    """
    columns = with_unit(columns, records)
    sources: dict[str, Source] = {}
    outcomes: dict[tuple[str, str, int], tuple[Row, Record]] = {}
    keys: dict[tuple[Any, ...], str] = {}
    counters: dict[str, int] = {}
    propensities: dict[tuple[str, str, int], float] = {}
    names = {policy.name: None for policy in columns.policies.values()}
    dropped = differing = 0
    for record in records:
        source, known = _source(columns, record, sources, keys, counters)
        if columns.policy is None:
            if known and columns.repeat is None and columns.duplicates in ("refuse", "drop"):
                if columns.duplicates == "refuse":
                    raise _duplicate(columns, record, sources[source.key].record, f"instance {quoted(source.key)}")
                dropped += 1
                kept = [outcomes.get((source.key, policy.name, 0)) for policy in columns.policies.values()]
                again = [_row(columns, record, source, policy, 0) for policy in columns.policies.values()]
                differing += [row and _outcome(row) for row in again] != [pair and _outcome(pair[0]) for pair in kept]
                continue
            policies = list(columns.policies.values())
        else:
            policies = [_policy(columns, record, names)]
            names.setdefault(policies[0].name)
        sources.setdefault(source.key, source)
        repeat = _repeat(columns, record)
        for policy in policies:
            row = _row(columns, record, source, policy, repeat or 0)
            if row is None:
                continue
            place = (source.key, policy.name, row.repeat)
            if place in outcomes and columns.repeat is None and columns.duplicates == "repeats":
                place = (*place[:2], next(count for count in range(1, len(records)) if (*place[:2], count) not in outcomes))
                row = Row(**{**vars(row), "repeat": place[2]})
            if place in outcomes:
                if columns.duplicates != "drop":
                    what = f"instance {quoted(source.key)}, policy {quoted(policy.name)}, repeat {row.repeat}"
                    raise _duplicate(columns, record, outcomes[place][1], what)
                dropped += 1
                differing += _outcome(row) != _outcome(outcomes[place][0])
                continue
            outcomes[place] = row, record
            if columns.propensity is not None:
                propensities[place] = _propensity(record, columns.propensity)
    _check_all_ran(names, {policy for _, policy, _ in outcomes}, records[0].file)
    order = {key: index for index, key in enumerate(sources)}, {name: index for index, name in enumerate(names)}
    places = sorted(outcomes, key=lambda place: (order[0][place[0]], order[1][place[1]], place[2]))
    with_outcome = {place[0] for place in places}
    used = [source for key, source in sources.items() if key in with_outcome]
    chances = None if columns.propensity is None else [propensities[place] for place in places]
    return Converted([outcomes[place][0] for place in places], used, list(names), dropped, differing, chances)


def _check_all_ran(names: Iterable[str], ran: Set[str], file: Path) -> None:
    """Refuse a policy without any outcome."""
    for name in names:
        if name not in ran:
            raise DataError(f"{file}: policy {quoted(name)} has no outcome in any row")


def _source(
    columns: Columns, record: Record, sources: dict[str, Source], keys: dict[tuple[Any, ...], str], counters: dict[str, int]
) -> tuple[Source, bool]:
    """The instance of a row, and whether an earlier row had it."""
    task = fill(columns.group, lambda column: text(record, column)) if columns.group else columns.name
    words = fill(columns.text, lambda column: text(record, column))
    images = tuple(_image(record, column) for column in columns.images)
    context = tuple(task if column == TASK else _context_value(record, column) for column in columns.context)
    identity = (task, fill(columns.key, lambda column: text(record, column))) if columns.key else (task, words, images)
    known = identity in keys
    each_is_one = columns.propensity is not None or (columns.duplicates == "keep" and columns.policy is None)
    if known and not each_is_one:
        first = sources[keys[identity]]
        other = f"row {first.record.number} of {first.record.file}"
        if (first.text, first.images) != (words, images):
            raise DataError(f"{record.where}: instance {quoted(first.key)} has another text or image here than in {other}")
        for column, now, then in zip(columns.context, context, first.context, strict=True):
            if now != then:
                raise record.error(column, f"is {quoted(now)} here, of the same instance ({quoted(first.key)}) it is {quoted(then)} in {other}")
        return first, True
    if known and columns.key:
        raise _duplicate(columns, record, sources[keys[identity]].record, f"instance {quoted(keys[identity])}")
    counters[task] = counters.get(task, 0) + 1
    key = f"{task}/{identity[1] if columns.key else format(counters[task], '06d')}"
    keys[identity] = key
    return Source(key, task, words, images, context, record), False


def _context_value(record: Record, column: str) -> str | float | None:
    """A number where it can be read as one, else a text; None where there is nothing."""
    value = record.values[column]
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    with contextlib.suppress(DataError):
        return number(record, column)
    return text(record, column)


def _image(record: Record, column: str) -> Path:
    """The file of an image; a path is relative to the table that names it."""
    value = record.values[column]
    if value is not None and not isinstance(value, str):
        raise record.error(column, f"must be the path of an image file, got {quoted(value)}; write images into files and name these")
    return record.file.parent / text(record, column)


def _policy(columns: Columns, record: Record, names: Collection[str]) -> PolicyColumns:
    """The policy that a row of a long table is about; `names` are those of earlier rows."""
    column = columns.policy or ""  # only called for long tables
    name = text(record, column)
    if name in columns.policies:
        return columns.policies[name]
    if columns.default is None:
        where = "--policies" if columns.from_flags else str(columns.file)
        near = did_you_mean(name[:200], columns.policies)
        raise record.error(column, f"unknown policy {quoted(name)}: {near}known: {listed(sorted(columns.policies))} ({where})")
    alike = None if name in names else next((other for other in names if _plain(other) == _plain(name)), None)
    if alike is not None:
        way = "after --policies" if columns.from_flags else "as [policies.NAME]"
        raise record.error(
            column, f"policy {quoted(name)} and {quoted(alike)} differ only in capitals or spaces; write both alike, or name all policies {way}"
        )
    return replace(columns.default, name=name)


def _plain(name: str) -> str:
    return " ".join(name.casefold().split())


def _repeat(columns: Columns, record: Record) -> int | None:
    if columns.repeat is None:
        return None
    value = number(record, columns.repeat)
    if value is None or not 0 <= value <= _LONGEST or value != int(value):
        raise record.error(columns.repeat, f"must be an integer in [0, 2^53], got {quoted(record.values[columns.repeat])}")
    return int(value)


def _propensity(record: Record, column: str) -> float:
    value = number(record, column)
    if value is None or not 0.0 < value <= 1.0:
        shown = "nothing" if value is None else quoted(record.values[column])
        raise record.error(column, f"must be the probability, in (0, 1], with which the row's policy was chosen, got {shown}")
    return value


def _row(columns: Columns, record: Record, source: Source, policy: PolicyColumns, repeat: int) -> Row | None:
    error = text(record, policy.error) if policy.error is not None and record.values[policy.error] is not None else None
    success = False if error is not None else _success(columns, record, policy.success)
    if success is None:
        return None
    numbers: dict[str, float | None] = {}
    if error is None:
        for name, terms in policy.numbers.items():
            numbers[name] = _number(record, policy, name, terms)
    if any(name in numbers for name in _WAITING):
        # The three are parts of one wait: what the table does not tell apart is not waited for twice.
        numbers = {**dict.fromkeys(_WAITING, 0.0), **numbers}
    labels = {label: text(record, column) for label, column in columns.labels.items()}
    steps = numbers.pop("steps", None)
    return Row(
        task=source.task,
        instance=source.key,
        seed=None,
        level=None,
        split=labels.get("split"),
        instruction=source.text,
        phrasing=labels.get("phrasing"),
        target=labels.get("target"),
        container=labels.get("container"),
        policy=policy.name,
        repeat=repeat,
        success=success,
        subgoals=numbers.get("subgoals"),
        steps=None if steps is None else int(steps),
        upload=numbers.get("upload"),
        inference=numbers.get("inference"),
        download=numbers.get("download"),
        motion=numbers.get("motion"),
        calls=None,
        actions=None,
        price=numbers.get("price"),
        fallback=None,
        error=error,
        score=numbers.get("score"),
    )


def _success(columns: Columns, record: Record, success: Success) -> bool | None:
    """None where the policy did not run."""
    value = record.values[success.column]
    if value is None:
        return None
    if success.at_least is not None:
        measured = _ratio(record, success.column, success.divide)
        return None if measured is None else measured >= success.at_least
    if success.true:
        if value in success.true or value in success.false:
            return value in success.true
        raise record.error(success.column, f"must be one of {listed([*success.true, *success.false])}, got {quoted(value)}")
    word = _word(value)
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    if word == "nan":
        raise record.error(success.column, "is NaN; leave it empty where the policy did not run")
    if _is_number(value):
        hint = f"a graded outcome is a score, and its success a threshold: {threshold(columns.from_flags)}"
    else:
        hint = "a mapping file (--map) says which words mean it: success = { column = ..., true = [WORDS], false = [WORDS] }"
    raise record.error(success.column, f"must be true or false (or 1 or 0), got {quoted(value)}; {hint}; leave it empty where the policy did not run")


def _word(value: Any) -> str:
    if isinstance(value, str):
        return value.strip().lower()
    return str(value).lower() if isinstance(value, bool) else str(float(value)) if _is_number(value) else quoted(value)


def _number(record: Record, policy: PolicyColumns, name: str, terms: Sequence[Term | float]) -> float:
    total = math.fsum(_term(record, term, price if name == "price" else number) for term in terms)
    if name == "price":
        total *= UNITS[policy.unit or "cents"]
    called = policy.called(name)
    column = next((term.column for term in terms if isinstance(term, Term)), None)

    def error(problem: str) -> DataError:
        problem = f"{called} must {problem}, got {total:g}"
        return DataError(f"{record.where}, policy {quoted(policy.name)}: {problem}") if column is None else record.error(column, problem)

    low, high = (-math.inf, math.inf) if name == "score" else (0.0, 1.0) if name == "subgoals" else (0.0, math.inf)
    if not low <= total <= high:
        raise error(f"lie in [{low:g}, {high:g}]")
    if not math.isfinite(total):
        raise error("be a finite number")
    if name == "steps" and (total != int(total) or total > _LONGEST):
        raise error("be an integer" if total <= _LONGEST else "lie in [0, 2^53]")
    return total


def _term(record: Record, term: Term | float, read: "Callable[[Record, str], float | None]") -> float:
    if not isinstance(term, Term):
        return term
    if term.count in _COUNTS:
        value: float | None = _COUNTS[term.count](text(record, term.column))
        if term.divide is not None:
            value = _divided(record, float(value or 0), term.divide)
    else:
        value = _ratio(record, term.column, term.divide, read)
    if value is None:
        raise record.error(term.column, "is empty although the policy has an outcome")
    return term.scale * value + term.offset


def _ratio(record: Record, column: str, divide: str | float | None, read: "Callable[[Record, str], float | None]" = number) -> float | None:
    value = read(record, column)
    return value if value is None or divide is None else _divided(record, value, divide)


def _divided(record: Record, value: float, divide: str | float) -> float:
    by = number(record, divide) if isinstance(divide, str) else divide
    if not by:
        raise record.error(str(divide), f"must be a number other than 0 to divide by, got {quoted(record.values[str(divide)])}")
    try:
        return value / by
    except OverflowError:
        return math.inf


def _outcome(row: Row) -> tuple[Any, ...]:
    """What two rows of the same policy on the same instance may differ in; labels are none of it."""
    return tuple(getattr(row, name) for name in ("success", *NUMBERS, "error"))


def _duplicate(columns: Columns, record: Record, first: Record, what: str) -> DataError:
    if columns.from_flags:
        ways = "name a column of repeats (--repeat-column), or say what it means: --duplicates drop or repeats (in a wide table also keep)"
    else:
        ways = 'name a column of repeats, or say what it means with duplicates = "drop" or "repeats" (in a wide table also "keep")'
    return DataError(f"{record.where}: {what} is in row {first.number} of {first.file} already; remove one, {ways}")


def _is_number(value: Any) -> bool:
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError, ArithmeticError):
        return False
