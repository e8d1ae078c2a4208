"""The commands as Python functions: `import osel_sim as osel`."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from run_helpers import make_world
from synthetic_log import clusters

import osel_sim as osel
from osel_sim.core.errors import SettingError, UnknownNameError
from osel_sim.interface.selector import Choice


class Greedy:
    """A selector of one's own: all that it needs."""

    def __init__(self, names, length, number):
        self.policies, self.mean = tuple(names), {}

    def select(self, context):
        best = max(self.policies, key=lambda policy: self.mean.get(policy, 9.0))
        return Choice(best, {policy: float(policy == best) for policy in self.policies})

    def update(self, context, choice, reward):
        self.mean[choice.policy] = 0.9 * self.mean.get(choice.policy, reward) + 0.1 * reward


class Hold:
    """A policy of one's own, which does nothing."""

    def reset(self, instruction):
        self.instruction = instruction

    def act(self, observation):
        assert observation["task"] == self.instruction and observation["observation.images.agentview"].shape == (32, 32, 3)
        return np.zeros((10, 7), np.float32)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return clusters(tmp_path_factory.mktemp("log"), instances=120, clusters=3, dim=6, policies=3, seed=2).folder


def test_functions_stay_functions_when_the_commands_are_imported():
    for name in ("run", "record", "replay", "report", "ingest", "collect", "compare"):
        assert callable(import_module(f"osel_sim.{name}").main)
        assert getattr(osel, name).__module__ == f"osel_sim.api.{name}"
    assert set(osel.__all__) <= set(dir(osel))
    with pytest.raises(AttributeError, match="no attribute 'rn'"):
        osel.rn  # noqa: B018


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, osel_sim; osel_sim.RunConfig; print({'torch', 'mujoco', 'pandas', 'altair', 'numpy', 'cyclopts'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


def test_a_log_is_replayed_to_a_selector_of_ones_own(log, tmp_path, capsys):
    free = {"alpha_time": 0, "alpha_price": 0, "no_frontier": True}
    told = []
    result = osel.replay(log, selectors=["ucb1", Greedy], seeds=3, workers=2, out=tmp_path / "out", on_result=told.append, **free)
    assert {"ucb1", "Greedy"} <= set(result.selectors["selector"]) and told[0].verdict == result.verdict != ""
    assert capsys.readouterr().out == ""  # only the progress bar, on standard error
    again = osel.replay(log, selectors=[Greedy], seeds=3, workers=1, out=tmp_path / "again", **free)
    mine = [frame.selectors.set_index("selector").loc["Greedy", "mean_reward"] for frame in (result, again)]
    assert mine[0] == mine[1]
    result.curve.save(tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    page = osel.report(tmp_path / "out").page
    assert page == tmp_path / "out" / "report.html" and page.is_file()


def test_a_live_run_of_objects_of_ones_own(tmp_path, capsys):
    world = make_world(tmp_path / "world")
    policies = [
        osel.as_policy(Hold(), "still", cameras=["agentview"], image_size=32),
        osel.as_policy(Hold(), "calm", image_size=32, price_per_action=0.1),
    ]
    settings = {"task": "short", "tasks": world / "tasks", "policies": policies, "selector": Greedy, "out": tmp_path / "run"}
    osel.run(**settings, episodes=1, no_page=True)
    assert len(osel.run(**settings, episodes=2, resume=True, no_page=True).decisions) == 2
    with pytest.raises(osel.OselError, match="episodes was 2 at the beginning"):
        osel.run(**settings, episodes=1, resume=True)
    result = osel.run(**{**settings, "out": tmp_path / "two"}, episodes=2, seed=1, no_page=True)
    assert list(result.decisions["policy"]) == ["still", "calm"]  # what it has not tried it takes for the best
    assert list(result.decisions["price"]) == pytest.approx([0.0, 3.0]) and not result.interrupted
    assert (tmp_path / "run" / "episodes.jsonl").read_text() and not (tmp_path / "run" / "selector.safetensors").exists()
    assert capsys.readouterr().out == ""


def test_parts_alone(log):
    loaded = osel.load_log(log)
    assert len(loaded) == 120
    assert osel.make_selector("ucb1", loaded.policies, loaded.contexts.shape[1]).select(loaded.contexts[0]).policy in loaded.policies
    assert hasattr(osel.load_policy("local_small"), "act")


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda log: osel.replay(log, sedes=3), UnknownNameError, "unknown setting 'sedes': did you mean 'seeds'"),
        (lambda log: osel.replay(log, seeds=0), SettingError, "seeds: must be 1 or more, got 0"),
        (lambda log: osel.replay(log / "none"), SettingError, "there is no folder"),
        (lambda log: osel.run(task="lft"), UnknownNameError, "did you mean 'lift'"),
        (lambda log: osel.run(task="lift", policies=[object()]), osel.OselError, "has no method 'reset'"),
        (lambda log: osel.record(task="lift"), SettingError, "out: is missing"),
        (lambda log: osel.make_env("lft"), UnknownNameError, "did you mean 'lift'"),
    ],
)
def test_errors_are_typed_and_name_what_is_wrong(log, call, kind, message):
    with pytest.raises(kind, match=message):
        call(log)
