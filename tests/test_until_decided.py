"""A recording that stops as soon as its policies are told apart: where does not depend on who came first, and compare says the same of it."""

import dataclasses
import json
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from run_helpers import command, environment, execute, make_world, wait_for_lines
from test_compare import log_of
from test_record import files, resume

import osel_sim as osel
from osel_sim.analysis.log import read_outcomes
from osel_sim.analysis.until_decided import UntilDecided, seeds_a_look
from osel_sim.api.record_here import _check_stopping
from osel_sim.api.record_settings import RecordConfig
from osel_sim.core.errors import DataError, SettingError, UsageError
from osel_sim.episodes.workers import Plan, make_row
from osel_sim.formats import library
from osel_sim.formats.rollout_log import read_rollouts, write_rollouts
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.record import main as record_main
from osel_sim.suites.registry import find_task

OLD, NEW = "local_small", "remote_large"


@pytest.fixture(scope="module")
def plan() -> Plan:
    policies = tuple(library.load_policy(name) for name in (OLD, NEW))
    tasks = (find_task("lift"), find_task("push"), find_task("door"))
    return Plan(tasks, policies, policies, range(4, 84), (0, 2), "test", "osel_small", repeats=2, repeat_every=5)


def recorded(plan: Plan, rates: dict[str, float], errors: float = 0.0, seed: int = 0) -> dict[str, dict]:
    """Made-up episodes of all of a plan, by instance."""
    generator, found = np.random.default_rng(seed), {}
    for key, instance in plan.instances.items():
        rows = {}
        for policy, repeat in plan.episodes(key):
            success, error = bool(generator.random() < rates[policy]), "the arm fell off" if generator.random() < errors else None
            rows[policy, repeat] = make_row(
                instance, policy, repeat, Outcome(success, 0.0, 9, Seconds(motion=1.0), 1, 9, 0.0, error=error), f"s{key}"
            )
        found[key] = rows
    return found


def stopped(plan: Plan, rows: dict[str, dict], margin: float = 0.05, arrival: int | None = None, **more) -> UntilDecided:
    """Told of one instance after the other, as they came."""
    stop, known = UntilDecided(plan, (OLD, NEW), margin, **more), {}
    order = stop.order if arrival is None else np.random.default_rng(arrival).permutation(stop.order).tolist()
    for key in order:
        known[key] = rows[key]
        if stop.look(known):
            break
    return stop


def kept_log(folder: Path, plan: Plan, rows: dict[str, dict], keys, margin: float = 0.05) -> Path:
    told = {"margin": margin, "seeds_a_look": seeds_a_look(3, 2), "policies": [OLD, NEW]}
    return log_of(folder, [row for key in plan.instances if key in keys for row in rows[key].values()], until_decided=told, start_seed=4)


@pytest.mark.parametrize(("rates", "decision"), [((0.3, 0.8), "better"), ((0.8, 0.3), "worse"), ((0.99, 0.99), "no worse")])
def test_it_stops_where_compare_has_an_answer_and_not_before(plan, tmp_path, rates, decision):
    rows, margin = recorded(plan, dict(zip((OLD, NEW), rates, strict=True)), errors=0.05), 0.0 if decision == "better" else 0.05
    stop = stopped(plan, rows, margin)
    assert stop.kept is not None and len(stop.kept) % 12 == 0 and len(stop.kept) < len(plan.instances)
    assert all(stopped(plan, rows, margin, arrival=number).kept == stop.kept for number in range(3))
    found = osel.compare(kept_log(tmp_path / "log", plan, rows, stop.kept), margin=margin)
    assert found.decision == decision and found.result["pairs"][0]["looks"] == len(stop.kept) // 12
    assert "at any time" in found.result["pairs"][0]["test"]["method"]
    before = frozenset(stop.order[: len(stop.kept) - 12])
    earlier = osel.compare(kept_log(tmp_path / "before", plan, rows, before), margin=margin) if before else None
    assert earlier is None or (earlier.decision == "not enough data" and "more instances would tell" in earlier.verdict)


