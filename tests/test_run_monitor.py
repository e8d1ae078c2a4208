"""Live runs with a monitor: what they write, going on after an interruption, and what is refused."""

import json
import shutil
import sys

import pytest
from run_helpers import execute

from osel_sim.analysis.live import read_live
from osel_sim.formats.journal import JOURNAL, TIMING, read_journal
from osel_sim.formats.points import POINTS, to_points
from osel_sim.formats.run_config import RUN
from osel_sim.interface.monitor import Candidate
from osel_sim.reporting.run_page import run_page
from osel_sim.run import main
from osel_sim.selection.monitors.registry import MONITORS, make_monitor

EPISODES = 4
SETTINGS = ("--selector", "random", "--monitor", "value", "--decide-every", "1", "--episodes", EPISODES, "--counterfactual", "--no-page")


@pytest.fixture(scope="module")
def run(world):
    done = execute(world, "run", "--out", "run", *SETTINGS, "--video", 1)
    assert done.returncode == 0, done.stderr
    return world / "run", done.stdout


@pytest.mark.slow
def test_journal_tells_handoffs_duty_and_price_by_policy(run):
    folder, printed = run
    decisions = read_journal(folder / JOURNAL)
    assert len(decisions) == EPISODES
    for decision in decisions:
        told = decision.monitored
        assert told is not None and 2 <= told.points <= 3
        assert sum(one.steps for one in told.by_policy.values()) == decision.steps
        assert sum(one.price for one in told.by_policy.values()) == pytest.approx(decision.price)
        assert told.duty_steps == pytest.approx(told.by_policy["wild"].steps / decision.steps if "wild" in told.by_policy else 0.0)
        assert [one.driver for one in told.handoffs[:1]] == [decision.policy] * len(told.handoffs[:1])
    assert any(decision.monitored.handoffs for decision in decisions)  # it tries what it does not know
    assert "Monitor value: " in printed and "of the same choices without it" in printed
    assert json.loads((folder / RUN).read_text())["configuration"]["monitor"] == {"name": "value", "decide_every": 1}
    assert len(list((folder / "videos").iterdir())) == 1


@pytest.mark.slow
def test_what_it_saw_lies_beside_the_journal(run):
    folder, _ = run
    decisions = read_journal(folder / JOURNAL)
    for decision, line in zip(decisions, (folder / POINTS).read_text().splitlines(), strict=True):
        seen = to_points(json.loads(line), decision.index, folder / POINTS, ("calm", "wild"), decision.instruction)
        assert len(seen.points) == decision.monitored.points
        assert all(point.look.picture().shape == (53,) for point in seen.points)
        assert all(sum(turn.propensities.values()) == pytest.approx(1.0) for turn in seen.turns)
    log = read_live(folder)  # the run can be estimated from, as any other
    assert log.outcomes.success.shape[:2] == (EPISODES, 2)
    others = [json.loads(line) for line in (folder / "counterfactual.jsonl").read_text().splitlines()]
    assert all(set(line) == {"index", "policies", "alone"} and "monitored" not in line["alone"] for line in others)
    timed = [set(json.loads(line)["episodes"]) for line in (folder / TIMING).read_text().splitlines()]
    assert timed == [{"calm", "wild", f"{decision.policy} alone"} for decision in decisions]


@pytest.mark.slow
def test_a_run_that_was_cut_off_goes_on_to_the_same_bytes(run, world):
    folder, _ = run
    cut = world / "cut"
    shutil.copytree(folder, cut)
    shutil.rmtree(cut / "videos")
    for name, lines in ((JOURNAL, 2), (POINTS, 3), ("counterfactual.jsonl", 3), (TIMING, 3)):  # killed within the third decision
        kept = (folder / name).read_bytes().split(b"\n")[:lines]
        (cut / name).write_bytes(b"\n".join(kept) + b"\n" + b'{"index": ' * (name == JOURNAL))
    done = execute(world, "run", "--out", "cut", *SETTINGS, "--video", 1, "--resume")
    assert done.returncode == 0, done.stderr
    for name in (JOURNAL, POINTS, "counterfactual.jsonl", "summary.json"):
        assert (cut / name).read_bytes() == (folder / name).read_bytes(), name


