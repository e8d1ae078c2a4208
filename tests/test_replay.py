"""`python -m osel_sim.replay`: one log, many selectors, a verdict."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from synthetic_log import clusters, make_row, write_log

from osel_sim.analysis.engine import Part, Setup, replay_parts
from osel_sim.analysis.engine import replay as replay_all
from osel_sim.analysis.gains import Gain
from osel_sim.analysis.log import read_log
from osel_sim.analysis.measures import Curves, gap_closed
from osel_sim.api.replay import replay
from osel_sim.cli.replay_tables import print_replay
from osel_sim.core.errors import DataError
from osel_sim.core.interrupts import uninterrupted
from osel_sim.formats.replay_result import read_replay
from osel_sim.formats.rollout_log import write_rollouts
from osel_sim.interface.selector import Choice
from osel_sim.replay import main as replay_main
from osel_sim.report import main as report_main
from osel_sim.selection.reward import RewardWeights

FREE = ["--alpha-time", "0", "--alpha-price", "0", "--workers", "1", "--no-frontier"]


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """Where context matters a lot: four clusters, three policies."""
    return clusters(tmp_path_factory.mktemp("log"), instances=600, clusters=4, dim=8, policies=3, seed=5).folder


def run(*arguments: object) -> int:
    return replay_main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def replayed(log, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out") / "replay"
    assert run(log, "--selectors", "linucb", "thompson", "random", "--seeds", 6, "--out", out, *FREE) == 0
    return out


def test_result(replayed, log):
    result, choices = read_replay(replayed)
    json.dumps(result, allow_nan=False)
    assert result["log"]["instances"] == result["decisions"] == 600 and result["seeds"] == list(range(6))
    assert set(result["selectors"]) == {
        "linucb", "thompson", "random", "best_single", "worst_single", "fixed:policy_0", "fixed:policy_1", "fixed:policy_2"
    }  # fmt: skip
    table = read_log(log).rewards(RewardWeights(0.0, 0.0))
    for name, entry in result["selectors"].items():
        received = choices.received(name, table)
        assert received.shape == (6, 600) and entry["mean_reward"] == pytest.approx(received.mean())
        assert entry["ci95"][0] - 1e-9 <= entry["mean_reward"] <= entry["ci95"][1] + 1e-9
        assert sum(entry["shares"].values()) == pytest.approx(1.0)
    means = {name: entry["mean_reward"] for name, entry in result["selectors"].items()}
    oracles = {name: entry["mean_reward"] for name, entry in result["oracles"].items()}
    assert means["worst_single"] < means["random"] < means["best_single"] == oracles["best_single"] < means["linucb"] < oracles["predictable"] < 1
    gap = (means["linucb"] - means["best_single"]) / (oracles["predictable"] - means["best_single"])
    best = result["selectors"]["linucb"]
    assert best["learnable_gap_closed"] == pytest.approx(gap)
    assert best["learnable_gap_closed_late"] > best["learnable_gap_closed"] > 0.4
    assert best["predictable_gap_closed"] == best["learnable_gap_closed"]  # the same oracle, where there are no repeats
    assert best["regret"]["hindsight"] == pytest.approx(oracles["hindsight"] - means["linucb"])
    assert 0 < best["decisions_until_better"] < best["decisions_until_ahead"] < 300
    assert result["selectors"]["thompson"]["decisions_until_ahead"] is None
    pair = next(pair for pair in result["paired"] if {pair["a"], pair["b"]} == {"linucb", "thompson"})
    assert pair["ci95"][0] > 0 or pair["ci95"][1] < 0


def test_verdict_is_to_route(replayed):
    verdict = read_replay(replayed)[0]["verdict"]
    assert verdict["decision"] == "route" and verdict["selector"] == "linucb"
    assert verdict["text"].startswith("Route with linucb")
    low, high = verdict["stake"]["gain_bounds"]
    assert 0 < low < verdict["stake"]["gain"] < high and verdict["stake"]["success_rate"] > 0


def test_tables(replayed):
    with (replayed / "selectors.csv").open() as file:
        rows = {row["selector"]: row for row in csv.DictReader(file)}
    assert float(rows["linucb"]["mean_reward"]) == read_replay(replayed)[0]["selectors"]["linucb"]["mean_reward"]
    assert len((replayed / "paired.csv").read_text().splitlines()) == 1 + 6
    assert not list(replayed.glob("*.partial"))


def test_verdict_is_not_to_route_where_context_says_nothing(tmp_path: Path):
    generator = np.random.default_rng(0)
    rates = (("good", 0.8), ("bad", 0.5))
    rows = [make_row(f"i{row}", policy, success=bool(generator.random() < rate)) for row in range(400) for policy, rate in rates]
    folder = write_log(tmp_path / "log", rows, {f"i{row}": generator.normal(size=8) for row in range(400)})
    assert run(folder, "--selectors", "linucb", "thompson", "ucb1", "--seeds", 3, "--out", tmp_path / "out", *FREE) == 0
    result, _ = read_replay(tmp_path / "out")
    assert result["verdict"]["decision"] == "do_not_route" and result["verdict"]["selector"] is None
    assert result["verdict"]["policy"] == "good" and result["verdict"]["text"].startswith("Do not route: always use good.")
    assert result["selectors"]["thompson"]["learnable_gap_closed"] is None  # nothing to close
    assert result["verdict"]["test"]["advantages"]["thompson"]["high"] > result["verdict"]["stake"]["gain"]


def test_repeats_missing_outcomes_and_the_half(tmp_path: Path, log):
    made = clusters(tmp_path / "log", instances=60, clusters=2, dim=4, policies=2, repeats=4)
    rows = [row for row in _rows(made.folder) if row.instance != "made_up/7" or row.policy != "policy_1"]
    folder = write_log(tmp_path / "less", rows, {f"made_up/{row}": made.contexts[row] for row in range(60)})
    assert run(folder, "--selectors", "random", "--seeds", 2, "--out", tmp_path / "out", *FREE) == 0
    result, choices = read_replay(tmp_path / "out")
    assert result["log"]["instances"] == 59 and result["log"]["left_out"]["by_policy"] == {"policy_0": 0, "policy_1": 1}
    assert "made_up/7" not in choices.instances and choices.repeats.max() == 3
    assert "expected" in result["oracles"] and result["learnable_oracle"]["name"] == "expected"
    assert 0 < result["learnable_oracle"]["repeated"] <= result["log"]["instances"]
    widths = {name: float(np.diff(entry["ci95"])[0]) for name, entry in result["oracles"].items()}
    assert widths["expected"] > widths["predictable"] + 0.01, "the expected oracle alone is an estimate, and its interval says so"
    assert result["oracles"]["predictable"]["gain_ci95"][0] < 0.0 < result["oracles"]["predictable"]["gain"], "59 instances show no gap"
    assert result["selectors"]["random"]["predictable_gap_closed"] is None and "No gap to close is seen" in result["verdict"]["text"]
    assert run(log, "--half", "score", "--selectors", "random", "--seeds", 2, "--decisions", 50, "--out", tmp_path / "half", *FREE) == 0
    result, choices = read_replay(tmp_path / "half")
    assert 250 < result["log"]["instances"] < 350 and choices.order.shape == (2, 50)


def test_the_frontier_follows_the_price(tmp_path: Path, capsys):
    """One policy solves everything for ten cents, the other half of it, which the context tells, for nothing."""
    rows = []
    for number in range(80):
        rows.append(make_row(f"i{number}", "free", success=number % 2 == 0, motion=2.0))
        rows.append(make_row(f"i{number}", "paid", success=True, motion=4.0, price=10.0))
    folder = write_log(tmp_path / "log", rows, {f"i{row}": 3.0 * np.eye(8)[row % 2] + 0.1 * np.eye(8)[2 + row % 6] for row in range(80)})
    flags = ["--selectors", "linucb", "random", "--seeds", 2, "--alpha-time", 0, "--alpha-price", 0.01, "--workers", 1]
    assert run(folder, "--out", tmp_path / "out", *flags) == 0
    result, _ = read_replay(tmp_path / "out")
    found = result["frontier"]
    assert (found["seeds"], found["decisions"]) == (1, 80)
    for axis in ("alpha_time", "alpha_price"):
        assert found[axis]["weights"][0] == 0 and np.all(np.diff(found[axis]["weights"]) > 0)
        assert set(found[axis]["selectors"]) == {"linucb"}
    own = found["alpha_price"]["selectors"]["linucb"]
    assert own["price"][0] > 4 > own["price"][-1] == 0 and own["score"][0] > 0.9 > own["score"][-1] == pytest.approx(0.5, abs=0.15)
    assert min(own["price"]) < 6 and own["seconds"][0] > own["seconds"][-1]
    with (tmp_path / "out" / "frontier.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and [float(row["price"]) for row in rows if row["weight"] == "alpha_price"] == own["price"]
    without = result | {"frontier": None}
    assert run(folder, "--out", tmp_path / "without", *flags, "--no-frontier") == 0
    again, _ = read_replay(tmp_path / "without")
    assert again == without, "what is measured at the weights given does not depend on it"


def test_one_seed_has_intervals_over_its_decisions_and_auto_is_told_every_cost(tmp_path: Path):
    generator = np.random.default_rng(0)
    contexts = {f"i{number}": generator.normal(size=8) for number in range(60)}
    costs = {"free": 0.0, "paid": 5.0, "hopeless": 1.0}
    rows = [
        make_row(key, name, success=name != "hopeless" and bool(generator.random() < 0.5), price=price)
        for key in contexts
        for name, price in costs.items()
    ]
    folder = write_log(tmp_path / "log", rows, contexts)
    flags = ["--selectors", "auto", "random", "--seeds", 1, "--alpha-time", 0, "--alpha-price", 0.01, "--workers", 1, "--no-frontier"]
    assert run(folder, "--out", tmp_path / "told", *flags) == 0
    told, _ = read_replay(tmp_path / "told")
    assert told["expected_costs"] == pytest.approx({"free": 0.0, "paid": 0.05, "hopeless": 0.01})
    for entry in told["selectors"].values():
        assert entry["ci95"][0] < entry["mean_reward"] < entry["ci95"][1] or entry.get("policy") == "hopeless"
    assert all(pair["ci95"][0] < pair["ci95"][1] for pair in told["paired"])
    assert run(folder, "--out", tmp_path / "untold", *flags, "--unknown-costs") == 0
    assert read_replay(tmp_path / "untold")[0]["expected_costs"] is None


def test_a_log_of_scores_counts_them_as_success_and_is_reported(tmp_path: Path):
    """As `ingest --metric action-mse` leaves it; and neither times nor prices are there to weigh."""
    generator = np.random.default_rng(0)
    unknown = dict.fromkeys(("upload", "inference", "download", "motion", "price", "steps", "subgoals"))
    contexts = {f"i{number}": generator.normal(size=8) for number in range(40)}
    rows = [make_row(key, name, success=False, score=-float(generator.random()), **unknown) for key in contexts for name in ("a", "b")]
    folder = write_log(tmp_path / "log", rows, contexts)
    write_rollouts(folder, rows, {"encoder": "made_up@1", "source": {"metric": "action-mse"}})
    flags = ["--alpha-time", "0", "--alpha-price", "0"]
    assert run(folder, "--selectors", "linucb", "--seeds", 2, "--workers", 1, "--out", tmp_path / "out", *flags) == 0
    result, _ = read_replay(tmp_path / "out")
    assert result["reward"]["success"] == "score" and -1.0 < result["selectors"]["linucb"]["mean_reward"] < -0.1
    assert set(result["frontier"]) == {"seeds", "decisions"}, "there is no weight to move"
    assert result["selectors"]["linucb"]["mean_score"] == pytest.approx(result["selectors"]["linucb"]["mean_reward"])
    for source in (tmp_path / "out", folder):
        page = tmp_path / f"page-{source.name}"
        assert report_main([str(source), "--out", str(page), *(flags if source == folder else [])]) == 0
        assert not (page / "figures" / "frontier.png").exists()
        assert "neither times nor prices" in (page / "report.html").read_text()
    assert "mean_score" in (tmp_path / "page-out" / "tables" / "selectors.csv").read_text().splitlines()[0]


def test_a_gap_within_its_error_is_not_shared():
    base, order = np.random.default_rng(0).random((6, 50)), np.tile(np.arange(50, dtype=np.int32), (6, 1))

    def over(gain: float, error: float) -> Curves:
        known = {"best_single": base, "expected": base + gain}
        return Curves({}, known, "expected", order, np.arange(50), 0.0, {"expected": Gain(gain, error)}, {})

    share, interval = gap_closed(base + 0.5, over(1.0, 0.1), "expected", 0)
    assert (share, *interval) == pytest.approx((0.5, 0.5, 0.5))
    for gain, error in ((0.02, 0.02), (0.0, 0.0), (-1.0, 0.1), (0.01, 0.001)):  # the last is surely there, and below the margin
        assert gap_closed(base - 1.0, over(gain, error), "expected", 0) is None
    assert gap_closed(base, over(1.0, 0.1), "predictable", 0) is None  # a selector beat it: it is not among them


def test_an_oracle_that_a_selector_beats_bounds_nothing(tmp_path: Path, capsys):
    """Contexts and labels tell nothing, and the selector knows the outcomes: the log's oracles are no bounds of what it earns."""
    generator = np.random.default_rng(2)
    contexts = {f"i{row}": generator.normal(size=8).astype(np.float32) for row in range(200)}
    outcomes = {key: generator.random(2) < 0.5 for key in contexts}
    rows = [make_row(key, policy, success=bool(outcomes[key][at])) for key in contexts for at, policy in enumerate("ab")]
    folder = write_log(tmp_path / "log", rows, contexts)
    best = {context.tobytes(): int(outcomes[key].argmax()) for key, context in contexts.items()}

    class Peeking:
        def __init__(self, policies, context_dim, seed):
            self.policies = tuple(policies)

        def select(self, context):
            column = best[context.tobytes()]
            return Choice("ab"[column], {"a": 1.0 - column, "b": float(column)})

        def update(self, context, choice, reward):
            pass

    out = tmp_path / "out"
    replay(folder, selectors=[Peeking, "thompson"], seeds=2, alpha_time=0, alpha_price=0, no_frontier=True, workers=1, out=out)
    result, _ = read_replay(out)
    assert set(result["oracles"]) == {"hindsight", "best_single"}
    (name,) = set(result["learnable_oracle"]["beaten"].values())
    assert "eeking" in name and result["learnable_oracle"]["name"] is None and result["selectors"][name]["learnable_gap_closed"] is None
    assert "How much can be learned is not known" in result["verdict"]["text"]
    print_replay(Console(width=200), result)
    assert f"The predictable oracle is left out: {name} earned more" in capsys.readouterr().out
    assert report_main([str(out), "--out", str(tmp_path / "page")]) == 0
    assert "predictable oracle is left out" in (tmp_path / "page" / "report.html").read_text()