def test_it_goes_on_where_no_answer_is_there(plan, tmp_path):
    rows = recorded(plan, {OLD: 0.5, NEW: 0.5})
    assert stopped(plan, rows, margin=0.01).kept is None
    found = osel.compare(kept_log(tmp_path / "log", plan, rows, plan.instances), margin=0.01)
    assert found.decision == "not enough data"


def test_rounds_have_all_tasks_and_levels_alike():
    assert [seeds_a_look(*sizes) for sizes in ((1, 1), (1, 2), (3, 2), (11, 2), (1, 4), (10, 1))] == [10, 10, 4, 4, 12, 4]


def test_a_baseline_is_compared_with_by_instance_and_scene(plan, tmp_path):
    rows = recorded(plan, {OLD: 0.9, NEW: 0.3})
    old = [row for key in plan.instances for (policy, _), row in rows[key].items() if policy == OLD]
    baseline = read_outcomes(log_of(tmp_path / "old", old))
    alone = dataclasses.replace(plan, policies=plan.policies[1:], everyone=plan.policies[1:])
    only = {key: {episode: row for episode, row in found.items() if episode[0] == NEW} for key, found in rows.items()}
    stop = UntilDecided(alone, (NEW,), 0.05, (baseline, OLD))
    assert stop.look(only) and stop.kept == stopped(plan, rows).kept
    other = {key: {episode: dataclasses.replace(row, scene="elsewhere") for episode, row in found.items()} for key, found in only.items()}
    with pytest.raises(DataError, match=r"instance 'lift/test/0/4' is not the same scene as in the baseline"):
        UntilDecided(alone, (NEW,), 0.05, (baseline, OLD)).look(other)
    few = read_outcomes(log_of(tmp_path / "few", old[:20]))
    with pytest.raises(UsageError, match=r"lacks \d+ of the 240 instances"):
        UntilDecided(alone, (NEW,), 0.05, (few, OLD))


def test_all_pairs_of_several_policies_need_an_answer(plan):
    third = dataclasses.replace(plan, policies=(*plan.policies, library.load_policy("remote_base")))
    rows = recorded(third, {OLD: 0.2, NEW: 0.9, "remote_base": 0.2})
    two, three = (UntilDecided(third, names, 0.05) for names in ((OLD, NEW), (OLD, NEW, "remote_base")))
    assert two.look(rows) and three.pairs == 3
    assert not three.look(rows) or len(three.kept) > len(two.kept)


@pytest.mark.parametrize("told", ["yes", {"seeds_a_look": 0}, {"seeds_a_look": "4"}, {}])
def test_metadata_that_do_not_say_when_one_looked_are_refused(plan, tmp_path, told):
    rows = [row for found in list(recorded(plan, {OLD: 0.5, NEW: 0.5}).values())[:20] for row in found.values()]
    with pytest.raises(DataError, match="until_decided in its metadata must have seeds_a_look"):
        osel.compare(log_of(tmp_path / "log", rows, until_decided=told, start_seed=4))
    with pytest.raises(DataError, match="some of its instances have other seeds"):
        osel.compare(log_of(tmp_path / "seeds", rows, until_decided={"seeds_a_look": 4}, start_seed=10))


