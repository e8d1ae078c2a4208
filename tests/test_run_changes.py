"""Policies that join and leave a live run: journals, what is refused, what readers make of it."""

import json
import random
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from run_helpers import environment, wait_for_lines

import osel_sim
from osel_sim.analysis.live import read_live
from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.episodes.changes import PolicyChanges
from osel_sim.episodes.run_subscribers import RunSubscriber
from osel_sim.formats.journal import read_journal
from osel_sim.formats.policy_changes import EVENTS, PolicyChange, available, read_changes, write_changes
from osel_sim.interface.selector import Choice
from osel_sim.run import main as run_main

FIRST, SECOND, THIRD = 3, 6, 8


POLICY = """version = 1
name = "{name}"
title = "test"
location = "local"
kind = "toy_{kind}"
execute = 4
inference_seconds = 0.01

[observation]
cameras = ["top"]
image_size = 64
"""

ENCODER = """
import numpy as np


class Letters:
    name = identity = "letters"
    dimension, image_size = 26, 64

    def encode(self, images, instruction):
        return np.array([instruction.lower().count(letter) / len(instruction) for letter in "abcdefghijklmnopqrstuvwxyz"], np.float32)
"""
POINTS = """[osel_sim.suites]
toy = toy_suite:Toy
[osel_sim.policies]
toy_greedy = toy_policies:load_greedy
toy_reader = toy_policies:load_reader
[osel_sim.encoders]
letters = letters:Letters
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Two local policies of the toy suite, `calm` and `brisk`: no simulator, no server."""
    folder = tmp_path_factory.mktemp("world")
    plugin, info = folder / "plugin", folder / "plugin" / "toy_suite-1.0.dist-info"
    info.mkdir(parents=True)
    for name in ("toy_suite.py", "toy_policies.py"):
        shutil.copy(Path(__file__).parent / "toy_suite" / name, plugin)
    (plugin / "letters.py").write_text(ENCODER)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-suite\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    (folder / "policies").mkdir()
    for name, kind in (("calm", "greedy"), ("brisk", "reader")):
        (folder / "policies" / f"{name}.toml").write_text(POLICY.format(name=name, kind=kind))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(plugin))
        yield folder


@pytest.fixture(scope="module")
def begun(world) -> Path:
    """A run of one policy, of some decisions."""
    folder = world / "begun"
    flags = ["--task", "toy:reach", "--policies-dir", world / "policies", "--policies", "calm", "--encoder", "letters"]
    flags += ["--selector", "thompson", "--counterfactual", "--no-page", "--episodes", FIRST, "--out", folder]
    assert run_main(list(map(str, flags))) == 0
    return folder


class Told(RunSubscriber):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.words: list[str] = []

    def on_event(self, event: PolicyChange) -> None:
        self.words.append(event.words)


@pytest.fixture(scope="module")
def changed(world, begun) -> tuple[Path, Told]:
    """It went on with another policy, and at last without the first."""
    folder, told = world / "changed", Told()
    shutil.copytree(begun, folder)
    osel_sim.run(out=folder, resume=True, episodes=SECOND, add_policies="brisk", no_page=True, subscribers=[told])
    shutil.copytree(folder, world / "joined")
    osel_sim.run(out=folder, resume=True, episodes=THIRD, retire="calm", no_page=False, subscribers=[told])
    return folder, told


def bytes_of(folder: Path) -> dict[str, bytes]:
    """What must not depend on how a run went."""
    return {name: (folder / name).read_bytes() for name in ("episodes.jsonl", "counterfactual.jsonl", "contexts.npz", EVENTS)}


