"""The mapping file of an outcome table: its tables and keys, and what must fit together in it."""

import re
from dataclasses import field
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, ValidationInfo, model_validator
from pydantic.dataclasses import dataclass

from osel_sim.formats.toml_types import TABLE, Faults, OneOf, Text, Texts, Version, plain_name, quoted, refuse
from osel_sim.ingestion.columns import (
    COMMAND_LINE,
    DUPLICATES,
    FIELD,
    NUMBERS,
    PLACE,
    UNITS,
    VALUES,
    Factor,
    Files,
    Join,
    Success,
    Term,
    threshold,
)

_OUTCOMES = ("success", "score", "subgoals")
"""What tells the policies of a table apart; what an action costs may well be the same for all."""


def _template(text: str) -> str:
    if not text:
        raise ValueError("must be a column, or a template with columns in braces")
    if re.search(r"[{}]", FIELD.sub("", text)):
        raise ValueError(f"{quoted(text)} has a brace too many or too few; {{COLUMN}} stands for a column's text, other braces a text cannot have")
    return text if FIELD.search(text) else "{" + text + "}"


def _threshold_or_words(success: Success) -> Success:
    if (success.at_least is None) == (not success.true) or bool(success.true) != bool(success.false) or (success.divide and success.at_least is None):
        raise ValueError("give either at_least (with numbers), or both true and false (lists of words)")
    if both := set(success.true) & set(success.false):
        refuse((("true",), f"{quoted(min(both))} is in false as well"))
    return success


def _form(value: object) -> str | None:
    if isinstance(value, str):
        return "column"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "number"
    return "table" if isinstance(value, dict | Term | Success) else None


def _form_or_list(value: object) -> str | None:
    return "list" if isinstance(value, list | tuple) else _form(value)


def _column_or_table(value: object) -> str | None:
    return None if _form(value) == "number" else _form(value)


_NUMBER = "a column, a number, a table with column, count, scale, divide and offset, or a list of these"
_SUCCESS = "a column, or a table with column and at_least, or with column, true and false"
Column = Annotated[str, Tag("column")]
Constant = Annotated[Factor, Tag("number")]
Part = Annotated[Column | Constant | Annotated[Term, Tag("table")], Discriminator(_form, "wanted", _NUMBER)]
Amount = Annotated[
    Column | Constant | Annotated[Term, Tag("table")] | Annotated[tuple[Part, ...], Field(min_length=1), Tag("list")],
    Discriminator(_form_or_list, "wanted", _NUMBER),
]
Succeeded = Annotated[
    Column | Annotated[Success, AfterValidator(_threshold_or_words), Tag("table")], Discriminator(_column_or_table, "wanted", _SUCCESS)
]


