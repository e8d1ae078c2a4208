"""`python -m osel_sim.run` as a user meets it: real processes, a real policy server, and a run that is killed."""

import contextlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from remote_helpers import alive
from run_helpers import HORIZON, children, command, environment, execute, next_commands, wait_for_lines, wait_until
from synthetic_log import make_row, write_log

from osel_sim.analysis.live import read_live
from osel_sim.formats.journal import read_journal, to_line
from osel_sim.reporting.run_page import run_page
from osel_sim.run import main as run_main
from osel_sim.selection.state import load_state

EPISODES = 6


@pytest.fixture(scope="module")
def reference(world):
    """A run that nobody disturbed: folder, output, messages."""
    folder = world / "reference"
    with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.redirect_stderr(io.StringIO()) as messages:
        assert user(world, "--episodes", EPISODES, "--counterfactual", "--out", folder) == 0
    return folder, output.getvalue(), messages.getvalue()


def bytes_of(folder: Path) -> dict[str, bytes]:
    """What must not depend on how a run went."""
    return {name: (folder / name).read_bytes() for name in ("episodes.jsonl", "counterfactual.jsonl", "summary.json", "contexts.npz")}


def test_what_a_run_writes_and_prints(world, reference):
    folder, output, messages = reference
    files = "contexts.npz counterfactual.jsonl curve.png episodes.jsonl run.json selector.safetensors summary.json timing.jsonl"
    page = "figures report.html tables"
    assert sorted(file.name for file in folder.iterdir()) == sorted(f"{files} {page}".split())
    assert "mean reward" in output
    assert "hindsight oracle" in output
    assert "--selector auto" in output
    assert [name for name, _ in next_commands(output)] == ["report", "replay", "run"]
    assert "Traceback" not in messages
    decisions = read_journal(folder / "episodes.jsonl")
    assert [decision.seed for decision in decisions] == list(range(EPISODES))
    assert all(decision.error is None and decision.steps == HORIZON for decision in decisions)
    assert all(sum(decision.propensities.values()) == pytest.approx(1) for decision in decisions)
    remote = [decision for decision in decisions if decision.policy == "wild"]
    assert remote, "the untrained selector explores"
    assert all(decision.seconds.upload > 0 and decision.price > 0 and decision.actions < HORIZON for decision in remote)
    assert len((folder / "timing.jsonl").read_text().splitlines()) == EPISODES
    assert len({decision.scene for decision in decisions} - {None}) == EPISODES


def test_summary_agrees_with_the_journal(reference):
    folder, *_ = reference
    summary = json.loads((folder / "summary.json").read_text())
    decisions = read_journal(folder / "episodes.jsonl")
    others = [json.loads(line)["policies"] for line in (folder / "counterfactual.jsonl").read_text().splitlines()]
    rewards = [
        {decision.policy: decision.reward, **{name: item["reward"] for name, item in other.items()}}
        for decision, other in zip(decisions, others, strict=True)
    ]
    assert summary["mean_reward"] == pytest.approx(np.mean([decision.reward for decision in decisions]))
    assert summary["best_single"] == pytest.approx(max(np.mean([row[name] for row in rewards]) for name in ("calm", "wild")))
    assert summary["hindsight_oracle"] == pytest.approx(np.mean([max(row.values()) for row in rewards]))
    assert summary["regret"] == pytest.approx(summary["hindsight_oracle"] - summary["mean_reward"])
    for name in ("calm", "wild"):
        part, own = summary["policies"][name], [decision for decision in decisions if decision.policy == name]
        assert part["decisions"] == len(own)
        assert part["price"] == pytest.approx(np.mean([decision.price for decision in own]))
        assert {"success_rate", "mean_reward", "mean_steps", "mean_seconds"} <= part.keys()


