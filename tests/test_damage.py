"""Damaged files are told with their names, and never pass for others: bytes flipped, files cut, fields altered."""

import json
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from report_helpers import WEIGHTS, made_run
from synthetic_log import make_row

from osel_sim.analysis.live import is_live_run, read_live
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError, OselError
from osel_sim.episodes.live import LiveOptions, LiveRun
from osel_sim.formats.journal import line_digest
from osel_sim.formats.rollout_log import ROLLOUTS, read_rollouts, write_rollouts
from osel_sim.formats.run_config import check_run_folder
from osel_sim.formats.shards import SHARDS, Shards

FREE = ("instruction", "phrasing", "target", "container", "propensities", "subgoals", "steps", "seconds", "calls", "actions", "fallback", "error")
"""Fields of a decision of which no rule knows the only right value."""


def damaged(raw: bytes, count: int) -> Iterator[bytes]:
    """Copies of a file with a bit flipped, a byte replaced, or cut off."""
    chance = random.Random(0)
    for _ in range(count):
        place = chance.randrange(len(raw))
        yield raw[:place] + bytes([raw[place] ^ 1 << chance.randrange(8)]) + raw[place + 1 :]
        yield raw[:place] + bytes([chance.choice(b'\n\r\x000{"\xff')]) + raw[place + 1 :]
        yield raw[:place]


def told(file: Path, read: Callable[[], object]) -> object | None:
    """What is read, or None where the error names the file. Any other exception is a failure."""
    try:
        return read()
    except DataError as error:
        assert str(file) in str(error) and "\n" not in str(error)
        return None


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_run(tmp_path_factory.mktemp("live") / "run", 6)


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "run"))


def test_a_damaged_journal_is_told_or_reads_as_before(copy: Path) -> None:
    file = copy / "episodes.jsonl"
    raw, before = file.read_bytes(), read_live(copy).decisions
    refused = 0
    for content in damaged(raw, 200):
        file.write_bytes(content)
        found = told(copy, lambda: read_live(copy).decisions)
        refused += found is None
        for was, now in zip(before, found or (), strict=False):
            alike = [name for name in asdict(was) if name not in (*FREE, "reward")]
            assert [getattr(was, name) for name in alike] == [getattr(now, name) for name in alike]
            assert now.reward == pytest.approx(was.reward, abs=1e-8)
    assert refused > 300


def test_a_damaged_line_about_the_other_policies_is_told_or_reads_as_before(copy: Path) -> None:
    file = copy / "counterfactual.jsonl"
    raw, before = file.read_bytes(), read_live(copy).outcomes
    for content in damaged(raw, 100):
        file.write_bytes(content)
        found = told(copy, lambda: read_live(copy).outcomes)
        if found is not None:
            assert np.array_equal(found.success, before.success, equal_nan=True) and np.array_equal(found.price, before.price, equal_nan=True)


def test_damaged_contexts_are_told_or_read_as_before(tmp_path: Path) -> None:
    cache = ContextCache(tmp_path, autosave=0)
    values = np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)
    for number, value in enumerate(values):
        cache.put("e@1", f"t/test/0/{number}", value)
    cache.save()
    raw = cache.file.read_bytes()
    for content in damaged(raw, 300):
        cache.file.write_bytes(content)
        found = told(cache.file, lambda: ContextCache(tmp_path).table("e@1", [f"t/test/0/{number}" for number in range(5)]))
        assert found is None or np.array_equal(found, values)


def test_a_damaged_log_is_told_or_reads_as_before(tmp_path: Path) -> None:
    chance = random.Random(1)
    about = [{"task": "t", "seed": number, "instruction": f"do {number}"} for number in range(20)]
    rows = [
        make_row(f"t/test/0/{number}", policy, price=9 * chance.random(), motion=chance.random(), **about[number])
        for number in range(20)
        for policy in ("small", "large")
    ]
    file = write_rollouts(tmp_path, rows, {"encoder": "e@1", "policies": ["small", "large"], "content": {"task t": "0123"}})
    raw, (_, metadata) = file.read_bytes(), read_rollouts(tmp_path)
    for content in damaged(raw, 300):
        file.write_bytes(content)
        found = told(file, lambda: read_rollouts(tmp_path))
        assert found is None or (found[0] == rows and metadata.items() <= found[1].items())


