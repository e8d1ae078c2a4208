"""Outcome tables of others as rollout logs: the paper's workloads in small, and what is wrong with a table in one line."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from PIL import Image

from osel_sim.analysis.log import read_log
from osel_sim.context.cache import ContextCache
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.ingest import main as ingest_main
from osel_sim.selection.reward import RewardWeights, preset

SUBJECTS = {"anatomy": "Which bone is part of the hand?", "astronomy": "Which planet is nearest to the sun?"}
MAPPING = """
version = 1
name = "quiz"

[table]
files = ["quiz_{subject}.csv"]

[instance]
text = "prompt"
group = "subject"

[outcome]
success = "{policy}"

[policies.small]
seconds = 0.25
price = 0

[policies."big/model-1"]
name = "big"
seconds = 1.5
price = [{ column = "prompt", count = "characters", scale = 0.01 }, 0.5]
"""


def quiz(folder: Path) -> Path:
    """A table like MMLU's: a file a subject, a column a model."""
    folder.mkdir(exist_ok=True)
    for subject, question in SUBJECTS.items():
        lines = [f'"{question} No. {number},\nsay ""A"" or B",{number % 2 == 0},{"" if number == 3 else number < 4}' for number in range(5)]
        (folder / f"quiz_{subject}.csv").write_text("prompt,small,big/model-1\n" + "\n".join(lines) + "\n")
    (folder / "quiz.toml").write_text(MAPPING)
    return folder


def run(*arguments: object) -> int:
    return ingest_main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture[str], out: Path, *arguments: object) -> str:
    """The one line that a refused command says; it leaves nothing behind."""
    there = out.exists()
    try:
        code = run(*arguments, "--out", out)
    except SystemExit as left:
        code = int(str(left.code))
    error = capsys.readouterr().err
    assert code == 2, error
    assert error.startswith("error: ") and error.count("\n") == 1
    assert out.exists() == there
    return error


def test_text_from_a_mapping_file(tmp_path, capsys):
    out = tmp_path / "log"
    assert run("--map", quiz(tmp_path) / "quiz.toml", "--out", out) == 0
    rows, metadata = read_rollouts(out)
    assert len(rows) == 18  # the empty cell is no row
    first, second = rows[:2]
    text = 'Which bone is part of the hand? No. 0,\nsay "A" or B'
    assert (first.task, first.instance, first.instruction, first.policy, first.success) == ("anatomy", "anatomy/000001", text, "small", True)
    assert (first.inference, first.upload, first.motion, first.price) == (0.25, 0.0, None, 0.0)
    assert (first.steps, first.subgoals, first.score, first.seed, first.error) == (None, None, None, None, None)
    assert second.policy == "big"
    assert second.price == pytest.approx(0.01 * len(text) + 0.5)
    assert [row.instance for row in rows if row.policy == "small"].count("anatomy/000004") == 1
    assert metadata["policies"] == ["small", "big"]
    assert metadata["task"] == "quiz"
    contexts = ContextCache(out).table(metadata["encoder"], [row.instance for row in rows])
    assert np.allclose(np.linalg.norm(contexts, axis=1), 1.0, atol=1e-5)
    rewards = read_log(out).mean_rewards(preset("mmlu"))
    assert rewards.shape == (10, 2) and np.isnan(rewards).sum() == 2
    assert rewards[0, 0] == pytest.approx(1 - 0.03 * np.log10(0.25))
    text = capsys.readouterr().out
    assert "10 rows: 10 instances, 2 policies, 18 outcomes" in text
    assert "astronomy" in text and "best on" in text


def test_the_command_line_says_the_same(tmp_path):
    quiz(tmp_path)
    assert run("--map", tmp_path / "quiz.toml", "--out", tmp_path / "a") == 0
    flags = ["--files", tmp_path / "quiz_{subject}.csv", "--text", "prompt", "--group", "subject", "--policies", "small", "big/model-1"]
    assert run(*flags, "--success", "{policy}", "--seconds", "small=0.25", "big/model-1=1.5", "--out", tmp_path / "b") == 0
    a, b = (read_rollouts(tmp_path / name)[0] for name in ("a", "b"))
    assert [(row.instance, row.success, row.inference) for row in a] == [(row.instance, row.success, row.inference) for row in b]
    assert b[0].price is None