def test_a_warm_start_spares_the_beginning(tmp_path: Path, log):
    assert run(log, "--half", "score", "--selectors", "linucb", "linucb:warm", "--seeds", 3, "--out", tmp_path / "out", *FREE) == 0
    result, choices = read_replay(tmp_path / "out")
    begun = read_log(log)
    begun = begun.take([begun.keys.index(key) for key in choices.instances])
    first = {name: choices.received(name, begun.rewards(RewardWeights(0.0, 0.0)))[:, :100].mean() for name in ("linucb", "linucb:warm")}
    assert first["linucb:warm"] > first["linucb"] + 0.05
    assert result["selectors"]["linucb:warm"]["kind"] == "learner" and result["selectors"]["linucb:warm"]["decisions_until_ahead"] < 30


def test_auto_is_told_what_the_log_says_of_its_policies(tmp_path: Path, capsys):
    """Two kinds of instances, each the business of one policy, and examples of both in the log."""
    chance = np.random.default_rng(0)
    centres, rows, contexts = {"dig": np.eye(1, 8)[0], "fly": -np.eye(1, 8)[0]}, [], {}
    for number in range(80):
        kind = ("dig", "fly")[number % 2]
        contexts[f"{kind}/{number}"] = centres[kind] + 0.1 * chance.normal(size=8)
        rows += [make_row(f"{kind}/{number}", policy, success=bool(chance.random() < (0.9 if policy == kind else 0.1))) for policy in ("dig", "fly")]
    folder = write_log(tmp_path / "log", rows, contexts | {f"skill:{kind}:{row}": centre for kind, centre in centres.items() for row in range(3)})
    write_rollouts(folder, rows, {"encoder": "made_up@1", "skills": {"dig": ["dig"], "fly": ["fly"]}})
    ahead = {}
    for name, flags in (("told", []), ("untold", ["--unknown-skills"])):
        assert run(folder, "--selectors", "auto", "--seeds", 4, "--out", tmp_path / name, *FREE, *flags) == 0
        result, _ = read_replay(tmp_path / name)
        ahead[name] = result["selectors"]["auto"]["decisions_until_ahead"]
        assert result["skills"] == (None if flags else {"dig": ["dig"], "fly": ["fly"]})
    assert ahead["told"] < ahead["untold"]
    write_rollouts(folder, rows, {"encoder": "made_up@1", "skills": {"dig": ["dive"]}})
    assert run(folder, "--selectors", "random", "--seeds", 1, "--out", tmp_path / "lacking", *FREE) == 0
    assert "record --resume --out" in capsys.readouterr().err
    write_rollouts(folder, rows, {"encoder": "made_up@1", "skills": "dig"})
    with pytest.raises(DataError, match="skills in its metadata must be an object of lists of names, got 'dig'"):
        read_log(folder)


