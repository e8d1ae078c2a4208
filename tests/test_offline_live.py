"""A live run's folder replayed: estimates from its propensities, and a replay where it has every outcome."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from osel_sim.analysis.evaluation import evaluate
from osel_sim.analysis.live import is_live_run, read_live
from osel_sim.cli.replay_tables import print_off_policy
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.formats.journal import Decision, to_line
from osel_sim.formats.replay_result import read_replay
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.replay import main as replay_main
from osel_sim.reporting.off_policy_section import off_policy_table
from osel_sim.reporting.page import to_html
from osel_sim.reporting.run_page import run_page
from osel_sim.selection.reward import RewardWeights

FREE = RewardWeights(0.0, 0.0)
RATES = {"local": 0.4, "remote": 0.7}


def outcome(success: bool, error: str | None = None) -> Outcome:
    return Outcome(success, float(success), 20, Seconds(motion=1.0), 1, 20, 0.0, error=error)


def make_run(folder: Path, decisions: int = 400, counterfactual: bool = False) -> Path:
    """A run that chose `local` in four of five decisions, whatever the context."""
    folder.mkdir()
    generator = np.random.default_rng(0)
    cache = ContextCache(folder, autosave=0)
    configuration = {"policies": list(RATES), "selector": "made_up", "encoder": "e@1", "reward": asdict(FREE)}
    (folder / "run.json").write_text(json.dumps({"schema_version": 1, "configuration": configuration}))
    journal, others = [], []
    for index in range(decisions):
        cache.put("e@1", f"t/test/0/{index}", generator.normal(size=4).astype(np.float32))
        policy = "local" if generator.random() < 0.8 else "remote"
        found = {name: outcome(bool(generator.random() < rate)) for name, rate in RATES.items()}
        if index == 3:
            found[policy] = outcome(False, "the server died")
        one = found[policy]
        about = {
            "index": index,
            "task": "t",
            "axes": None,
            "phrasing": "train-0",
            "target": "",
            "container": "",
            "seed": index,
            "level": 0,
            "split": "test",
            "instruction": "do it",
            "policy": policy,
        }
        reward = None if one.error else float(one.success)
        own = {key: value for key, value in vars(one).items()}
        journal.append(asdict(Decision(**about, propensities={"local": 0.8, "remote": 0.2}, reward=reward, **own)))
        rewards = {name: None if other.error else float(other.success) for name, other in found.items()}
        others.append({"index": index, "policies": {name: {**found[name].to_dict(), "reward": rewards[name]} for name in found if name != policy}})
    cache.save()
    (folder / "episodes.jsonl").write_text("".join(to_line(row) for row in journal))
    if counterfactual:
        (folder / "counterfactual.jsonl").write_text("".join(to_line(row) for row in others))
    return folder


def test_estimates_from_the_propensities(tmp_path, capsys):
    run = make_run(tmp_path / "run")
    assert is_live_run(run) and not is_live_run(tmp_path)
    assert replay_main([str(run), "--out", str(tmp_path / "out")]) == 0
    found = read_json(tmp_path / "out" / "off_policy.json")
    assert found["run"]["decisions"] == 399 and found["run"]["errors"] == 1 and found["reward"] == asdict(FREE)
    for policy, rate in RATES.items():
        entry = found["targets"][f"fixed:{policy}"]
        for kind in ("ips", "snips", "dr"):
            low, high = entry[f"{kind}_ci95"]
            assert low < entry[kind] < high < low + 0.5
            assert entry[kind] == pytest.approx(rate, abs=high - low)  # twice as far as in 95 of 100 runs
    assert found["targets"]["fixed:local"]["effective_decisions"] > 250 > found["targets"]["fixed:remote"]["effective_decisions"]
    printed = capsys.readouterr().out
    assert "--counterfactual" in printed and "1 decisions that ended in error" in printed
    assert replay_main([str(run), "--out", str(tmp_path / "out")]) == 2


def test_an_estimate_that_rests_on_too_few_decisions_is_not_shown(tmp_path, capsys):
    run = make_run(tmp_path / "run", 100, counterfactual=True)
    found = evaluate(read_live(run), FREE)
    entry = found["targets"]["fixed:remote"]
    assert entry["few"] == ["ips", "snips", "dr"] and entry["ips"] is not None and entry["ips_effective"] < 30
    log = read_live(run).outcomes
    assert entry["measured"] == pytest.approx(np.nanmean(log.success[:, list(log.policies).index("remote")]))
    table = off_policy_table(found)
    remote = next(row for row in table.rows if row["who"] == "always remote")
    assert remote["ips"] is remote["snips"] is remote["dr"] is None and remote["measured"] == entry["measured"]
    assert remote["ips_effective"] == entry["ips_effective"]
    received = table.rows[0]["measured"]
    assert [received.low, received.high] == found["run"]["ci95"]
    print_off_policy(Console(width=200), found)
    line = next(line for line in capsys.readouterr().out.splitlines() if "fixed:remote" in line)
    assert all(f" - ({entry[f'{way}_effective']:.0f}) " in line for way in ("ips", "snips", "dr")) and f" {entry['measured']:.3f} " in line


def test_a_policy_that_was_never_chosen_is_no_warning(tmp_path, recwarn):
    folder = make_run(tmp_path / "run", 40)
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    for line in lines:
        line |= {"policy": "local", "success": True, "subgoals": 1.0, "error": None, "reward": 1.0}
    (folder / "episodes.jsonl").write_text("".join(to_line(line) for line in lines))
    html = to_html(run_page(folder))
    assert "What other ways of choosing would have earned" in html
    assert [str(warning.message) for warning in recwarn if issubclass(warning.category, RuntimeWarning)] == []


def test_errors_of_one_policy_do_not_favour_the_other(tmp_path):
    """Every episode that ends well is worth the same, and half of the remote policy's do not: no policy is worth more than that."""
    folder = make_run(tmp_path / "run", decisions=400)
    lines = []
    for line in (folder / "episodes.jsonl").read_text().splitlines():
        decision = json.loads(line)
        if "policy" in decision:  # one in five is remote, as its propensity says, and one in ten ends in error
            decision |= {"policy": "local" if decision["index"] % 5 else "remote", "error": None, "success": True, "reward": 1.0}
            decision |= {"error": "the server died", "reward": None} if decision["index"] % 10 == 0 else {}
        lines.append(json.dumps(decision))
    (folder / "episodes.jsonl").write_text("\n".join(lines) + "\n")
    found = evaluate(read_live(folder), FREE)
    assert found["run"]["errors"] == 40
    for target in ("fixed:local", "fixed:remote", "random"):
        assert found["targets"][target]["ips"] == pytest.approx(1.0) == found["targets"][target]["snips"], target


