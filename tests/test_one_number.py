"""A quantity has one value and one interval on a page, wherever it stands."""

from pathlib import Path

import pytest
from report_helpers import FAR, NEAR, WEIGHTS, made_log, made_replay, made_run
from rich.console import Console

from osel_sim.analysis.estimate import Estimate
from osel_sim.cli.rollout_tables import print_rollouts
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.reporting.html_tables import Table
from osel_sim.reporting.log_page import log_page
from osel_sim.reporting.page import Page
from osel_sim.reporting.replay_page import ReplayOptions, replay_page
from osel_sim.reporting.run_page import run_page


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory):
    """Three repeats, of which a replay draws one."""
    return made_log(tmp_path_factory.mktemp("log"), 60, repeats=3)


def table(page: Page, name: str) -> Table:
    return next(block for block in page.tables if block.name == name)


def policies(page: Page) -> dict[str, dict]:
    """The rows of the table of policies over all tasks."""
    return {str(row["policy"]): dict(row) for row in table(page, "policies").rows if row["group"] == "all"}


def test_a_fixed_policy_is_worth_the_same_all_over_the_page_of_a_replay(log, tmp_path: Path) -> None:
    page = replay_page(made_replay(tmp_path, log), ReplayOptions())
    own = policies(page)
    rows = {str(row["selector"]).partition(" (best")[0].partition(" (worst")[0]: row for row in table(page, "selectors").rows}
    for policy in (NEAR, FAR):
        assert isinstance(own[policy]["reward"], Estimate)
        assert rows[f"always {policy}"]["reward"] == own[policy]["reward"] and rows[f"always {policy}"]["success"] == own[policy]["success"]
        assert rows[f"always {policy}"]["mean_price"] == own[policy]["price"].value
    best = max(own, key=lambda policy: own[policy]["reward"].value)
    single = next(row for row in table(page, "oracles").rows if row["oracle"] == "best single")
    assert single["reward"] == own[best]["reward"]
    assert page.verdict.tiles[0].note == f"mean reward {own[best]['reward'].value:.3f}"
    dots = {dot["name"]: dot for figure in page.figures if figure.name == "success_against_penalty" for dot in dots_of(figure.spec)}
    for policy in (NEAR, FAR):
        name = next(name for name in dots if name.startswith(f"always {policy}"))
        assert dots[name]["y"] == pytest.approx(100 * own[policy]["success"].value, rel=1e-3)


def dots_of(spec: dict) -> list[dict]:
    """All inline records of a figure that stand for dots."""
    found = [value for value in spec.get("datasets", {}).values()] + [spec.get("data", {}).get("values", [])]
    for part in (*spec.get("concat", ()), *spec.get("layer", ())):
        found.append(dots_of(part))
    return [record for records in found for record in records if isinstance(record, dict) and "ty" in record and "dx" in record]


def test_intervals_are_over_instances_however_many_seeds(log, tmp_path: Path) -> None:
    widths = []
    for seeds in (2, 12):
        page = replay_page(made_replay(tmp_path / str(seeds), log, seeds), ReplayOptions())
        row = next(row for row in table(page, "selectors").rows if row["selector"] == "ppo")
        assert isinstance(row["reward"], Estimate)
        widths.append(row["reward"].high - row["reward"].low)
    assert widths[1] > 0.5 * widths[0]  # over seeds alone it would be that of the order, and go on shrinking


def test_the_best_policy_is_worth_the_same_all_over_the_page_of_a_log(log, capsys) -> None:
    page = log_page(log, WEIGHTS)
    own = policies(page)
    best = max(own, key=lambda policy: own[policy]["reward"].value)
    reward, success = own[best]["reward"], own[best]["success"]
    tiles = {tile.label: tile for tile in page.verdict.tiles}
    assert f"mean reward {reward.value:.3f}, 95% [{reward.low:.3f}, {reward.high:.3f}]" in tiles["best single policy"].note
    assert tiles["its success"].value == f"{100 * success.value:.0f}%"
    print_rollouts(Console(width=200), read_rollouts(log.source)[0], WEIGHTS)
    said = capsys.readouterr().out
    for row in own.values():
        assert f"{row['reward'].value:.3f}" in said and f"{100 * row['success'].value:.0f}% [{100 * row['success'].low:.0f}," in said


def test_what_a_run_received_is_one_number(tmp_path: Path) -> None:
    page = run_page(made_run(tmp_path))
    received = table(page, "chosen").rows[0]["reward"]
    off_policy = {str(row["who"]): row for row in table(page, "off_policy").rows}
    assert off_policy["ppo (as it was)"]["measured"] == received
    assert page.verdict.tiles[0].value == f"{received.value:.3f}"
    for policy in (NEAR, FAR):
        assert off_policy[f"always {policy}"]["measured"] == pytest.approx(policies(page)[policy]["reward"].value)
