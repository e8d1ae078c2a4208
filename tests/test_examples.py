"""The examples do what they say: each runs in a folder that looks like the repository's root, with fewer decisions; the notebook runs as it is."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
SHORT = ("own_policy", "own_selector", "price_sweep")
MOST_LINES = 10


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the repository's content that can be written to."""
    for name in ("assets", "policies", "tasks"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def run(name: str, folder: Path, shorter: bool = True) -> str:
    """What an example prints."""
    code = (EXAMPLES / f"{name}.py").read_text()
    if shorter:
        code = re.sub(r"seeds=\d+", "seeds=1, decisions=40", code)
    (folder / f"{name}.py").write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, f"{name}.py"], cwd=folder, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", SHORT)
def test_they_are_short(name: str) -> None:
    """At most ten lines beside imports, docstring and blank lines."""
    text = (EXAMPLES / f"{name}.py").read_text()
    passed_over = {number for node in ast.parse(text).body if isinstance(node, ast.Import | ast.ImportFrom) for number in lines_of(node)}
    passed_over |= set(lines_of(ast.parse(text).body[0]))
    own = [line for number, line in enumerate(text.splitlines(), 1) if line.strip() and number not in passed_over]
    assert len(own) <= MOST_LINES


def lines_of(node: ast.stmt) -> range:
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


@pytest.mark.slow
def test_a_policy_object_of_ones_own_drives(checkout: Path) -> None:
    printed = run("own_policy", checkout)
    assert len(printed.splitlines()) == 4
    assert "stand_still" in printed
    assert "local_small" in printed


@pytest.mark.slow
def test_a_selector_class_of_ones_own_is_replayed_and_its_curve_written(checkout: Path) -> None:
    run("own_selector", checkout)
    assert "RecentBest" in (checkout / "runs" / "own_selector" / "curve.svg").read_text()


@pytest.mark.slow
def test_less_is_paid_the_more_it_counts(checkout: Path) -> None:
    cents = [float(found) for found in re.findall(r"([\d.]+) cents", run("price_sweep", checkout))]
    assert len(cents) == 5
    assert cents[0] > cents[-1]


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    shutil.copy(EXAMPLES / "tour.ipynb", tmp_path)
    notebook = nbformat.read(tmp_path / "tour.ipynb", as_version=4)
    NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    texts = "".join(output.get("text", "") + str(output.get("data", {})) for output in shown)
    assert any(answer in texts for answer in ("Route with", "Do not route", "Not enough data to tell"))
    assert "report.html" in texts
    assert any("vegalite" in kind for output in shown for kind in output.get("data", {}))


def test_the_notebook_is_committed_without_outputs() -> None:
    import nbformat

    notebook = nbformat.read(EXAMPLES / "tour.ipynb", as_version=4)
    assert all(not cell.get("outputs") and not cell.get("execution_count") for cell in notebook.cells)
