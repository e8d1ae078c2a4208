"""Estimates of ways of choosing of one's own: from tables, and from functions through the API."""

import pytest
from test_offline_live import make_run

import osel_sim as osel
from osel_sim.core.errors import DataError, OselError, UsageError

HALF = "policy,probability\nlocal,0.5\nremote,.5\n"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("targets") / "run")


@pytest.fixture
def estimated(run, tmp_path):
    """Estimates of targets: functions by name, or the text of a table."""

    def estimate(targets, name="mine.csv"):
        if isinstance(targets, str):
            (tmp_path / name).write_text(targets)
            targets = tmp_path / name
        return osel.replay(run, targets=targets, out=tmp_path / "out", overwrite=True).off_policy["targets"]

    return estimate


def test_a_table_and_a_function_that_choose_alike_are_estimated_alike(estimated):
    found = estimated(HALF)
    assert found["mine"] == found["random"]  # what half and half is
    assert estimated({"mine": lambda instance, context: {"local": 0.5, "remote": 0.5}})["mine"] == found["random"]


def test_rows_hold_for_a_decision_or_an_instance(estimated):
    by_decision = "decision,policy,probability\n" + "".join(f"{row},local,1\n" for row in reversed(range(400)))
    by_instance = "".join(f'{{"instance": "t/test/0/{row}", "policy": "local", "probability": 1}}\n' for row in range(400))
    for found in (estimated(by_decision), estimated(by_instance, "mine.jsonl")):
        assert found["mine"] == {**found["fixed:local"], "measured": None}


def test_a_function_sees_the_instance_and_its_context(estimated):
    found = estimated({"mine": lambda instance, context: {"local" if instance.seed % 2 and len(context) == 4 else "remote": 1.0}})["mine"]
    assert found["unsupported"] == 0.0 and 0.0 < found["effective_decisions"] < 399


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("policy,probability\nlocl,1\n", "row 1.*did you mean 'local'|did you mean 'local'.*row 1"),
        ("policy,probability\nlocal,.5\n", "must sum to 1, and come to 0.5"),
        ("policy,chance\nlocal,1\n", "no column 'probability'"),
        ("policy,probability\nlocal,1.5\n", r"row 1 .*must be in \[0, 1\]"),
        ("policy,probability\nlocal,.5\nlocal,.5\n", "is in row 1 already"),
        ("policy,probability\nlocal,\n", "row 1"),
        ("decision,policy,probability\n0,local,1\n", "no row of decision 1"),
        ("decision,policy,probability\n0.5,local,1\n", "0 to 399, got '0.5'"),
        ("decision,policy,probability\n400,local,1\n", "0 to 399, got '400'"),
        ("instance,policy,probability\nt/test/0/0,local,1\n", "no row of instance 't/test/0/1'"),
        ("decision,instance,policy,probability\n0,t/test/0/0,local,1\n", "one of them"),
        ("policy,probability\n", "has no rows"),
    ],
)
def test_a_table_that_says_something_else_is_refused(estimated, table, said):
    with pytest.raises(OselError, match=said):
        estimated(table)


@pytest.mark.parametrize("answer", [{"local": 0.5}, {"lokal": 1.0}, "local", {"local": "x"}, {"local": float("nan")}, {"local": 2.0, "remote": -1.0}])
def test_a_function_that_returns_no_probabilities_is_refused(estimated, answer):
    with pytest.raises(UsageError, match=r"decision 0 \(t/test/0/0\)"):
        estimated({"mine": lambda instance, context: answer})


def test_names_that_are_taken_and_logs_that_have_all_outcomes_are_refused(estimated, tmp_path):
    with pytest.raises(UsageError, match="'greedy'"):
        estimated({"greedy": lambda instance, context: {"local": 1.0}})
    with pytest.raises(UsageError, match="'random'"):
        estimated(HALF, "random.csv")
    with pytest.raises(DataError, match="no such file"):
        estimated([tmp_path / "none.csv"])
    with pytest.raises(UsageError, match="every policy"):
        osel.replay("assets/logs/pick_place", targets={"mine": lambda instance, context: {}}, out=tmp_path / "replay")
