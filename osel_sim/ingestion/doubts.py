"""What is most likely a mistake in a table although it can be read: said, and left as it is."""

import statistics
from collections.abc import Iterable, Iterator, Sequence

from osel_sim.formats.rollout_log import Row
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.records import form

SECONDS, CENTS = 600.0, 1000.0
"""Medians beyond these are beyond reason: ten minutes for an answer, ten dollars for one."""
_PARTS = ("upload", "inference", "download", "motion")


def beyond_reason(rows: Sequence[Row], from_flags: bool) -> Iterator[str]:
    """A sentence for seconds and for price where some policy's median is larger than any real one.

    Args:
        from_flags: the columns' meaning was told by flags, not by a file.
    """
    units = {
        "seconds": "--seconds COLUMN/1000" if from_flags else "{ column = ..., divide = 1000 }",
        "cents": "the unit (--price-unit), or COLUMN/N" if from_flags else "outcome.price_unit, or { column = ..., divide = N }",
    }
    for what, unit, most, parts in (("seconds", "seconds", SECONDS, _PARTS), ("price", "cents", CENTS, ("price",))):
        by_policy: dict[str, list[float]] = {}
        for row in rows:
            if found := [value for part in parts if (value := getattr(row, part)) is not None]:
                by_policy.setdefault(row.policy, []).append(sum(found))
        medians = {policy: statistics.median(values) for policy, values in by_policy.items()}
        worst = max(medians, key=lambda policy: medians[policy], default=None)
        if worst is not None and medians[worst] > most:
            yield (
                f"half of the outcomes of policy {quoted(worst)} have a {what} of more than {medians[worst]:.6g} {unit}; "
                f"in another unit? say so with {units[unit]}"
            )


def alike(what: str, names: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """A sentence where names that differ only in form (1 and 1.0, capitals, spaces) are taken for different things.

    Args:
        names: each in its parts.
    """
    first: dict[tuple[str, ...], tuple[str, ...]] = {}
    pairs = []
    for parts in dict.fromkeys(names):
        before = first.setdefault(tuple(map(form, parts)), parts)
        if before != parts:
            pairs.append((before, parts))
    if pairs:
        one, other = ("/".join(name) for name in pairs[0])
        more = f", and {len(pairs) - 1} more such" if len(pairs) > 1 else ""
        yield f"{what} {quoted(one)} and {quoted(other)} differ only in form and are taken for two{more}; write both alike if they are one"