def test_wrong_settings_are_named(tmp_path):
    for values, message in (
        ({"margin": 0.1}, "margin: is for a recording until it is decided"),
        ({"baseline": tmp_path}, "baseline: is for a recording until it is decided"),
        ({"until_decided": True, "baseline_policy": "mine"}, "baseline_policy: is a policy of --baseline"),
        ({"until_decided": True, "margin": 1.0}, "margin: must lie in"),
        ({"until_decided": True}, "local_small alone is compared with nothing"),
    ):
        with pytest.raises(SettingError, match=message):
            osel.record(task="lift", policies="local_small", out=tmp_path / "out", **values)
    assert RecordConfig.of(task="lift", out=tmp_path).to_json().keys() >= {"margin", "until_decided", "baseline"}
    _check_stopping(RecordConfig.of(**RecordConfig.of(task="lift", out=tmp_path).to_json()))  # of a run.json
    both = [row for policy in ("a", "b") for row in _rows(policy, 3)]
    with pytest.raises(SettingError, match="has several policies, a, b"):
        osel.record(
            task="lift", policies="local_small", instances=3, until_decided=True, baseline=log_of(tmp_path / "two", both), out=tmp_path / "out"
        )
    with pytest.raises(DataError, match="does not say how its instances were drawn"):
        osel.record(policies="local_small", until_decided=True, baseline=log_of(tmp_path / "one", _rows("a", 3)), out=tmp_path / "out")
    with pytest.raises(UsageError, match="lacks 197 of the 200 instances, such as 'lift/test/0/3'"):
        osel.record(task="lift", policies="local_small", until_decided=True, baseline=tmp_path / "one", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def _rows(policy: str, count: int) -> list:
    from test_compare import rows_of

    return rows_of(policy, [True] * count)


@pytest.mark.slow
def test_killed_and_resumed_by_another_number_of_workers_it_stops_at_the_same_bytes(tmp_path, monkeypatch, capsys):
    world = make_world(tmp_path / "world")
    monkeypatch.syspath_prepend(str(world / "plugin"))
    monkeypatch.setenv("PYTHONPATH", environment(world)["PYTHONPATH"])  # of servers that are started from here
    flags = ["--instances", 40, "--start-seed", 40, "--until-decided", "--margin", 0.3]
    done = execute(world, "record", *flags, "--workers", 3, "--out", world / "whole")
    assert done.returncode == 0, done.stderr
    assert "wild is no worse than calm" in done.stdout
    assert "stopped after 20 of 40 instances: 40 of 80 planned episodes were not needed" in done.stdout
    rows, metadata = read_rollouts(world / "whole")
    assert len(rows) == 40 and metadata["until_decided"] == {"margin": 0.3, "seeds_a_look": 10, "policies": ["calm", "wild"]}

    killed = world / "killed"
    process = subprocess.Popen(
        command(world, "record", *flags, "--workers", 1, "--out", killed), env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    wait_for_lines(process, killed / "shards.jsonl", 3)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    assert resume(world, killed, "--workers", 2) == 0
    assert files(killed) == files(world / "whole")
    capsys.readouterr()
    assert resume(world, killed) == 0
    assert "stopped after 20 of 40" in capsys.readouterr().out and files(killed) == files(world / "whole")
    for flag, value, says in (("--repeats", 2, "repeats was 1 at the beginning"), ("--margin", 0.2, "margin: 0.2, but")):
        assert resume(world, killed, flag, value) == 2
        assert says in capsys.readouterr().err

    places = ["--tasks", world / "tasks", "--policies-dir", world / "policies", "--margin", 0.3, "--workers", 2]
    alone = ["--policies", "wild", "--baseline", world / "whole", "--baseline-policy", "calm", "--until-decided", *places]
    assert record_main(list(map(str, [*alone, "--out", world / "new"]))) == 0
    told = capsys.readouterr().out
    assert "all 20 instances were needed" in told and "wild is no worse than calm" in told
    told = json.loads((world / "new" / "run.json").read_text())["configuration"]
    assert (told["instances"], told["start_seed"], told["until_decided"]["baseline_policy"]) == (20, 40, "calm")
    assert osel.compare(world / "whole", world / "new", policies=["calm", "wild"], margin=0.3).decision == "no worse"

    other = world / "other"
    shutil.copytree(world / "whole", other)
    changed = [dataclasses.replace(row, scene="0123456789abcdef") for row in rows]
    write_rollouts(other, changed, {key: value for key, value in metadata.items() if key != "schema_version"})
    alone[alone.index(world / "whole")] = other
    assert record_main(list(map(str, [*alone, "--out", world / "newer"]))) == 2
    assert "is not the same scene as in the baseline" in capsys.readouterr().err
