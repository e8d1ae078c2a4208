"""Several robots in a replay and in a live run."""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic_log import clusters

import osel_sim as osel
from osel_sim.api.run_settings import RunConfig
from osel_sim.cli.console import SafeConsole
from osel_sim.cli.sharing_table import print_sharing
from osel_sim.core.errors import DataError, UsageError
from osel_sim.episodes.drivers import Drivers, choose_policies
from osel_sim.episodes.live import LiveOptions, LiveRun
from osel_sim.formats.journal import JOURNAL, read_journal
from osel_sim.interface.selector import Choice
from osel_sim.selection.dealing import deal, groups
from osel_sim.selection.fleet import Fleet, InTurn, Sharing, members
from osel_sim.selection.registry import make_selector
from osel_sim.selection.reward import RewardWeights
from osel_sim.selection.state import load_state, save_state
from osel_sim.suites.registry import select_tasks

TOY = Path(__file__).parent / "toy_suite"
FREE = {"alpha_time": 0, "alpha_price": 0, "no_frontier": True}


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return clusters(tmp_path_factory.mktemp("log"), instances=240, clusters=3, dim=6, policies=3, seed=2).folder


def test_what_sharing_is_worth_does_not_depend_on_workers_and_is_shown(log, tmp_path):
    settings = {"selectors": ["linucb", "thompson"], "seeds": 2, "decisions": 60, "robots": 4, "share": "every:5", **FREE}
    results = [osel.replay(log, workers=workers, out=tmp_path / str(workers), **settings).result for workers in (1, 2)]
    assert (tmp_path / "1" / "replay.json").read_bytes() == (tmp_path / "2" / "replay.json").read_bytes()
    sharing = results[0]["sharing"]
    assert (sharing["robots"], sharing["share"], sharing["decisions"], sharing["by"], sharing["delay"]) == (4, "every:5", 15, None, 0)
    entry = sharing["selectors"]["thompson"]
    assert list(entry["ways"]) == ["none", "every:5", "all"]
    assert entry["message_bytes"] == 16 * 3 + 8
    assert entry["gain"] == pytest.approx(entry["ways"]["all"]["mean_reward"] - entry["ways"]["none"]["mean_reward"])
    assert len(entry["ways"]["all"]["curve"]) == len(sharing["at"]) == 15
    assert sharing["selectors"]["linucb"]["message_bytes"] == 5 * (4 * 6 + 8 + 16)
    console = SafeConsole(width=200, record=True)
    print_sharing(console, sharing)
    assert "4 robots, 15 decisions each, dealt out in turn" in console.export_text()
    page = osel.report(tmp_path / "1").page.read_text()
    assert "Robots that share" in page and "closed by sharing" in page


def test_without_robots_a_replay_is_as_it_was(log, tmp_path):
    result = osel.replay(log, selectors=["ucb1"], seeds=1, decisions=20, workers=1, out=tmp_path / "one", **FREE).result
    assert "sharing" not in result


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"robots": 4, "selectors": ["auto", "vw_regcb"]}, "vw_regcb"),
        ({"robots": 4, "selectors": ["random"]}, "name a selector that learns"),
        ({"robots": 4, "share": "every:0"}, "--share must be none, all, or every:N"),
        ({"robots": 2, "selectors": ["ucb1"], "join": ["policy_1@9"]}, "--robots is for streams that do not change"),
        ({"robots": 2, "selectors": ["ucb1"], "budget_cents": 9}, "is for one robot"),
        ({"share": "every:20"}, "--share is for several robots; say how many with --robots"),
        ({"share_delay": 3}, "--share-delay is for several robots"),
        ({"robots_by": "task"}, "--robots-by is for several robots"),
        ({"robots": 4, "share": "none", "share_delay": 3}, "--share-delay 3 is for --share every:N"),
        ({"robots": 6, "robots_by": "task", "selectors": ["ucb1"]}, "--robots 6 --robots-by task: there are only"),
        ({"robots": 2, "robots_by": "level", "selectors": ["ucb1"]}, r"--robots 2 --robots-by level: there is only 1 \(0\)"),
        ({"robots": 2, "robots_by": "robot", "selectors": ["ucb1"]}, r"there is only 1 \(unknown\)"),
        ({"robots": 30, "selectors": ["ucb1"], "decisions": 20}, "--robots 30: a stream of 20 instances leaves a robot without any"),
    ],
)
def test_what_cannot_be_is_refused(log, tmp_path, settings, message):
    with pytest.raises(UsageError, match=message):
        osel.replay(log, out=tmp_path / "out", **{"seeds": 1, "workers": 1, "decisions": 40, **FREE, **settings})


def test_instances_are_dealt_out_or_by_what_they_differ_in():
    order = np.array([5, 3, 1, 0, 2, 4, 6], np.int32)
    assert deal(None, order, 3).tolist() == [[0, 1, 2], [3, 4, 5]]
    owners = np.array([0, 1, 0, 1, 0, 1, 0])
    assert deal(owners, order, 2).tolist() == [[3, 0], [4, 1], [5, 2]]
    assert groups(["b", "c", "a"], 2, "task") == {"a": 0, "b": 1, "c": 0}


