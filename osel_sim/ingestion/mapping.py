"""What the columns of somebody's outcome table mean: a mapping, from a TOML file (mapping_file) or from the command line.

    version = 1
    name = "mmlu"

    [table]
    files = ["responses/mmlu_{subject}.csv"]     # {subject} becomes a column; csv, tsv, jsonl or parquet

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

A long table (a row for each instance and policy) names its column of policies: `outcome.policy = "model"`.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Duplicates = Literal["refuse", "drop", "repeats", "keep"]
Count = Literal["value", "characters", "words"]

NUMBERS = ("score", "subgoals", "steps", "upload", "inference", "download", "motion", "price")
"""What a mapping may give for each policy besides success, by the log's names."""
LABELS = ("split", "phrasing", "target", "container")
FIELD = re.compile(r"\{([^{}]+)\}")
"""A column's name in a template."""


@dataclass(frozen=True)
class Term:
    """A number for every row: scale * (column, or its length) / divide + offset, or only the offset where there is no column.

    Attributes:
        count: the column's value, or how many characters or words it has (for a price by tokens where only the text is there).
        divide: a column to divide by, such as the number of subgoals there are.
    """

    column: str | None = None
    count: Count = "value"
    scale: float = 1.0
    divide: str | None = None
    offset: float = 0.0


@dataclass(frozen=True)
class Success:
    """Success for every row: a column of true and false, of words that mean these, or of numbers with a threshold.

    Attributes:
        at_least: success is a number of so much or more; None where the column has true and false, or 1 and 0.
        true, false: words that mean success and failure; empty where the column has true and false.
    """

    column: str
    at_least: float | None = None
    divide: str | None = None
    true: tuple[str, ...] = ()
    false: tuple[str, ...] = ()


@dataclass(frozen=True)
class PolicyColumns:
    """Where the outcome of one policy is.

    Attributes:
        name: in the log.
        numbers: name in the log -> the terms whose sum it is.
        error: column that says why there is no valid outcome; empty where there is one.
    """

    name: str
    success: Success
    numbers: dict[str, tuple[Term, ...]]
    error: str | None = None

    @property
    def columns(self) -> list[str]:
        """All columns it needs."""
        terms = [term for number in self.numbers.values() for term in number]
        optional = [self.success.divide, self.error, *(term.column for term in terms), *(term.divide for term in terms)]
        return list(dict.fromkeys([self.success.column, *(name for name in optional if name is not None)]))


@dataclass(frozen=True)
class Join:
    """Another table: one row for every value of the column `on`."""

    files: tuple[str, ...]
    on: str


@dataclass(frozen=True)
class Mapping:
    """A mapping, validated.

    Attributes:
        file: the TOML file, or `command line`.
        base: folder that the files are relative to.
        name: of the workload; the task of instances without a group.
        text: template of the instruction or question: columns in braces.
        images: columns with paths of images, relative to the table that names them.
        group: column whose value is the log's task, or None.
        key: column that identifies an instance, or None: its text, images and group do.
        labels: log column (`split`, `phrasing`, `target`, `container`) -> the table's column.
        duplicates: what to do with a second row of the same instance (and policy, and repeat).
        policy: column of policies in a long table; None where the table is wide.
        repeat: column that numbers repeats from 0 on, or None.
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
    duplicates: Duplicates
    policy: str | None
    repeat: str | None
    policies: dict[str, PolicyColumns] = field(default_factory=dict)
    default: PolicyColumns | None = None

    @property
    def columns(self) -> dict[str, str]:
        """Columns it needs -> the key that asks for them."""
        needed = {name: "instance.text" for name in FIELD.findall(self.text)}
        needed |= {name: "instance.images" for name in self.images}
        needed |= {column: f"instance.{label}" for label, column in self.labels.items()}
        for key, column in (
            ("instance.group", self.group),
            ("instance.key", self.key),
            ("outcome.policy", self.policy),
            ("outcome.repeat", self.repeat),
        ):
            if column is not None:
                needed[column] = key
        for policy in [*self.policies.values(), *([self.default] if self.default else [])]:
            needed |= {column: f"outcome of policy {policy.name!r}" if self.policies else "outcome" for column in policy.columns}
        return needed


def fill(template: str, text: Callable[[str], str]) -> str:
    """The template with the columns' texts in place of their names."""
    return FIELD.sub(lambda match: text(match[1]), template)