def test_equal_tables_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        assert run("--map", quiz(tmp_path / name) / "quiz.toml", "--out", tmp_path / name / "log") == 0
    for file in ("rollouts.parquet", "contexts.npz", "ingest.json"):
        assert (tmp_path / "a" / "log" / file).read_bytes() == (tmp_path / "b" / "log" / file).read_bytes()


def test_images_and_text_in_a_long_table(tmp_path, capsys):
    generator = np.random.default_rng(0)
    (tmp_path / "frames").mkdir()
    for frame in range(3):
        Image.fromarray(generator.integers(0, 255, (20, 30, 3), dtype=np.uint8)).save(tmp_path / "frames" / f"{frame}.png")
    columns = {"frame": [], "path": [], "object": [], "model": [], "right": [], "ms": []}
    for frame in range(3):
        for index, model in enumerate(("llava-7b", "llava-13b")):
            row = (frame, f"frames/{frame}.png", ("truck", "sign", "pole")[frame], model, (frame + index) % 2, 1000 + index)
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value)
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "answers.parquet")
    (tmp_path / "waymo.toml").write_text("""
version = 1
name = "waymo"
[table]
files = ["answers.parquet"]
[instance]
text = "Is there a {object} in the picture?"
images = "path"
key = "frame"
target = "object"
[outcome]
policy = "model"
success = "right"
inference = { column = "ms", scale = 0.001 }
""")
    assert run("--map", tmp_path / "waymo.toml", "--preset", "waymo", "--out", tmp_path / "log") == 0
    rows, metadata = read_rollouts(tmp_path / "log")
    assert [(row.instance, row.policy, row.success, row.target) for row in rows[:2]] == [
        ("waymo/0", "llava-7b", False, "truck"),
        ("waymo/0", "llava-13b", True, "truck"),
    ]
    assert rows[1].instruction == "Is there a truck in the picture?"
    assert rows[1].inference == pytest.approx(1.001)
    assert metadata["encoder"].startswith("osel_small@") and "#images+tfidf@" in metadata["encoder"]
    assert len(ContextCache(tmp_path / "log").get(metadata["encoder"], "waymo/0")) > 3

    capsys.readouterr()
    whole = (tmp_path / "frames" / "2.png").read_bytes()
    (tmp_path / "frames" / "2.png").write_bytes(whole[: len(whole) // 2])
    line = refused(capsys, tmp_path / "cut", "--map", tmp_path / "waymo.toml")
    assert "answers.parquet, row 5: image" in line and "2.png cannot be read" in line
    (tmp_path / "frames" / "2.png").unlink()
    assert "No such file" in refused(capsys, tmp_path / "gone", "--map", tmp_path / "waymo.toml")


def test_subgoals_and_steps_with_repeats(tmp_path):
    episodes = [
        {"id": f"t{task}", "model": model, "trial": trial, "solved": done == 3, "done": done, "all": 3, "steps": 100 * task + trial, "crash": crash}
        for task in (1, 2)
        for model in ("hitut", "film")
        for trial, done, crash in ((0, task, None), (1, 3, "simulator died" if model == "film" else None))
    ]
    (tmp_path / "episodes.jsonl").write_text("".join(json.dumps(episode) + "\n" for episode in reversed(episodes)))
    (tmp_path / "tasks.csv").write_text("id,words,kind\nt1,heat the apple,heat\nt2,cool the egg,cool\n")
    (tmp_path / "alfred.toml").write_text("""
version = 1
name = "alfred"
[table]
files = ["episodes.jsonl"]
[[join]]
files = ["tasks.csv"]
on = "id"
[instance]
text = "words"
group = "kind"
key = "id"
[outcome]
policy = "model"
repeat = "trial"
success = "solved"
subgoals = { column = "done", divide = "all" }
steps = "steps"
error = "crash"
[policies.hitut]
price = 0
[policies.film]
price = 2
""")
    assert run("--map", tmp_path / "alfred.toml", "--preset", "alfred", "--out", tmp_path / "log") == 0
    (tmp_path / "new").mkdir()
    (tmp_path / "episodes.jsonl").rename(tmp_path / "new" / "episodes.jsonl")
    moved = ["--map", tmp_path / "alfred.toml", "--files", tmp_path / "new" / "*.jsonl"]  # the joined table stays where it was
    assert run(*moved, "--preset", "alfred", "--out", tmp_path / "log") == 0
    rows, _ = read_rollouts(tmp_path / "log")
    found = {(row.instance, row.policy, row.repeat): row for row in rows}
    assert [(row.policy, row.repeat) for row in rows[:4]] == [("hitut", 0), ("hitut", 1), ("film", 0), ("film", 1)]
    assert found["heat/t1", "hitut", 0].subgoals == pytest.approx(1 / 3)
    assert found["heat/t1", "hitut", 1].success
    assert (found["cool/t2", "film", 0].steps, found["cool/t2", "film", 0].price) == (200, 2.0)
    log = read_log(tmp_path / "log")
    place = log.keys.index("heat/t1"), log.policies.index("film"), 0
    assert log.rewards(preset("alfred"))[place] == pytest.approx(1 / 3 - 0.05 * np.log10(100) - 0.005 * 2)
    assert (found["cool/t2", "film", 1].error, found["cool/t2", "film", 1].success) == ("simulator died", False)


def test_a_score_with_a_threshold_keeps_both(tmp_path):
    (tmp_path / "t.csv").write_text("q,m\nwhat,-0.2\nwhere,-0.02\n")
    flags = ["--files", tmp_path / "t.csv", "--text", "q", "--policies", "m", "--success", "m", "--at-least", "-0.1", "--score", "m"]
    assert run(*flags, "--out", tmp_path / "log") == 0
    assert read_log(tmp_path / "log").rewards(RewardWeights(0.0, 0.0, success="score")).ravel().tolist() == [-0.2, -0.02]
    assert [(row.success, row.score) for row in read_rollouts(tmp_path / "log")[0]] == [(False, -0.2), (True, -0.02)]


def test_a_folder_a_model_and_a_file_a_subject(tmp_path):
    for model in ("big", "small"):
        for subject in ("sun", "moon"):
            (tmp_path / model).mkdir(exist_ok=True)
            (tmp_path / model / f"{subject}.csv").write_text(f"q,right\nwhere is the {subject},{int(model == 'big')}\n")
    flags = ["--files", tmp_path / "{model}" / "{topic}.csv", "--text", "q", "--group", "topic", "--policy-column", "model", "--success", "right"]
    assert run(*flags, "--out", tmp_path / "log") == 0
    rows = read_rollouts(tmp_path / "log")[0]
    assert [(row.task, row.policy, row.success) for row in rows] == [
        ("moon", "big", True),
        ("moon", "small", False),
        ("sun", "big", True),
        ("sun", "small", False),
    ]


LONG = ["--text", "q", "--policy-column", "m", "--success", "s"]
WIDE = ["--text", "q", "--policies", "a", "--success", "a"]


@pytest.mark.parametrize(
    ("content", "flags", "says"),
    [
        ("", WIDE, "t.csv: is empty, expected a header"),
        ("q,a\n", WIDE, "t.csv: has no rows"),
        ("q,aa\nx,1\n", WIDE, "there is no column 'a', which --success of policy 'a' names: did you mean 'aa'? columns: q, aa"),
        ("q,a,a\nx,1,1\n", WIDE, "line 1: column 'a' is there twice"),
        ("q,a\nx,1\ny\n", WIDE, "row 2 (line 3): has 1 fields, the header has 2; the file was cut, or a quote is missing"),
        ('q,a\nx,1\n"y', WIDE, "the row that begins at line 3 cannot be read (unexpected end of data); the file was cut, a quote is wrong"),
        ("q,a\nx,1\nx,0\n", WIDE, "row 2 (line 3): instance 'log/000001' is in row 1 of"),
        ("q,a\nx,1\ny,nan\n", WIDE, "row 2 (line 3), column 'a': is NaN; leave it empty where the policy did not run"),
        ("q,a\nx,1\ny,0.5\n", WIDE, "column 'a': must be true or false (or 1 or 0), got '0.5'; a graded outcome is a score"),
        ("q,a\nx,1\ny,maybe\n", WIDE, "must be true or false (or 1 or 0), got 'maybe'; a mapping file (--map) says which words mean it: success = {"),
        ("q,a\nx,1\ny,2\n", WIDE, "got '2'; a graded outcome is a score, and its success a threshold: --success COLUMN --at-least X; leave it empty"),
        ("q,a\nx,\n", WIDE, "policy 'a' has no outcome in any row"),
        ("q,a\n,1\n", WIDE, "row 1 (line 2), column 'q': is empty, expected text"),
        ("q,a,p\nx,1,2\ny,0,much\n", [*WIDE, "--price", "p"], "row 2 (line 3), column 'p': must be a number, got 'much'"),
        ("q,a,p\nx,1,nan\n", [*WIDE, "--price", "p"], "column 'p': must be a finite number, got nan"),
        ("q,a,p\nx,1,\n", [*WIDE, "--price", "p"], "column 'p': is empty although the policy has an outcome"),
        ("q,a,p\nx,1,-2\n", [*WIDE, "--price", "p"], "column 'p': price must lie in [0, inf], got -2"),
        ("q,a,p\nx,1,1.5\n", [*WIDE, "--subgoals", "p"], "column 'p': subgoals must lie in [0, 1], got 1.5"),
        ("q,a,p\nx,1,1.5\n", [*WIDE, "--steps", "p"], "column 'p': steps must be an integer, got 1.5"),
        ("q,m,s\nx,a,1\nx,a,1\n", LONG, "instance 'log/000001', policy 'a', repeat 0 is in row 1 of"),
        ("q,m,s\nx,smal,1\n", [*LONG, "--policies", "small"], "column 'm': unknown policy 'smal': did you mean 'small'? known: small"),
        ("q,m,s,r\nx,a,1,first\n", [*LONG, "--repeat-column", "r"], "column 'r': must be a number, got 'first'"),
        ("q,m,s,k\nx,a,1,7\ny,b,1,7\n", [*LONG, "--key", "k"], "row 2 (line 3): instance 'log/7' has another text or image here than in row 1"),
        (b"q,a\n\xff\xfe,1\n", WIDE, "t.csv: is not UTF-8 text"),
        ("q,a,p\nx,1,1_000\n", [*WIDE, "--price", "p"], "column 'p': must be a number, got '1_000'"),
        ("q,a,p\nx,1,'1,000'\n".replace("'", '"'), [*WIDE, "--price", "p"], "column 'p': must be a number, got '1,000'"),
        ("q,a\nx,1\n", [*WIDE, "--price", "1_000"], "there is no column '1_000', which --price of policy 'a' names"),
        ("q,a\nx,1\n", [*WIDE, "--seconds", "-1"], "policy 'a': seconds must lie in [0, inf], got -1"),
        ("q,a,p\nx,1,-1\n", [*WIDE, "--seconds", "p"], "column 'p': seconds must lie in [0, inf], got -1"),
        ("q,a\nx,1\nx,0\n", WIDE, "--duplicates drop or repeats"),
        ("q;a\nx;1\n", WIDE, "columns: q;a; it seems to be separated by ';', but a .csv is by ',' and a .tsv by '\\t': write it with one of these"),
        ("q\ta\nx\t1\n", WIDE, "it seems to be separated by '\\t', but a .csv is by ',' and a .tsv by '\\t': name it .tsv"),
        ("q;a\nx;0,5\n", WIDE, "has 2 fields, the header has 1; the file was cut, or a quote is missing; it seems to be separated by ';'"),
        ("q,m,s\nx,large,1\nx,large ,1\n", LONG, "row 2 (line 3), column 'm': policy 'large ' and 'large' differ only in capitals or spaces"),
        (
            "q,m,s\nx,large,1\nx,Large,1\n",
            LONG,
            "policy 'Large' and 'large' differ only in capitals or spaces; write both alike, or name",
        ),
    ],
)
def test_a_bad_table_gets_one_line(content, flags, says, tmp_path, capsys):
    file = tmp_path / "t.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    line = refused(capsys, tmp_path / "log", "--files", file, *flags)
    assert says in line and "t.csv" in line


TWO = ["--text", "q", "--policies", "a", "b"]


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (
            [*TWO, "--success", "a"],
            "--success: is 'a' for each of a, b; let {policy} in it stand for the policy's name, or",
        ),
        ([*TWO, "--success", "a", "--at-least", "1"], "--success: is {'column': 'a', 'at_least': 1.0} for each of a, b"),
        ([*TWO, "--success", "{policy}", "--score", "p"], "--score: is 'p' for each of a, b"),
        ([*TWO, "--success", "a=a", "b=b", "--price", "a=1"], "--price of policy 'b': is missing, policy 'a' has it"),
        ([*TWO, "--success", "{policy}", "--seconds", "a=1"], "--seconds of policy 'b': is missing, policy 'a' has it"),
        ([*TWO, "--success", "a=a"], "--success of policy 'b': is missing; --success COLUMN --at-least X takes a score"),
        ([*TWO, "--success", "{policy}", "--price", "1e99"], "--price: must lie in"),
        ([*TWO, "--success", "{policy}", "--at-least", "1e99"], "--at-least: must lie in"),
        ([*TWO, "--success", "{policy}", "--group", "g"], "there is no column 'g', which --group names: columns: q, a, b, p"),
        (["--text", "q", "--policy-column", "m", "--success", "a"], "there is no column 'm', which --policy-column names"),
        (["--text", "q", "--policy-column", "q", "--success", "s"], "there is no column 's', which --success names"),
        (["--text", "q", "--policy-column", "q", "--success", "a", "--duplicates", "keep"], "--duplicates: must be"),
        ([*TWO, "--success", "{policy}", "--text", "is {q"], "--text: 'is {q' has a brace too many or too few; {COLUMN} stands for a column's text"),
        ([*TWO, "--success", "{policy}", "--text", "{{q}}"], "--text: '{{q}}' has a brace too many or too few"),
    ],
)
def test_wrong_flags_are_named(flags, says, tmp_path, capsys):
    (tmp_path / "t.csv").write_text("q,a,b,p\nx,1,0,1\n")
    assert says in refused(capsys, tmp_path / "log", "--files", tmp_path / "t.csv", *flags)