def test_a_log_without_checksums_is_read(tmp_path: Path) -> None:
    rows = [make_row("i", "a"), make_row("i", "b")]
    file = write_rollouts(tmp_path, rows, {"encoder": "e@1"})
    table = pyarrow.parquet.read_table(file)
    kept = {key: value for key, value in table.schema.metadata.items() if b"checksum" not in key}
    pyarrow.parquet.write_table(table.replace_schema_metadata(kept), file)
    assert read_rollouts(tmp_path) == (rows, {"encoder": "e@1", "schema_version": 2})


@pytest.mark.parametrize("log", ["pick_place", "suite"])
def test_shipped_logs_are_read(log: str) -> None:
    folder = Path(__file__).parents[1] / "assets" / "logs" / log
    assert len(read_rollouts(folder)[0]) > 1000


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seed": True}, "seed must be an integer of 0 or more"),
        ({"seed": 5}, "seed must be 1"),
        ({"seed": -1}, "seed must be an integer"),
        ({"level": "0"}, "level must be an integer"),
        ({"split": "train"}, "no context"),
        ({"task": ""}, "task must be text that is not empty"),
        ({"success": 1}, "success must be true or false"),
        ({"success": None}, "success must be true or false"),
        ({"subgoals": 1.5}, r"subgoals must be a number in \[0, 1\]"),
        ({"steps": 40.0}, "steps must be an integer"),
        ({"steps": 10**30}, "steps must be an integer"),
        ({"price": -1.0}, "price must be a finite number of 0 or more"),
        ({"price": "4"}, "price must be"),
        ({"price": 4.125}, "its outcome comes to"),
        ({"reward": 0.123}, "reward is 0.123, its outcome comes to"),
        ({"reward": None}, "reward must be a number"),
        ({"error": "died"}, "reward must be null beside an error"),
        ({"error": 5}, "error must be text or null"),
        ({"propensities": {"near": 0.5, "far": 0.4}}, "propensities must be probabilities"),
        ({"propensities": {}}, "propensities must be probabilities"),
        ({"policy": "nobody"}, "'nobody' is no policy of the run"),
        ({"seconds": {"upload": 0.0}}, "seconds must be an object of upload, inference"),
        ({"seconds": {"upload": 0.0, "inference": 0.0, "download": 0.0, "motion": -1.0}}, "seconds must be an object"),
        ({"index": 4}, "index must be 1, got 4"),
        ({"extra": 1}, "has an unknown field 'extra'"),
        ({"robot": ""}, "robot must be"),
        ({"robot": "UR5e"}, "no context"),
    ],
)
def test_a_decision_is_read_as_strictly_as_it_is_written(copy: Path, changes: dict, says: str) -> None:
    file = copy / "episodes.jsonl"
    lines = file.read_text().splitlines()
    lines[1] = json.dumps(json.loads(lines[1]) | changes)
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=says) as error:
        read_live(copy)
    assert f"{file}, line 2" in str(error.value) or says == "no context"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('{"index": 1, "index": 1}', "a key is there twice"),
        ('{"price": NaN}', "NaN is no number of JSON"),
        ('{"price": 1e999}', "not a decision"),
        ('{"a": "\udcff"}', "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("", "not JSON"),
        ("\r", "not JSON"),
    ],
)
def test_a_line_that_is_none_is_told(copy: Path, line: str, says: str) -> None:
    file = copy / "episodes.jsonl"
    lines = file.read_text().splitlines()
    lines[1] = line
    file.write_bytes(("\n".join(lines) + "\n").encode(errors="surrogateescape"))
    with pytest.raises(DataError, match=f"line 2: .*{says}"):
        read_live(copy)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda data: data | {"index": 0}, "line 2: index must be 1, got 0"),
        (lambda data: data | {"policies": {}}, "line 2: not outcomes of policies"),
        (lambda data: {"index": data["index"]}, "line 2: not outcomes of policies"),
        (lambda data: data | {"policies": {name: own | {"reward": 7.0} for name, own in data["policies"].items()}}, "line 2: .*: reward is 7.0"),
        (lambda data: data | {"policies": {name: own | {"calls": None} for name, own in data["policies"].items()}}, "calls must be an integer"),
    ],
)
def test_a_line_about_the_others_is_read_as_strictly(copy: Path, change: Callable[[dict], dict], says: str) -> None:
    file = copy / "counterfactual.jsonl"
    lines = file.read_text().splitlines()
    lines[1] = json.dumps(change(json.loads(lines[1])))
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=says) as error:
        read_live(copy)
    assert str(file) in str(error.value)


