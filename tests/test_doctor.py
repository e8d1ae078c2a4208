import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from osel_sim.cli import machine_checks
from osel_sim.cli.machine_checks import Check
from osel_sim.core import content
from osel_sim.doctor import main as doctor_main


def checkpoint(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text('{"type": "act"}')
    save_file({"weight": np.zeros((3, 4), np.float32), "bias": np.zeros(4, np.float32)}, folder / "model.safetensors")
    return folder


def policy(folder: Path, checkpoint: str) -> Check:
    folder.mkdir(exist_ok=True)
    text = (content.root() / "policies" / "local_small.toml").read_text()
    (folder / "mine.toml").write_text(text.replace('"local_small"', '"mine"').replace("assets/policies/local_small", checkpoint))
    return next(check for check in machine_checks._policies(folder) if check.name == "mine")


def test_a_whole_checkpoint_is_counted(tmp_path: Path) -> None:
    found = policy(tmp_path / "policies", str(checkpoint(tmp_path / "weights")))
    assert (found.state, found.found) == ("ok", "checkpoint is whole, 0.0M parameters")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "config.json").unlink(), "config.json in"),
        (lambda folder: (folder / "config.json").write_text("{"), "is missing or no JSON"),
        (lambda folder: (folder / "model.safetensors").unlink(), "no safetensors file in"),
        (
            lambda folder: (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:-1]),
            "is not a whole safetensors file",
        ),
        (lambda folder: (folder / "model.safetensors").write_bytes(b""), "is not a whole safetensors file"),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"\xff" * 64), "is not a whole safetensors file"),
    ],
)
def test_a_damaged_checkpoint_is_found(damage, message: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    folder = checkpoint(tmp_path / "weights")
    damage(folder)
    found = policy(tmp_path / "policies", str(folder))
    assert found.state == "missing"
    assert message in found.found
    assert found.fix.startswith("python -m osel_sim.train --policy mine")


def test_a_missing_checkpoint_folder_is_not_taken_for_a_hub_name(tmp_path: Path) -> None:
    assert policy(tmp_path, "assets/policies/nothing").state == "missing"
    assert policy(tmp_path, "/no/such").state == "missing"
    assert policy(tmp_path, "lerobot/smolvla_base").state == "note"


def test_a_broken_policy_file_is_reported_with_its_key(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('version = 1\nname = "mine"\nlocation = "lokal"\n')
    found = next(check for check in machine_checks._policies(tmp_path) if check.name == "mine")
    assert (found.state, found.fix) == ("missing", "correct mine.toml")
    assert "location: unknown value 'lokal', did you mean 'local'?" in found.found


def test_the_command_reports_every_area_and_its_exit_code_agrees(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-m", "osel_sim.doctor", "--json"], capture_output=True, text=True, cwd=tmp_path)
    report = json.loads(done.stdout)
    checks = [Check(**check) for check in report["checks"]]
    assert {check.area for check in checks} == {"python", "packages", "display", "machine", "tasks", "suites", "policies", "encoder"}
    assert {check.state for check in checks} <= {"ok", "note", "missing"}
    assert all(check.fix for check in checks if check.state == "missing")
    assert report["ready"] == all(check.state != "missing" for check in checks)
    assert done.returncode == (0 if report["ready"] else 1)
    assert {"mujoco", "robosuite", "torch"} <= {check.name for check in checks if check.area == "packages" and check.state == "ok"}


def test_without_opengl_it_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "eggl")
    (found,) = machine_checks._display()
    assert found.state == "missing"
    assert "known: egl, osmesa, glfw" in found.found + found.fix


def test_the_table_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.toml").write_text("version = 1\n")
    assert doctor_main(["--policies-dir", str(tmp_path)]) == 1
    told = capsys.readouterr().out
    assert "correct mine.toml" in told
    *_, summary, following = told.splitlines()
    assert "missing" in summary
    assert f"-m osel_sim.doctor --policies-dir {tmp_path} " in following
