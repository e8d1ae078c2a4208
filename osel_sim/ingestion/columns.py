"""What the columns of somebody's outcome table mean, from a mapping file (TOML, columns_file) or from the command line.

    version = 1
    name = "mmlu"

    [table]
    files = ["responses/mmlu_{subject}.csv"]     # {subject} becomes a column; csv, tsv, jsonl, json or parquet, or a folder of such

    [[join]]                                     # other tables, each with one row for every value of `on`
    files = ["questions.jsonl"]
    on = "id"

    [instance]
    text = "prompt"                              # a column, or a template such as "{question} A. {a} B. {b}"
    group = "subject"                            # the log's task

    [outcome]                                    # for every policy; {policy} stands for its name
    success = "{policy}"
    inference = 1.0                              # a string is a column, a number holds for every row

    [policies."gpt-4-1106-preview"]              # what differs
    price = [{ column = "prompt", count = "characters", scale = 0.00025 }, 0.003]

A long table (a row for each instance and policy) names its column of policies: `outcome.policy = "model"`. Where other words than true and false mean
success: `success = { column = "solved", true = ["yes"], false = ["no"] }`.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Discriminator, Tag
from pydantic.dataclasses import dataclass as pydantic_dataclass

from osel_sim.context.names import TASK
from osel_sim.formats.toml_types import TABLE, OneOf, Texts, between

DUPLICATES = ("refuse", "drop", "repeats", "keep")
COUNTS = ("value", "characters", "words")

NUMBERS = ("score", "subgoals", "steps", "upload", "inference", "download", "motion", "price")
"""What may be given for each policy besides success, by the log's names."""
UNITS = {"cents": 1.0, "usd": 100.0}
"""What a price may be given in, and how many cents that is."""
VALUES = ("success", "score", "subgoals", "steps", "seconds", "upload", "inference", "download", "motion", "price", "error")
"""Keys of each policy, each of them a flag as well."""
LABELS = ("split", "phrasing", "target", "container")
COMMAND_LINE = "command line"
"""What stands in place of the file where the columns' meaning is made of flags."""
_FLAGS = {
    "instance.images": "--image",
    "outcome.policy": "--policy-column",
    "outcome.repeat": "--repeat-column",
    "outcome.price_unit": "--price-unit",
}
"""Flags that are not called what their key is called."""
FIELD = re.compile(r"\{([^{}]+)\}")
"""A column's name in a template."""
PLACE = "{policy}"
"""Stands for a policy's name in what holds for all policies."""


def _one_or_more(files: Texts) -> Texts:
    if not files:
        raise ValueError("must name at least one file")
    return files


Files = Annotated[Texts, AfterValidator(_one_or_more)]
Factor = Annotated[float, between(-1e12, 1e12)]


def _column_or_number(value: object) -> str | None:
    if isinstance(value, str):
        return "column"
    return "number" if isinstance(value, int | float) and not isinstance(value, bool) else None


def _not_zero(number: float) -> float:
    if number == 0.0:
        raise ValueError("must not be 0")
    return number


Divisor = Annotated[
    Annotated[str, Tag("column")] | Annotated[Factor, AfterValidator(_not_zero), Tag("number")],
    Discriminator(_column_or_number, "wanted", "a column, or a number"),
]


@pydantic_dataclass(frozen=True, config=TABLE)
class Term:
    """A number for every row: scale * (column, or its length) / divide + offset."""

    column: str
    """The column."""
    count: Annotated[str, OneOf(COUNTS)] = "value"
    """The column's value, or how many characters or words it has (for a price by tokens where only the text is there)."""
    scale: Factor = 1.0
    """What the value is multiplied by."""
    divide: Divisor | None = None
    """What to divide by: a column, such as the number of subgoals there are, or a number, such as 1000 for milliseconds."""
    offset: Factor = 0.0
    """What is added."""


@pydantic_dataclass(frozen=True, config=TABLE)
class Success:
    """Success for every row: a column of true and false, of words that mean these, or of numbers with a threshold."""

    column: str
    """The column."""
    at_least: Factor | None = None
    """Success is a number of so much or more; left out where the column has true and false, or 1 and 0."""
    divide: str | None = None
    """A column to divide by, before it is held against `at_least`."""
    true: Texts = ()
    """Words that mean success."""
    false: Texts = ()
    """Words that mean failure."""


