"""What a live run of several robots says of sharing on its page: measured, and played again."""

import json
from pathlib import Path

import numpy as np
import pytest
from report_helpers import made_run

from osel_sim.analysis.live import LiveLog, read_live
from osel_sim.analysis.live_sharing import RunFleet, fleet_of
from osel_sim.core.errors import DataError
from osel_sim.reporting.charts import Figure
from osel_sim.reporting.html_tables import Table
from osel_sim.reporting.robots_section import robots_sections
from osel_sim.selection.fleet import Sharing
from osel_sim.selection.reward import RewardWeights

FLEET = {"robots": 4, "share": "every:5", "delay": 2, "by": None}
BUDGET = 2_000


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Makes the files of a run of four robots."""
    folders = iter(range(100))

    def make(fleet: object = FLEET, selector: str = "thompson", decisions: int = 41, **settings: bool) -> LiveLog:
        folder: Path = made_run(tmp_path_factory.mktemp("run") / str(next(folders)), decisions, **settings)
        told = json.loads((folder / "run.json").read_text())
        told["configuration"] |= {"selector": selector, **({"fleet": fleet} if fleet else {})}
        (folder / "run.json").write_text(json.dumps(told))
        return read_live(folder)

    return make


def weights(live: LiveLog) -> RewardWeights:
    return RewardWeights(**live.reward)


def test_the_page_shows_what_was_measured_and_what_sharing_is_worth(run):
    live = run()
    [section] = robots_sections(live, weights(live), BUDGET)
    about, measured, table, told, worth, ways = section.blocks
    assert about.startswith("4 robots; decision t is robot t mod 4's.") and "After every 5 decisions" in about and "known 2 decisions later" in about
    assert (
        isinstance(measured, Figure) and isinstance(table, Table) and measured.title.startswith("Measured:") and table.title.startswith("Measured:")
    )
    assert [row["decisions"] for row in table.rows] == [11, 10, 10, 10, 41]
    assert isinstance(worth, Figure) and isinstance(ways, Table) and worth.title.startswith("Estimated:") and ways.title.startswith("Estimated:")
    assert told.startswith("Estimated: the same instances, played again to thompson") and "each alone" in told and "one that sees everything" in told
    assert {column.key for column in ways.columns} >= {"none", "every:5", "all"}
    received = np.array([decision.reward for decision in live.decisions if decision.index % 4 == 3 and decision.reward is not None])
    assert len(received) == 9 and np.isclose(table.rows[3]["reward"].value, received.mean())  # decision 3 ended in an error


def test_a_run_of_one_robot_has_no_such_section(run):
    live = run(fleet=None)
    assert fleet_of(live) is None and robots_sections(live, weights(live), BUDGET) == []


def test_a_run_that_does_not_know_the_others_outcomes_says_how_they_would_be_known(run):
    live = run(counterfactual=False)
    [section] = robots_sections(live, weights(live), BUDGET)
    assert "A run with --counterfactual tells it" in section.blocks[-1]
    assert "osel_sim.replay runs/log --selectors thompson --robots 4 --share every:5 --share-delay 2" in section.blocks[-1]


@pytest.mark.parametrize(("selector", "command"), [("ppo", True), ("fixed:near", False), ("random", False), ("MySelector", False)])
def test_a_selector_that_the_page_does_not_play_again_gets_a_command_where_one_works(run, selector, command):
    live = run(selector=selector)
    [section] = robots_sections(live, weights(live), BUDGET)
    assert f"not those of {selector}." in section.blocks[-1]
    assert ("osel_sim.replay" in section.blocks[-1]) is command


def test_too_few_decisions_are_said_to_be_too_few(run):
    live = run(decisions=3)
    [section] = robots_sections(live, weights(live), BUDGET)
    assert "Some robot has no instance yet" in section.blocks[-1]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"robots": 1}, "robots is 1"),
        ({"robots": "4"}, "robots is '4'"),
        ({"share": "every:0"}, "every:0"),
        ({"share": 5}, "share is 5"),
        ({"delay": -1}, "delay is -1"),
        ({"delay": None}, "delay is None"),
        ({"share": "none"}, "--share-delay 2"),
        ({"by": "colour"}, "by is 'colour'"),
    ],
)
def test_a_fleet_that_no_run_writes_is_refused(run, wrong, told):
    live = run({**FLEET, **wrong})
    with pytest.raises(DataError, match=r"configuration\.fleet of run\.json") as problem:
        fleet_of(live)
    assert told in str(problem.value)


@pytest.mark.parametrize(
    ("share", "delay", "decisions", "expected"),
    [("every:5", 2, 20, [7, 12, 17]), ("every:5", 0, 10, [5, 10]), ("every:20", 0, 10, []), ("none", 0, 10, []), ("all", 0, 10, [])],
)
def test_what_was_told_is_known_when_it_has_arrived(share, delay, decisions, expected):
    assert RunFleet(4, Sharing.parse(share, delay)).arrivals(decisions) == expected
