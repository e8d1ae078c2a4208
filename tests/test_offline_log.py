"""A rollout log as arrays: the same rewards as everywhere else, and what is missing stays missing."""

from pathlib import Path

import numpy as np
import pytest
from synthetic_log import clusters, make_row, write_log

from osel_sim.analysis.log import read_log
from osel_sim.analysis.outcomes import per_group
from osel_sim.cli.console import console
from osel_sim.cli.rollout_tables import print_rollouts
from osel_sim.core.content import root
from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.reporting.episodes import note_of
from osel_sim.selection.reward import PRESETS, RewardWeights, reward

SHIPPED = root() / "assets" / "logs" / "pick_place"
ONE = np.ones(3, np.float32)


@pytest.mark.parametrize("name", PRESETS)
def test_rewards_are_those_of_the_rows(name):
    rows, _ = read_rollouts(SHIPPED)
    log = read_log(SHIPPED)
    table = log.rewards(PRESETS[name])
    assert table.shape == (1000, 2, 3) and log.contexts.shape == (1000, 256)
    for row in rows[::7]:
        place = log.keys.index(row.instance), log.policies.index(row.policy), row.repeat
        assert table[place] == pytest.approx(reward(row.outcome, PRESETS[name]), abs=1e-12)


def test_errors_and_what_never_ran_are_missing_not_failures(tmp_path: Path):
    rows = [
        make_row("i0", "a", 0),
        make_row("i0", "a", 1, success=False),
        make_row("i0", "b", 0, success=False, error="the server died"),
        make_row("i1", "a", 1, motion=10.0),
    ]
    log = read_log(write_log(tmp_path, rows, {"i0": ONE, "i1": 2 * ONE}))
    table = log.rewards(RewardWeights(0.5, 0.0))
    assert np.isnan(table).tolist() == [[[False, False], [True, True]], [[True, False], [True, True]]]
    assert table[1, 0, 1] == 0.5
    assert log.mean_rewards(RewardWeights(0.0, 0.0))[0, 0] == 0.5
    assert log.errors.sum() == 1 and log.errors[0, 1, 0]
    assert log.only(["b"]).success.shape == (2, 1, 2) and log.take([1]).keys == ("i1",)
    assert log.contexts[1].tolist() == [2, 2, 2]


def test_a_fallbacks_successes_are_told_apart_and_credited_to_nobody(tmp_path: Path, capsys):
    dead = {"fallback": "closed the connection", "actions": 0, "fallback_steps": 20}
    late = {"fallback": "deadline", "actions": 8, "fallback_steps": 12}
    rows = [make_row("a", "remote", **dead), make_row("b", "remote", **late), make_row("c", "remote"), make_row("d", "remote", success=False, **dead)]
    write_log(tmp_path, rows, {name: np.ones(4) for name in "abcd"})
    assert read_rollouts(tmp_path)[1]["schema_version"] == 4
    log = read_log(tmp_path)
    assert log.success.ravel().tolist() == [0.0, 1.0, 1.0, 0.0]
    assert log.subgoals.ravel().tolist() == [0.0, 1.0, 1.0, 0.0]
    assert log.fallbacks.ravel().tolist() == [True, True, False, True]
    assert log.solved_by_fallback.ravel().tolist() == [True, True, False, False]
    weights = RewardWeights(0.2, 0.01)
    everything = per_group(log, weights)[0]
    assert (everything.fallbacks, everything.solved_by_fallback, everything.success.value) == (3, 2, 0.5)
    assert log.rewards(weights).ravel().tolist() == pytest.approx([reward(row.outcome, weights) for row in rows])
    print_rollouts(console(), rows, weights)
    cells = [cell.strip() for cell in next(line for line in capsys.readouterr().out.splitlines() if "remote" in line).split("│")]
    assert "50% [15, 85]" in cells and cells[-4:-1] == ["3", "2", "0"]  # fallbacks, solved by them, errors
    assert note_of(rows[0])["fallback"] == "closed the connection; it drove 20 of 20 steps; it solved the task alone, which is no success of remote"
    assert note_of(rows[1])["fallback"] == "deadline; it drove 12 of 20 steps"


def test_expected_costs_are_those_of_successes_where_there_are_any(tmp_path: Path):
    rows = [make_row(f"i{n}", policy, motion=10.0 ** (n + 1), price=n, success=n < 2) for n in range(3) for policy in "ab"]
    rows += [make_row("i0", "never", success=False, motion=100.0, price=3.0)]
    log = read_log(write_log(tmp_path, rows, {f"i{n}": ONE for n in range(3)}))
    assert log.expected_costs(RewardWeights(0.5, 0.1)) == pytest.approx({"a": 0.8, "b": 0.8, "never": 1.3})


def test_halves_are_disjoint_complete_and_do_not_depend_on_the_rest(tmp_path: Path):
    whole = read_log(clusters(tmp_path / "a", instances=200, clusters=3, dim=4, policies=2).folder)
    choose, score = whole.half("choose"), whole.half("score")
    assert (choose ^ score).all() and 70 < choose.sum() < 130
    assert (whole.take(range(50, 100)).half("choose") == choose[50:100]).all()


def test_columns_of_others_may_be_null(tmp_path: Path):
    rows = [make_row("q", name, steps=None, motion=None, upload=None, inference=2.0, download=None, price=None) for name in ("a", "b")]
    log = read_log(write_log(tmp_path, rows, {"q": ONE}))
    assert log.seconds.ravel().tolist() == [2.0, 2.0]
    assert log.rewards(RewardWeights(0.0, 0.0)).ravel().tolist() == [1.0, 1.0]
    with pytest.raises(DataError, match=r"no prices.*--alpha-price 0"):
        log.rewards(RewardWeights(0.0, 0.1))
    with pytest.raises(DataError, match=r"no steps.*--alpha-time 0"):
        log.rewards(RewardWeights(0.1, 0.0, "steps"))


def test_wrong_logs_are_refused(tmp_path: Path):
    with pytest.raises(DataError, match="does not exist"):
        read_log(tmp_path)
    with pytest.raises(DataError, match="'i', policy 'a', repeat 0 is there twice"):
        read_log(write_log(tmp_path / "twice", [make_row("i", "a"), make_row("i", "a")], {"i": ONE}))
    with pytest.raises(DataError, match="column 'price', row 1: must be a finite number of 0 or more or null, got nan"):
        read_log(write_log(tmp_path / "nan", [make_row("i", "a", price=float("nan"))], {"i": ONE}))
    with pytest.raises(DataError, match="no context of 1 instances"):
        read_log(write_log(tmp_path / "context", [make_row("i", "a"), make_row("j", "a")], {"i": ONE}))
    good = read_log(write_log(tmp_path / "good", [make_row("i", "a")], {"i": ONE}))
    with pytest.raises(UnknownNameError, match="unknown policy 'c'"):
        good.only(["c"])
    with pytest.raises(UsageError, match="each once"):
        good.only(["a", "a"])