@pytest.mark.parametrize("keep", [0, 1, 3])
def test_a_journal_that_lost_decisions_is_refused(copy: Path, keep: int) -> None:
    file = copy / "episodes.jsonl"
    whole = file.read_bytes()
    file.write_bytes(b"".join(whole.splitlines(keepends=True)[:keep]))
    with pytest.raises(DataError, match=f"counterfactual.jsonl has 6 lines, episodes.jsonl beside it {keep}"):
        read_live(copy)
    file.unlink()
    assert is_live_run(copy)
    with pytest.raises(DataError, match=r"episodes\.jsonl does not exist"):
        read_live(copy)
    file.write_bytes(whole)
    (copy / "counterfactual.jsonl").write_bytes(b"".join((copy / "counterfactual.jsonl").read_bytes().splitlines(keepends=True)[:keep]))
    with pytest.raises(DataError, match=f"counterfactual.jsonl: line {keep + 1} is missing"):
        read_live(copy)


@pytest.mark.parametrize("keep", [0])
@pytest.mark.parametrize("beside", ["counterfactual.jsonl", "timing.jsonl", "summary.json"])
def test_going_on_with_a_journal_that_lost_decisions_overwrites_nothing(copy: Path, keep: int, beside: str) -> None:
    lines = (copy / "episodes.jsonl").read_bytes().splitlines(keepends=True)
    (copy / "episodes.jsonl").write_bytes(b"".join(lines[:keep]))
    if beside != "counterfactual.jsonl":
        (copy / "counterfactual.jsonl").unlink()
        (copy / beside).write_text('{"index": 0}\n' * 6 if beside == "timing.jsonl" else '{"decisions": 6}')
    before = {file.name: file.read_bytes() for file in copy.iterdir()}
    options = LiveOptions(0, WEIGHTS, counterfactual=beside == "counterfactual.jsonl")
    with pytest.raises(DataError, match=f"{beside}.*the journal lost decisions; put it back"):
        LiveRun(copy, (), None, None, None, options)
    assert {file.name: file.read_bytes() for file in copy.iterdir()} == before


@pytest.mark.parametrize("name", ["episodes.jsonl", "counterfactual.jsonl"])
def test_a_line_that_is_not_what_was_written_is_told_however_plausible(copy: Path, name: str) -> None:
    """Steps, texts and low digits are as good as any; their checksums lie in timing.jsonl, of which nothing else is asked."""
    names = ("episodes.jsonl", "counterfactual.jsonl")
    rows = {key: [json.loads(line) for line in (copy / key).read_text().splitlines()] for key in names}
    checksums = [{key: line_digest(rows[key][at]) for key in names} for at in range(6)]
    (copy / "timing.jsonl").write_text("".join(json.dumps({"index": at, "checksums": own}) + "\n" for at, own in enumerate(checksums)))
    assert len(read_live(copy).decisions) == 6
    file = copy / name
    whole = file.read_text()
    lines = whole.splitlines(keepends=True)
    lines[2] = lines[2].replace('"steps": 40', '"steps": 41', 1)
    assert "".join(lines) != whole
    file.write_text("".join(lines))
    with pytest.raises(DataError, match=rf"{name}, line 3: is not what was written \(timing\.jsonl has its checksum\)"):
        read_live(copy)
    with pytest.raises(DataError, match="line 3: is not what was written"):
        LiveRun(copy, (), None, None, None, LiveOptions(0, WEIGHTS, counterfactual=True))
    (copy / "timing.jsonl").write_bytes(b"\xff{\n" + b'{"index": "x"}\n' * 3)
    assert len(read_live(copy).decisions) == 6  # nobody knows then


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"schema_version": 2}, "schema_version must be 1, got 2"),
        ({"schema_version": True}, "schema_version must be 1, got True"),
        ({"schema_version": None}, "schema_version must be 1, got None"),
        ({"configuration": []}, "configuration must be an object"),
        ({"environment": "x"}, "environment must be an object"),
        ({"environment": {"versions": 5}}, r"environment\.versions must be an object of texts"),
        ({"configuration": {"content": [{}]}}, r"configuration\.content must be an object of texts"),
    ],
)
def test_a_run_of_another_form_is_refused(copy: Path, changes: dict, says: str) -> None:
    file = copy / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(DataError, match=says):
        read_live(copy)
    with pytest.raises(DataError, match=says):
        check_run_folder(copy, {}, resume=True)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"reward": {"alpha_time": "0.2"}}, r"configuration\.reward: alpha_time must be a finite number"),
        ({"reward": 5}, r"configuration\.reward must be an object"),
        ({"reward": {"alpha_time": 0.2, "alpha_price": 0.0, "time_unit": "hours", "success": "success"}}, "unknown time unit 'hours'"),
        ({"reward": {"alpha_time": 0.2, "alpha_price": 0.0, "time_unit": "steps", "success": "success"}}, "line 1: reward is"),
        ({"policies": ["near", "near"]}, r"configuration\.policies must name"),
        ({"policies": [{}]}, r"configuration\.policies must name"),
        ({"encoder": 5}, r"configuration\.encoder must be"),
        ({"seed": 1}, "line 1: seed must be 1000000"),
        ({"tasks": ["other"]}, "line 1: task must be one of the run's"),
        ({"split": "train"}, "line 1: split must be the run's, 'train'"),
        ({"counterfactual": True}, None),
    ],
)
def test_a_configuration_of_another_form_is_refused(copy: Path, changes: dict, says: str | None) -> None:
    file = copy / "run.json"
    data = json.loads(file.read_text())
    file.write_text(json.dumps(data | {"configuration": data["configuration"] | changes}))
    if says is None:
        read_live(copy)
        (copy / "counterfactual.jsonl").unlink()
        says = r"counterfactual\.jsonl: line 1 is missing"
    with pytest.raises(DataError, match=says):
        read_live(copy)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seed": 8}, "instance must be 't/test/0/8'"),
        ({"level": 1}, "instance must be 't/test/1/7'"),
        ({"robot": "UR5e"}, "instance must be 't/test/0/7-UR5e'"),
        ({"axes": "camera=2"}, "instance must be 't/test/camera=2/7'"),
        ({"price": float("inf")}, "must be a finite number of 0 or more"),
        ({"steps": -1}, "must be an integer of 0 or more"),
        ({"subgoals": 2.0}, "must be a number in"),
        ({"score": float("nan")}, "must be a finite number"),
    ],
)
def test_a_row_is_read_as_strictly_as_it_is_written(tmp_path: Path, changes: dict, says: str) -> None:
    good = {"task": "t", "seed": 7}
    write_rollouts(tmp_path, [make_row("t/test/0/7", "a", **good), make_row("t/test/0/7", "b", **good)], {})
    assert len(read_rollouts(tmp_path)[0]) == 2
    write_rollouts(tmp_path, [make_row("t/test/0/7", "a", **good | changes)], {})
    with pytest.raises(DataError, match=rf"{ROLLOUTS}: .*row 1: {says}"):
        read_rollouts(tmp_path)


