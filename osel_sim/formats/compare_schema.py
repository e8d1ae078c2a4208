"""The form of `compare.json`, checked as a whole before anything is shown of it."""

from collections.abc import Iterator
from itertools import combinations
from typing import Annotated, Any, Literal, Self

from annotated_types import Ge, Gt, Le, MinLen
from pydantic import BaseModel, ConfigDict, Field, model_validator

Share = Annotated[float, Ge(0.0), Le(1.0)]
Change = Annotated[float, Ge(-1.0), Le(1.0)]
Count = Annotated[int, Ge(0)]
Some = Annotated[int, Ge(1)]
Name = Annotated[str, MinLen(1)]
Interval = Annotated[list[float], Field(min_length=2, max_length=2)]
Decision = Literal["better", "worse", "no worse", "not enough data"]
Measure = Literal["success", "subgoals", "score", "reward", "steps", "seconds", "price"]
EXIT_CODES: dict[Decision, int] = {"better": 0, "no worse": 0, "worse": 1, "not enough data": 3}
"""What the command tells a CI server."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Policy(_Part):
    """Who is compared: what it is called, its name in its log, the log's folder."""

    name: Name
    policy: Name
    log: str


class Difference(_Part):
    """Means of both on the same instances, and their difference with its interval where there is one."""

    instances: Some
    first: float
    second: float
    difference: float
    ci95: Interval | None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        _check(self.ci95 is None or self.ci95[0] <= self.ci95[1], "the ends of an interval must be in order")
        return self


class TaskDifference(Difference):
    """The difference of success on one task."""

    p: Share
    p_holm: Share
    decision: Literal["better", "worse"] | None


class Sides(_Part):
    """A number of each of the two policies."""

    first: Count
    second: Count


class Test(_Part):
    """Whether the two are equally good."""

    method: str
    gained: Count
    lost: Count
    p: Share
    p_holm: Share


class Flip(_Part):
    """An instance on which success is not the same."""

    instance: Name
    task: str
    first: Share
    second: Share


class PairVerdict(_Part):
    """What is claimed of the second policy."""

    decision: Decision
    low: Change
    high: Change
    more: Some | None
    text: str


class Pair(_Part):
    """Two policies on the instances of which both have outcomes."""

    first: Name
    second: Name
    instances: Some
    pairs_of_repeats: Some
    unpaired: Sides
    errors: Sides
    same_scene: Count
    looks: Some | None
    differences: dict[Measure, Difference]
    missing: dict[str, str]
    test: Test
    tasks: dict[str, TaskDifference]
    flips: list[Flip]
    verdict: PairVerdict

    @model_validator(mode="after")
    def _together(self) -> Self:
        _check("success" in self.differences, "differences must have success")
        _check(self.same_scene <= self.instances, f"same_scene must be {self.instances} at most, got {self.same_scene}")
        changed = self.test.gained + self.test.lost
        _check(changed == len(self.flips) <= self.instances, f"flips must be the {changed} instances that were gained or lost, got {len(self.flips)}")
        _check(self.verdict.low <= self.verdict.high, "the ends of an interval must be in order")
        return self


class Verdict(_Part):
    """What is claimed of all that are compared with the first."""

    decision: Decision
    text: str
    exit_code: int


class Comparison(_Part):
    """All of a comparison."""

    schema_version: int
    policies: Annotated[list[Policy], MinLen(2)]
    margin: Share
    error: Annotated[float, Gt(0.0), Le(1.0)]
    power: Share
    reward: dict[str, Any]
    pairs: list[Pair]
    letters: dict[str, str] | None
    verdict: Verdict

    @model_validator(mode="after")
    def _together(self) -> Self:
        names = [policy.name for policy in self.policies]
        _check(len(set(names)) == len(names), "two policies must not have the same name")
        found = [(pair.first, pair.second) for pair in self.pairs]
        _check(found == list(combinations(names, 2)), "pairs must be all pairs of the policies, in their order")
        _check((self.letters is None) == (len(names) < 3), "letters are those of three policies or more")
        _check(self.letters is None or set(self.letters) == set(names), "letters must be those of the policies")
        _check(self.verdict.exit_code == EXIT_CODES[self.verdict.decision], "exit_code must be the decision's")
        return self


def faults(error: Any) -> Iterator[str]:
    """What is wrong, place by place, of a pydantic error."""
    for detail in error.errors(include_url=False):
        place = ".".join(map(str, detail["loc"]))
        yield f"{place + ': ' if place else ''}{detail['msg'].removeprefix('Value error, ')}"


def _check(kept: bool, problem: str) -> None:
    if not kept:
        raise ValueError(problem)
