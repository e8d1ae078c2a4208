"""Packages that tests try ours with and that are no dependency of ours: installed once, in a cache of their own."""

import hashlib
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

CACHE = Path(tempfile.gettempdir()) / "osel_sim_test_packages"


def beside(*requirements: str) -> Path:
    """A folder for `PYTHONPATH` with just these packages, without what they depend on; the test is skipped where they cannot be had."""
    return _made("beside", requirements, lambda folder: ["--target", str(folder), "--no-deps"])


def _made(kind: str, requirements: tuple[str, ...], flags) -> Path:
    name = hashlib.sha256("\n".join(requirements).encode()).hexdigest()[:16]
    folder = CACHE / f"{kind}-{sys.version_info.minor}-{name}"
    if not (folder / "complete").exists():
        shutil.rmtree(folder, ignore_errors=True)
        command = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", sys.executable, *flags(folder), *requirements]
        done = subprocess.run(command, capture_output=True, text=True, timeout=500)
        if done.returncode:
            pytest.skip(f"{', '.join(requirements)} cannot be installed: {done.stderr.strip().splitlines()[-1:]}")
        (folder / "complete").touch()
    return folder
