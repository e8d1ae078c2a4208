"""Episodes of several robots in worker processes: the same bytes for any number of them."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from run_helpers import wait_for_lines

import osel_sim as osel
from osel_sim.analysis.live import read_live
from osel_sim.analysis.live_sharing import fleet_of, played_again
from osel_sim.core.errors import SettingError, UsageError
from osel_sim.episodes.run_subscribers import RunSubscriber
from osel_sim.formats.counterfactual import COUNTERFACTUAL
from osel_sim.formats.journal import JOURNAL, TIMING, read_lines
from osel_sim.interface.selector import Choice
from osel_sim.selection.fleet import Fleet, Sharing
from osel_sim.selection.registry import make_selector
from osel_sim.selection.reward import RewardWeights
from osel_sim.selection.state import load_state

TOY = Path(__file__).parent / "toy_suite"
POINTS = (
    "[osel_sim.suites]\ntoy = toy_suite:Toy\n[osel_sim.policies]\ntoy_greedy = toy_policies:load_greedy\ntoy_reader = toy_policies:load_reader\n"
    "[osel_sim.encoders]\ncolour = colour_encoder:Colour\n"
)
ENCODER = """
import numpy as np


class Colour:
    name = identity = "colour"
    dimension, image_size = 4, 16

    def encode(self, images, instruction):
        return np.array([*np.mean(images, axis=(0, 1, 2)) / 255, "red" in instruction], np.float32)
"""
WRITTEN = (JOURNAL, COUNTERFACTUAL, "contexts.npz", "summary.json")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The toy suite as it is when it is installed, with an encoder, and two policies that need no server."""
    site = tmp_path_factory.mktemp("site")
    info = site / "toy_suite-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-suite\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    (site / "colour_encoder.py").write_text(ENCODER)
    (site / "policies").mkdir()
    greedy = (TOY / "policies" / "toy_greedy.toml").read_text()
    (site / "policies" / "toy_greedy.toml").write_text(greedy)
    (site / "policies" / "toy_reader.toml").write_text(greedy.replace("toy_greedy", "toy_reader"))
    return site


@pytest.fixture
def toy(site, monkeypatch):
    for folder in (TOY, site):
        monkeypatch.syspath_prepend(str(folder))
    return {"task": "toy:all", "policies_dir": site / "policies", "encoder": "colour", "no_page": True, "counterfactual": True}


def written(folder: Path) -> dict[str, object]:
    """The bytes of the files that nothing else than the run may change, and the selectors' states (safetensors orders its metadata by chance)."""
    state = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in load_state(folder / "selector.safetensors").items()}
    return {"state": state, **{name: (folder / name).read_bytes() for name in WRITTEN}}


@pytest.mark.parametrize(
    ("share", "delay", "selector", "robots"), [("every:2", 1, "thompson", 4), ("none", 0, "linucb", 4), ("all", 0, "epsilon_greedy", 3)]
)
def test_a_run_of_several_robots_is_the_same_bytes_for_any_number_of_workers(toy, tmp_path, share, delay, selector, robots):
    settings = {**toy, "selector": selector, "robots": robots, "share": share, "share_delay": delay, "episodes": 18}
    for workers in (1, 2, 4) if share != "none" else (1, 3):
        result = osel.run(out=tmp_path / str(workers), workers=workers, **settings)
        assert len(result.decisions) == 18 and not result.interrupted
        assert written(tmp_path / str(workers)) == written(tmp_path / "1")
    for timing, _ in read_lines(tmp_path / str(workers) / TIMING):
        assert set(timing["episodes"]) == {"toy_greedy", "toy_reader"}
        assert timing["seconds"] >= timing["context_and_choice"] + timing["episodes"]["toy_greedy"]["seconds"] > 0


def test_what_is_played_again_in_the_runs_own_order_is_what_the_run_did(toy, tmp_path, monkeypatch):
    osel.run(out=tmp_path / "run", **toy, selector="thompson", robots=3, share="every:2", share_delay=1, episodes=18)
    monkeypatch.setattr("osel_sim.analysis.live_sharing.ORDERS", 1)
    live = read_live(tmp_path / "run")
    found = played_again(live, fleet_of(live), RewardWeights(**live.reward), budget=1_000)
    received = np.array([decision.reward for decision in live.decisions]).reshape(-1, 3).mean(axis=1)
    [entry] = found["selectors"].values()
    assert found["orders"] == 1
    assert np.allclose(entry["ways"]["every:2"]["curve"], received.cumsum() / np.arange(1, 7), atol=1e-12)