def test_policies_may_share_what_they_are_given_each(tmp_path):
    (tmp_path / "t.csv").write_text("q,a,p\nx,1,2\ny,0,3\n")
    flags = [*TWO, "--success", "a=a", "b=a", "--price", "p", "--subgoals", "1"]  # the same model at two prices, or the same price
    assert run("--files", tmp_path / "t.csv", *flags, "--out", tmp_path / "log") == 0
    rows = read_rollouts(tmp_path / "log")[0]
    assert [(row.policy, row.success, row.price) for row in rows] == [("a", True, 2), ("b", True, 2), ("a", False, 3), ("b", False, 3)]


def test_policies_that_look_alike_may_be_named(tmp_path):
    (tmp_path / "t.csv").write_text("q,m,s\nwhere is it,large,1\nwhere is it,Large,0\n")
    assert run("--files", tmp_path / "t.csv", *LONG, "--policies", "large", "Large", "--out", tmp_path / "log") == 0
    assert [(row.policy, row.success) for row in read_rollouts(tmp_path / "log")[0]] == [("large", True), ("Large", False)]


def test_bytes_are_text(tmp_path, capsys):
    columns = {"q": [b"wo?", "wer \u00e4h?".encode()], "a": [b"true", b"0"], "p": [b"1", b"2"], "image": [b"\x89PNG", b"\xff"]}
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "t.parquet")
    assert run("--files", tmp_path / "t.parquet", *WIDE, "--price", "p", "--out", tmp_path / "log") == 0
    rows = read_rollouts(tmp_path / "log")[0]
    assert [(row.instruction, row.success, row.price) for row in rows] == [("wo?", True, 1.0), ("wer \u00e4h?", False, 2.0)]
    capsys.readouterr()
    line = refused(capsys, tmp_path / "other", "--files", tmp_path / "t.parquet", *WIDE, "--group", "image")
    assert "row 1, column 'image': must be text, got 4 bytes that are not UTF-8" in line


