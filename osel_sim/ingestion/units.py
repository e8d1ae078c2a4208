"""What prices are given in, where the cells themselves say so."""

from collections.abc import Sequence
from dataclasses import replace

from osel_sim.ingestion.columns import Columns, PolicyColumns, Term
from osel_sim.ingestion.records import Record, dollars


def with_unit(columns: Columns, records: Sequence[Record]) -> Columns:
    """The columns with the unit of their prices: dollars where the cells say so.

    Raises:
        DataError: some cells of a column have a dollar sign and others none, and the unit is not told; or it is told to be cents.
    """

    def told(policy: PolicyColumns) -> PolicyColumns:
        terms = [term.column for term in policy.numbers.get("price", ()) if isinstance(term, Term) and term.count == "value"]
        signs = {column: _first_signs(records, column) for column in terms}
        with_sign = next((found[True] for found in signs.values() if True in found), None)
        if with_sign is None or policy.unit == "usd":
            return policy
        for column, found in signs.items():
            way = "--price-unit usd" if columns.from_flags else 'outcome.price_unit = "usd"'
            if policy.unit is not None:
                raise with_sign.error(column, f"is in dollars, and the unit of prices is told to be {policy.unit}; give {way}")
            if False in found:
                problem = f"has no dollar sign, row {with_sign.number} of {with_sign.file} has one; if all are dollars, give {way}"
                raise found[False].error(column, problem)
        if len(policy.numbers["price"]) > len(terms):
            raise with_sign.error(terms[0], "is in dollars; say what the other parts of the price are in, with the unit of all")
        return replace(policy, unit="usd")

    return replace(
        columns,
        policies={name: told(policy) for name, policy in columns.policies.items()},
        default=columns.default and told(columns.default),
    )


def _first_signs(records: Sequence[Record], column: str) -> dict[bool, Record]:
    """The first row with a dollar sign in a column, and the first one without."""
    found: dict[bool, Record] = {}
    for record in records:
        sign = dollars(record, column)
        if sign is not None and sign not in found:
            found[sign] = record
            if len(found) == 2:
                break
    return found
