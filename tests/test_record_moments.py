"""`python -m osel_sim.record --moments K` with real workers and servers: every way on, the same bytes however it went."""

import dataclasses
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from run_helpers import command, environment, execute, wait_for_lines

from osel_sim.api.record_moments import in_blocks
from osel_sim.episodes.moment_recording import MOMENT_SHARDS
from osel_sim.episodes.workers import Plan
from osel_sim.formats.journal import JOURNAL, TIMING, read_lines, to_decision
from osel_sim.formats.moments import MOMENTS, SEEN, SIGNALS, read_moments
from osel_sim.formats.points import POINTS
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.record import main as record_main
from osel_sim.run import main as run_main
from osel_sim.suites.registry import find_task

SIZE = ("--instances", 2, "--action-noise", 0.05, "--moments", 1, "--most-moments", 2)


@pytest.fixture(scope="module")
def reference(world):
    """A recording that nobody disturbed."""
    folder = world / "reference"
    done = execute(world, "record", *SIZE, "--workers", 1, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in (MOMENTS, SEEN, "rollouts.parquet", "contexts.npz")}


def resume(world: Path, folder: Path, *flags: object) -> int:
    places = ["--tasks", world / "tasks", "--policies-dir", world / "policies"]
    return record_main(list(map(str, ["--resume", *places, "--out", folder, *flags])))


def test_every_other_policy_goes_on_from_every_moment(reference):
    table, (episodes, _) = read_moments(reference), read_rollouts(reference)
    assert sorted(file.name for file in reference.iterdir()) == ["contexts.npz", SEEN, MOMENTS, "rollouts.parquet", "run.json"]
    found = [(row.instance, row.first, row.call, row.second) for row in table.rows]
    assert found == [
        (row.instance, row.policy, call, second)
        for row in episodes
        for call in (1, 2)
        for second in (None, "wild" if row.policy == "calm" else "calm")
    ]
    outcomes = {(row.instance, row.policy): row.outcome for row in episodes}
    assert all(row.outcome == outcomes[row.instance, row.first] for row in table.rows if row.second is None)
    assert all(row.outcome != outcomes[row.instance, row.first] for row in table.rows if row.second is not None)
    moments = len(table.rows) // 2
    assert table.seen.pictures.shape == (moments, 53) and len(np.unique(table.seen.pictures, axis=0)) == moments
    change = table.seen.signals[:, SIGNALS.index("change")].reshape(-1, 2)
    assert np.isnan(change[:, 0]).all() and (change[:, 1] > 0).all(), "nothing was looked at before the first"


def test_duty_and_price_are_of_who_drove(reference):
    for row in read_moments(reference).rows:
        remote = row.first if row.second is None else row.second
        if remote == "calm" and row.first == "calm":
            assert row.remote_steps == 0 and row.price == row.price_first == 0
        elif row.first == "wild":
            assert row.remote_steps == (row.step if row.second else row.steps) and row.price == row.price_first > 0
        else:
            assert row.remote_steps == row.steps - row.step and row.price > row.price_first == 0


def test_the_episodes_are_those_of_a_recording_without_moments(world, reference):
    folder = world / "plain"
    assert record_main(list(map(str, command(world, "record", "--instances", 2, "--action-noise", 0.05, "--workers", 1, "--out", folder)[3:]))) == 0
    assert read_rollouts(folder)[0] == read_rollouts(reference)[0]


