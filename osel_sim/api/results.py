"""What the functions of the Python API return: tables as pandas frames, figures that show themselves in a notebook."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import pandas

    from osel_sim.formats.budget import Spent
    from osel_sim.formats.journal import Decision
    from osel_sim.formats.rollout_log import Row
    from osel_sim.reporting.charts import Figure


def frame(rows: Iterable[Any]) -> "pandas.DataFrame":
    """Dataclasses or mappings as a table, nested ones as columns `outer.inner`."""
    import pandas

    plain = [asdict(row) if is_dataclass(row) and not isinstance(row, type) else dict(row) for row in rows]
    return pandas.json_normalize(plain)


@dataclass(frozen=True)
class RunResult:
    """What came of a live run.

    Attributes:
        folder: where everything lies that it wrote.
        summary: means over all decisions and by policy, as `summary.json` has them.
        journal: its decisions.
        page: the page about it, or None where it could not be written.
        interrupted: Ctrl-C ended it; `run(..., resume=True)` goes on.
        verdict: whether routing is worth it on its instances, as the page says it; empty without a page.
        spent: what came of its budget; None of a run without one.
    """

    folder: Path
    summary: Mapping[str, Any]
    journal: "tuple[Decision, ...]"
    page: Path | None = None
    interrupted: bool = False
    verdict: str = ""
    spent: "Spent | None" = None

    @cached_property
    def decisions(self) -> "pandas.DataFrame":
        """A row a decision: instance, policy, propensities, outcome, reward."""
        return frame(self.journal)

    @cached_property
    def curve(self) -> "Figure":
        """Mean reward so far, and the share of each policy. It shows itself in a notebook; `.chart` is Altair's, `.save(FILE)` writes it."""
        from osel_sim.reporting.run_page import run_curve

        return run_curve(self.folder)


@dataclass(frozen=True)
class RecordResult:
    """What came of a recording.

    Attributes:
        folder: of the rollout log.
        recorded: how many episodes were run this time.
        seconds: that it took.
        comparison: of a recording until decided, as `compare` has it; None of others.
        instances, planned: of a recording until decided, how many instances it took, and how many there might have been.
        spared: episodes that were planned and not needed.
    """

    folder: Path
    recorded: int = 0
    seconds: float = 0.0
    comparison: Mapping[str, Any] | None = None
    instances: int = 0
    planned: int = 0
    spared: int = 0

    @property
    def verdict(self) -> str:
        """Of a recording until decided: which is better? In words; empty of others."""
        return str(self.comparison["verdict"]["text"]) if self.comparison else ""

    @cached_property
    def rows(self) -> "list[Row]":
        """The log's rows."""
        from osel_sim.formats.rollout_log import read_rollouts

        return read_rollouts(self.folder)[0]

    @cached_property
    def episodes(self) -> "pandas.DataFrame":
        """A row an episode."""
        return frame(self.rows)


@dataclass(frozen=True)
class ReplayResult:
    """What came of a replay.

    Attributes:
        folder: where everything lies that it wrote.
        result: as `replay.json` has it; None where a live run had only the outcomes of what it chose.
        off_policy: estimates from a live run's propensities, or None.
    """

    folder: Path
    result: Mapping[str, Any] | None = None
    off_policy: Mapping[str, Any] | None = None

    @property
    def pending(self) -> list[str]:
        """What is not replayed yet: names of selectors, `budget`, `frontier` and `sharing`."""
        return list(self.result.get("pending", [])) if self.result else []

    @property
    def verdict(self) -> str:
        """Is routing worth it? In words; empty where nothing was replayed."""
        return str(self.result["verdict"]["text"]) if self.result else ""

    @cached_property
    def selectors(self) -> "pandas.DataFrame":
        """A row a selector: reward, success, price, gap closed, regret, each with its interval."""
        return self._table("selectors")

    @cached_property
    def oracles(self) -> "pandas.DataFrame":
        """A row an oracle."""
        return self._table("oracles")

    @cached_property
    def paired(self) -> "pandas.DataFrame":
        """A row a pair of selectors: their difference over the same streams."""
        return self._table("paired")

    @cached_property
    def curve(self) -> "Figure":
        """Mean reward of every selector over decisions, with the oracles. It shows itself in a notebook; `curve.chart` is Altair's."""
        from osel_sim.reporting.replay_page import replay_curve

        return replay_curve(self.folder)

    def _table(self, name: str) -> "pandas.DataFrame":
        from osel_sim.analysis.result import tables

        return frame(tables(cast(dict[str, Any], self.result))[name] if self.result else [])