class Colour:
    """An encoder: the mean colour, and whether the goal is red."""

    name = identity = "colour"
    dimension, image_size = 4, 16

    def encode(self, images, instruction):
        return np.array([*np.mean(images, axis=(0, 1, 2)) / 255, "red" in instruction], np.float32)


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """The toy suite as it is when it is installed, and its policy that needs no server."""
    info = tmp_path / "site" / "toy_suite-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-suite\nVersion: 1.0\n")
    points = "[osel_sim.suites]\ntoy = toy_suite:Toy\n[osel_sim.policies]\ntoy_greedy = toy_policies:load_greedy\n"
    points += "[osel_sim.encoders]\ncolour = test_fleet:Colour\n"
    (info / "entry_points.txt").write_text(points)
    for folder in (TOY, info.parent):
        monkeypatch.syspath_prepend(str(folder))
    return select_tasks(["toy:all"])


class Still:
    """A policy that stays where it is."""

    def reset(self, instruction):
        pass

    def act(self, observation):
        return np.zeros((4, 2), np.float32)


def _live(folder, tasks, share="every:2", delay=1, by=None, robots=2):
    folder.mkdir(exist_ok=True)
    specification = tasks[0].specification
    objects = {"still": osel.as_policy(Still(), "still", cameras=["top"], image_size=64, execute=4)}
    specs = choose_policies(["toy_greedy", "still"], specification, TOY / "policies", objects)
    fleet = Fleet(lambda robot: make_selector("linucb", ["toy_greedy", "still"], 4, robot), robots, Sharing.parse(share, delay))
    options = LiveOptions(0, RewardWeights(0.0, 0.0), robots=robots, robots_by=by)
    return LiveRun(folder, tasks, Colour(), Drivers(specs, specification, objects), InTurn(fleet), options)


def test_a_live_run_of_several_robots_that_was_cut_off_comes_back_to_the_same_bytes(toy, tmp_path):
    whole, cut = _live(tmp_path / "whole", toy), _live(tmp_path / "cut", toy)
    whole.run(16)
    cut.run(7)  # in the middle of a round, with a message under way
    again = _live(tmp_path / "cut", toy)
    again.replay()
    again.run(16)
    assert (tmp_path / "cut" / JOURNAL).read_bytes() == (tmp_path / "whole" / JOURNAL).read_bytes()
    states = [live.selector.state_dict() for live in (whole, again)]
    assert states[0].keys() == states[1].keys()
    assert all(np.array_equal(states[0][key], states[1][key]) for key in states[0])
    save_state(states[0], tmp_path / "state.safetensors")
    assert load_state(tmp_path / "state.safetensors")["robots"] == 2
    # It is another run with other sharing: what it chose does not fit.
    with pytest.raises(DataError, match="this selector now chooses"):
        _live(tmp_path / "cut", toy, share="none", delay=0).replay()


def test_robots_of_a_live_run_have_their_own_tasks(toy, tmp_path):
    live = _live(tmp_path / "run", toy, by="task")
    live.run(8)
    tasks = [decision.task for decision in read_journal(tmp_path / "run" / JOURNAL)]
    assert tasks == ["toy:hurry", "toy:reach"] * 4
    assert len(members(live.selector)) == 2


class Alternating:
    """A selector of one's own: it chooses and learns, and knows nothing of states, prices or other robots."""

    def __init__(self, names, length, number):
        self.policies, self.learned = tuple(names), 0

    def select(self, context):
        chosen = self.policies[self.learned % len(self.policies)]
        return Choice(chosen, {name: float(name == chosen) for name in self.policies})

    def update(self, context, choice, reward):
        self.learned += 1


@pytest.mark.parametrize("settings", [{}, {"robots": 2, "share": "all"}, {"robots": 2, "share": "none"}, {"budget_cents": 5}])
def test_a_selector_of_ones_own_runs_alone_on_several_robots_and_within_a_budget(toy, tmp_path, settings):
    common = {"task": "toy:reach", "policies": ["toy_greedy", osel.as_policy(Still(), "still", cameras=["top"], image_size=64, execute=4)]}
    common |= {"policies_dir": TOY / "policies", "encoder": "colour", "no_page": True, "episodes": 4, "selector": Alternating}
    found = osel.run(out=tmp_path / "run", **common, **settings)
    assert len(found.decisions) == 4 and found.summary["decisions"] == 4
    with pytest.raises(UsageError, match="Alternating cannot share"):
        osel.run(out=tmp_path / "shared", robots=2, **common)
    assert not (tmp_path / "shared").exists()


def test_settings_of_several_robots_are_said_in_the_configuration():
    from osel_sim.api.robots import fleet_said, sharing_asked

    config = RunConfig.of(task="lift", robots=3, share="every:7", share_delay=2, robots_by="level")
    assert fleet_said(config, sharing_asked(config)) == {"fleet": {"robots": 3, "share": "every:7", "delay": 2, "by": "level"}}
    assert fleet_said(RunConfig.of(task="lift"), None) == {}
    assert json.loads(json.dumps(RunConfig.of(task="lift", robots=2).to_json()))["robots"] == 2
