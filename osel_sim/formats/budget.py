"""`budget.json`: what a live run spent of its budget, and what a cent was worth to it."""

from dataclasses import asdict, dataclass
from pathlib import Path

from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json, write_json
from osel_sim.formats.values import AMOUNT, COUNT, NUMBER, TEXT, Kind, fault

BUDGET = "budget.json"
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Spent:
    """What came of a budget.

    Attributes:
        cents: of a period.
        period: decisions of a period.
        decisions: that were made.
        spent: cents, over all periods.
        ended: why no decision can follow: what is left pays for none; empty where the budget did not end the run.
        reward_of_a_dollar, success_of_a_dollar: what one more dollar would have bought, by the price of a cent over the last quarter of decisions.
        prices: the price of a cent, in reward, at each decision.
    """

    cents: float
    period: int
    decisions: int
    spent: float
    ended: str
    reward_of_a_dollar: float
    success_of_a_dollar: float
    prices: tuple[float, ...]

    @property
    def sentence(self) -> str:
        """In words."""
        over = f" for each {self.period} decisions" if self.decisions > self.period else ""
        spent = f"spent {self.spent:.2f} cents in {self.decisions} decisions, of a budget of {self.cents:g}{over}"
        if self.reward_of_a_dollar <= 0.0:
            return f"{spent}; more money would have bought nothing"
        return f"{spent}; one more dollar would have bought about {self.reward_of_a_dollar:.2f} reward, {self.success_of_a_dollar:.2f} successes"


def write_budget(folder: Path, spent: Spent) -> None:
    """Write it, at once or not at all."""
    write_json(folder / BUDGET, {"schema_version": SCHEMA_VERSION, **asdict(spent)})


def read_budget(folder: Path) -> Spent | None:
    """Read it; None where the run had no budget.

    Raises:
        DataError: of another version or form.
    """
    file = folder / BUDGET
    if not file.is_file():
        return None
    data = read_json(file)
    if data.pop("schema_version", None) != SCHEMA_VERSION:
        raise DataError(f"{file}: schema_version must be {SCHEMA_VERSION}")
    if problem := fault(data, _FIELDS):
        raise DataError(f"{file}: {problem}")
    return Spent(**{**data, "prices": tuple(data["prices"])})


_NUMBERS = Kind("a list of finite numbers of 0 or more", lambda value: isinstance(value, list) and all(map(AMOUNT.fits, value)))
_FIELDS = {
    **{"cents": AMOUNT, "period": COUNT, "decisions": COUNT, "spent": AMOUNT, "ended": TEXT},
    **{"reward_of_a_dollar": NUMBER, "success_of_a_dollar": NUMBER, "prices": _NUMBERS},
}