@dataclass(frozen=True, kw_only=True, config=TABLE)
class FilesTable:
    """Where the table is."""

    files: Files
    """Its files, relative to this one: names, patterns (*.csv), or templates such as `quiz_{subject}.csv`, where the braces become a column."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class InstanceTable:
    """What identifies and describes an instance."""

    text: Annotated[str, AfterValidator(_template)]
    """The instruction or question: a column, or a template with columns in braces."""
    images: Annotated[Texts, BeforeValidator(lambda value: [value] if isinstance(value, str) else value, json_schema_input_type=str | Texts)] = ()
    """Columns with paths of images, relative to the table that names them."""
    group: Annotated[str, AfterValidator(_template)] | None = None
    """What the log calls the task: a column, or a template."""
    key: Annotated[str, AfterValidator(_template)] | None = None
    """What identifies an instance: a column, or a template such as `{subject}-{number}`; left out: its text, images and group do."""
    context: Texts = ()
    """Columns that are part of the context besides text and images: numbers, or names of few different values; `task` stands for the group."""
    split: str | None = None
    """Column of the log's `split`."""
    phrasing: str | None = None
    """Column of the log's `phrasing`."""
    target: str | None = None
    """Column of the log's `target`."""
    container: str | None = None
    """Column of the log's `container`."""
    duplicates: Annotated[str, OneOf(DUPLICATES)] = "refuse"
    """What to do with a second row of the same instance (and policy, and repeat)."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ValuesTable:
    """Where an outcome is: a column, a number that holds for every row, or a table that says more."""

    success: Succeeded | None = None
    """Whether the task was done."""
    score: Amount | None = None
    """A graded outcome, higher is better."""
    subgoals: Amount | None = None
    """Fraction of the subgoals reached."""
    steps: Amount | None = None
    """Steps of the robot."""
    seconds: Amount | None = None
    """Seconds in total, where their parts are not known."""
    upload: Amount | None = None
    """Seconds of sending the question."""
    inference: Amount | None = None
    """Seconds of computing the answer."""
    download: Amount | None = None
    """Seconds of sending the answer."""
    motion: Amount | None = None
    """Seconds in which the robot moves."""
    price: Amount | None = None
    """Cents."""
    error: str | None = None
    """Column that says why there is no valid outcome; empty where there is one."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class OutcomeTable(ValuesTable):
    """What holds for every policy; {policy} stands for its name."""

    policy: str | None = None
    """Column of policies, in a long table: one with a row for each instance and policy."""
    repeat: str | None = None
    """Column that numbers repeats from 0 on."""
    propensity: str | None = None
    """Column of the probability, in (0, 1], with which the row's policy was chosen, in a long table of one row an instance: logged bandit data."""
    price_unit: Annotated[str, OneOf(tuple(UNITS))] | None = None
    """What prices are given in, `cents` or `usd`; left out: cents, or dollars where a column has dollar signs."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class PolicyTable(ValuesTable):
    """What holds for one policy."""

    name: str | None = None
    """What it is called in the log; left out: as in the table."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ColumnsFile:
    """What the columns of an outcome table mean, for `python -m osel_sim.ingest --map FILE`."""

    version: Version
    """Of the format."""
    name: Text
    """Of the workload; the task of instances without a group."""
    table: FilesTable
    """Where the table is."""
    join: tuple[Join, ...] = ()
    """Other tables whose columns come beside."""
    instance: InstanceTable
    """What identifies and describes an instance."""
    outcome: OutcomeTable = field(default_factory=OutcomeTable)
    """What holds for every policy."""
    policies: dict[str, PolicyTable] = field(default_factory=dict)
    """Each policy by its name in the table, and what holds for it only."""

    @model_validator(mode="after")
    def _fits_together(self, info: ValidationInfo) -> "ColumnsFile":
        context = info.context or {}
        if faults := [*self._lacking(context.get("file") == COMMAND_LINE), *self._unequal(), *self._shared(context)]:
            refuse(*faults)
        return self

    def values(self, policy: PolicyTable) -> dict[str, Any]:
        """What is said of a policy, by the names of `VALUES`."""
        both = {key: own if (own := getattr(policy, key)) is not None else getattr(self.outcome, key) for key in VALUES}
        return {key: value for key, value in both.items() if value is not None}

    def _lacking(self, from_flags: bool) -> Faults:
        """Values that lack, or are there twice."""
        if self.outcome.policy is not None and self.instance.duplicates == "keep":
            yield ("instance", "duplicates"), 'must be "refuse", "drop" or "repeats" in a long table, where many rows are about one instance'
        if self.outcome.propensity is not None:
            if self.outcome.policy is None:
                yield ("outcome", "propensity"), "is of the row's policy: name the column of policies too, in a table with a row for each decision"
            if self.outcome.repeat is not None or self.instance.duplicates != "refuse":
                yield ("outcome", "propensity"), "says that each row is a decision of its own; repeats and duplicates have no meaning then"
        if not self.policies and self.outcome.policy is None:
            needs = "a wide table needs [policies.NAME] for each policy, a long one outcome.policy, its column of policies"
            yield ("policies", "NAME"), f"is missing: {needs}"
            return
        places: dict[tuple[str, ...], PolicyTable] = {("policies", name): policy for name, policy in self.policies.items()} or {
            ("outcome",): PolicyTable()
        }
        values = {place: self.values(policy) for place, policy in places.items()}
        for place, given in values.items():
            if "success" not in given:
                yield (*place, "success"), f"is missing; {threshold(from_flags)} takes a score from so much on as success"
                return  # of all others that lack it the same would be said
        for place, given in values.items():
            clash = [key for key in ("upload", "inference", "download", "motion") if key in given]
            if clash and "seconds" in given:
                yield (*place, "seconds"), f"is the total, where its parts are not known; {clash[0]} is given as well"

    def _unequal(self) -> Faults:
        """What is known of one policy must be known of all: nothing is free, or takes no time, because a line is missing."""
        for number in NUMBERS:
            keys = (number, "seconds") if number == "inference" else (number,)
            given = {name: next((key for key in keys if key in self.values(policy)), None) for name, policy in self.policies.items()}
            having = next((name for name in given if given[name] is not None), None)
            for name, key in given.items():
                if having is not None and key is None:
                    first = self.policies[having].name or having
                    problem = f"is missing, policy {first!r} has it; give it for all (0 where it is free or takes no time)"
                    yield ("policies", name, str(given[having])), problem

    def _shared(self, context: dict[str, Any]) -> Faults:
        """Names of two policies, and outcomes of one that several would have."""
        titles = [policy.name or name for name, policy in self.policies.items()]
        for title in dict.fromkeys(titles):
            if titles.count(title) > 1:
                yield ("policies", title), "is the name of two policies"
        if self.outcome.policy is not None:
            return
        way = "--policy-column" if context.get("file") == COMMAND_LINE else "outcome.policy"
        for key in _OUTCOMES:
            heirs = [name for name, policy in self.policies.items() if getattr(policy, key) is None]
            value = context.get("data", {}).get("outcome", {}).get(key)
            if len(heirs) > 1 and isinstance(value, str | list | dict) and PLACE not in str(value):
                names = ", ".join(map(plain_name, heirs))
                yield (
                    ("outcome", key),
                    f"is {quoted(value)} for each of {names}; let {PLACE} in it stand for the policy's name, or give each policy its own; "
                    f"if the table is long, name its column of policies ({way})",
                )