def test_unknown_rewards_are_dashes(tmp_path, capsys):
    (tmp_path / "t.csv").write_text("q,a,b\nwhere is it,1,0\n")
    assert run("--files", tmp_path / "t.csv", *TWO, "--success", "{policy}", "--out", tmp_path / "log") == 0
    text = capsys.readouterr().out
    assert "best on" in text
    line = next(line for line in text.splitlines() if line.startswith("│ a "))
    assert [cell.strip() for cell in line.strip("│").split("│")][-5:] == ["-", "-", "0", "0", "0"]  # reward, best on, fallbacks, solved, errors


def test_bad_files_of_other_kinds(tmp_path, capsys):
    out = tmp_path / "log"
    (tmp_path / "a.jsonl").write_text('{"q": "x", "a": true}\n{"q": "y", "a"')
    assert "a.jsonl, line 2: is not JSON" in refused(capsys, out, "--files", tmp_path / "a.jsonl", *WIDE)
    (tmp_path / "b.jsonl").write_text('{"q": "x", "a": true}\n{"q": ["y"], "a": true}\n')
    assert "b.jsonl, row 2 (line 2), column 'q': must be text, got ['y']" in refused(capsys, out, "--files", tmp_path / "b.jsonl", *WIDE)
    (tmp_path / "c.jsonl").write_text("[1]\n")
    assert "line 1: must be an object, got list" in refused(capsys, out, "--files", tmp_path / "c.jsonl", *WIDE)
    pyarrow.parquet.write_table(pyarrow.table({"q": ["x", "y"], "a": [1.0, float("nan")]}), tmp_path / "d.parquet")
    assert "d.parquet, row 2, column 'a': is NaN" in refused(capsys, out, "--files", tmp_path / "d.parquet", *WIDE)
    (tmp_path / "e.parquet").write_bytes((tmp_path / "d.parquet").read_bytes()[:-20])
    assert "e.parquet: is not a whole Parquet file" in refused(capsys, out, "--files", tmp_path / "e.parquet", *WIDE)
    (tmp_path / "f.xlsx").write_text("")
    assert "unknown format '.xlsx', known: .csv" in refused(capsys, out, "--files", tmp_path / "f.xlsx", *WIDE)
    assert "there is no such file" in refused(capsys, out, "--files", tmp_path / "g.csv", *WIDE)
    (tmp_path / "i.jsonl").write_text('{"q": "x", "a": true}\n{"q": "y", "a": true, "a": false}\n')
    assert "i.jsonl, line 2: key 'a' is there twice" in refused(capsys, out, "--files", tmp_path / "i.jsonl", *WIDE)
    (tmp_path / "j.jsonl").write_text('{"q": "a \\ud800 b", "a": true}\n')
    line = refused(capsys, out, "--files", tmp_path / "j.jsonl", *WIDE)
    assert "j.jsonl, row 1 (line 1), column 'q': must be text, got '\\ud800' in it, which is only half of a character" in line
    (tmp_path / "k.jsonl").write_text('{"q": "x", "a": ' + "[" * 100_000 + "\n")
    assert "k.jsonl, line 1: is not JSON" in refused(capsys, out, "--files", tmp_path / "k.jsonl", *WIDE)
    twice = pyarrow.table([["x"], [True], [False]], names=["q", "a", "a"])
    pyarrow.parquet.write_table(twice, tmp_path / "l.parquet")
    assert "l.parquet: column 'a' is there twice" in refused(capsys, out, "--files", tmp_path / "l.parquet", *WIDE)
    (tmp_path / "m.csv").write_text('"q";"a"\n"x";1\n')
    assert "a quote is wrong, or it is not separated by ','" in refused(capsys, out, "--files", tmp_path / "m.csv", *WIDE)
    (tmp_path / "n.tsv").write_text("q,a\nx,1\n")
    assert "it seems to be separated by ',', but a .csv is by ',' and a .tsv by '\\t': name it .csv" in refused(
        capsys, out, "--files", tmp_path / "n.tsv", *WIDE
    )
    (tmp_path / "sun_o.csv").write_text("q;a\nx;1\n")
    assert "it seems to be separated by ';'" in refused(capsys, out, "--files", tmp_path / "{topic}_o.csv", *WIDE, "--group", "topic")
    (tmp_path / "h1.csv").write_text("q,a\nx,1\n")
    (tmp_path / "h2.csv").write_text("q,b\nx,1\n")
    assert "h2.csv: column" in refused(capsys, out, "--files", tmp_path / "h*.csv", *WIDE)


