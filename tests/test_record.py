"""`python -m osel_sim.record` with real workers and servers: the same bytes however it went, and workers that die."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from remote_helpers import alive
from run_helpers import HORIZON, children, command, environment, execute, next_commands, started, wait_for_lines, wait_until

from osel_sim.analysis.log import read_log
from osel_sim.api.report import report
from osel_sim.context.cache import ContextCache
from osel_sim.core.files import digest
from osel_sim.episodes.workers import Plan
from osel_sim.formats import library
from osel_sim.formats.rollout_log import read_rollouts, write_rollouts
from osel_sim.record import main as record_main
from osel_sim.suites.registry import find_task

INSTANCES, REPEATS = 5, 2
SIZE = ("--instances", INSTANCES, "--repeats", REPEATS, "--start-seed", 40)


@pytest.fixture(scope="module")
def reference(world):
    """A recording that nobody disturbed."""
    folder = world / "reference"
    done = execute(world, "record", *SIZE, "--workers", 1, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder, done


@pytest.fixture(scope="module")
def killed(world):
    """What a recording of one of the policies leaves that was killed."""
    folder = world / "killed"
    arguments = command(world, "record", *SIZE, "--workers", 1, "--out", folder, "--policies", "calm")
    process = subprocess.Popen(arguments, env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    wait_for_lines(process, folder / "shards.jsonl", 2)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    assert not (folder / "rollouts.parquet").exists()
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("rollouts.parquet", "contexts.npz")}


def resumed(world: Path, folder: Path, *flags: object) -> list[str]:
    """Arguments of `record --resume` with the settings of the folder and these flags."""
    return list(map(str, ["--resume", "--tasks", world / "tasks", "--policies-dir", world / "policies", "--out", folder, *flags]))


def record(world: Path, *flags: object) -> int:
    """The command in this process, which has imported already what it needs; its workers and servers are processes as ever."""
    return record_main(list(map(str, command(world, "record", *flags)[3:])))


def resume(world: Path, folder: Path, *flags: object) -> int:
    """`record --resume` with the settings of the folder and these flags, in this process."""
    return record_main(resumed(world, folder, *flags))


def configuration(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text())["configuration"]


def test_repeats_are_of_all_levels():
    task, policy = find_task("lift"), library.load_policy("local_small")
    plan = Plan((task,), (policy,), (policy,), range(40), (0, 2), "test", "osel_small", repeats=3, repeat_every=10)
    repeated = [plan.instances[key] for key in plan.instances if len(plan.episodes(key)) == 3]
    assert sorted(instance.level for instance in repeated) == [0, 0, 2, 2]


def test_every_policy_on_every_instance_from_the_same_state(reference):
    folder, done = reference
    rows, metadata = read_rollouts(folder)
    assert [(row.seed, row.policy, row.repeat) for row in rows] == [
        (seed, policy, repeat) for seed in range(40, 40 + INSTANCES) for policy in ("calm", "wild") for repeat in range(REPEATS)
    ]
    assert all(row.error is None and row.steps == HORIZON and row.target and row.container for row in rows)
    local = [row for row in rows if row.policy == "calm"]
    assert all(first.outcome == second.outcome for first, second in zip(local[::2], local[1::2], strict=True)), "nothing random in a local policy"
    remote = [row for row in rows if row.policy == "wild"]
    assert len({row.upload for row in remote}) == len(remote), "each episode has its own network"
    assert metadata["encoder"] == "colours"
    assert len({(row.instance, row.scene) for row in rows}) == len({row.scene for row in rows}) == INSTANCES
    contexts = ContextCache(folder).table("colours", [row.instance for row in rows[:: 2 * REPEATS]])
    assert contexts.shape == (INSTANCES, 53)
    assert len(np.unique(contexts, axis=0)) == INSTANCES
    assert sorted(file.name for file in folder.iterdir()) == ["contexts.npz", "rollouts.parquet", "run.json"]
    assert "episodes an hour" in done.stdout
    assert f"written to {folder}" in done.stdout
    assert [name for name, _ in next_commands(done.stdout)] == ["replay", "report", "record"]
    assert "success [95%]" in done.stdout


def test_killed_and_resumed_with_more_workers_and_policies_it_writes_the_same_bytes(world, reference, killed):
    folder = world / "half"
    shutil.copytree(killed, folder)
    before = (folder / "shards.jsonl").read_bytes()
    report(folder, out=world / "page")  # as far as it is, and without touching it
    assert (world / "page" / "report.html").is_file() and (folder / "shards.jsonl").read_bytes() == before
    assert record(world, *SIZE, "--out", folder, "--workers", 2, "--resume") == 0
    assert files(folder) == files(reference[0]) and configuration(folder) == configuration(reference[0])


def test_a_policy_added_to_a_log_gives_the_bytes_of_all_at_once(world, reference, killed):
    folder = world / "grown"
    shutil.copytree(killed, folder)
    assert resume(world, folder) == 0
    assert {row.policy for row in read_rollouts(folder)[0]} == {"calm"}
    assert resume(world, folder, "--policies", "wild") == 0
    assert files(folder) == files(reference[0]) and configuration(folder) == configuration(reference[0])


@pytest.mark.slow
def test_repeats_added_to_a_log_give_the_bytes_of_all_at_once(world, reference, capsys):
    folder = world / "repeated"
    assert record(world, "--instances", INSTANCES, "--start-seed", 40, "--workers", 1, "--out", folder) == 0
    assert resume(world, folder, "--repeats", REPEATS, "--repeat-every", 2) == 0
    some = {(row.instance, row.repeat) for row in read_rollouts(folder)[0]}
    assert len(some) == INSTANCES + (INSTANCES + 1) // 2 * (REPEATS - 1)
    assert resume(world, folder, "--repeat-every", 1) == 0
    assert files(folder) == files(reference[0]) and configuration(folder) == configuration(reference[0])
    capsys.readouterr()
    assert resume(world, folder, "--repeats", 1) == 2
    assert f"repeats was {REPEATS} at the beginning, now it is 1" in capsys.readouterr().err
    assert resume(world, folder, "--repeat-every", 2) == 2
    for flag, given in (("--instances", 7), ("--level", "0 2"), ("--action-noise", 0.5)):
        assert resume(world, folder, flag, *str(given).split()) == 2
        assert f"{flag}: {given}, but {folder / 'run.json'} began with" in capsys.readouterr().err
    assert files(folder) == files(reference[0])


@pytest.mark.slow
def test_contexts_of_another_encoder_are_added(world, reference, capsys):
    folder = world / "encoded"
    shutil.copytree(reference[0], folder)
    assert record(world, *SIZE, "--out", folder, "--resume", "--workers", 1, "--encoder", "osel_small") == 0
    assert "episodes in" not in capsys.readouterr().out
    rows, metadata = read_rollouts(folder)
    assert rows == read_rollouts(reference[0])[0]
    assert metadata["encoder"].startswith("osel_small@")
    keys, old, new = list(dict.fromkeys(row.instance for row in rows)), ContextCache(reference[0]), ContextCache(folder)
    assert np.array_equal(new.table("colours", keys), old.table("colours", keys))
    assert len(np.unique(new.table("osel_small", keys), axis=0)) == INSTANCES
    assert read_log(folder).encoder == metadata["encoder"]
    # The first one's are there already; given again, it is the one that the log is read with.
    assert record(world, *SIZE, "--out", folder, "--resume", "--encoder", "colours") == 0
    assert read_log(folder).encoder == "colours" and read_rollouts(folder)[0] == rows
    assert configuration(folder)["encoder"] == "colours"
    assert np.array_equal(ContextCache(folder).table("osel_small", keys), new.table("osel_small", keys))


def test_a_log_knows_what_its_policies_declare(world, reference):
    """A log made before it was declared learns of it without an episode."""
    folder, own = world / "declared", world / "declaring"
    shutil.copytree(reference[0], folder)
    assert read_log(folder).skills is None
    shutil.copytree(world / "policies", own)
    run = json.loads((folder / "run.json").read_text())
    for name, skills in (("calm", '["lift", "push"]'), ("wild", '["short"]')):
        file = own / f"{name}.toml"
        file.write_text(file.read_text().replace("execute = 8", f"execute = 8\nskills = {skills}"))
        run["configuration"]["content"][f"policy {name}"] = digest(file)
    (folder / "run.json").write_text(json.dumps(run))
    arguments = list(map(str, ["--resume", "--out", folder, "--tasks", world / "tasks", "--policies-dir", own]))
    assert record_main(arguments) == 0
    log = read_log(folder)
    assert log.skills is not None and log.skills.able == {"calm": ("lift", "push"), "wild": ("short",)}
    assert log.skills.nearest(log.contexts[0]) == "short"
    assert read_rollouts(folder)[0] == read_rollouts(reference[0])[0]
    before = files(folder)
    assert record_main(arguments) == 0 and files(folder) == before
    (own / "wild.toml").write_text((own / "wild.toml").read_text().replace('"short"', '"shrt"'))
    assert record_main([*arguments[:1], "--out", str(world / "undeclared"), "--task", "short", *arguments[3:], "--policies", "wild"][1:]) == 2
    assert not (world / "undeclared").exists()


def test_a_policy_is_not_added_to_other_scenes(world, reference, capsys):
    folder = world / "other scenes"
    shutil.copytree(reference[0], folder)
    rows, metadata = read_rollouts(folder)
    assert rows[0].scene is not None
    changed = [dataclasses.replace(row, scene="0123456789abcdef") if row.seed == 41 else row for row in rows if row.policy == "calm"]
    write_rollouts(folder, changed, {key: value for key, value in metadata.items() if key != "schema_version"})
    before = files(folder)
    assert resume(world, folder) == 2
    assert "instance 'short/test/0/41' now has another scene than in the episodes that are there" in capsys.readouterr().err
    assert files(folder) == before


def test_a_policy_that_cannot_be_added_leaves_the_log_as_it_was(world, reference, capsys):
    folder = world / "kept"
    shutil.copytree(reference[0], folder)
    more = world / "more"
    shutil.copytree(world / "policies", more)
    lost = (
        (more / "calm.toml")
        .read_text()
        .replace('name = "calm"', 'name = "lost"')
        .replace('kind = "calm"', 'kind = "lerobot"\ncheckpoint = "nowhere/at/all"')
    )
    (more / "lost.toml").write_text(lost)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    more_policies = ("--policies-dir", more, "--policies", "calm", "wild", "lost", "--workers", 1)
    assert record(world, *SIZE, "--out", folder, "--resume", *more_policies) == 2
    assert "nowhere/at/all" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_an_encoder_that_changed_is_refused_unless_it_is_asked_for(world, reference, capsys):
    folder = world / "old_encoder"
    shutil.copytree(reference[0], folder)
    run = json.loads((folder / "run.json").read_text())
    run["configuration"]["encoder"] = "colours@before"
    (folder / "run.json").write_text(json.dumps(run))
    places = ["--tasks", str(world / "tasks"), "--policies-dir", str(world / "policies")]
    assert record_main(["--resume", "--out", str(folder), *places]) == 2
    assert "encoder was 'colours@before' at the beginning, now it is 'colours'" in capsys.readouterr().err
    assert record_main(["--resume", "--out", str(folder), *places, "--encoder", "colours"]) == 0


def test_repeats_differ_by_noise_on_actions(tmp_path):
    """Without noise those of a local policy are equal: `test_every_policy_on_every_instance_from_the_same_state`."""
    folder = tmp_path / "log"
    what = ["--task", "close_drawer", "--policies", "scripted_expert", "--instances", "2", "--repeats", "3"]
    assert record_main([*what, "--action-noise", "0.1", "--workers", "1", "--out", str(folder)]) == 0
    steps: dict[str, set[int]] = {}
    for row in read_rollouts(folder)[0]:
        steps.setdefault(row.instance, set()).add(row.steps)
    assert {len(different) for different in steps.values()} <= {2, 3}


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing(world, reference):
    """Its instance goes on where it was, in another worker."""
    folder = world / "worker_killed"
    arguments = command(world, "record", *SIZE, "--workers", 1, "--out", folder)
    process = subprocess.Popen(arguments, env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_for_lines(process, folder / "shards.jsonl", 2)
    (worker,) = started(process) - children(process)
    os.kill(worker, signal.SIGKILL)
    complaints = process.communicate(timeout=600)[1]
    assert process.returncode == 0 and "lost" not in complaints
    assert files(folder) == files(reference[0])


@pytest.mark.slow
def test_workers_that_die_again_and_again_end_the_recording(world, reference):
    """With one policy there is nothing but deaths: the third instance in a row is the end, or the last where there are fewer."""
    flags = ("--repeats", 1, "--workers", 1, "--policies", "calm")
    for instances, words in ((5, "3 jobs in a row"), (1, "no episode was recorded")):
        folder = world / f"hopeless_{instances}"
        done = execute(world, "record", *SIZE, *flags, "--instances", instances, "--out", folder, WANDER_DIES_ON="everything")
        complaint = done.stderr.splitlines()[-1]
        assert done.returncode == 2 and complaint.startswith("error: ") and words in complaint and "signal 9" in complaint, done.stderr
        assert not (folder / "rollouts.parquet").exists()
        assert "Traceback" not in done.stderr
    assert resume(world, world / "hopeless_5") == 0
    whole, _ = read_rollouts(reference[0])
    assert read_rollouts(world / "hopeless_5")[0] == [row for row in whole if row.policy == "calm" and row.repeat == 0]


def test_a_recording_killed_while_its_workers_start_leaves_no_process(world):
    folder = world / "young"
    arguments = command(world, "record", *SIZE, "--workers", 2, "--out", folder)
    process = subprocess.Popen(arguments, env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert wait_until(lambda: len(started(process)) == 3, 120)  # two, and what forked them
    workers = started(process)
    time.sleep(0.5)  # they load what records episodes
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert wait_until(lambda: not any(map(alive, workers)), 10)
    assert "Traceback" not in process.stderr.read()
    process.stderr.close()


def test_an_episode_on_which_workers_die_is_lost_alone_and_recorded_again_by_a_resume(world, reference, capsys, monkeypatch):
    """The local policy takes its worker along in one of the instances; everything else is as it would have been."""
    whole, _ = read_rollouts(reference[0])
    victim = whole[2 * REPEATS]
    with monkeypatch.context() as patch:
        patch.setenv("WANDER_DIES_ON", victim.instruction)
        assert record(world, *SIZE, "--repeats", 1, "--workers", 1, "--out", world / "dying") == 0
    assert f"1 episodes were lost, the first of them of {victim.instance}, policy calm" in capsys.readouterr().err
    rows, _ = read_rollouts(world / "dying")
    assert len(rows) == 2 * INSTANCES
    for row in rows:
        if (row.seed, row.policy) == (victim.seed, "calm"):
            assert row.error == "the worker process died (signal 9)"
            assert not row.success
        else:
            assert row in whole
    assert resume(world, world / "dying") == 0
    assert "lost" not in capsys.readouterr().err
    assert read_rollouts(world / "dying")[0] == [row for row in whole if row.repeat == 0]
    assert record_main(resumed(world, world / "dying")) == 0
    assert "is complete" in capsys.readouterr().err


def test_error_rows_that_say_something_of_a_policy_are_kept_by_a_resume(world, reference, capsys):
    folder = world / "failed"
    shutil.copytree(reference[0], folder)
    rows, metadata = read_rollouts(folder)
    rows[0] = dataclasses.replace(rows[0], success=False, error="PolicyError: the answer is not finite")
    write_rollouts(folder, rows, {key: value for key, value in metadata.items() if key != "schema_version"})
    before = files(folder)
    assert record_main(resumed(world, folder)) == 0
    shown = capsys.readouterr()
    assert "is complete" in shown.err and files(folder) == before
    assert "1 episode of calm ended in an error, in short/test/0/40: PolicyError: the answer is not finite" in shown.out


def test_axes_are_recorded_and_change_what_the_policies_see(world, reference):
    folder = world / "perturbed"
    flags = ("--policies", "calm", "--repeats", 1, "--level", 1, "--axis", "camera=3", "--axis", "light=1", "--workers", 1)
    assert record(world, *SIZE, *flags, "--out", folder) == 0
    rows, metadata = read_rollouts(folder)
    assert {(row.level, row.axes) for row in rows} == {(1, "camera=3")}
    assert {row.instance for row in rows} == {f"short/test/1,camera=3/{seed}" for seed in range(40, 40 + INSTANCES)}
    assert (metadata["levels"], metadata["axes"]) == ([1], ["camera=3"])
    clean, _ = read_rollouts(reference[0])
    assert {(row.level, row.axes) for row in clean} == {(0, None)}
    before, after = (
        ContextCache(place).table("colours", [row.instance for row in log if row.policy == "calm" and row.repeat == 0])
        for place, log in ((reference[0], clean), (folder, rows))
    )
    assert (before != after).any(axis=1).all()


@pytest.mark.slow
def test_another_robot_is_recorded_and_stays_that_of_the_recording(world, reference, capsys):
    folder = world / "ur5e"
    assert record(world, "--instances", 1, "--robot", "UR5e", "--workers", 1, "--out", folder) == 0
    rows, metadata = read_rollouts(folder)
    assert {(row.instance, row.robot) for row in rows} == {("short/test/0/0-UR5e", "UR5e")}
    assert metadata["robot"] == "UR5e" and {row.robot for row in read_rollouts(reference[0])[0]} == {None}
    before = files(folder)
    assert resume(world, folder) == 0 and files(folder) == before
    capsys.readouterr()
    assert record_main(["--resume", "--out", str(folder), "--robot", "Panda"]) == 2
    text = capsys.readouterr().err
    assert "--robot: Panda, but " in text and "began with UR5e" in text


def test_summary_of_a_log(reference, capsys):
    assert record_main(["--summary", str(reference[0])]) == 0
    output = capsys.readouterr().out
    assert f"{INSTANCES} instances, {2 * INSTANCES * REPEATS} episodes" in output
    for word in ("calm", "wild", "object", "container", "phrasing", "mean reward"):
        assert word in output


def test_a_complete_recording_is_only_shown_again(world, reference, capsys):
    before = files(reference[0])
    assert record(world, *SIZE, "--out", reference[0], "--resume") == 0
    assert "is complete" in capsys.readouterr().err
    assert files(reference[0]) == before


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["--instances", "0"], "--instances: must be 1 or more, got 0"),
        (["--workers", "-2"], "--workers: must be 1 or more, got -2"),
        (["--task", "shrt"], "did you mean 'short'?"),
        (["--policies", "clam"], "did you mean 'calm'?"),
        (["--summary", "/nowhere"], "there is no folder /nowhere"),
        (["--level", "17"], "unknown level 17"),
        (["--axis", "camra=2"], "did you mean 'camera'?"),
        (["--axis", "camera"], "must read AXIS=LEVEL"),
        (["--robot", "UR5"], "did you mean 'UR5e'?"),
        (["--resume"], "there is no run in"),
    ],
)
def test_wrong_input_gets_one_line(world, capsys, flags, complaint):
    try:
        code = record(world, "--out", world / "wrong", *flags)
    except SystemExit as exit:
        code = exit.code
    text = capsys.readouterr().err
    assert code == 2
    assert complaint in text
    assert text.count("\n") == 1
    assert not (world / "wrong").exists()


def test_a_used_folder_or_another_recording_is_refused(world, reference, capsys):
    arguments = (*SIZE, "--out", reference[0])
    assert record(world, *arguments) == 2
    assert "add --resume" in capsys.readouterr().err
    assert record(world, *arguments, "--resume", "--instances", 6) == 2
    assert "instances was 5 at the beginning, now it is 6" in capsys.readouterr().err
    assert configuration(reference[0])["instances"] == 5