@pytest.mark.slow  # 20 s and more
def test_a_killed_run_of_workers_comes_back_to_the_same_bytes(toy, site, tmp_path):
    def command(out: Path, *more: str) -> list[str]:
        fixed = [
            "--task",
            "toy:all",
            "--policies-dir",
            str(site / "policies"),
            "--encoder",
            "colour",
            "--no-page",
            "--counterfactual",
            "--out",
            str(out),
        ]
        fixed += ["--selector", "linucb", "--robots", "4", "--share", "every:3", "--share-delay", "2", "--episodes", "30"]
        return [sys.executable, "-m", "osel_sim.run", *fixed, "--out", str(out), *more]

    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TOY), str(site), os.environ.get("PYTHONPATH", "")])}
    killed = subprocess.Popen(command(tmp_path / "killed", "--workers", "2"), env=environment, stderr=subprocess.PIPE, text=True)
    wait_for_lines(killed, tmp_path / "killed" / JOURNAL, 6)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert 6 <= (tmp_path / "killed" / JOURNAL).read_bytes().count(b"\n") < 30
    osel.run(resume=True, out=tmp_path / "killed")
    osel.run(**toy, out=tmp_path / "whole", selector="linucb", robots=4, share="every:3", share_delay=2, episodes=30)
    assert written(tmp_path / "killed") == written(tmp_path / "whole")


class Watching(RunSubscriber):
    """Watches episodes."""

    def watch(self, index, policy, chosen):
        return ()


class Interrupting(RunSubscriber):
    """Ctrl-C after some decisions."""

    def __init__(self, after):
        self.after, self.seen = after, []

    def on_decision(self, decision, rewards):
        self.seen.append(decision.index)
        if decision.index == self.after:
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.slow  # 20 s and more
def test_an_interrupted_run_leaves_no_gap_and_goes_on(toy, tmp_path):
    settings = {**toy, "selector": "ucb1", "robots": 4, "share": "every:2", "episodes": 24, "out": tmp_path / "run"}
    watcher = Interrupting(5)
    cut = osel.run(workers=2, subscribers=[watcher], **settings)
    assert cut.interrupted and watcher.seen == list(range(len(cut.decisions))) and 6 <= len(cut.decisions) <= 14
    osel.run(workers=3, resume=True, **settings)
    osel.run(**{**settings, "out": tmp_path / "whole"})
    assert written(tmp_path / "run") == written(tmp_path / "whole")


def test_workers_without_work_are_refused(toy, tmp_path):
    settings = {**toy, "selector": "ucb1", "out": tmp_path / "run", "workers": 2}
    with pytest.raises(UsageError, match="--workers 2 is for several robots"):
        osel.run(**settings)
    with pytest.raises(UsageError, match="subscriber Watching watches episodes"):
        osel.run(**settings, robots=2, subscribers=[Watching()])
    with pytest.raises(SettingError, match="does not go with --monitor"):
        osel.run(**settings, robots=2, monitor="never")

    class Still:
        def reset(self, instruction):
            pass

        def act(self, observation):
            return np.zeros((4, 2), np.float32)

    with pytest.raises(UsageError, match="policy 'still' is an object of this process"):
        osel.run(**settings, robots=2, policies=["toy_greedy", osel.as_policy(Still(), "still", cameras=["top"], image_size=64, execute=4)])
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["auto", "linucb", "neural_linear", "ppo", "ppo_tuned", "thompson"])
@pytest.mark.parametrize(("share", "delay"), [("every:3", 2), ("every:2", 0), ("all", 0), ("none", 0)])
def test_a_robot_that_is_ahead_decides_as_in_step_with_the_others(name, share, delay):
    robots, rounds, width, policies = 3, 14, 5, ("a", "b")
    settings = {"ppo": {"layers": (8,)}, "ppo_tuned": {"layers": (8,), "n_steps": 4}}.get(name, {})
    chance = np.random.default_rng(3)
    contexts, rewards = chance.normal(size=(rounds, robots, width)).astype(np.float32), chance.normal(size=(rounds, robots, 2))

    def fleet() -> Fleet:
        made = Fleet(lambda robot: make_selector(name, policies, width, robot, **settings), robots, Sharing.parse(share, delay))
        made.begin()
        return made

    def learned(fleet: Fleet, number: int, robot: int, choice: Choice) -> None:
        fleet.update(robot, contexts[number, robot], choice, float(rewards[number, robot, policies.index(choice.policy)]))

    in_step, ahead, chosen, now = fleet(), fleet(), {}, [0] * robots
    for number in range(rounds):
        for robot in range(robots):
            chosen[number, robot] = in_step.select(robot, contexts[number, robot])
            learned(in_step, number, robot, chosen[number, robot])
        in_step.end_round()
    order = np.random.default_rng(4)
    waiting = {}  # robots at work -> what they chose
    while min(now) < rounds:
        can = [robot for robot in range(robots) if robot not in waiting and now[robot] < rounds and ahead.can_decide(robot)]
        if can and (not waiting or order.random() < 0.6):
            robot = int(order.choice(can))
            waiting[robot] = ahead.select(robot, contexts[now[robot], robot])
            assert waiting[robot] == chosen[now[robot], robot]
        else:
            robot = int(order.choice(list(waiting)))
            learned(ahead, now[robot], robot, waiting.pop(robot))
            ahead.end_turn(robot)
            now[robot] += 1
    for one, other in zip(in_step.selectors, ahead.selectors, strict=True):
        then, after = one.state_dict(), other.state_dict()
        assert then.keys() == after.keys() and all(np.array_equal(then[key], after[key]) for key in then)