def test_bad_joins_get_one_line(tmp_path, capsys):
    (tmp_path / "t.csv").write_text("id,a\n1,1\n2,0\n")
    mapping = """version = 1
name = "x"
table.files = ["t.csv"]
join = [{ files = FILES, on = "id" }]
instance.text = "q"
outcome.success = "a"
policies.a = {}
"""
    for files, content, says in (
        ("[]", "", "join[0].files: must name at least one file"),
        ('["q.csv"]', "id,q\n1,x\n", "row 2 (line 3), column 'id': '2' is not in"),
        ('["q.csv"]', "id,q\n1,x\n1,y\n2,z\n", "row 2 (line 3), column 'id': '1' is in row 1 of"),
        ('["q.csv"]', "id,q\n1,x\n,y\n", "q.csv, row 2 (line 3), column 'id': is empty, expected text"),
        ('["q.csv"]', "id,q,a\n1,x,1\n2,y,1\n", "column 'a' is in"),
        ('["q.csv"]', "key,q\n1,x\n", "there is no column 'id' to join on: columns: key, q"),
    ):
        (tmp_path / "q.csv").write_text(content)
        (tmp_path / "m.toml").write_text(mapping.replace("FILES", files))
        assert says in refused(capsys, tmp_path / "log", "--map", tmp_path / "m.toml")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("version = 1", "version = 2", "version: must lie in [1, 1], got 2"),
        ('text = "prompt"', 'texts = "prompt"', "instance.texts: is not a known key, did you mean 'text'?"),
        ('group = "subject"', 'gruop = "subject"', "instance.gruop: is not a known key, did you mean 'group'?"),
        ('success = "{policy}"', "", "policies.small.success: is missing"),
        ('success = "{policy}"', "success = true", "outcome.success: must be a column"),
        ("price = 0\n", f"price = {10**400}\n", "policies.small.price: is an integer too large to be a number"),
        ("price = 0\n", "price = true\n", "policies.small.price: must be a column, a number, a table"),
        ('success = "{policy}"', "success = { column = 'a', at_least = 1, true = ['x'] }", "give either at_least"),
        ("price = 0\n", "", "policies.small.price: is missing, policy 'big' has it"),
        ('name = "big"', 'name = "small"', "policies.small: is the name of two policies"),
        ('count = "characters"', 'count = "letters"', "unknown value 'letters'"),
        ("seconds = 0.25", "seconds = 0.25\ninference = 0.25", "seconds: is the total, where its parts are not known; inference is given as well"),
        ('name = "quiz"', 'name = "quiz', "quiz.toml: TOML"),
        ('text = "prompt"', 'text = "Q: {prompt"', "instance.text: 'Q: {prompt' has a brace too many or too few"),
        ('"{policy}"', '"small"', "outcome.success: is 'small' for each of small, big/model-1; let {policy} in it stand for the policy's name"),
        ('"{policy}"', '"{policy}"\nscore = ["prompt", 1]', "outcome.score: is ['prompt', 1] for each of small, big/model-1"),
        (
            'text = "prompt"',
            'text = "promt"',
            "quiz.toml names as instance.text: did you mean 'prompt'? columns: prompt, small",
        ),
    ],
)
def test_a_bad_mapping_file_gets_one_line(old, new, says, tmp_path, capsys):
    file = quiz(tmp_path) / "quiz.toml"
    assert old in MAPPING
    file.write_text(MAPPING.replace(old, new, 1))
    line = refused(capsys, tmp_path / "log", "--map", file)
    assert "quiz.toml" in line and says in line


