"""Why episodes ended in an error: each cause once, with how often it was and where first."""

from collections.abc import Iterable

from osel_sim.core.shown import shown

MOST = 5
LONGEST = 300


def print_causes(errors: Iterable[tuple[str, str, str]]) -> None:
    """Print the causes, the most frequent first.

    Args:
        errors: (policy, where, what it ended in) of each episode that did.
    """
    found: dict[tuple[str, str], list[str]] = {}
    for policy, where, error in errors:
        found.setdefault((policy, error.removeprefix(f"{policy}: ")), []).append(where)
    causes = sorted(found.items(), key=lambda item: -len(item[1]))
    for (policy, error), places in causes[:MOST]:
        count = f"{len(places)} episodes" if len(places) > 1 else "1 episode"
        first = f"first in {places[0]}" if len(places) > 1 else f"in {places[0]}"
        print(shown(f"{count} of {policy} ended in an error, {first}: {error[:LONGEST]}"))
    if more := causes[MOST:]:
        print(f"{sum(len(places) for _, places in more)} more ended in {len(more)} other errors")