def test_policies_join_and_leave(changed):
    folder, told = changed
    words = ["brisk joins before decision 3", "calm retires before decision 6"]
    assert told.words == words
    decisions = read_journal(folder / "episodes.jsonl")
    assert [tuple(decision.propensities) for decision in decisions] == [("calm",)] * 3 + [("calm", "brisk")] * 3 + [("brisk",)] * 2
    assert [change.words for change in read_changes(folder, ["calm"])] == words
    noted = json.loads((folder / "run.json").read_text())
    assert noted["events"] == [{"before": 3, "event": "add", "policy": "brisk"}, {"before": 6, "event": "retire", "policy": "calm"}]
    assert noted["configuration"]["policies"] == ["calm"] and noted["configuration"]["episodes"] == THIRD
    live = read_live(folder)
    assert live.outcomes.policies == ("calm", "brisk")
    assert (live.propensities[:3, 1] == 0.0).all() and (live.propensities[6:, 0] == 0.0).all()
    assert np.isfinite(live.outcomes.success).all(axis=(1, 2)).tolist() == [False] * 3 + [True] * 3 + [False] * 2
    assert set(json.loads((folder / "summary.json").read_text())["policies"]) == {"calm", "brisk"}


def test_the_page_tells_of_them(changed):
    page = (changed[0] / "report.html").read_text()
    assert "brisk joins before decision 3" in page
    assert (changed[0] / "tables" / "changes.csv").read_text().splitlines()[0].startswith("before,event,policy")


def test_such_a_run_is_replayed_where_all_policies_ran(changed, tmp_path):
    result = osel_sim.replay(changed[0], selectors=["thompson"], seeds=2, workers=1, no_frontier=True, out=tmp_path / "replay")
    assert result.result is not None and result.result["log"]["instances"] == 3
    assert result.off_policy is not None and result.off_policy["targets"]["fixed:calm"]["unsupported"] > 0.0


def test_killed_and_resumed_gives_the_same_bytes(world, begun, changed):
    folder = world / "killed"
    shutil.copytree(begun, folder)
    flags = ["--out", folder, "--resume", "--episodes", SECOND, "--add-policies", "brisk", "--no-page"]
    words = [sys.executable, "-m", "osel_sim.run", *map(str, flags)]
    process = subprocess.Popen(words, env=environment(world), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    wait_for_lines(process, folder / "episodes.jsonl", FIRST + 1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    assert run_main(["--out", str(folder), "--resume", "--no-page"]) == 0
    assert bytes_of(folder) == bytes_of(world / "joined")


def test_a_run_killed_before_run_json_said_so_goes_on(world, changed):
    folder = world / "unnoted"
    shutil.copytree(world / "joined", folder)
    whole = bytes_of(folder)
    data = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({key: value for key, value in data.items() if key != "events"}))
    for name in ("episodes.jsonl", "counterfactual.jsonl"):
        (folder / name).write_bytes(b"".join((folder / name).read_bytes().splitlines(keepends=True)[: FIRST + 1]))
    assert run_main(["--out", str(folder), "--resume", "--no-page"]) == 0
    assert bytes_of(folder) == whole
    assert json.loads((folder / "run.json").read_text())["events"] == data["events"]


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["--add-policies", "brisl"], "unknown policy 'brisl': did you mean 'brisk'"),
        (["--add-policies", "calm"], "the run has had it from the beginning"),
        (["--add-policies", "brisk", "brisk"], "named twice after --add-policies"),
        (["--add-policies", "brisk", "--retire", "brisk"], "leave one of them out"),
        (["--retire", "clam"], "did you mean 'calm'"),
        (["--retire", "calm"], "the last one to choose from"),
        (["--add-policies", "brisk", "--episodes", FIRST], "has made all its 3 decisions"),
    ],
)
def test_what_cannot_be_changed_is_one_line(begun, capsys, flags, complaint):
    whole = bytes_of_begun(begun)
    flags = ["--out", begun, "--resume", "--no-page", *([] if "--episodes" in flags else ["--episodes", SECOND]), *flags]
    assert run_main(list(map(str, flags))) == 2
    error = capsys.readouterr().err.strip()
    assert complaint in error and len(error.splitlines()) == 1
    assert bytes_of_begun(begun) == whole and not (begun / EVENTS).exists()