@pytest.mark.slow
def test_workers_do_not_matter(log):
    names = ["ppo_tuned", "linucb", "epsilon_greedy"]
    outcomes = read_log(log)
    setups = [Setup(RewardWeights(0.0, 0.0)), Setup(RewardWeights(0.1, 0.0), {"linucb": {"optimism": 5.0}})]
    parts = [Part(outcomes, setups, names, range(2), 90), Part(outcomes, setups[1:], ["thompson"], range(1), 20)]
    (one, last), (two, again) = (list(replay_parts(parts, workers)) for workers in (1, 2))
    assert (last[0].chosen["thompson"] == again[0].chosen["thompson"]).all()
    for number in range(2):
        assert (one[number].order == two[number].order).all()
        assert all((one[number].chosen[name] == two[number].chosen[name]).all() for name in names)
    assert (one[0].chosen["linucb"] != one[1].chosen["linucb"]).any(), "each setup has its own settings"


def test_a_selector_sees_the_outcomes_of_its_choices_only(log, monkeypatch):
    outcomes = read_log(log)
    (first,) = replay_all(outcomes, [Setup(RewardWeights(0.0, 0.0))], ["linucb"], range(1), 100)
    chosen = np.zeros_like(outcomes.success, bool)
    rows = first.order[0]
    chosen[rows, first.chosen["linucb"][0], 0] = True
    other = read_log(log)
    other.success[~chosen] = 1.0 - other.success[~chosen]
    (again,) = replay_all(other, [Setup(RewardWeights(0.0, 0.0))], ["linucb"], range(1), 100)
    assert (again.chosen["linucb"] == first.chosen["linucb"]).all()