def test_with_all_outcomes_it_is_a_log(tmp_path):
    run = make_run(tmp_path / "run", 120, counterfactual=True)
    live = read_live(run)
    assert live.has_all_outcomes(FREE) and np.isfinite(live.outcomes.success).sum() == 2 * 120 - 1
    arguments = ["--selectors", "random", "--seeds", "2", "--workers", "1", "--out", str(tmp_path / "out")]
    assert replay_main([str(run), *arguments]) == 0
    result, _ = read_replay(tmp_path / "out")
    assert result["log"]["instances"] == 119 and result["off_policy"]["run"]["decisions"] == 119
    assert result["reward"]["alpha_time"] == 0.0 and result["verdict"]["policy"] == "remote"


def test_damaged_runs_are_refused(tmp_path):
    run = make_run(tmp_path / "run", 5)
    text = (run / "episodes.jsonl").read_text()
    (run / "episodes.jsonl").write_text(text.replace('"policy": "local"', '"policy": "nobody"'))
    with pytest.raises(DataError, match="'nobody' is no policy of the run"):
        read_live(run)
    (run / "episodes.jsonl").write_text("")
    with pytest.raises(DataError, match="made no decision"):
        read_live(run)
    (run / "episodes.jsonl").write_text(text)
    (run / "counterfactual.jsonl").write_text('{"index": 0, "policies": {"remote": {}}}\n')
    with pytest.raises(DataError, match=r"counterfactual.jsonl, line 1: not outcomes"):
        read_live(run)
