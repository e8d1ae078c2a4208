"""A Python that lacks something says in one line which to use, whatever the command; and what comes next can be typed as it is printed."""

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from osel_sim.cli.causes import print_causes
from osel_sim.cli.next_step import print_next
from osel_sim.core import this_python

ROOT = Path(__file__).resolve().parent.parent
LIGHT = (
    "annotated_types",
    "attr",
    "attrs",
    "cyclopts",
    "packaging",
    "pydantic",
    "pydantic_core",
    "rich",
    "typing_extensions.py",
    "typing_inspection",
)


def bare(*arguments: str, packages: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run this Python without its installed packages, but for those in a folder."""
    path = os.pathsep.join(map(str, [ROOT, *([packages] if packages else [])]))
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run([sys.executable, "-S", *arguments], env=environment, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("arguments", ["-m osel_sim.doctor", "-m osel_sim.run --list", "-m osel_sim.record --help", "-m osel_sim"])
def test_without_packages_one_line_says_which_python_to_use(arguments: str) -> None:
    done = bare(*arguments.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert "does not have the packages 'cyclopts', 'packaging', 'pydantic', 'rich'; " in done.stderr
    assert ".venv/bin/python" in done.stderr


def test_without_packages_the_python_api_says_so() -> None:
    assert "ImportError: " in (errors := bare("-c", "import osel_sim; osel_sim.run").stderr)
    assert ".venv/bin/python" in errors.splitlines()[-1]


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages that commands begin with, and no other."""
    folder = tmp_path_factory.mktemp("light")
    for name in LIGHT:
        spec = importlib.util.find_spec(name.removesuffix(".py"))
        assert spec is not None and spec.origin is not None
        origin = Path(spec.origin)
        (folder / name).symlink_to(origin if name.endswith(".py") else origin.parent)
    return folder


def test_a_missing_package_is_told_by_doctor_and_by_whoever_needs_it(light: Path) -> None:
    looked = bare("-m", "osel_sim.doctor", packages=light)
    assert looked.returncode == 1 and "Traceback" not in looked.stderr
    assert "for want of the package 'numpy'" in looked.stdout
    ran = bare("-m", "osel_sim.run", "--task", "lift", packages=light)
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1)
    assert "does not have the package 'numpy'; " in ran.stderr
    listed = bare("-m", "osel_sim.run", "--list", packages=light)
    assert listed.returncode == 0 and "pick_place" in listed.stdout


@pytest.mark.parametrize("file", ["__init__.py", "core/__init__.py", "core/this_python.py"])
def test_old_pythons_can_read_what_tells_them(file: str) -> None:
    ast.parse((ROOT / "osel_sim" / file).read_text(), feature_version=(3, 7))


def test_an_old_python_is_told_what_it_is_and_which_to_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 11, 2))
    assert "osel_sim needs Python 3.12 or 3.13, and " in this_python.problem()
    assert "(Python 3.11.2) runs it; " in this_python.problem()


def test_what_comes_next_names_this_python_and_quotes_paths(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(sys, "argv", ["/x/osel_sim/run.py"])
    print_next(("one", "report", [Path("runs/my run"), "--open"]), ("another", "replay", ["log"]))
    first, second = capsys.readouterr().out.splitlines()
    assert first == f"next: {this_python.called()} -m osel_sim.report 'runs/my run' --open   # one"
    assert second.startswith(f"      {this_python.called()} -m osel_sim.replay log ") and second.endswith("   # another")
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    monkeypatch.setattr(sys, "argv", ["/x/bin/osel-sim", "run"])
    assert this_python.called() == "python"
    print_next(("one", "report", ["log"]))
    assert capsys.readouterr().out == "next: osel-sim report log   # one\n"


def test_each_cause_of_errors_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    print_causes([("a", "x/1", "a: OSError: no"), ("b", "x/1", "PolicyError: \x1b[31m"), ("a", "x/2", "a: OSError: no")])
    assert (
        capsys.readouterr().out
        == "2 episodes of a ended in an error, first in x/1: OSError: no\n1 episode of b ended in an error, in x/1: PolicyError: \\x1b[31m\n"
    )
    print_causes([("a", "x", f"cause {number}") for number in range(7)])
    assert capsys.readouterr().out.splitlines()[-1] == "2 more ended in 2 other errors"