def test_a_verdict_comes_first_and_all_is_written_as_it_comes(tmp_path: Path, capsys, monkeypatch):
    """Interrupted while it replays what comes last, a replay leaves all that was told before; in the end nothing tells that it came in stages."""
    log = clusters(tmp_path / "log", instances=80, clusters=4, dim=8, policies=3, seed=5).folder
    settings = {"seeds": 2, "decisions": 30, "workers": 1, "alpha_time": 0, "alpha_price": 0.1}
    told = []

    def tell(result):
        written, choices = read_replay(result.folder)
        assert written["verdict"]["text"] == result.verdict and set(choices.chosen) == set(written["selectors"])
        told.append((result.pending, {name for name in choices.chosen if ":" not in name and "single" not in name}, bool(written["frontier"])))
        if len(told) == 2:
            raise KeyboardInterrupt

    out, names = tmp_path / "out", ["thompson", "linucb", "random"]
    monkeypatch.setenv("BROWSER", "true")  # a program that does nothing
    with pytest.raises(KeyboardInterrupt):
        replay(log, selectors=names, on_result=tell, open=True, out=out, **settings)
    assert told == [(["thompson", "random", "frontier"], {"linucb"}, False), (["frontier"], set(names), False)]
    assert read_replay(out)[0]["pending"] == ["frontier"]
    assert "so far; still being replayed: thompson, random, frontier" in (out / "report.html").read_text()
    flags = [word for name, value in settings.items() for word in (f"--{name.replace('_', '-')}", value)]
    capsys.readouterr()
    assert run(log, "--selectors", *names, "--out", out, "--overwrite", *flags) == 0
    shown = capsys.readouterr().out
    first, last = shown.index("So far, from linucb and the fixed policies:"), shown.rindex("thompson")
    assert first < shown.index("Still being replayed: thompson, random, frontier; Ctrl-C keeps what is there") < last
    result, _ = read_replay(out)
    assert "pending" not in result and set(result["frontier"]["alpha_price"]["selectors"]) == {"thompson", "linucb"}
    assert list(result["selectors"])[:3] == names
    again = replay(log, selectors=names, out=tmp_path / "again", **settings)
    assert again.pending == [] and (tmp_path / "again" / "replay.json").read_bytes() == (out / "replay.json").read_bytes()


