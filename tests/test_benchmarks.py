"""Benchmarks can be run: nobody does for weeks, and then they have to."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def test_none_hides_a_package():
    """A script's folder comes first where Python looks: one named `coverage` stands in the way of the package, which numba imports."""
    names = [file.stem for file in BENCHMARKS.glob("*.py")]
    found = {name: find_spec(name) for name in names}
    others = [name for name, spec in found.items() if spec is not None and Path(str(spec.origin)).parent != BENCHMARKS]  # tests import some as well
    assert names and others == []


@pytest.mark.slow
def test_replays_are_measured():
    arguments = ["--parts", "ppo", "bound", "--dim", "16", "--decisions", "15", "--seeds", "1", "--sb3-seeds", "1", "--workers", "1"]
    command = [sys.executable, str(BENCHMARKS / "replay.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(BENCHMARKS.parent)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["ratio_one_thread"] > 1.0 and 0.0 < figures["memory_ms"] < figures["epoch_ms"]
