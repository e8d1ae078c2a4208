"""Warnings that a policy succeeds less than it did: false alarms, how soon a change is told, and what a live run makes of it."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from run_helpers import PLUGIN

import osel_sim as osel
from osel_sim.core.errors import DataError
from osel_sim.episodes.run_subscribers import RunSubscriber
from osel_sim.episodes.warnings import Watch
from osel_sim.formats.journal import Decision, read_journal
from osel_sim.formats.policy_file import Price
from osel_sim.formats.run_warnings import RunWarning, read_warnings, write_warnings
from osel_sim.interface.outcome import Seconds
from osel_sim.reporting.warnings_section import warnings_section
from osel_sim.statistics.change import MOST, RATE, FallDetector

TOY = Path(__file__).parent / "toy_suite"
ALARM = math.log(1.0 / RATE)


def watched(rates, after=None, change: int = 10**9, outcomes: int = 150, streams: int = 1000, tilt: float = 0.0, seed: int = 0):
    """What all bets are worth after each outcome, (outcomes, streams), as logarithms, and the detector. `tilt` sends ever more to the last strata."""
    chance = np.random.default_rng(seed)
    rates, detector, found = np.array(rates), FallDetector(len(rates), streams), []
    for at in range(outcomes):
        shares = np.linspace(1.0 - tilt * at / outcomes, 1.0 + tilt * at / outcomes, len(rates))
        strata = chance.choice(len(rates), size=streams, p=shares / shares.sum())
        now = rates if at < change else np.array(after)
        found.append(detector.see(strata, chance.random(streams) < now[strata]))
    return np.array(found), detector


@pytest.mark.parametrize(("rates", "tilt"), [([0.5], 0.0), ([0.05], 0.0), ([0.97], 0.0), ([0.9, 0.5, 0.1], 0.9), ([0.5] * 6, 0.0)], ids=str)
def test_false_alarms_of_1000_unchanged_streams_are_as_rare_as_is_said(rates, tilt):
    worth, _ = watched(rates, tilt=tilt)
    outcomes, streams = worth.shape
    highest = worth.max(axis=0)
    # Of so many outcomes a share of outcomes * rate of the streams may be alarmed; at a rate at which that is 1%, ten of them on average.
    assert (highest > math.log(outcomes / 0.01)).sum() <= 10 + 3 * math.sqrt(10)
    assert (highest > ALARM).sum() <= 1 + 3 * math.sqrt(streams * outcomes * RATE)
    assert np.exp(worth[-1]).mean() < 3.0 * outcomes  # all bets together are worth what was staked


@pytest.mark.parametrize(
    ("before", "after"), [([0.78], [0.51]), ([0.9, 0.8, 0.7, 0.75, 0.75], [0.63, 0.5, 0.4, 0.5, 0.5])], ids=["one", "five strata"]
)
def test_a_fall_from_78_to_51_percent_is_told_soon(before, after):
    worth, detector = watched(before, after, change=200, outcomes=420, streams=20)
    assert (worth[:200] < ALARM).all()
    alarmed = worth[200:] > ALARM
    told = alarmed.any(axis=0)
    assert told.mean() >= 0.9
    assert np.median(alarmed.argmax(axis=0)[told]) < 90
    falls = [detector.likeliest(stream) for stream in np.flatnonzero(told)]
    assert np.median([fall.since for fall in falls]) == pytest.approx(200, abs=15)
    assert np.median([fall.before for fall in falls]) == pytest.approx(0.78, abs=0.04)
    assert np.median([fall.after for fall in falls]) == pytest.approx(0.51, abs=0.05)


def test_a_rise_is_no_fall_and_bets_are_given_up_beyond_so_many():
    worth, _ = watched([0.3], [0.9], change=100, outcomes=250, streams=5)
    assert (worth < ALARM).all()
    _, detector = watched([0.5], outcomes=4 * MOST + 40, streams=2)
    assert detector._logs.shape[1] == MOST


def decision(index: int, policy: str = "remote", success: bool = True, **values) -> Decision:
    about = {
        "task": "lift",
        "seed": index,
        "level": 0,
        "axes": None,
        "split": "test",
        "instruction": "do it",
        "phrasing": "p-0",
        "target": "",
        "container": "",
    }
    came = {"success": success, "subgoals": float(success), "steps": 20, "seconds": Seconds(), "calls": 2, "actions": 16, "price": 2.0, "reward": 1.0}
    plain = {"index": index, "policy": policy, "propensities": {policy: 1.0}, "fallback": None, "error": None}
    return Decision(**{**about, **came, **plain, **values})


def test_policies_are_watched_apart_and_a_second_fall_is_told_too():
    chance, watch, told = np.random.default_rng(1), Watch({}, [("lift", 0)]), []
    for index in range(1200):
        policy = "remote" if index % 2 else "local"
        rate = 0.7 if policy == "local" else 0.95 if index < 400 else 0.5 if index < 800 else 0.1
        told += watch.see(decision(index, policy, bool(chance.random() < rate)))
        told += watch.see(decision(index, policy, error="crash", reward=None))  # is nobody's failure
    assert [(warning.policy, warning.kind) for warning in told] == [("remote", "success")] * 2
    assert abs(told[0].since - 400) < 40 and abs(told[1].since - 800) < 40
    assert told[0].sentence == f"remote succeeds less than it did: {told[0].before:.2f} -> {told[0].after:.2f} since decision {told[0].since}"


def test_a_price_that_is_not_the_declared_one_is_told_once():
    watch = Watch({"remote": Price(per_call=0.5, per_action=0.0625)}, [("lift", 0)])
    assert watch.see(decision(0)) == []
    [warning] = watch.see(decision(1, price=4.0))
    assert warning.sentence == "remote costs another price than its file says: 4 cents instead of 2 in decision 1"
    assert watch.see(decision(2, price=4.0)) == []
    assert watch.see(decision(3, price=2.0)) == []  # as declared again
    assert len(watch.see(decision(4, price=6.0))) == 1
    assert watch.see(decision(5, price=9.0, fallback="outage")) == []  # the fallback's is in it
    free = Watch({"remote": Price()}, [("lift", 0)])
    assert len(free.see(decision(0, price=1.0))) == 1


@pytest.mark.parametrize("damage", [{"kind": "smell"}, {"since": -1}, {"after": None}, {"more": 1}])
def test_damaged_warnings_are_refused(tmp_path, damage):
    write_warnings(tmp_path, [RunWarning(7, "success", "remote", 3, 0.8, 0.5)])
    assert read_warnings(tmp_path)[0].since == 3
    line = json.loads((tmp_path / "warnings.jsonl").read_text())
    (tmp_path / "warnings.jsonl").write_text(json.dumps(line | damage) + "\n")
    with pytest.raises(DataError, match=r"warnings\.jsonl, line 1: "):
        read_warnings(tmp_path)


class Worsens:
    """Goes straight to the goal, and from its `last` episode on nowhere."""

    def __init__(self, last: int) -> None:
        self.left = last

    def reset(self, instruction):
        self.left -= 1
        self.channel = ("red", "green", "blue").index(next(word for word in instruction.split() if word in ("red", "green", "blue")))

    def act(self, observation):
        picture = np.asarray(observation["observation.images.top"]).astype(int)
        others = [channel for channel in range(3) if channel != self.channel]
        y, x = np.nonzero(picture[..., self.channel] - picture[..., others].max(axis=-1) > 60)
        way = np.array([x.mean(), y.mean()]) / (len(picture) - 1) - observation["observation.state"][:2]
        return np.zeros((1, 2), np.float32) if self.left < 0 else np.clip(way / 0.05, -1, 1).astype(np.float32)[None]


class Heard(RunSubscriber):
    def __init__(self):
        self.warnings = []

    def on_warning(self, warning):
        self.warnings.append(warning)


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """The toy suite and an encoder, as if installed."""
    site = tmp_path / "site"
    (site / "toys-1.0.dist-info").mkdir(parents=True)
    shutil.copy(TOY / "toy_suite.py", site)
    (site / "wander_policies.py").write_text(PLUGIN)
    (site / "toys-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-suite\nVersion: 1.0\n")
    entries = "[osel_sim.suites]\ntoy = toy_suite:Toy\n[osel_sim.encoders]\ncolours = wander_policies:Colours\n"
    (site / "toys-1.0.dist-info" / "entry_points.txt").write_text(entries)
    monkeypatch.syspath_prepend(str(site))


def test_a_live_run_warns_and_a_resumed_one_writes_the_same_bytes(toy, tmp_path, caplog):
    common = {"task": "toy:reach", "selector": "fixed:worsens", "encoder": "colours", "no_page": True}
    heard, whole, cut = Heard(), tmp_path / "whole", tmp_path / "cut"
    osel.run(policies=[Worsens(50)], episodes=75, out=whole, subscribers=[heard], **common)
    [warning] = heard.warnings
    assert warning.kind == "success" and warning.policy == "worsens"
    assert 44 <= warning.since <= 50 < warning.index < 70
    assert warning.sentence in caplog.text
    assert read_warnings(whole) == [warning]
    [section] = warnings_section(whole)
    assert warning.sentence in section.blocks[0]
    kept = warning.index + 2  # it is resumed after the warning, and says it again to nobody but the file
    osel.run(policies=[Worsens(50)], episodes=kept, out=cut, **common)
    (cut / "warnings.jsonl").unlink()
    again = Heard()
    osel.run(policies=[Worsens(50 - kept)], episodes=75, out=cut, resume=True, subscribers=[again], **common)
    assert again.warnings == []
    for name in ("episodes.jsonl", "warnings.jsonl"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes()
    assert len(read_journal(cut / "episodes.jsonl")) == 75