def bytes_of_begun(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def test_more_that_cannot_be_changed(world, changed, tmp_path, capsys):
    joined = world / "joined"
    assert run_main(["--out", str(joined), "--resume", "--episodes", "9", "--add-policies", "brisk"]) == 2
    assert "has had it since decision 3" in capsys.readouterr().err
    flags = ["--task", "toy:reach", "--policies-dir", world / "policies", "--out", tmp_path / "new"]
    assert run_main([*map(str, flags), "--add-policies", "brisk"]) == 2
    assert "add --resume" in capsys.readouterr().err
    file = world / "policies" / "brisk.toml"
    text = file.read_text()
    try:
        file.write_text(text + "# another\n")
        assert run_main(["--out", str(joined), "--resume", "--episodes", "9"]) == 2
        assert "when brisk joined" in capsys.readouterr().err
    finally:
        file.write_text(text)


def make_changes(folder: Path) -> list[PolicyChange]:
    folder.mkdir(exist_ok=True)
    (folder / "run.json").write_text(json.dumps({"schema_version": 1}))
    changes = [PolicyChange(4, "add", "b", {"policy b": "1234"}), PolicyChange(7, "retire", "a", {}), PolicyChange(9, "add", "a", {"policy a": "1"})]
    write_changes(folder, changes)
    return changes


def test_a_policy_may_come_back(tmp_path):
    changes = make_changes(tmp_path)
    assert list(read_changes(tmp_path, ["a"])) == changes
    assert [available(["a"], changes, index) for index in (3, 4, 7, 9)] == [("a",), ("a", "b"), ("b",), ("b", "a")]


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda lines: lines[:2], "lost decisions"),
        (lambda lines: [lines[0].replace("1234", "1235"), *lines[1:]], "line 1: is not what was written"),
        (lambda lines: [lines[0].replace('"add"', '"ad"'), *lines[1:]], "line 1: not a change of policies .event must be one of add, retire"),
        (lambda lines: [lines[1], lines[0], lines[2]], "line 1: unknown|line 1: policy"),
        (lambda lines: [*lines, lines[2]], "line 4: policy 'a' is already"),
        (lambda lines: [*lines[:2], lines[2][:-9]], "cut off|lost decisions"),
        (lambda lines: ["[]\n", *lines], "line 1: expected an object"),
    ],
)
def test_a_damaged_file_of_events_is_refused(tmp_path, damage, complaint):
    make_changes(tmp_path)
    file = tmp_path / EVENTS
    file.write_text("".join(damage(file.read_text().splitlines(keepends=True))))
    with pytest.raises(DataError, match=complaint):
        read_changes(tmp_path, ["a"])


def test_no_bit_of_a_file_of_events_can_flip_unseen(tmp_path):
    changes = make_changes(tmp_path)
    file, chance = tmp_path / EVENTS, random.Random(0)
    raw = file.read_bytes()
    for _ in range(300):
        place = chance.randrange(len(raw))
        for other in (bytes([raw[place] ^ 1 << chance.randrange(8)]), b"\n"):
            file.write_bytes(damaged := raw[:place] + other + raw[place + 1 :])
            if damaged != raw:
                with pytest.raises(DataError, match=re.escape(str(file))):
                    read_changes(tmp_path, ["a"])
        file.write_bytes(raw[:place])
        with pytest.raises(DataError, match=re.escape(str(file))):
            read_changes(tmp_path, ["a"])
    file.write_bytes(raw)
    assert list(read_changes(tmp_path, ["a"])) == changes


class Stranger:
    """A selector of somebody's own that knows its policies and nothing of changes."""

    policies = ("a", "b")

    def select(self, context):
        return Choice("a", {"a": 0.5, "b": 0.5})

    def update(self, context, choice, reward):
        return None


def test_a_selector_that_cannot_is_named():
    for change in (PolicyChange(0, "add", "c", {}), PolicyChange(0, "retire", "a", {})):
        with pytest.raises(UsageError, match="'Stranger' lacks add_policy and retire_policy"):
            PolicyChanges((change,)).apply(Stranger(), 0)


def test_unknown_policies_are_named():
    with pytest.raises(UnknownNameError):
        from osel_sim.formats.policy_changes import check_change

        check_change(PolicyChange(0, "retire", "c", {}), ["a", "b"])
