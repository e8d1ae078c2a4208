import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from osel_sim.__main__ import COMMANDS as COMMAND_NAMES
from osel_sim.core import content

CHECKOUT = Path(__file__).resolve().parent.parent
COMMANDS = sorted(COMMAND_NAMES)
END = "== end of help =="
HELP = f"""
import contextlib, runpy, sys
for command in sys.argv[1:]:  # as `python -m` runs it, all in one process
    sys.argv[1:] = ["--help"]
    with contextlib.suppress(SystemExit):
        runpy.run_module(f"osel_sim.{{command}}", run_name="__main__", alter_sys=True)
    print({END!r})
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this checkout, built with what is installed: no network."""
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(CHECKOUT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (file,) = out.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder it is installed into, alone."""
    target = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", str(target), str(wheel)]
    subprocess.run(command, check=True, timeout=300)
    return target


def run(installed: Path, folder: Path, *arguments: str) -> str:
    """Standard output of python in another folder, with the installed wheel before the checkout."""
    environment = {**os.environ, "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=folder, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_nothing_but_the_package_is_at_its_top(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0] for name in names} == {"osel_sim", "osel_sim-0.1.0.dist-info"}
    assert not [name for name in names if "__pycache__" in name or name.startswith("osel_sim/tests")]
    assert "osel_sim-0.1.0.dist-info/licenses/LICENSE" in names


def test_it_holds_all_content(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for kind in ("tasks", "policies", "assets"):
        files = [file for file in (content.root() / kind).rglob("*") if file.is_file() and "__pycache__" not in file.parts]
        assert files
        assert {f"osel_sim/content/{file.relative_to(content.root()).as_posix()}" for file in files} <= names


def test_it_holds_the_template_of_the_report(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"osel_sim/reporting/template/report.{ending}" for ending in ("html.j2", "css", "js")} <= names


def test_it_lists_its_own_content_from_any_folder(installed: Path, tmp_path: Path) -> None:
    listed = json.loads(run(installed, tmp_path, "-m", "osel_sim.run", "--list", "--json"))
    files = [Path(item["file"]) for kind in ("tasks", "policies") for item in listed[kind]]
    assert {file.stem for file in files} >= {"pick_place", "local_small", "remote_large"}
    assert all(file.is_relative_to(installed / "osel_sim" / "content") for file in files)


def test_every_command_helps_from_any_folder(installed: Path, tmp_path: Path) -> None:
    told = run(installed, tmp_path, "-c", HELP, *COMMANDS)
    assert [f"python -m osel_sim.{command}" in part for command, part in zip(COMMANDS, told.split(END)[:-1], strict=True)] == [True] * len(COMMANDS)


def test_checkpoints_and_objects_are_those_of_the_wheel(installed: Path, tmp_path: Path) -> None:
    code = "from osel_sim.core import content; print(content.resolve_checkpoint('assets/objects'))"
    assert Path(run(installed, tmp_path, "-c", code).strip()) == installed / "osel_sim" / "content" / "assets" / "objects"