def test_ctrl_c_waits_for_what_is_written_together():
    done, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append("all")
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == ["all"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--selectors", "pppo"], "unknown selector 'pppo': did you mean 'ppo'?"),
        (["--policies", "policy_9"], "unknown policy 'policy_9'"),
        (["--selectors", "linucb:warm"], "say which half to replay with --half"),
        (["--selectors", "ppo:warm", "--half", "score"], "cannot start warm; those that can: auto, "),
        (["--selectors", "linubc:warm", "--half", "score"], "did you mean 'linucb'?"),
        (["--preset", "mmul"], "unknown reward preset 'mmul': did you mean 'mmlu'?"),
        (["--decisions", "601"], "--decisions 601: the log has 600 instances"),
        (["--encoder", "clip"], "no contexts of encoder 'clip'"),
        (["--half", "all"], "unknown value 'all'"),
        (["--worker", "1"], "did you mean '--workers'?"),
        (["--selectors", "auto", "ppo", "--route-with", "pppo"], "unknown selector 'pppo': did you mean 'ppo'?"),
        (["--selectors", "random", "--route-with", "random"], "unknown selector 'random'"),
        (["--margin", "-1"], "margin"),
    ],
)
def test_wrong_input_is_one_line(log, tmp_path, capsys, arguments, message):
    try:
        code = run(log, "--seeds", 1, "--out", tmp_path / "out", *arguments)
    except SystemExit as error:
        code = error.code
    assert code == 2
    complaint = capsys.readouterr().err.strip().splitlines()[-1]
    assert complaint.startswith("error: ") and message in complaint
    assert not (tmp_path / "out").exists()