def test_killed_and_resumed_with_more_workers_it_writes_the_same_bytes(world, reference):
    folder = world / "half"
    arguments = command(world, "record", *SIZE, "--workers", 1, "--out", folder)
    process = subprocess.Popen(arguments, env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for_lines(process, folder / MOMENT_SHARDS, 2)  # an instance: two episodes
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (folder / MOMENTS).exists()
    assert resume(world, folder, "--workers", 2) == 0
    assert files(folder) == files(reference)


def test_repeats_are_added_with_their_moments_and_what_would_lack_them_is_refused(world, reference, capsys):
    folder = world / "more"
    shutil.copytree(reference, folder)
    for flags, says in (
        (["--moments", 2], "began with 1"),
        (["--policies", "other"], "would lack"),
        (["--encoder", "osel_small"], "pictures of colours"),
    ):
        assert resume(world, folder, *flags) == 2
        assert says in capsys.readouterr().err
    assert resume(world, folder, "--repeats", 2, "--repeat-every", 2) == 0
    before, after = read_moments(reference).rows, read_moments(folder).rows
    assert [row for row in after if row.repeat == 0] == before
    assert {row.repeat for row in after} == {0, 1}


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["--most-moments", 2], "is for a recording with moments"),
        (["--moments", 2, "--until-decided"], "does not go with --until-decided"),
        (["--moments", 0], "--moments"),
        (["--moments", 2, "--policies", "calm"], "has nobody to hand over to"),
    ],
)
def test_wrong_settings_get_one_line(world, capsys, flags, complaint):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(world)
        try:
            code = record_main(list(map(str, command(world, "record", *flags, "--out", world / "wrong")[3:])))
        except SystemExit as end:
            code = end.code
    assert code == 2
    assert complaint in capsys.readouterr().err
    assert not (world / "wrong").exists()


@pytest.mark.parametrize(("first", "second", "call"), [("calm", "wild", 1), ("calm", "wild", 2), ("wild", "calm", 2)])
def test_a_row_is_what_a_live_run_with_that_handover_comes_to(world, reference, first, second, call):
    out = world / f"live-{first}-{call}"
    flags = ["--selector", f"fixed:{first}", "--monitor", f"blind:{call}:{second}", "--decide-every", 1, "--action-noise", 0.05]
    more = [] if (first, call) == ("calm", 1) else ["--no-page"]  # one is enough
    arguments = command(world, "run", *flags, "--episodes", 1, "--seed", 0, "--out", out, *more)
    assert run_main(list(map(str, arguments[3:]))) == 0
    (data, _), *_ = read_lines(out / JOURNAL)
    live = to_decision(data, 0, out / JOURNAL)
    row = next(
        row for row in read_moments(reference).rows if (row.first, row.call, row.second) == (first, call, second) and row.instance.endswith("/0")
    )
    assert row.outcome == dataclasses.replace(live.outcome, monitored=None)
    told = live.outcome.monitored
    assert told is not None and [(one.call, one.step, one.to) for one in told.handoffs] == [(call, row.step, second)]
    assert told.by_policy[first].price == row.price_first
    assert told.duty_steps == row.remote_steps / row.steps


def test_a_live_run_starts_warm_from_them_and_goes_on_so(world, reference, capsys):
    out, flags = world / "warm", ["--selector", "random", "--monitor", "value", "--decide-every", 1, "--seed", 7, "--episodes", 2, "--no-page"]

    def run(folder, *more):
        arguments = command(world, "run", *flags, "--out", folder, *more)
        assert run_main(list(map(str, arguments[3:]))) == 0
        return capsys.readouterr().err

    warm = ("--monitor-warm-start", reference)
    assert "moments of 2 instances" in run(out, *warm)
    run(world / "cold")
    assert (out / POINTS).read_bytes() != (world / "cold" / POINTS).read_bytes()
    whole = {name: (out / name).read_bytes() for name in (JOURNAL, POINTS)}
    for name, content in whole.items():
        (out / name).write_bytes(content.split(b"\n")[0] + b"\n")
    (out / TIMING).write_bytes((out / TIMING).read_bytes().split(b"\n")[0] + b"\n")
    run(out, *warm, "--resume")
    assert {name: (out / name).read_bytes() for name in whole} == whole


def test_an_interrupted_recording_has_some_of_every_task():
    tasks = (find_task("lift"), find_task("stack"))
    plan = Plan(tasks, (), (), range(3, 6), (0,), "test", "colours")
    turns = [(plan.instances[key].task, plan.instances[key].seed) for key in in_blocks(plan.instances, plan)]
    assert turns == [(task.name, seed) for seed in (3, 4, 5) for task in tasks]