@dataclass(frozen=True)
class MomentsResult:
    """What came of a replay of a table of moments.

    Attributes:
        folder: where everything lies that it wrote.
        result: as `moments.json` has it.
    """

    folder: Path
    result: Mapping[str, Any]

    @property
    def verdict(self) -> str:
        """Whether to hand over, in words."""
        return str(self.result["verdict"]["headline"])

    @cached_property
    def arms(self) -> "pandas.DataFrame":
        """A row for each start selector with each monitor."""
        return self._table("arms")

    @cached_property
    def gains(self) -> "pandas.DataFrame":
        """A row a task, first policy, second policy and decision point: what handing over there gains."""
        return self._table("gains")

    def _table(self, name: str) -> "pandas.DataFrame":
        from osel_sim.analysis.moment_tables import tables

        return frame(tables(self.result)[name])


@dataclass(frozen=True)
class CompareResult:
    """What came of a comparison.

    Attributes:
        folder: where `compare.json` is; None where none was asked for.
        result: as `compare.json` has it.
    """

    folder: Path | None
    result: Mapping[str, Any]

    @property
    def file(self) -> Path | None:
        """`compare.json`."""
        from osel_sim.formats.compare_result import COMPARE

        return None if self.folder is None else self.folder / COMPARE

    @property
    def page(self) -> Path | None:
        """The page beside it; None of a plan."""
        from osel_sim.reporting.page import PAGE

        return None if self.folder is None or "plan" in self.result else self.folder / PAGE

    @property
    def decision(self) -> str:
        """`better`, `worse`, `no worse` or `not enough data`; empty of a plan. Of several policies that of the first that is found in the order
        worse, not enough data, no worse, better."""
        return str(self.result["verdict"]["decision"]) if "verdict" in self.result else ""

    @property
    def verdict(self) -> str:
        """Did it get worse? In words; empty of a plan."""
        return str(self.result["verdict"]["text"]) if "verdict" in self.result else ""

    @property
    def exit_code(self) -> int:
        """Of the command: 0 no worse, or a plan; 1 worse; 3 not enough data."""
        return int(self.result["verdict"]["exit_code"]) if "verdict" in self.result else 0

    @cached_property
    def differences(self) -> "pandas.DataFrame":
        """A row a pair of policies and measure: both means, the difference with its interval."""
        return frame(
            {"first": pair["first"], "second": pair["second"], "measure": name, **_means(found)}
            for pair in self.result.get("pairs", ())
            for name, found in pair["differences"].items()
        )

    @cached_property
    def tasks(self) -> "pandas.DataFrame":
        """A row a pair of policies and task: the difference of success, with its p corrected over the tasks."""
        return frame(
            {"first": pair["first"], "second": pair["second"], "task": name, **_means(found)}
            for pair in self.result.get("pairs", ())
            for name, found in pair["tasks"].items()
        )

    @cached_property
    def flips(self) -> "pandas.DataFrame":
        """A row a pair of policies and instance whose success is not the same."""
        return frame(
            {"first": pair["first"], "second": pair["second"], "instance": flip["instance"], "task": flip["task"]}
            | {f"success_{side}": flip[side] for side in ("first", "second")}
            for pair in self.result.get("pairs", ())
            for flip in pair["flips"]
        )

    @property
    def plan(self) -> "pandas.DataFrame":
        """A row a pair of policies: instances needed. Empty of a comparison."""
        return frame(self.result.get("plan", ()))


def _means(found: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of a comparison, whose `first` and `second` are means, as columns."""
    low, high = found["ci95"] or (None, None)
    rest = {name: value for name, value in found.items() if name not in ("first", "second", "ci95")}
    return {"mean_first": found["first"], "mean_second": found["second"], **rest, "low": low, "high": high}