def test_flags_that_do_not_go_together(tmp_path, capsys):
    out = tmp_path / "log"
    file = quiz(tmp_path) / "quiz.toml"
    assert "--text does not go with --map" in refused(capsys, out, "--map", file, "--text", "x")
    assert "--dataset does not go with a table" in refused(capsys, out, "--map", file, "--dataset", tmp_path)
    assert "--dataset: is missing" in refused(capsys, out, "--metric", "action-mse")
    assert "--map or --files is missing" in refused(capsys, out)
    assert "--price big=1: unknown policy 'big'" in refused(
        capsys, out, "--files", file, "--text", "q", "--policies", "a", "--success", "a", "--price", "big=1"
    )
    assert "did you mean '--preset'?" in refused(capsys, out, "--presset", "x")


def test_duplicates_as_told(tmp_path):
    (tmp_path / "t.csv").write_text("q,a\nx,1\ny,1\nx,0\n")
    expected = {
        "drop": [("log/000001", 0, True), ("log/000002", 0, True)],
        "repeats": [("log/000001", 0, True), ("log/000001", 1, False), ("log/000002", 0, True)],
        "keep": [("log/000001", 0, True), ("log/000002", 0, True), ("log/000003", 0, False)],
    }
    for how, rows in expected.items():
        assert run("--files", tmp_path / "t.csv", *WIDE, "--name", "log", "--duplicates", how, "--out", tmp_path / how) == 0
        assert [(row.instance, row.repeat, row.success) for row in read_rollouts(tmp_path / how)[0]] == rows


