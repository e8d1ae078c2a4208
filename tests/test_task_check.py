"""`doctor --task FILE`: the expert does the task, or the reason is told."""

import json
import re
from pathlib import Path

import pytest

from osel_sim.core import content
from osel_sim.doctor import main

VARIANTS = {
    "a shut drawer": (
        "tidy",
        [(r"\[scene\.start\].*?\n\n", ""), (r"horizon = \d+", "horizon = 60")],
        r"_drawer is 0% open when (move|place)\(object, drawer\) puts something into it",
    ),
    "a horizon too short": ("lift", [(r"horizon = \d+", "horizon = 30")], r"done after \d+ steps: horizon = 30 is too short"),
    "a plan without its end": (
        "lift",
        [(r"all = \[.*?\]", 'all = ["lifted(object)", "released(object)"]')],
        r"done to its end, and released\(object\) did not hold",
    ),
    "nothing to do": ("close_drawer", [(r"\[0\.7, 1\.0\]", "[0.0, 0.0]")], "the goal holds at the start"),
    "out of reach": (
        "lift",
        [(r"(region\.object\]\nx = )\[.*?\]", r"\1[0.36, 0.38]"), (r"horizon = \d+", "horizon = 50")],
        r"came no nearer to \w+ than \d+ cm: is x = 0\.3\d, y = .* out of its reach",
    ),
    "no room": ("lift", [(r"(region\.object\]\nx = )\[.*?\]\ny = \[.*?\]", r"\1[0.0, 0.01]\ny = [0.0, 0.01]")], "its regions are too small for"),
}
"""What is wrong -> a shipped task, what is changed in it, and the reason that is told."""


def variant(folder: Path, base: str, changes: list[tuple[str, str]]) -> Path:
    text = content.find("tasks", base).read_text().replace(f'name = "{base}"', 'name = "mine"')
    for pattern, new in changes:
        text, count = re.subn(pattern, new, text, flags=re.DOTALL)
        assert count == 1, pattern
    file = folder / "mine.toml"
    file.write_text(text)
    return file


@pytest.mark.parametrize("kind", VARIANTS)
def test_the_reason_of_a_failure_is_told(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base, changes, reason = VARIANTS[kind]
    file = variant(tmp_path, base, changes)
    assert main(["--task", str(file), "--instances", "1", "--json"]) == 1
    (attempt,) = json.loads(capsys.readouterr().out)["attempts"]
    assert any(re.search(reason, found) for found in attempt["reasons"]), attempt


def test_a_task_that_can_be_done_is_told_and_run_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = variant(tmp_path, "lift", [])
    assert main(["--task", str(file), "--instances", "2"]) == 0
    out = capsys.readouterr().out
    assert "solves 2 of 2 instances" in out
    assert f"-m osel_sim.run --task mine --tasks {tmp_path} --episodes 20" in out


def test_all_that_is_wrong_with_a_file_is_told_before_anything_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = variant(tmp_path, "lift", [("horizon", "horizn"), (r'plan = \["reach', 'plan = ["reech')])
    assert main(["--task", str(file)]) == 2
    errors = capsys.readouterr().err
    assert "horizn: is not a known key, did you mean 'horizon'?" in errors and "did you mean 'reach'?" in errors
    assert main(["--task", str(tmp_path / "other.toml")]) == 2
    assert "there is no such task file" in capsys.readouterr().err