def test_run_json_holds_what_the_run_depends_on(reference):
    folder, *_ = reference
    found = json.loads((folder / "run.json").read_text())
    assert found["configuration"]["reward"] == {"alpha_time": 0.2, "alpha_price": 0.01, "time_unit": "log10-seconds", "success": "success"}
    assert set(found["configuration"]["content"]) == {"task short", "policy calm", "policy wild"}
    assert found["environment"]["gl"] in ("egl", "osmesa")
    assert found["environment"]["versions"]["mujoco"]


@pytest.mark.parametrize("trial", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_killed_and_resumed_filmed_or_not_gives_the_same_bytes(world, reference, trial):
    chance = random.Random(trial)
    folder = world / f"killed-{trial}"
    arguments = ["--episodes", EPISODES if trial else EPISODES - 1, "--counterfactual", "--out", folder]
    for attempt in range(1 + trial):
        flags = ["--resume"] if attempt else ["--video", "2", *(["--view"] if trial else [])]
        process = subprocess.Popen(
            command(world, "run", *arguments, *flags), env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        wait_for_lines(process, folder / "episodes.jsonl", 1 + attempt + chance.randrange(3 - trial))
        time.sleep(chance.random() * 0.15)  # about a decision: somewhere in the next one
        started = children(process)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stderr.close()
        assert wait_until(lambda started=started: not any(map(alive, started)), 60)  # what shows the run among them
    assert run_page(folder).title.endswith(f" over {len(read_journal(folder / 'episodes.jsonl'))} decisions")
    assert len(read_journal(folder / "episodes.jsonl")) < EPISODES
    if trial:
        assert user(world, *arguments, "--resume", "--no-page") == 0
    else:  # the settings are those that it began with, and there may be more decisions
        assert run_main(["--out", str(folder), "--resume", "--episodes", str(EPISODES), "--no-page"]) == 0
    assert json.loads((folder / "run.json").read_text())["configuration"]["episodes"] == EPISODES
    assert not (folder / "report.html").exists()
    assert bytes_of(folder) == bytes_of(reference[0])


@pytest.mark.slow
def test_a_journal_begun_without_scenes_goes_on_without(world, reference):
    folder = world / "older"
    shutil.copytree(reference[0], folder)

    def without(lines: list[str]) -> bytes:
        return "".join(to_line({key: value for key, value in json.loads(line).items() if key != "scene"}) for line in lines).encode()

    lines = (folder / "episodes.jsonl").read_text().splitlines()
    (folder / "timing.jsonl").unlink()  # such a version kept no checksums there either
    (folder / "counterfactual.jsonl").write_text("".join((folder / "counterfactual.jsonl").read_text().splitlines(keepends=True)[:3]))
    (folder / "episodes.jsonl").write_bytes(without(lines[:3]))
    (folder / "summary.json").unlink()
    done = execute(world, "run", "--episodes", EPISODES, "--counterfactual", "--out", folder, "--resume", "--no-page")
    assert done.returncode == 0, done.stderr
    assert (folder / "episodes.jsonl").read_bytes() == without(lines)


def test_noise_on_actions_reaches_the_robot(tmp_path):
    lengths = []
    for noise in ("0", "0.1"):
        folder = tmp_path / noise
        what = ["--task", "close_drawer", "--policies", "scripted_expert", "--selector", "random", "--episodes", "3"]
        assert run_main([*what, "--action-noise", noise, "--no-page", "--out", str(folder)]) == 0
        lengths.append([decision.steps for decision in read_journal(folder / "episodes.jsonl")])
    assert lengths[0] != lengths[1]


def test_a_warm_start_shows_the_outcomes_of_other_instances_first(world, capsys):
    rates = {"calm": 0.9, "wild": 0.1}
    chance = np.random.default_rng(0)
    keys = [f"short/test/0/{seed}" for seed in range(40)]
    rows = [make_row(key, policy, success=bool(chance.random() < rate)) for key in keys for policy, rate in rates.items()]
    log = write_log(world / "log", rows, {key: chance.normal(size=53).astype(np.float32) for key in keys}, encoder="colours")
    out = world / "warm"
    flags = ["--selector", "auto", "--episodes", 4, "--no-page", "--out", out]
    assert user(world, *flags, "--warm-start", log) == 0
    assert f"shown beforehand: 72 outcomes of 36 instances of {log}, none of them of this run" in capsys.readouterr().err
    decisions = read_journal(out / "episodes.jsonl")
    assert decisions[0].propensities["calm"] > 0.99 and [decision.policy for decision in decisions] == ["calm"] * 4
    assert user(world, *flags, "--resume") == 2  # without the log it would be another run
    before = load_state(out / "selector.safetensors")
    costs = before["settings"]["expected_costs"]  # as the policy files declare them
    assert costs["wild"] > costs["calm"] and before["settings"]["skills"] is None  # they declare none
    assert user(world, *flags, "--warm-start", log, "--resume") == 0
    np.testing.assert_equal(load_state(out / "selector.safetensors"), before)
    capsys.readouterr()
    # It cannot go on to instances whose outcomes it was shown.
    assert run_main(["--out", str(out), "--resume", "--episodes", "5", "--no-page"]) == 2
    assert f"--episodes 5: 1 of the instances to come, such as short/test/0/4, are in {log}" in capsys.readouterr().err
    assert len(read_journal(out / "episodes.jsonl")) == 4 and json.loads((out / "run.json").read_text())["configuration"]["episodes"] == 4


def test_ctrl_c_ends_with_what_there_is(world):
    folder = world / "interrupted"
    arguments = command(world, "run", "--episodes", 500, "--out", folder, "--selector", "random", "--no-page")
    process = subprocess.Popen(arguments, env=environment(world), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for_lines(process, folder / "episodes.jsonl", 2)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["decisions"] == len(read_journal(folder / "episodes.jsonl")) >= 2
    assert "random" in output
    (name, config), *_ = next_commands(output)  # goes on with it
    assert name == "run" and config.resume and config.out == folder and not config.task  # which run.json says


def test_a_resumed_run_must_be_the_same_run(world, reference, capsys):
    folder, *_ = reference
    for flags, key in (
        (["--seed", "1"], "seed"),
        (["--alpha-price", "1"], "reward.alpha_price"),
        (["--selector", "random"], "selector"),
        (["--robot", "UR5e"], "robot"),
        (["--episodes", "5"], "episodes"),
    ):
        assert user(world, "--episodes", EPISODES, "--counterfactual", "--out", folder, "--resume", *flags) == 2
        assert f"{key} was" in one_line(capsys)


@pytest.mark.slow
def test_another_robot_is_told_by_everything_a_run_writes(world, capsys):
    folder = world / "ur5e"
    assert user(world, "--episodes", 2, "--counterfactual", "--robot", "UR5e", "--out", folder) == 0
    capsys.readouterr()
    assert json.loads((folder / "run.json").read_text())["configuration"]["robot"] == "UR5e"
    assert [decision.robot for decision in read_journal(folder / "episodes.jsonl")] == ["UR5e", "UR5e"]
    assert read_live(folder).outcomes.keys == ("short/test/0/0-UR5e", "short/test/0/1-UR5e")  # they have contexts
    assert user(world, "--episodes", 2, "--counterfactual", "--out", folder, "--resume") == 2
    assert "robot was 'UR5e' at the beginning, now it is None" in one_line(capsys)
    before = bytes_of(folder)
    assert user(world, "--episodes", 2, "--counterfactual", "--robot", "UR5e", "--out", folder, "--resume") == 0
    assert bytes_of(folder) == before


def test_a_dead_server_is_replaced_by_the_local_policy_and_the_journal_says_so(world, monkeypatch):
    """The server dies at its second call, in every episode anew."""
    monkeypatch.setenv("WANDER_DIES_ON", "server")
    assert user(world, "--episodes", 3, "--selector", "fixed:wild", "--no-page", "--out", world / "crash") == 0
    decisions = read_journal(world / "crash" / "episodes.jsonl")
    assert all(decision.fallback and not decision.error for decision in decisions)
    assert all(decision.seconds.upload > 2.0 and decision.calls == 2 for decision in decisions)  # it waited until the deadline
    assert json.loads((world / "crash" / "summary.json").read_text())["fallbacks"] == 3


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["--task", "shrt"], "unknown task 'shrt': did you mean 'short'?"),
        (["--policies", "clam"], "unknown policy 'clam': did you mean 'calm'?"),
        (["--policies", "calm", "calm"], "named twice"),
        (["--selector", "pop"], "unknown selector 'pop': did you mean 'ppo'?"),
        (["--selector", "fixed:clam"], "did you mean 'calm'?"),
        (["--encoder", "colour"], "unknown encoder 'colour': did you mean 'colours'?"),
        (["--selector", "ppo", "--warm-start", "."], "cannot start warm; those that can: auto, "),
        (["--selector", "auto", "--warm-start", "."], "rollouts.parquet"),
        (["--preset", "waym"], "did you mean 'waymo'?"),
        (["--episodes", "0"], "--episodes: must be 1 or more, got 0"),
        (["--alpha-time", "-0.1"], "--alpha-time: must be 0.0 or more"),
        (["--level", "17"], "unknown level 17"),
        (["--axis", "camra=2"], "did you mean 'camera'?"),
        (["--axis", "camera"], "must read AXIS=LEVEL"),
        (["--split", "tset"], "did you mean 'test'?"),
        (["--robot", "UR5"], "unknown robot 'UR5': did you mean 'UR5e'?"),
        (["--tasks", "/nowhere"], "there is no folder /nowhere"),
        (["--resume"], "there is no run in"),
        (["--episods", "3"], "did you mean '--episodes'?"),
    ],
)
def test_wrong_input_gets_one_line_and_a_suggestion(world, capsys, flags, complaint):
    try:
        code = user(world, "--out", world / "wrong", *flags)
    except SystemExit as exit:
        code = exit.code
    assert code == 2
    assert complaint in one_line(capsys)
    assert not (world / "wrong").exists()