@pytest.mark.parametrize(
    ("content", "flags", "says"),
    [
        ("what is x,1\nwhat is x,0\nwhat is x,1\n", WIDE, "2 duplicate rows left out, 1 of which differed from the row that was kept"),
        ("what is x,1\nwhat is x,1\nwhat is x,\n", WIDE, "2 duplicate rows left out, 1 of which differed from the row that was kept"),
        ("what is x,1\nwhat is x,1\n", WIDE, "1 duplicate rows left out, none of which differed from the row that was kept"),
        (
            "what is x,1,a\nwhat is x,0,a\nwhat is x,1,b\nwhat is x,1,b\n",
            LONG,
            "2 duplicate rows left out, 1 of which differed from the row that was kept",
        ),
    ],
)
def test_dropped_rows_that_differ_are_counted(content, flags, says, tmp_path, capsys):
    (tmp_path / "t.csv").write_text(("q,a\n" if flags is WIDE else "q,s,m\n") + content)
    assert run("--files", tmp_path / "t.csv", *flags, "--duplicates", "drop", "--out", tmp_path / "log") == 0
    assert says in capsys.readouterr().out
    assert all(row.success for row in read_rollouts(tmp_path / "log")[0])


def test_a_folder_in_use_is_left_alone_and_the_same_log_goes_on(tmp_path, capsys):
    file, out = quiz(tmp_path) / "quiz.toml", tmp_path / "log"
    assert run("--map", file, "--out", out) == 0
    before = {item.name: item.read_bytes() for item in out.iterdir()}
    assert run("--map", file, "--out", out) == 0  # it is complete
    assert {item.name: item.read_bytes() for item in out.iterdir()} == before

    assert run("--map", file, "--encoder", "osel_small", "--out", out) == 0  # another encoder's contexts come beside them
    assert len(ContextCache(out).encoders()) == 2
    assert (out / "rollouts.parquet").read_bytes() == before["rollouts.parquet"]

    (out / "rollouts.parquet").unlink()  # as if interrupted
    assert run("--map", file, "--out", out) == 0
    assert (out / "rollouts.parquet").read_bytes() == before["rollouts.parquet"]

    capsys.readouterr()
    table = tmp_path / "quiz_anatomy.csv"
    text = table.read_text()
    table.write_text(text.replace("False", "True", 1))
    assert "holds a log with other outcomes" in refused(capsys, out, "--map", file)
    table.write_text(text.replace("bone", "muscle", 1))
    assert "holds the contexts of other instances" in refused(capsys, out, "--map", file)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    assert "is not empty" in refused(capsys, tmp_path / "other", "--map", file)


def test_help_is_quick_and_imports_nothing_heavy():
    done = subprocess.run([sys.executable, "-X", "importtime", "-m", "osel_sim.ingest", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "examples:" in done.stdout
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert not imported & {"torch", "numpy", "pyarrow", "sklearn", "lerobot", "open_clip", "sentence_transformers"}


def test_the_example_mapping_is_valid():
    from osel_sim.ingestion.columns_file import load_columns

    columns = load_columns(Path(__file__).parent.parent / "examples" / "mmlu.toml")
    assert [policy.name for policy in columns.policies.values()] == ["mixtral-8x7b", "gpt-4-turbo"]
    assert set(columns.needed) == {"prompt", "subject", "mistralai/Mixtral-8x7B-Instruct-v0.1", "gpt-4-1106-preview"}
