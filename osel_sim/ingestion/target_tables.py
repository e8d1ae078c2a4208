"""A table of how somebody would choose: with which probability each policy, for each decision or instance, or for all alike."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError, UnknownNameError
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.readers import read_named
from osel_sim.ingestion.records import Record, number, text

POLICY, PROBABILITY = "policy", "probability"
DECISION, INSTANCE = "decision", "instance"
"""Either says whose probability a row holds: the decision's number from 0 on, or the instance's key. Without both, a row holds for all decisions."""

CLOSE = 1e-6
"""Probabilities sum to 1 to so much; they are then made to sum to it."""


def read_target(file: Path, instances: Sequence[str], policies: Sequence[str]) -> NDArray[np.float64]:
    """Probabilities (T, P) with which a way of choosing takes each policy, from a table.

    Args:
        file: CSV, TSV, JSON or Parquet with the columns `policy`, `probability`, and `decision` or `instance` or neither. A policy that has no row
            has no chance.
        instances: (T,) key of each decision's instance.
        policies: (P,) names.

    Raises:
        DataError: a cell, a decision without rows, or probabilities that do not sum to 1; names file and row, or the decision.
        UnknownNameError: a policy that was not to be chosen from.
    """
    columns, records = read_named(file, (POLICY, PROBABILITY), (DECISION, INSTANCE))
    by = [name for name in (DECISION, INSTANCE) if name in columns]
    if len(by) == 2:
        raise DataError(f"{file}: has the columns {DECISION} and {INSTANCE}; one of them says whose probability a row holds")
    keys: Sequence[object] = [None] * len(instances) if not by else range(len(instances)) if by == [DECISION] else instances
    rows: dict[object, dict[str, Record]] = defaultdict(dict)
    for record in records:
        key = _key(record, by[0], keys) if by else None
        policy = text(record, POLICY)
        if policy not in policies:
            raise UnknownNameError("policy", policy, policies, record.where)
        if policy in rows[key]:
            raise record.error(POLICY, f"{quoted(policy)} is in row {rows[key][policy].number} already{_of(by, key)}")
        rows[key][policy] = record
    mixes = {key: _mix(file, own, policies, _of(by, key)) for key, own in rows.items()}
    missing = next((key for key in keys if key not in mixes), None)
    if missing is not None:
        raise DataError(f"{file}: has no row{_of(by, missing)}; each of the {len(instances)} decisions needs its probabilities")
    return np.stack([mixes[key] for key in keys])


def _key(record: Record, column: str, keys: Sequence[object]) -> object:
    """Whose probability a row holds."""
    if column == INSTANCE:
        return text(record, column)  # of others than were decided on there may be rows as well
    value = number(record, column)
    if value is None or value != int(value) or int(value) not in keys:
        raise record.error(column, f"must be a decision's number, 0 to {len(keys) - 1}, got {quoted(record.values[column])}")
    return int(value)


def _mix(file: Path, rows: Mapping[str, Record], policies: Sequence[str], whose: str) -> NDArray[np.float64]:
    probabilities = np.zeros(len(policies))
    for policy, record in rows.items():
        value = number(record, PROBABILITY)
        if value is None or not 0.0 <= value <= 1.0:
            raise record.error(PROBABILITY, f"must be in [0, 1], got {quoted(record.values[PROBABILITY])}")
        probabilities[policies.index(policy)] = value
    total = float(probabilities.sum())
    if abs(total - 1.0) > CLOSE:
        raise DataError(f"{file}: the probabilities{whose} must sum to 1, and come to {total:.6g}")
    return probabilities / total


def _of(by: Sequence[str], key: object) -> str:
    return f" of {by[0]} {quoted(key)}" if by else ""