def test_used_out_without_resume_is_refused(world, reference, capsys):
    assert user(world, "--out", reference[0]) == 2
    assert "add --resume" in one_line(capsys)
    (world / "other").mkdir()
    (world / "other" / "thesis.txt").write_text("years of work")
    assert user(world, "--out", world / "other", "--selector", "random") == 2
    assert "is not empty and holds no run.json" in one_line(capsys)
    assert user(world, "--out", world / "other" / "thesis.txt" / "run") == 2
    assert "cannot be written: " in one_line(capsys)


def user(world: Path, *flags: object) -> int:
    """The command in this process, which has imported already what it needs; its servers are processes as ever."""
    os.environ["OMP_NUM_THREADS"] = "1"
    return run_main(list(map(str, command(world, "run", *flags)[3:])))


def one_line(capsys) -> str:
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert text.startswith("error: ")
    return text


@pytest.mark.slow
def test_tensorboard_files_have_each_decision_once_after_a_resume(world):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator", reason="tensorboard is not installed")
    folder = world / "board"
    for resume in ([], ["--resume"]):
        assert user(world, "--episodes", 3, "--selector", "random", "--tensorboard", "--no-page", "--out", folder, *resume) == 0
    events = accumulator.EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    decisions = read_journal(folder / "episodes.jsonl")
    rewards = events.Scalars("decision/reward")
    assert [event.step for event in rewards] == [0, 1, 2]
    assert [event.value for event in rewards] == pytest.approx([decision.reward for decision in decisions], rel=1e-5)
    assert {"mean/reward", "chosen/calm", "propensity/wild", "decision/price"} <= set(events.Tags()["scalars"])
