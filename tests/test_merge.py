"""Shards of a recording: put together they are the recording of all, and what does not fit together is refused by name."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from run_helpers import command

import osel_sim as osel
from osel_sim.api.record_cluster import SETTINGS, is_for_cluster
from osel_sim.api.record_settings import RecordConfig
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import OselError, SettingError
from osel_sim.core.holding import held
from osel_sim.episodes.merging import PARTS
from osel_sim.episodes.shard import Shard
from osel_sim.formats.rollout_log import read_rollouts, write_rollouts
from osel_sim.formats.shards import Shards
from osel_sim.merge import main as merge_main
from osel_sim.record import main as record_main

FLAGS = ("--instances", 5, "--start-seed", 40, "--level", 0, 2, "--repeats", 2, "--repeat-every", 2, "--policies", "calm", "--workers", 1)


def record(world: Path, *flags: object) -> int:
    return record_main(list(map(str, command(world, "record", *FLAGS, *flags)[3:])))


@pytest.fixture(scope="module")
def recorded(world):
    """The recording of all, and its two shards."""
    assert record(world, "--out", world / "whole") == 0
    shards = [world / "shards" / str(number) for number in (1, 2)]
    for number, folder in enumerate(shards, 1):
        assert record(world, "--shard", f"{number}/2", "--out", folder) == 0
    return world / "whole", shards


@pytest.fixture
def shards(recorded, tmp_path):
    """Copies of the shards, to be harmed."""
    return [Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in recorded[1]]


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("rollouts.parquet", "contexts.npz")}


def change(folder: Path, **configuration: object) -> None:
    """Change what a shard says it was recorded with, in `run.json` and in its log."""
    run = json.loads((folder / "run.json").read_text())
    run["configuration"] |= configuration
    (folder / "run.json").write_text(json.dumps(run))
    rows, metadata = read_rollouts(folder)
    write_rollouts(folder, rows, {key: value for key, value in metadata.items() if key != "schema_version"} | configuration)


@pytest.mark.parametrize("count", [1, 5, 7, 12])
def test_shards_are_neighbours_and_all_there_is(count):
    whole = list(range(12))
    parts = [Shard(number, count).part(whole) for number in range(1, count + 1)]
    assert [item for part in parts for item in part] == whole and max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "1/0", "a/b", "1/2/3", "-1/3", "1.5/3", "\u0661/3", "1 / 3", ""])
def test_a_shard_that_is_none_is_refused(text):
    with pytest.raises(SettingError, match="NUMBER/ALL"):
        Shard.parse(text)


def test_shards_put_together_are_the_recording_of_all(recorded, tmp_path, capsys):
    whole, shards = recorded
    assert [len({row.instance for row in read_rollouts(folder)[0]}) for folder in shards] == [2, 3]
    assert merge_main([*map(str, reversed(shards)), "--out", str(tmp_path / "log")]) == 0
    assert "8 episodes of 2 shards" in (text := capsys.readouterr().out) and "osel_sim.replay" in text
    assert files(tmp_path / "log") == files(whole)
    run, was = (json.loads((folder / "run.json").read_text()) for folder in (tmp_path / "log", whole))
    run["environment"]["git"] = was["environment"]["git"]  # somebody may commit while the tests run
    assert list(run) == list(was) and run["configuration"] == was["configuration"] and run["environment"] == was["environment"]
    assert {name for name in was["settings"] if run["settings"][name] != was["settings"][name]} == {"out"}
    assert sorted(file.name for file in (tmp_path / "log").iterdir()) == ["contexts.npz", "rollouts.parquet", "run.json"]
    assert osel.merge(*shards, out=tmp_path / "log").rows == read_rollouts(whole)[0], "merged once more, it is what it was"


def test_a_shard_goes_on_where_it_was_cut_off(recorded, shards, capsys):
    folder = shards[1]
    rows, metadata = read_rollouts(folder)
    first, encoder = rows[0].instance, metadata["encoder"]
    context = ContextCache(folder).get(encoder, first)
    for name in ("rollouts.parquet", "contexts.npz"):
        (folder / name).unlink()
    there = Shards(folder)
    there.add(first, [row for row in rows if row.instance == first], encoder, context)
    there.close(remove=False)
    with pytest.raises(OselError, match=rf"2, shard 2/2, is not finished: record --resume --out {folder}"):
        osel.merge(*shards, out=folder.parent / "log")
    assert record_main(["--resume", "--out", str(folder), "--shard", "1/2"]) == 2
    assert f"--shard: 1/2, but {folder / 'run.json'} is of 2/2" in capsys.readouterr().err
    world = recorded[0].parent
    assert record_main(["--resume", "--out", str(folder), "--tasks", str(world / "tasks"), "--policies-dir", str(world / "policies")]) == 0
    assert f"osel_sim.merge {folder} OTHER_SHARDS --out LOG" in capsys.readouterr().out
    assert files(folder) == files(recorded[1][1])


def test_a_merge_replaces_an_earlier_one_and_nothing_else(recorded, shards, tmp_path):
    log = tmp_path / "log"
    osel.merge(*shards, out=log)
    rows, metadata = read_rollouts(log)
    more = [row for row in rows if row.repeat == 0]
    kept = {key: value for key, value in metadata.items() if key != "schema_version"}
    write_rollouts(log, more, kept)  # as before repeats were added
    osel.merge(*shards, out=log)
    assert files(log) == files(recorded[0])
    write_rollouts(log, [*rows, *(dataclasses.replace(row, policy="wild") for row in rows)], kept)
    with pytest.raises(OselError, match="holds 8 episodes that the shards do not, such as short/test/0/40, policy wild"):
        osel.merge(*shards, out=log)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    with pytest.raises(OselError, match=r"not empty and holds thesis.txt"):
        osel.merge(*shards, out=tmp_path / "other")
    with pytest.raises(OselError, match="is one of the shards"):
        osel.merge(*shards, out=shards[0])


def test_shards_that_do_not_fit_together_are_refused_by_name(recorded, shards, tmp_path):
    first, second = shards

    def refused(*folders: Path) -> str:
        with pytest.raises(OselError) as caught:
            osel.merge(*folders, out=tmp_path / "log")
        assert not (tmp_path / "log").exists()
        return str(caught.value)

    assert "shard 2/2 of the recording is missing" in refused(first)
    assert f"shard 1/2 is there twice: {first} and {first}" in refused(first, first, second)
    assert "there is no folder" in refused(first, tmp_path / "nowhere")
    assert f"{recorded[0]} is no shard: its run.json says that it holds all instances" in refused(first, recorded[0])
    (tmp_path / "empty").mkdir()
    assert "empty is no shard of a recording" in refused(first, tmp_path / "empty")
    with held(second):
        assert "shard 2/2, is being recorded" in refused(first, second)
    run = (second / "run.json").read_text()
    (second / "run.json").write_text(run.replace('"gl": "', '"gl": "o'))
    assert "GL backend" in refused(first, second)
    (second / "run.json").write_text(run)
    change(second, action_noise=0.5)
    assert f"{second} is not of the recording of {first}: action_noise is 0.5 in it, 0.0 there" in refused(first, second)
    change(second, action_noise=0.0, shard="2/3")
    assert "is not finished" in refused(first, second), "these are not the episodes of that shard"
    change(second, shard="2/2", repeats=None)
    assert "configuration does not have the promised form" in refused(first, second)
    change(second, repeats=2)
    rows, metadata = read_rollouts(second)
    write_rollouts(second, rows[:-1], {key: value for key, value in metadata.items() if key != "schema_version"})
    assert "shard 2/2, is not finished" in refused(first, second)


def test_a_recording_on_a_cluster_goes_on_as_one_until_all_is_put_together(tmp_path):
    (tmp_path / PARTS).mkdir()
    (tmp_path / PARTS / SETTINGS).touch()
    again = RecordConfig.of(out=tmp_path, resume=True)
    assert is_for_cluster(again)
    (tmp_path / "run.json").touch()
    assert is_for_cluster(again), "it was killed while it merged"
    (tmp_path / "rollouts.parquet").touch()
    assert not is_for_cluster(again)


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["--shard", "6/6"], "--shard: 6/6, but there are 5 instances"),
        (["--shard", "0/6"], "--shard: must be NUMBER/ALL"),
        (["--shards", "6"], "--shards: is for a recording on a cluster; add --cluster"),
        (["--shard", "1/2", "--until-decided"], "--shard: does not go with --until-decided"),
        (["--cluster", "local"], "--shards: is missing"),
        (["--cluster", "local", "--shards", "6"], "--shards: 6, but there are 5 instances"),
        (["--cluster", "local", "--shards", "2", "--shard", "1/2"], "--shard: does not go with --cluster"),
        (["--cluster", "slrm", "--shards", "2"], "did you mean 'slurm'?"),
        (["--cluster", "local", "--shards", "2", "--resume"], "--resume: there is no recording on a cluster in"),
        (["--cluster", "local", "--shards", "2", "--level", "17"], "unknown level 17"),
    ],
)
def test_wrong_settings_get_one_line(world, tmp_path, capsys, flags, complaint):
    assert record(world, "--out", tmp_path / "wrong", *flags) == 2
    text = capsys.readouterr().err
    assert complaint in text and text.count("\n") == 1 and not (tmp_path / "wrong").exists()
