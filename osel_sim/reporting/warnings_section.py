"""What a live run noticed that nobody announced."""

from pathlib import Path

from osel_sim.formats.run_warnings import read_warnings
from osel_sim.reporting.page import Section
from osel_sim.statistics.change import RATE

ASSUMED = (
    "A fall in success is told where bets on one, begun at every fourth decision of the policy and settled with what it came to in the same task at "
    f"the same level, are worth {1 / RATE:,.0f} times their stake: without any change at most one false warning in so many decisions, on average, "
    "over all policies together. It is taken for granted that among the instances of a task and level a policy is not given harder ones than before."
)


def warnings_section(folder: Path) -> list[Section]:
    """The warnings of a run's folder, in words; nothing where there are none."""
    warnings = read_warnings(folder)
    told = [f"Decision {warning.index}: {warning.sentence}." for warning in warnings]
    return [Section("warnings", "What changed", [*told, ASSUMED])] if warnings else []
