"""`warnings.jsonl`: what a live run noticed that its user should know. It follows from the journal alone; a run without warnings has no such file."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from osel_sim.core.errors import DataError
from osel_sim.core.files import write_bytes
from osel_sim.formats.journal import read_lines, to_line
from osel_sim.formats.values import AMOUNT, COUNT, NAME, Kind, fault

WARNINGS = "warnings.jsonl"


@dataclass(frozen=True)
class RunWarning:
    """Something changed that nobody announced.

    Attributes:
        index: of the decision after which it was noticed.
        kind: `success`: a policy succeeds less than it did; `price`: it costs another price than its file says.
        since: index of the first decision of the policy after the change.
        before, after: rates of success, or cents of an episode (as the file says, and as paid).
    """

    index: int
    kind: Literal["success", "price"]
    policy: str
    since: int
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """In words."""
        if self.kind == "price":
            return (
                f"{self.policy} costs another price than its file says: {self.after:.4g} cents instead of {self.before:.4g} in decision {self.since}"
            )
        return f"{self.policy} succeeds less than it did: {self.before:.2f} -> {self.after:.2f} since decision {self.since}"


def write_warnings(folder: Path, warnings: list[RunWarning]) -> None:
    """Write all there are, at once or not at all; nothing where there are none."""
    if warnings:
        write_bytes(folder / WARNINGS, "".join(to_line(asdict(warning)) for warning in warnings).encode(), sync=True)


def read_warnings(folder: Path) -> list[RunWarning]:
    """Read them; none where there is no file.

    Raises:
        DataError: naming file and line.
    """
    file = folder / WARNINGS
    return [_warning(data, f"{file}, line {number}") for number, (data, _) in enumerate(read_lines(file), 1)]


_KIND = Kind("success or price", lambda value: value in ("success", "price"))
_FIELDS = {"index": COUNT, "kind": _KIND, "policy": NAME, "since": COUNT, "before": AMOUNT, "after": AMOUNT}


def _warning(data: dict[str, Any], place: str) -> RunWarning:
    if problem := fault(data, _FIELDS):
        raise DataError(f"{place}: {problem}")
    return RunWarning(**data)
