"""The command line's flags as the data that a mapping file would hold."""

import contextlib
import re
from collections.abc import Collection
from typing import Any

from osel_sim.core.errors import UsageError, did_you_mean
from osel_sim.ingestion.columns import VALUES

_SCALED = re.compile(r"(?P<column>.+?)\s*(?P<sign>[*/])\s*(?P<number>\d+(\.\d+)?(e[+-]?\d+)?)")
"""A column in other units: `time_ms/1000`."""


def as_data(options: Any, files: tuple[str, ...], there: Collection[str] = ()) -> dict[str, Any]:
    """What a mapping file would hold.

    Args:
        options: the flags of `osel_sim.ingest`.
        files: the tables' names or patterns, relative to the working folder.
        there: columns that there are: one that is called `score/5` is meant by that name.

    Raises:
        UsageError: a policy is named twice or not at all, or a value is given twice or for an unknown policy.
    """
    names = list(options.policies or ())
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"policy {name!r} is named twice after --policies")
    if not names and options.policy_column is None:
        raise UsageError("--policies or --policy-column is missing: a wide table needs the policies' names, a long one its column of them")
    instance = {
        "text": options.text,
        "images": None if options.image is None else list(options.image),
        "group": options.group,
        "context": None if options.context is None else list(options.context),
        "key": options.key,
        "duplicates": options.duplicates,
    }
    outcome: dict[str, Any] = {
        "policy": options.policy_column,
        "repeat": options.repeat_column,
        "propensity": options.propensity,
        "price_unit": options.price_unit,
    }
    policies: dict[str, dict[str, Any]] = {name: {} for name in names}
    for key in VALUES:
        for item in getattr(options, key) or ():
            policy, equals, value = item.partition("=")
            if equals and policy in policies:
                policies[policy][key] = _value(key, value, options.at_least, there)
            elif equals and names:
                raise UsageError(f"--{key} {item}: unknown policy {policy!r}: {did_you_mean(policy, names)}known: {', '.join(names)}")
            elif key in outcome:
                raise UsageError(f"--{key}: {item!r} is the second value for all policies; write POLICY=VALUE, with the policies after --policies")
            else:
                outcome[key] = _value(key, item, options.at_least, there)
    return {
        "version": 1,
        "name": options.name or options.out.resolve().name,
        "table": {"files": list(files)},
        "instance": {key: value for key, value in instance.items() if value is not None},
        "outcome": {key: value for key, value in outcome.items() if value is not None},
        "policies": policies,
    }


def scaled(options: Any) -> bool:
    """Whether a flag may mean a column in other units, which only the columns that there are can tell."""
    return any(_SCALED.fullmatch(item.rpartition("=")[2]) for key in VALUES for item in getattr(options, key) or ())


def _value(key: str, text: str, at_least: float | None, there: Collection[str]) -> Any:
    if key == "success":
        return text if at_least is None else {"column": text, "at_least": at_least}
    if key == "error":
        return text
    if "_" not in text:  # Python takes 1_000 for a number; here it is the name of a column
        with contextlib.suppress(ValueError):
            return float(text)
    match = None if text in there else _SCALED.fullmatch(text)
    if match is None:
        return text
    return {"column": match["column"], "scale" if match["sign"] == "*" else "divide": float(match["number"])}
