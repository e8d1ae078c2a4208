"""Reading a mapping: a TOML file, or the command line's flags as the same table."""

import re
from pathlib import Path
from typing import Any, get_args

from osel_sim.formats.validate import Table
from osel_sim.ingestion.mapping import (
    COMMAND_LINE,
    FIELD,
    LABELS,
    NUMBERS,
    VALUES,
    Count,
    Duplicates,
    Join,
    Mapping,
    PolicyColumns,
    Success,
    Term,
    threshold,
)

VERSION = 1
_PLACE = "{policy}"
_ANY = (str, int, float, bool, list, dict)
_OUTCOMES = ("success", "score", "subgoals")
"""What tells the policies of a table apart; what an action costs may well be the same for all."""


def load_mapping(file: Path, files: tuple[str, ...] = ()) -> Mapping:
    """Read a mapping file.

    Args:
        files: where given, in place of `table.files`, and relative to the working folder.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    table = Table.load(file)
    return parse_mapping(table, file.parent, tuple(str(Path(name).absolute()) for name in files))


def parse_mapping(table: Table, base: Path, files: tuple[str, ...] = ()) -> Mapping:
    """Check a mapping's table.

    Args:
        base: folder that its files are relative to.
        files: in place of `table.files`.

    Raises:
        ContentError: naming the key and what would be right.
    """
    table.integer("version", VERSION, VERSION)
    name = table.get("name", str)
    if not name:
        raise table.error("name", "must not be empty")
    source = table.table("table", {} if files else ...)
    own = source.strings("files", ()) if files else _files(source)
    source.done()
    joins = tuple(_join(table, index, entry) for index, entry in enumerate(table.get("join", list, [])))
    instance = table.table("instance")
    text = instance.get("text", str)
    if not text:
        raise instance.error("text", "must be a column, or a template with columns in braces")
    if re.search(r"[{}]", FIELD.sub("", text)):
        raise instance.error(
            "text", f"{text!r} has a brace too many or too few; {{COLUMN}} stands for a column's text, other braces a text cannot have"
        )
    if not FIELD.search(text):
        text = "{" + text + "}"
    labels = {label: instance.get(label, str) for label in LABELS if label in instance.data}
    images = instance.get("images", (str, list), [])
    images = (images,) if isinstance(images, str) else instance.strings("images", [])
    outcome = table.table("outcome", {})
    policy = outcome.get("policy", str, None)
    policies, default = _policies(table.table("policies", {}), outcome, policy)
    mapping = Mapping(
        file=table.file,
        base=base,
        name=name,
        files=files or own,
        joins=joins,
        text=text,
        images=images,
        group=instance.get("group", str, None),
        key=instance.get("key", str, None),
        labels=labels,
        duplicates=_literal(instance, "duplicates", get_args(Duplicates), "refuse"),
        policy=policy,
        repeat=outcome.get("repeat", str, None),
        policies=policies,
        default=default,
    )
    if policy is not None and mapping.duplicates == "keep":
        raise instance.error("duplicates", 'must be "refuse", "drop" or "repeats" in a long table, where many rows are about one instance')
    for part in (instance, outcome, table):
        part.done()
    return mapping


def _join(table: Table, index: int, entry: Any) -> Join:
    if not isinstance(entry, dict):
        raise table.error("join", f"must be a list of tables, got {entry!r}")
    part = Table(entry, table.file, f"join[{index}].")
    join = Join(_files(part), part.get("on", str))
    part.done()
    return join


def _files(table: Table) -> tuple[str, ...]:
    files = table.strings("files")
    if not files:
        raise table.error("files", "must name at least one file")
    return files


def _policies(section: Table, outcome: Table, column: str | None) -> tuple[dict[str, PolicyColumns], PolicyColumns | None]:
    """Columns of each policy, and of those that are not named."""
    common = {key: outcome.get(key, _ANY, None) for key in VALUES if key in outcome.data}
    policies: dict[str, PolicyColumns] = {}
    for name in section.data:
        part = section.table(name)
        own = {key: part.get(key, _ANY) for key in VALUES if key in part.data}
        title = part.get("name", str, name)
        merged = type(section)({**common, **own}, section.file, part.prefix)
        policies[name] = _columns(merged, name, title)
        part.done()
    if column is None:
        _own_outcomes(section, outcome, common)
    titles = [policy.name for policy in policies.values()]
    for title in titles:
        if titles.count(title) > 1:
            raise section.error(title, "is the name of two policies")
    default = None
    if not policies:
        if column is None:
            raise section.error(
                "NAME",
                "is missing: a wide table needs [policies.NAME] for each policy, a long one outcome.policy, its column of policies",
            )
        default = _columns(type(section)(common, section.file, outcome.prefix), _PLACE, "")
    _same_measures(section, policies)
    return policies, default


def _own_outcomes(section: Table, outcome: Table, common: dict[str, Any]) -> None:
    """What a wide table says for all policies must not give several of them the outcome of one."""
    for key in _OUTCOMES:
        value = common.get(key)
        heirs = [name for name in section.data if key not in section.data[name]]
        if len(heirs) > 1 and isinstance(value, str | list | dict) and _PLACE not in str(value):
            way = "--policy-column" if _from_flags(outcome) else "outcome.policy"
            raise outcome.error(
                key,
                f"is {value!r} for each of {', '.join(heirs)}; let {_PLACE} in it stand for the policy's name, or give each policy its own; "
                f"if the table is long, name its column of policies ({way})",
            )


def _same_measures(section: Table, policies: dict[str, PolicyColumns]) -> None:
    """What is known of one policy must be known of all: nothing is free, or takes no time, because a line is missing."""
    for first in policies.values():
        for name, policy in policies.items():
            lacking = [number for number in first.numbers if number not in policy.numbers]
            if lacking:
                raise section.error(
                    f"{name}.{first.called(lacking[0])}",
                    f"is missing, policy {first.name!r} has it; give it for all (0 where it is free or takes no time)",
                )


def _columns(table: Table, name: str, title: str) -> PolicyColumns:
    if "success" not in table.data:
        raise table.error("success", f"is missing; {threshold(_from_flags(table))} takes a score from so much on as success")
    success = _success(table, name)
    numbers: dict[str, tuple[Term, ...]] = {}
    for key in NUMBERS:
        if key in table.data:
            numbers[key] = _terms(table, key, name)
    if "seconds" in table.data:
        clash = [key for key in ("upload", "inference", "download", "motion") if key in numbers]
        if clash:
            raise table.error("seconds", f"is the total, where its parts are not known; {clash[0]} is given as well")
        numbers["inference"] = _terms(table, "seconds", name)
    error = table.get("error", str, None)
    return PolicyColumns(title, success, numbers, None if error is None else error.replace(_PLACE, name), "seconds" in table.data)


def _success(table: Table, name: str) -> Success:
    value = table.get("success", _ANY)
    if isinstance(value, str):
        return Success(value.replace(_PLACE, name))
    if not isinstance(value, dict):
        raise table.error("success", f"must be a column, or a table with column and at_least, or with column, true and false; got {value!r}")
    part = table.table("success")
    at_least = part.number("at_least", -1e12, 1e12) if "at_least" in part.data else None
    divide = part.get("divide", str, None)
    true, false = part.strings("true", ()), part.strings("false", ())
    if (at_least is None) == (not true) or bool(true) != bool(false) or (divide is not None and at_least is None):
        raise table.error("success", "give either at_least (with numbers), or both true and false (lists of words)")
    both = set(true) & set(false)
    if both:
        raise part.error("true", f"{min(both)!r} is in false as well")
    success = Success(part.get("column", str).replace(_PLACE, name), at_least, divide and divide.replace(_PLACE, name), true, false)
    part.done()
    return success


def _terms(table: Table, key: str, name: str) -> tuple[Term, ...]:
    value = table.get(key, _ANY)
    entries = value if isinstance(value, list) else [value]
    if not entries:
        raise table.error(key, "must not be an empty list")
    return tuple(_term(table, key, entry, name) for entry in entries)


def _term(table: Table, key: str, value: Any, name: str) -> Term:
    if isinstance(value, str):
        return Term(value.replace(_PLACE, name))
    if isinstance(value, int | float) and not isinstance(value, bool):
        return Term(offset=type(table)({key: value}, table.file, table.prefix).number(key, -1e12, 1e12))
    if not isinstance(value, dict):
        raise table.error(key, f"must be a column, a number, a table with column, count, scale, divide and offset, or a list of these; got {value!r}")
    part = Table(value, table.file, f"{table.prefix}{key}.")
    divide = part.get("divide", str, None)
    term = Term(
        column=part.get("column", str).replace(_PLACE, name),
        count=_literal(part, "count", get_args(Count), "value"),
        scale=part.number("scale", -1e12, 1e12, 1.0),
        divide=None if divide is None else divide.replace(_PLACE, name),
        offset=part.number("offset", -1e12, 1e12, 0.0),
    )
    part.done()
    return term


def _from_flags(table: Table) -> bool:
    return table.file == COMMAND_LINE


def _literal(table: Table, key: str, known: tuple[Any, ...], default: str) -> Any:
    return table.choice(key, known, default)