@pytest.mark.slow
def test_its_policies_do_not_come_and_go(run, world):
    done = execute(world, "run", "--out", "run", *SETTINGS, "--video", 1, "--resume", "--retire", "wild")
    assert done.returncode == 2 and "do not come and go" in done.stderr


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--monitor", "valu"), "did you mean 'value'"),
        (("--monitor", "blind:8:remote_larg", "--policies", "local_small", "remote_large"), "did you mean 'remote_large'"),
        (("--monitor", "blind:8:remote_large", "--policies", "local_small", "remote_specialist"), "unknown policy 'remote_large'"),
        (("--monitor", "blind:0"), "K must be an integer of at least 1"),
        (("--monitor", "never", "--decide-every", "0"), "decide-every"),
        (("--decide-every", "2"), "does nothing without --monitor"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_loads(flags, said, tmp_path, capsys):
    assert main(["--task", "press_button", "--out", str(tmp_path / "run"), *flags]) == 2
    assert said in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "run").exists()


def test_other_packages_bring_monitors(tmp_path, monkeypatch):
    (tmp_path / "nervous-1.0.dist-info").mkdir()
    (tmp_path / "nervous-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: nervous\nVersion: 1.0\n")
    (tmp_path / "nervous-1.0.dist-info" / "entry_points.txt").write_text("[osel_sim.monitors]\nnervous = nervous:Nervous\nnever = nervous:Nervous\n")
    (tmp_path / "nervous.py").write_text(
        "from osel_sim.selection.monitors.unseeing import NeverMonitor\n\n\nclass Nervous(NeverMonitor):\n"
        "    def __init__(self, candidates, picture_dim, seed, limit='1'):\n"
        "        super().__init__(candidates, picture_dim, seed)\n        self.limit = limit\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert "nervous" in MONITORS and MONITORS.others() == ["nervous"]  # none replaces a built-in one
    candidates = [Candidate("a", False), Candidate("b", True)]
    assert make_monitor("nervous:7", candidates, 1, 0).limit == "7"
    assert type(make_monitor("never", candidates, 1, 0)).__name__ == "NeverMonitor"
    sys.modules.pop("nervous")


@pytest.mark.slow
def test_its_page_shows_who_drove_and_what_the_same_choices_come_to_without_it(run):
    folder, _ = run
    decisions = read_journal(folder / JOURNAL)
    page = run_page(folder)
    section = next(section for section in page.sections if section.name == "handoffs")
    figure, driving, compared = section.blocks
    assert figure.caption.startswith(f"{EPISODES} episodes")
    drawn = next(iter(figure.spec["datasets"].values()))
    assert len(drawn) == sum(1 + len(decision.monitored.handoffs) for decision in decisions)
    assert max(row["to"] for row in drawn) == max(decision.steps for decision in decisions)
    assert {row["policy"] for row in driving.rows} == {"calm", "wild"} and sum(row["steps"] for row in driving.rows) == pytest.approx(1.0)
    assert sum(row["took"] for row in driving.rows) == sum(len(decision.monitored.handoffs) for decision in decisions)
    received = json.loads((folder / "summary.json").read_text())
    assert page.verdict.tiles[0].value == f"{received['mean_reward']:.3f}"  # what the run came to, not what it would have without the monitor
    summary = received["monitor"]
    assert compared.rows[0]["duty"] == pytest.approx(summary["duty_steps"]) and compared.rows[0]["reward"].value == pytest.approx(summary["with"])
    assert compared.rows[1]["reward"].value == pytest.approx(summary["without"])