@dataclass(frozen=True)
class PolicyColumns:
    """Where the outcome of one policy is.

    Attributes:
        name: in the log.
        numbers: name in the log -> the terms whose sum it is: columns, and numbers that hold for every row.
        error: column that says why there is no valid outcome; empty where there is one.
        unit: what prices are given in, one of `UNITS`; None: not told, cents unless a column has dollar signs.
        total: `inference` is given as `seconds`, the total.
    """

    name: str
    success: Success
    numbers: dict[str, tuple[Term | float, ...]]
    error: str | None = None
    total: bool = False
    unit: str | None = None

    @property
    def needed(self) -> dict[str, str]:
        """All columns it needs -> the key that asks for them."""
        needed: list[tuple[str | float | None, str]] = [(self.success.column, "success"), (self.success.divide, "success"), (self.error, "error")]
        for name, terms in self.numbers.items():
            needed += [(column, self.called(name)) for term in terms if isinstance(term, Term) for column in (term.column, term.divide)]
        columns: dict[str, str] = {}
        for column, name in needed:
            if isinstance(column, str):
                columns.setdefault(column, name)
        return columns

    def called(self, number: str) -> str:
        """The key that gives a number of the log."""
        return "seconds" if number == "inference" and self.total else number


@pydantic_dataclass(frozen=True, kw_only=True, config=TABLE)
class Join:
    """Another table: one row for every value of the column `on`."""

    files: Files
    """Its files, relative to this one; as `table.files`."""
    on: str
    """Column that both tables have."""


@dataclass(frozen=True)
class Columns:
    """What the columns of a table mean, with what holds for all policies written out for each.

    Attributes:
        file: the TOML file, or `COMMAND_LINE`.
        base: folder that the files are relative to.
        name: of the workload; the task of instances without a group.
        text: template of the instruction or question: columns in braces.
        images: columns with paths of images, relative to the table that names them.
        group: template of the log's task, or None.
        key: template of what identifies an instance, or None: its text, images and group do.
        context: columns that are part of the context, `task` standing for the log's task.
        labels: log column (`split`, `phrasing`, `target`, `container`) -> the table's column.
        duplicates: what to do with a second row of the same instance (and policy, and repeat).
        policy: column of policies in a long table; None where the table is wide.
        repeat: column that numbers repeats from 0 on, or None.
        propensity: column of the probability with which whoever chose the row's policy chose it, or None.
        policies: the table's name of a policy -> its columns. Empty in a long table whose policies are all alike and not named.
        default: columns of policies that are not named; None where all are.
    """

    file: Path | str
    base: Path
    name: str
    files: tuple[str, ...]
    joins: tuple[Join, ...]
    text: str
    images: tuple[str, ...]
    group: str | None
    key: str | None
    labels: dict[str, str]
    duplicates: str
    policy: str | None
    repeat: str | None
    propensity: str | None = None
    context: tuple[str, ...] = ()
    policies: dict[str, PolicyColumns] = field(default_factory=dict)
    default: PolicyColumns | None = None

    @property
    def from_flags(self) -> bool:
        """Whether it is made of the command line's flags, which errors then speak of."""
        return self.file == COMMAND_LINE

    @property
    def needed(self) -> dict[str, str]:
        """Columns it needs -> the key that asks for them."""
        needed = {name: "instance.text" for name in FIELD.findall(self.text)}
        needed |= {name: "instance.images" for name in self.images}
        needed |= {name: "instance.context" for name in self.context if name != TASK}
        needed |= {column: f"instance.{label}" for label, column in self.labels.items()}
        needed |= {name: "instance.key" for name in FIELD.findall(self.key or "")}
        needed |= {name: "instance.group" for name in FIELD.findall(self.group or "")}
        for key, column in (
            ("outcome.policy", self.policy),
            ("outcome.repeat", self.repeat),
            ("outcome.propensity", self.propensity),
        ):
            if column is not None:
                needed[column] = key
        for name, policy in self.policies.items():
            needed |= {column: f"policies.{name}.{key}" for column, key in policy.needed.items()}
        if self.default is not None:
            needed |= {column: f"outcome.{key}" for column, key in self.default.needed.items()}
        return needed


def flag(key: str) -> str:
    """The flag that stands for a key: `--text` for `instance.text`, `--price of policy 'large'` for `policies.large.price`."""
    section, _, rest = key.removesuffix(".scale").removesuffix(".divide").partition(".")
    policy, _, value = rest.rpartition(".")
    if value == "at_least":
        return "--at-least"
    name = _FLAGS.get(key, f"--{value or section}")
    return f"{name} of policy {policy!r}" if section == "policies" and policy else name


def threshold(from_flags: bool) -> str:
    """How to say that a number is success from somewhere on, for error messages."""
    return "--success COLUMN --at-least X" if from_flags else "success = { column = ..., at_least = ... }"


def fill(template: str, text: Callable[[str], str]) -> str:
    """The template with the columns' texts in place of their names."""
    return FIELD.sub(lambda match: text(match[1]), template)