def test_results_are_not_replaced_unasked(replayed, log, capsys):
    assert run(log, "--selectors", "random", "--seeds", 1, "--out", replayed, *FREE) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run(log, "--selectors", "random", "--seeds", 1, "--out", log, *FREE) == 2
    assert "not empty" in capsys.readouterr().err


def test_damage_is_noticed(log, tmp_path):
    assert run(log, "--selectors", "random", "--seeds", 1, "--decisions", 9, "--out", tmp_path / "out", *FREE) == 0
    file = tmp_path / "out" / "choices.npz"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(DataError, match="damaged"):
        read_replay(tmp_path / "out")


@pytest.mark.slow
def test_ctrl_c_leaves_nothing_behind(log, tmp_path):
    out = tmp_path / "out"
    # More seeds than any machine replays before the interruption, which comes once the workers are at it.
    command = [sys.executable, "-m", "osel_sim.replay", str(log), "--selectors", "ppo", "--seeds", "5000", "--out", str(out)]
    # Tests started in the background by a script ignore SIGINT, and what they start inherits that.
    heeding = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, preexec_fn=heeding) as process:
        shown = b""
        while not re.search(rb"\| [1-9]", shown):  # the progress bar has moved on from 0
            shown += (got := process.stderr.read1())
            assert got, shown.decode()
        os.kill(process.pid, signal.SIGINT)  # the parent alone: it has to end its workers
        complaints = (shown + process.stderr.read()).decode()
    assert process.returncode == 130 and complaints.strip().endswith("interrupted") and "Traceback" not in complaints
    assert not out.exists()


def _rows(folder: Path):
    from osel_sim.formats.rollout_log import read_rollouts

    return read_rollouts(folder)[0]


def test_a_warm_start_is_part_of_the_first_verdict_where_it_is_quick():
    from osel_sim.api.replay import WARM_SOON, _stages

    names = ["auto", "auto:warm", "linucb", "ppo"]
    assert _stages(names, WARM_SOON) == [["auto", "auto:warm", "linucb"], ["ppo"]]
    assert _stages(names, WARM_SOON + 1) == [["auto", "linucb"], ["auto:warm", "ppo"]]
    assert _stages(["auto:warm"], 10**6) == [["auto:warm"]]