def test_rows_of_an_instance_say_the_same_of_it(tmp_path: Path) -> None:
    write_rollouts(tmp_path, [make_row("i", "a"), make_row("i", "b", instruction="something else")], {})
    with pytest.raises(DataError, match="row 2: instance 'i': its instruction is 'something else', in an earlier row it is 'do it'"):
        read_rollouts(tmp_path)


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"e|contexts": np.full((1, 2), np.nan, np.float32)}, "context of i is not all finite"),
        ({"e|contexts": np.ones((1, 0), np.float32)}, "context of every instance is not all finite"),
        ({"e|instances": np.array(["i", "i"]), "e|contexts": np.ones((2, 2), np.float32)}, "an instance has two contexts"),
        ({"f|contexts": np.ones((1, 2), np.float32)}, "each encoder has instances and contexts"),
        ({"stray": np.ones(1)}, "each encoder has instances and contexts"),
    ],
)
def test_contexts_are_read_as_strictly_as_they_are_written(tmp_path: Path, arrays: dict, says: str) -> None:
    np.savez(tmp_path / "contexts.npz", **{"e|instances": np.array(["i"]), "e|contexts": np.ones((1, 2), np.float32)} | arrays)
    with pytest.raises(DataError, match=says) as error:
        ContextCache(tmp_path)
    assert str(tmp_path / "contexts.npz") in str(error.value)


@pytest.mark.parametrize(
    "changes",
    [{"instance": "other"}, {"rows": [5]}, {"rows": [{}]}, {"encoder": None}, {"context": "!"}, {"context": "AADAfw=="}, {"context": ""}],
)
def test_a_recorded_instance_is_read_as_strictly_as_it_is_written(tmp_path: Path, changes: dict) -> None:
    shards = Shards(tmp_path)
    shards.add("t/test/0/7", [make_row("t/test/0/7", "a", task="t", seed=7)], "e@1", np.ones(2, np.float32))
    shards.close(remove=False)
    file = tmp_path / SHARDS
    Shards(tmp_path).close(remove=False)
    file.write_text(json.dumps(json.loads(file.read_text()) | changes) + "\n")
    with pytest.raises(OselError, match=r"shards\.jsonl, line 1: "):
        Shards(tmp_path)
