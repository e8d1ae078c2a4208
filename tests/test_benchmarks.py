"""Benchmarks can be run: nobody does for weeks, and then they have to."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from osel_sim.suites.environments import environment

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def test_none_hides_a_package():
    """A script's folder comes first where Python looks: one named `coverage` stands in the way of the package, which numba imports."""
    names = [file.stem for file in BENCHMARKS.glob("*.py")]
    found = {name: find_spec(name) for name in names}
    others = [name for name, spec in found.items() if spec is not None and Path(str(spec.origin)).parent != BENCHMARKS]  # tests import some as well
    assert names and others == []


def figures(script: str, *arguments: str) -> dict[str, float]:
    """The last line that a benchmark prints."""
    command = [sys.executable, str(BENCHMARKS / script), *arguments]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(BENCHMARKS.parent)}, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_replays_are_measured():
    arguments = ["--parts", "ppo", "bound", "--dim", "16", "--decisions", "15", "--seeds", "1", "--sb3-seeds", "1", "--workers", "1"]
    measured = figures("replay.py", *arguments)
    assert measured["ratio_one_thread"] > 1.0 and 0.0 < measured["memory_ms"] < measured["epoch_ms"]


@pytest.mark.slow
@pytest.mark.skipif(not environment("metaworld").installed, reason="the suite's environment has not been made")
def test_hosts_are_measured():
    measured = figures("suites.py", "--parts", "frame", "hosted", "--rounds", "1", "--steps", "16")
    assert measured.keys() == {"metaworld_frame_ratio", "hosted_slowdown"} and measured["metaworld_frame_ratio"] > 5.0
