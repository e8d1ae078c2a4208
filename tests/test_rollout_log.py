"""The rollout log: typed columns, exact values, the same bytes for the same content; shards that survive a cut."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from rich.console import Console

from osel_sim.cli.rollout_tables import print_rollouts, share_best
from osel_sim.core.errors import DataError, UsageError
from osel_sim.formats.rollout_log import Row, read_rollouts, schema, write_rollouts
from osel_sim.formats.shards import SHARDS, Shards
from osel_sim.selection.reward import RewardWeights, preset, reward, row_rewards

COLUMNS = [
    "task",
    "instance",
    "seed",
    "level",
    "split",
    "instruction",
    "phrasing",
    "target",
    "container",
    "policy",
    "repeat",
    "success",
    "subgoals",
    "steps",
    "upload",
    "inference",
    "download",
    "motion",
    "calls",
    "actions",
    "price",
    "fallback",
    "error",
    "score",
    "axes",
]


def row(seed=0, policy="small", repeat=0, **more):
    values = {
        "task": "pick_place",
        "instance": f"pick_place/test/0/{seed}",
        "seed": seed,
        "level": 0,
        "split": "test",
        "instruction": "milk, bowl",
        "phrasing": "held_out-1" if seed % 2 else "train-3",
        "target": "milk",
        "container": "bowl",
        "policy": policy,
        "repeat": repeat,
        "success": seed % 2 == 0,
        "subgoals": 0.1 + 0.2,
        "steps": 100 + seed,
        "upload": 0.1,
        "inference": 0.2,
        "download": 0.3,
        "motion": 5.0,
        "calls": 12,
        "actions": 96,
        "price": 3.12,
        "fallback": None,
        "error": None,
    }
    return Row(**{**values, **more})


def test_columns_types_and_schema_version(tmp_path):
    write_rollouts(tmp_path, [row()], {"task": "pick_place"})
    table = pyarrow.parquet.read_table(tmp_path / "rollouts.parquet")
    assert table.schema.names == COLUMNS == schema(2).names
    assert table.schema.metadata[b"osel_sim.schema_version"] == b"2"
    assert table.schema.field("steps").type == pyarrow.int64()
    assert table.schema.field("success").type == pyarrow.bool_()
    assert table.schema.field("fallback").nullable


def test_what_goes_in_comes_out_and_equal_logs_are_equal_bytes(tmp_path):
    rows = [row(seed, policy, repeat, error="died" if seed == 1 else None) for seed in range(3) for policy in ("small", "large") for repeat in (0, 1)]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_rollouts(tmp_path / name, iter(rows), {"b": 1, "a": [2]})
    assert (tmp_path / "a" / "rollouts.parquet").read_bytes() == (tmp_path / "b" / "rollouts.parquet").read_bytes()
    read, metadata = read_rollouts(tmp_path / "a")
    assert read == rows
    assert metadata == {"a": [2], "b": 1, "schema_version": 2}
    assert read[0].outcome.seconds.download == 0.3


def test_wrong_logs_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"does not exist; python -m osel_sim\.record or, from a table, python -m osel_sim\.ingest with --out"):
        read_rollouts(tmp_path)
    (tmp_path / "rollouts.parquet").write_text("no parquet")
    with pytest.raises(DataError, match="not a Parquet file"):
        read_rollouts(tmp_path)
    pyarrow.parquet.write_table(pyarrow.table({"a": [1]}), tmp_path / "rollouts.parquet")
    with pytest.raises(DataError, match="schema_version must be 1 to 5, got None"):
        read_rollouts(tmp_path)


def test_a_log_of_version_1_is_read_without_scores_and_axes(tmp_path):
    write_rollouts(tmp_path, [row(), row(policy="large")], {})
    file = tmp_path / "rollouts.parquet"
    table = pyarrow.parquet.read_table(file)
    old = table.drop_columns(["score", "axes"]).replace_schema_metadata({**table.schema.metadata, b"osel_sim.schema_version": b"1"})
    pyarrow.parquet.write_table(old, file)
    assert read_rollouts(tmp_path)[0] == [row(), row(policy="large")]
    pyarrow.parquet.write_table(old.append_column("score", [[0.5, 0.25]]), file)
    with pytest.raises(DataError, match="columns must be"):
        read_rollouts(tmp_path)
    pyarrow.parquet.write_table(table.replace_schema_metadata({b"osel_sim.schema_version": b"6"}), file)
    with pytest.raises(DataError, match="schema_version must be 1 to 5, got 6"):
        read_rollouts(tmp_path)
    pyarrow.parquet.write_table(table.replace_schema_metadata({b"osel_sim.schema_version": b"3 or so"}), file)
    with pytest.raises(DataError, match="metadata cannot be read"):
        read_rollouts(tmp_path)


def test_a_log_that_tells_scenes_tells_one_of_each_instance(tmp_path):
    rows = [row(scene=None, error="the worker process died"), row(policy="large", scene="a1"), row(1, scene="b2")]
    write_rollouts(tmp_path, rows, {})
    read, metadata = read_rollouts(tmp_path)
    assert read == rows and metadata["schema_version"] == 5
    write_rollouts(tmp_path, [*rows, row(policy="third", scene="a2")], {})
    with pytest.raises(DataError, match="row 4: instance 'pick_place/test/0/0': its scene is 'a2', in an earlier row it is 'a1'"):
        read_rollouts(tmp_path)
    write_rollouts(tmp_path, [row(scene="")], {})
    with pytest.raises(DataError, match="column 'scene', row 1: must be text that is not empty or null"):
        read_rollouts(tmp_path)


def test_a_log_of_several_robots_says_which(tmp_path):
    rows = [row(), row(1), row(2, instance="pick_place/test/0/2-UR5e", robot="UR5e")]
    write_rollouts(tmp_path, rows, {})
    table = pyarrow.parquet.read_table(tmp_path / "rollouts.parquet")
    assert table.schema.names == [*COLUMNS, "robot"] == schema(3).names
    assert table.schema.metadata[b"osel_sim.schema_version"] == b"3"
    assert table["robot"].to_pylist() == [None, None, "UR5e"]
    assert read_rollouts(tmp_path)[0] == rows


def test_the_tables_tell_robots_apart_where_there_are_several(capsys):
    def said(rows):
        print_rollouts(Console(width=160), rows, preset("mmlu"))
        return [line.split("│")[1:4] for line in capsys.readouterr().out.splitlines() if line.startswith("│ robot")]

    assert said([row(), row(1)]) == []
    lines = said([row(), row(1), row(2, instance="pick_place/test/0/2-UR5e", robot="UR5e")])
    assert [[cell.strip() for cell in line] for line in lines] == [["robot", "Panda", "2"], ["robot", "UR5e", "1"]]


def changed(folder, **columns):
    """A log of three rows, with other columns instead of what was written; what reading it says."""
    write_rollouts(folder, [row(seed) for seed in range(3)], {})
    file = folder / "rollouts.parquet"
    table = pyarrow.parquet.read_table(file)
    for name, values in columns.items():
        table = table.set_column(table.schema.get_field_index(name), name, values)
    pyarrow.parquet.write_table(table, file)
    return read_rollouts(folder)[0]


@pytest.mark.parametrize(
    ("column", "values", "says"),
    [
        ("success", ["True", "False", "True"], "column 'success' must hold true and false, its type is string"),
        ("success", [1, 0, 1], "column 'success' must hold true and false, its type is int64"),
        ("subgoals", ["0.5", "1", "0"], "column 'subgoals' must hold numbers, its type is string"),
        ("steps", [1.5, 2.0, 3.0], "column 'steps' must hold integers, its type is double"),
        ("policy", [1, 2, 3], "column 'policy' must hold text, its type is int64"),
        ("instruction", [b"a", b"b", b"c"], "column 'instruction' must hold text, its type is binary"),
        ("target", [["a"], [], []], "column 'target' must hold text, its type is list"),
        ("policy", ["a", None, "c"], "column 'policy', row 2: is empty, every row needs one"),
        ("repeat", pyarrow.nulls(3), "column 'repeat', row 1: is empty, every row needs one"),
        ("repeat", [0, 0, -1], "column 'repeat', row 3: must be an integer of 0 or more, got -1"),
        ("success", [True, None, None], "column 'success', row 2: is empty, and error does not say why"),
        ("success", pyarrow.nulls(3), "column 'success', row 1: is empty, and error does not say why"),
    ],
)
def test_columns_of_another_kind_are_refused(column, values, says, tmp_path):
    with pytest.raises(DataError, match=r"^[^\n]*rollouts\.parquet: [^\n]*$") as refused:
        changed(tmp_path, **{column: pyarrow.array(values)})
    assert says in str(refused.value)


def test_columns_that_others_write_otherwise_are_read(tmp_path):
    columns = {
        "task": pyarrow.array(["pick_place"] * 3).dictionary_encode(),
        "policy": pyarrow.array(["small"] * 3, pyarrow.large_string()),
        "repeat": pyarrow.array([0, 0, 0], pyarrow.int32()),
        "price": pyarrow.array([3, 3, 3]),
        "subgoals": pyarrow.array([0.5, 0.5, 0.5], pyarrow.float32()),
        "score": pyarrow.nulls(3),
        "success": pyarrow.array([True, None, True]),
        "error": pyarrow.array([None, "died", None]),
    }
    expected = [row(seed, price=3, subgoals=0.5) for seed in range(3)]
    expected[1] = replace(expected[1], success=False, error="died")
    assert changed(tmp_path, **columns) == expected
    write_rollouts(tmp_path, [], {})
    assert read_rollouts(tmp_path)[0] == []


def test_a_torn_log_gets_one_line(tmp_path):
    write_rollouts(tmp_path, [row(seed) for seed in range(300)], {})
    file = tmp_path / "rollouts.parquet"
    whole = file.read_bytes()
    file.write_bytes(whole[:300] + bytes(500) + whole[800:])
    with pytest.raises(DataError, match=r"^[^\n]* is not a whole Parquet file [^\n]*$"):
        read_rollouts(tmp_path)


ELSEWHERE = dict.fromkeys(
    ["level", "split", "phrasing", "target", "container", "subgoals", "steps", "upload", "download", "motion", "calls", "actions"]
)


def test_a_log_from_elsewhere_may_lack_columns(tmp_path, capsys):
    rows = [row(seed, policy, score=-0.25, **{**ELSEWHERE, "inference": 2.0}) for seed in range(2) for policy in ("small", "large")]
    rows = [replace(item, seed=None) for item in rows]
    write_rollouts(tmp_path, rows, {})
    read, _ = read_rollouts(tmp_path)
    assert read == rows
    with pytest.raises(DataError, match="no episode in simulation: it has no subgoals, steps, upload"):
        _ = read[0].outcome
    print_rollouts(Console(width=160), read, preset("oxe"))
    text = capsys.readouterr().out
    assert "-0.2500" in text and "steps" not in text and "container" not in text


def test_reward_of_logged_rows_by_hand():
    oxe = preset("oxe")
    episode = row()
    bare = row(score=-0.5, inference=2.0, upload=None, download=None, motion=None, subgoals=None, steps=None)
    unknown = replace(bare, inference=None, price=None)
    rows = [episode, replace(episode, error="died"), bare, unknown]
    known = reward(episode.outcome, oxe)
    assert row_rewards(rows, oxe) == pytest.approx([known, np.nan, 1 - 0.2 * np.log10(2.0) - 0.01 * 3.12, np.nan], abs=1e-12, nan_ok=True)
    assert row_rewards([bare], replace(oxe, success="score")) == pytest.approx([-0.5 - 0.2 * np.log10(2.0) - 0.01 * 3.12])
    assert np.isnan(row_rewards([bare], replace(oxe, success="subgoals"))).all()
    assert np.isnan(row_rewards([bare], preset("alfred"))).all()
    assert row_rewards([unknown], RewardWeights(0.0, 0.0, success="score")).tolist() == [-0.5]
    with pytest.raises(UsageError, match="has no score"):
        reward(episode.outcome, replace(oxe, success="score"))


def test_shards_come_back_and_a_torn_one_is_dropped(tmp_path):
    shards = Shards(tmp_path)
    context = np.linspace(-1, 1, 7, dtype=np.float32) / 3
    shards.add(row(5).instance, [row(5), row(5, "large")], "e@1", context)
    shards.add(row(4).instance, [row(4)], "e@1", None)
    shards.close(remove=False)
    file = tmp_path / SHARDS
    file.write_bytes(file.read_bytes() + b'{"seed": 6, "rows": [')
    again = Shards(tmp_path)
    assert again.rows == {row(5).instance: {("small", 0): row(5), ("large", 0): row(5, "large")}, row(4).instance: {("small", 0): row(4)}}
    assert list(again.contexts) == ["e@1"]
    assert list(again.contexts["e@1"]) == [row(5).instance]
    assert np.array_equal(again.contexts["e@1"][row(5).instance], context)
    assert again.contexts["e@1"][row(5).instance].dtype == np.float32
    again.close(remove=True)
    assert not file.exists()


def test_tables_leave_errors_out_of_the_rates(capsys):
    rows = [row(seed, policy) for seed in range(4) for policy in ("small", "large")]
    rows[0] = row(0, "small", error="died")
    print_rollouts(Console(width=160), rows, preset("oxe"))
    text = capsys.readouterr().out
    assert "4 instances, 8 episodes" in text
    assert "33% [6, 79]" in text  # 1 of 3
    assert "50% [15, 85]" in text  # 2 of 4
    assert "held-out" in text


def test_tables_tell_tasks_and_levels_apart_where_there_are_several(capsys):
    rows = [
        replace(row(seed, task=task, level=level), instance=f"{task}/{level}/{seed}")
        for task in ("lift", "door")
        for level in (0, 2)
        for seed in range(3)
    ]
    print_rollouts(Console(width=160), rows, preset("oxe"))
    text = capsys.readouterr().out
    assert "door 2" in text and "task at level" in text
    print_rollouts(Console(width=160), rows[:3], preset("oxe"))
    assert "level" not in capsys.readouterr().out


def test_share_best_counts_complete_instances_only():
    rows = [row(0, "small", price=0.0), row(0, "large"), row(2, "small"), row(2, "large", price=0.0), row(4, "small", error="died"), row(4, "large")]
    assert share_best(rows, ["small", "large"], preset("oxe")) == {"small": 0.5, "large": 0.5}
    assert share_best(rows[4:], ["small", "large"], preset("oxe")) == {}


def test_policies_that_come_to_the_same_share_an_instance_whatever_their_order():
    rows = [row(0, "small", price=0.0), row(0, "large"), row(2, "small"), row(2, "large")]
    for policies in (["small", "large"], ["large", "small"]):
        assert share_best(rows, policies, preset("oxe")) == {"small": 0.75, "large": 0.25}


def test_a_folder_named_like_an_address_is_one(tmp_path, monkeypatch):
    """To Parquet's readers `12:30/rollouts.parquet` would be a file system of the kind `12`."""
    monkeypatch.chdir(tmp_path)
    for name in ("2026-11-28T09:30:00", "s3:x", "-x", "r.zip"):
        folder = Path(name)
        folder.mkdir()
        write_rollouts(folder, [row()], {})
        assert read_rollouts(folder)[0] == [row()]
