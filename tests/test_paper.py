"""The paper's experiment as one command: its PPO sees and does what the authors' does, and the command answers for every form."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from osel_sim.analysis.engine import replay_one

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def paper():
    spec = importlib.util.spec_from_file_location("paper_figure5", ROOT / "benchmarks" / "paper_figure5.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.parametrize("standardised", [True, False])
def test_its_ppo_decides_as_it_does_decision_by_decision(paper, standardised: bool):
    generator = np.random.default_rng(0)
    contexts = (3.0 + 0.1 * generator.normal(size=(40, 6))).astype(np.float32)
    rewards = generator.random((40, 2))
    kind = paper.as_the_authors(contexts, standardised)
    selector, chosen = kind(("a", "b"), 6, 3), []
    seen = selector.network_inputs(contexts)
    assert np.allclose(seen.std(axis=0), 1.0, atol=1e-3) if standardised else np.allclose(seen, 10.0 * contexts)
    settings = selector.all_settings
    assert (settings["activation"], settings["n_steps"], settings["batch_size"], settings["gamma"]) == ("gelu", 5, 5, 0.0)
    for context, row in zip(contexts, rewards, strict=True):
        choice = selector.select(context)
        chosen.append(selector.policies.index(choice.policy))
        selector.update(context, choice, float(row[chosen[-1]]))
    assert (replay_one("paper_ppo", contexts, rewards, ("a", "b"), 3, factory=kind) == chosen).all()


@pytest.mark.slow
def test_the_command_answers_for_every_form(paper, tmp_path: Path, monkeypatch, capsys):
    arguments = ["paper_figure5.py", "--out", str(tmp_path / "out"), "--seeds", "2", "--decisions", "40"]
    monkeypatch.setattr(sys, "argv", arguments)
    paper.main()
    lines = (tmp_path / "out" / "table.md").read_text().splitlines()
    assert [line.split(" | ")[0].strip("| ") for line in lines[2:]] == ["text"] * 2 + ["images"] * 2 + ["steps"] * 3 + ["actions"] * 2
    assert all(" of 2 " in line and "±" in line for line in lines[2:])
    assert (tmp_path / "out" / "figure5.png").stat().st_size > 10_000
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("replay.json")}
    paper.main()  # it goes on from what is there: nothing is replayed again
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("replay.json")} == before
    assert capsys.readouterr().out.count("| form |") == 2
