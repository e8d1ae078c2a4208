"""Reading what the columns of a table mean: a mapping file, or the command line's flags as the same data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from osel_sim.formats.toml_file import check, read_toml
from osel_sim.ingestion.columns import COMMAND_LINE, LABELS, NUMBERS, PLACE, Columns, PolicyColumns, Success, Term, flag
from osel_sim.ingestion.columns_schema import ColumnsFile, PolicyTable


def load_columns(file: Path, files: tuple[str, ...] = ()) -> Columns:
    """Read a file.

    Args:
        files: where given, in place of `table.files`, and relative to the working folder.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    data = read_toml(file)
    if files and isinstance(table := data.get("table", {}), dict):
        data["table"] = table | {"files": [str(Path(name).absolute()) for name in files]}
    return parse_columns(data, file, file.parent)


def parse_columns(data: dict[str, Any], file: Path | str, base: Path) -> Columns:
    """Check the data of a file, or of flags.

    Args:
        file: the file, or `COMMAND_LINE`: errors then name flags.
        base: folder that the table's files are relative to.

    Raises:
        ContentError: naming the key and what would be right.
    """
    found = check(ColumnsFile, data, file, called=flag if file == COMMAND_LINE else str)
    instance, outcome = found.instance, found.outcome
    return Columns(
        file=file,
        base=base,
        name=found.name,
        files=found.table.files,
        joins=found.join,
        text=instance.text,
        images=instance.images,
        group=instance.group,
        key=instance.key,
        context=tuple(dict.fromkeys(instance.context)),
        labels={label: column for label in LABELS if (column := getattr(instance, label)) is not None},
        duplicates=instance.duplicates,
        policy=outcome.policy,
        repeat=outcome.repeat,
        propensity=outcome.propensity,
        policies={name: _policy(found.values(policy), name, policy.name or name, outcome.price_unit) for name, policy in found.policies.items()},
        default=None if found.policies else _policy(found.values(PolicyTable()), PLACE, "", outcome.price_unit),
    )


def _policy(values: dict[str, Any], name: str, title: str, unit: str | None) -> PolicyColumns:
    """Where the outcome of a policy is.

    Args:
        name: the table's.
        title: the log's.
        unit: of prices, where it is told.
    """
    success = Success(values["success"]) if isinstance(values["success"], str) else values["success"]
    numbers = {key: _terms(values[key], name) for key in NUMBERS if key in values}
    if "seconds" in values:
        numbers["inference"] = _terms(values["seconds"], name)
    error = values.get("error")
    return PolicyColumns(title, _named(success, name), numbers, None if error is None else error.replace(PLACE, name), "seconds" in values, unit)


def _terms(value: str | float | Term | tuple[str | float | Term, ...], name: str) -> tuple[Term | float, ...]:
    parts = value if isinstance(value, tuple) else (value,)
    terms = (Term(part) if isinstance(part, str) else part for part in parts)
    return tuple(_named(term, name) if isinstance(term, Term) else term for term in terms)


def _named[T: (Term, Success)](value: T, name: str) -> T:
    """The same with a policy's name in its columns' names."""
    divide = value.divide.replace(PLACE, name) if isinstance(value.divide, str) else value.divide
    return replace(value, column=value.column.replace(PLACE, name), divide=divide)
