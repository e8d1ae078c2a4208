"""The journal: exact, ordered, and whole after any cut."""

import json

import pytest

from osel_sim.core.errors import DataError
from osel_sim.formats.journal import Decision, Lines, read_journal, to_line
from osel_sim.interface.outcome import Seconds

FIELDS = [
    "index",
    "task",
    "seed",
    "level",
    "axes",
    "split",
    "instruction",
    "phrasing",
    "target",
    "container",
    "policy",
    "propensities",
    "success",
    "subgoals",
    "steps",
    "seconds",
    "calls",
    "actions",
    "price",
    "reward",
    "fallback",
    "error",
]


def decision(index=0, **more):
    values = {
        "task": "pick_place",
        "seed": 7,
        "level": 0,
        "axes": None,
        "split": "test",
        "instruction": "put the milk in the bowl, s'il vous plaît",
        "phrasing": "train-0",
        "target": "milk",
        "container": "bowl",
        "policy": "a",
        "propensities": {"b": 0.1 + 0.2, "a": 1 - (0.1 + 0.2)},
        "success": True,
        "subgoals": 1.0,
        "steps": 90,
        "seconds": Seconds(0.1, 0.2, 0.3, 4.5),
        "calls": 12,
        "actions": 80,
        "price": 2.8000000000000003,
        "reward": -1e-17,
        "fallback": None,
        "error": None,
    }
    return Decision(index=index, **{**values, **more})


def test_a_line_has_the_promised_fields_in_order_and_exact_numbers(tmp_path):
    journal = Lines(tmp_path / "episodes.jsonl")
    journal.append(decision().to_dict())
    journal.append(decision(1, reward=None, error="p: died").to_dict())
    journal.close()
    lines = (tmp_path / "episodes.jsonl").read_text().splitlines()
    assert list(json.loads(lines[0])) == FIELDS
    assert list(json.loads(lines[0])["seconds"]) == ["upload", "inference", "download", "motion"]
    read = read_journal(tmp_path / "episodes.jsonl")
    assert read == [decision(), decision(1, reward=None, error="p: died")]
    assert [to_line(one.to_dict()).rstrip("\n") for one in read] == lines
    assert read[0].outcome.price == 2.8000000000000003


def test_any_cut_leaves_the_whole_lines_and_going_on_gives_the_same_bytes(tmp_path):
    whole = tmp_path / "whole.jsonl"
    journal = Lines(whole)
    for index in range(3):
        journal.append(decision(index).to_dict())
    journal.close()
    raw = whole.read_bytes()
    ends = [position + 1 for position, byte in enumerate(raw) if byte == ord("\n")]
    for cut in (0, 1, ends[0] - 1, ends[0], ends[0] + 1, ends[1] + 20, len(raw) - 1, len(raw)):
        torn = tmp_path / f"cut-{cut}.jsonl"
        torn.write_bytes(raw[:cut])
        journal = Lines(torn)
        assert len(journal.rows) == sum(end <= cut for end in ends)
        for index in range(len(journal.rows), 3):
            journal.append(decision(index).to_dict())
        journal.close()
        assert torn.read_bytes() == raw


def test_keep_drops_what_lies_beyond(tmp_path):
    lines = Lines(tmp_path / "timing.jsonl")
    for index in range(4):
        lines.append({"index": index})
    lines.close()
    Lines(tmp_path / "timing.jsonl", keep=2).close()
    assert (tmp_path / "timing.jsonl").read_text() == '{"index": 0}\n{"index": 1}\n'


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("not json\n", "line 1: not JSON"),
        ("[1]\n", "line 1: expected an object"),
        ('{"index": 0}\n', "line 1: not a decision"),
    ],
)
def test_a_broken_journal_is_refused_with_file_and_line(tmp_path, text, complaint):
    file = tmp_path / "episodes.jsonl"
    file.write_text(text)
    with pytest.raises(DataError, match=complaint) as error:
        read_journal(file)
    assert str(file) in str(error.value)


def test_a_gap_is_refused(tmp_path):
    journal = Lines(tmp_path / "episodes.jsonl")
    journal.append(decision(1).to_dict())
    journal.close()
    with pytest.raises(DataError, match="index must be 0, got 1"):
        read_journal(tmp_path / "episodes.jsonl")


def test_a_missing_journal_is_refused(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        read_journal(tmp_path / "episodes.jsonl")


def test_nan_does_not_get_in(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        to_line(decision(reward=float("nan")).to_dict())
