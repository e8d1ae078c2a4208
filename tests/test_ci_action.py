"""The composite action in examples/ci: its steps run as a CI server would run them, but for what it installs and uploads."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from test_compare import log_of, pattern, rows_of

from osel_sim.core.files import read_json

ROOT = Path(__file__).resolve().parent.parent
ACTION = yaml.safe_load((ROOT / "examples" / "ci" / "action.yml").read_text())
STEPS: dict[str, dict[str, Any]] = {step["name"]: step for step in ACTION["runs"]["steps"]}
NOT_HERE = ("Install a software renderer", "Install osel_sim", "Keep the log")


def run_step(name: str, folder: Path, **inputs: str) -> subprocess.CompletedProcess[str]:
    """One step in a folder, `osel-sim` being this checkout's."""
    bin = folder / "bin"
    if not bin.is_dir():
        bin.mkdir()
        (bin / "osel-sim").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m osel_sim "$@"\n')
        (bin / "osel-sim").chmod(0o755)
    values = {key: str(about.get("default", "")) for key, about in ACTION["inputs"].items()} | {
        key.replace("_", "-"): value for key, value in inputs.items()
    }
    step = STEPS[name]
    own = {key: re.sub(r"\$\{\{ inputs\.([\w-]+) \}\}", lambda match: values[match[1]], text) for key, text in step.get("env", {}).items()}
    assert "${{" not in step["run"] + "".join(own.values())  # what others wrote gets to the shell by variables only
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "GITHUB_STEP_SUMMARY": str(folder / "summary.md"), **own}
    environment |= {"PATH": f"{bin}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(["bash", "-e", "-o", "pipefail", "-c", step["run"]], cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("cells", "undecided", "code"),
    [((60, 20, 2, 18), "pass", 1), ((200, 2, 2, 96), "pass", 0), ((20, 4, 4, 12), "pass", 0), ((20, 4, 4, 12), "fail", 3)],
)
def test_the_gate_closes_on_what_got_worse(tmp_path, cells, undecided, code):
    for name, successes in zip(("baseline", "candidate"), pattern(*cells), strict=True):
        log_of(tmp_path / "runs" / name, rows_of("mine", successes))
    done = run_step("Compare", tmp_path, policy="mine", undecided=undecided)
    assert done.returncode == code, done.stderr
    assert "points of success" in (tmp_path / "summary.md").read_text()
    assert (tmp_path / "runs" / "compared.xml").is_file()


def test_wrong_input_closes_the_gate_and_a_missing_baseline_does_not(tmp_path):
    log_of(tmp_path / "runs" / "candidate", rows_of("mine", [True] * 20))
    assert "nothing is compared" in run_step("Compare", tmp_path, policy="mine").stdout
    log_of(tmp_path / "runs" / "baseline", rows_of("other", [True] * 20))
    assert run_step("Compare", tmp_path, policy="mine").returncode == 2


def test_a_workflow_gives_inputs_that_the_action_has():
    workflow = yaml.safe_load((ROOT / "examples" / "ci" / "workflow.yml").read_text())
    (call,) = [step for step in workflow["jobs"]["policy"]["steps"] if step.get("uses", "").startswith("./")]
    assert set(call["with"]) <= set(ACTION["inputs"])
    assert {name for name, about in ACTION["inputs"].items() if about.get("required")} <= set(call["with"])


@pytest.mark.slow
def test_all_steps_in_their_order(tmp_path):
    inputs = {"policy": "scripted_expert", "policies_dir": str(ROOT / "policies"), "task": "lift", "instances": "2", "until_decided": "true"}
    for round in range(2):
        for name in STEPS:
            if name not in NOT_HERE:
                done = run_step(name, tmp_path, **inputs)
                assert done.returncode == 0, f"{name}: {done.stdout}{done.stderr}"
        if round == 0:
            (tmp_path / "runs" / "candidate").rename(tmp_path / "runs" / "baseline")
    assert read_json(tmp_path / "runs" / "baseline" / "run.json")
    assert "Not enough data" in (tmp_path / "summary.md").read_text()
