"""The verdict: one function, three answers, errors over units, words in the user's units."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from report_helpers import WEIGHTS, made_log, made_run
from synthetic_log import make_row, write_log

from osel_sim.analysis.log import read_log
from osel_sim.analysis.streamed import Streamed
from osel_sim.analysis.units import units_of
from osel_sim.analysis.verdict import FEWEST, Played, advisable, verdict
from osel_sim.analysis.verdict_words import headline, in_units, worth
from osel_sim.api.replay import replay
from osel_sim.cli.replay_tables import print_replay
from osel_sim.formats.replay_result import read_replay
from osel_sim.reporting.log_page import log_page
from osel_sim.reporting.replay_page import ReplayOptions, replay_page
from osel_sim.reporting.run_page import run_page
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.clustered import unit_mean

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))


def played(gain: float, instances: int = 400, seeds: int = 4, base: float = 0.5, knows: float = 1.0, seed: int = 0) -> Played:
    """Two policies, each better on half of the instances by twice the gain; the selector knows which with this probability, else takes the first."""
    generator = np.random.default_rng(seed)
    kind = np.arange(instances) % 2
    rates = base + gain * np.where(kind[:, None] == [0, 1], 1.0, -1.0)
    rewards = (generator.random((instances, 2)) < rates).astype(float)
    order = np.stack([generator.permutation(instances) for _ in range(seeds)]).astype(np.int32)
    chosen = np.where(generator.random(order.shape) < knows, kind[order], 0).astype(np.int16)
    routed = {"groups": rewards[np.arange(instances), kind]}
    return Played(("a", "b"), rewards, np.arange(instances), order, {"auto": chosen}, routed)


def test_three_answers() -> None:
    found = verdict(played(0.3), ["auto"])
    assert found["decision"] == "route" and found["selector"] == "auto" and headline(found) == "Route with auto"
    table = played(0.3)
    always = Played(table.policies, np.stack([np.ones(400), np.zeros(400)], axis=1), table.units, table.order, {"auto": 0 * table.chosen["auto"]}, {})
    found = verdict(always, ["auto"])
    assert found["decision"] == "do_not_route" and found["selector"] is None and headline(found) == "Do not route: always use a"
    assert found["ceiling"] < found["margin"] == 0.02 and found["more"] is None
    assert verdict(always, ["auto"], margin=0.001)["decision"] == "not_enough_data"  # 400 instances do not rule so little out
    found = verdict(played(0.05, instances=60), ["auto"])
    assert found["decision"] == "not_enough_data" and found["more"] > 0
    assert headline(found) == f"Not enough data to tell: about {found['more']:,} more instances would"
    json.dumps(found, allow_nan=False)


def test_what_a_router_gains_is_not_ruled_out_by_a_selector_that_learned_nothing() -> None:
    found = verdict(played(0.2, knows=0.0), ["auto"])
    assert found["test"]["advantages"]["auto"]["high"] < 0.08 < 0.15 < found["ceiling"]
    assert found["decision"] == "not_enough_data"


@pytest.mark.parametrize("instances", [1, 2, FEWEST - 1])
def test_too_few_say_nothing(instances: int) -> None:
    assert verdict(played(0.5, instances), ["auto"])["decision"] == "not_enough_data"
    assert verdict(played(0.5, instances), [])["stake"] is None


def test_about_so_many_more_instances_tell() -> None:
    told = []
    for seed in range(12):
        first = verdict(played(0.04, 100, seed=seed), ["auto"])
        if first["more"] is not None and first["stake"]["gain_late"] > 0.0:
            again = verdict(played(first["stake"]["gain_late"], 100 + first["more"], seed=100 + seed), ["auto"])
            told.append(again["decision"] != "not_enough_data")
    assert len(told) > 4 and np.mean(told) > 0.5


def test_naming_more_selectors_turns_no_verdict() -> None:
    assert advisable(["auto", "ppo", "linucb"], halved=False) == (["auto"], 0.05)
    assert advisable(["auto"], halved=True)[1] == advisable(["auto", "auto:warm", "ppo"], halved=True)[1] == 0.025
    assert advisable(["ppo", "linucb"], halved=False) == (["ppo", "linucb"], 0.025)
    assert advisable(["auto", "ppo"], False, ["ppo"]) == (["ppo"], 0.05)


def test_texts_and_scenes_are_units(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)

    def log(name: str, instances: int, **about):
        rows = [
            make_row(f"{about['key'](row)}", policy, success=bool(generator.random() < 0.5), **about["more"](row))
            for row in range(instances)
            for policy in "ab"
        ]
        return read_log(write_log(tmp_path / name, rows, {f"{about['key'](row)}": np.eye(4)[row % 4] for row in range(instances)}))

    texts = log(
        "texts", 600, key=lambda row: f"q{row}", more=lambda row: {"instruction": f"Question  {row % 60}?" if row % 2 else f"question {row % 60}?"}
    )
    assert len(set(units_of(texts))) == 60
    scenes = log(
        "scenes",
        80,
        key=lambda row: f"made_up/test/{row % 2}/{row // 2}",
        more=lambda row: {"instruction": f"words {row % 3}", "seed": row // 2, "level": row % 2},
    )
    assert len(set(units_of(scenes))) == 40
    same = log("same", 30, key=lambda row: f"i{row}", more=lambda row: {"instruction": "do it"})
    assert len(set(units_of(same))) == 30


def test_rows_of_the_same_text_are_no_more_evidence() -> None:
    one = played(0.1, 60)
    rows = np.repeat(np.arange(60), 10)
    order = np.stack([np.random.default_rng(seed).permutation(600) for seed in range(4)]).astype(np.int32)
    many = Played(one.policies, one.rewards[rows], rows, order, {"auto": (rows % 2)[order].astype(np.int16)}, {})
    found, apart = (verdict(table, ["auto"])["test"] for table in (many, Played(**vars(many) | {"units": np.arange(600)})))
    wide, narrow = (np.subtract(test["advantages"]["auto"]["high"], test["advantages"]["auto"]["low"]) for test in (found, apart))
    assert found["units"] == 60 and found["instances"] == 600
    assert wide > 2.5 * narrow


def test_clusters_are_what_varies() -> None:
    """The error of a mean of values that go together in tens is that of their means; and a value that none has shown is not ruled out."""
    values = np.random.default_rng(0).normal(size=50)
    found = unit_mean(10.0 * values, np.full(50, 10))
    assert found.mean == pytest.approx(values.mean()) and found.error == pytest.approx(values.std(ddof=1) / 50**0.5)
    sure = unit_mean(np.zeros(50), np.ones(50), rare=1.0)
    assert sure.half(0.05) == pytest.approx(3.0 / 50, rel=0.01) and unit_mean([1.0], [1.0]).half(0.05) == np.inf


def test_a_settled_selector_adds_nothing_to_what_it_received() -> None:
    table = played(0.2)
    assert not Streamed.of(table.order, table.chosen["auto"], 2).leaning.any()
    unsure = played(0.2, knows=0.5, seeds=20)
    streamed = Streamed.of(unsure.order, unsure.chosen["auto"], 2)
    assert np.abs(streamed.leaning).max() < 0.3 and streamed.counts.sum() == 400 * 20


def test_units_come_first() -> None:
    mine = {"success_rate": 0.77, "mean_price": 4.24, "mean_seconds": 7.8, "mean_steps": 150.0}
    other = {"success_rate": 0.76, "mean_price": 16.8, "mean_seconds": 8.2, "mean_steps": 160.0}
    assert in_units("Routing with auto", mine, "remote_large", other) == (
        "Routing with auto: 77% success at 4.2 cents and 7.8 s, against 76% at 16.8 cents and 8.2 s for always remote_large."
    )
    cheap = {"success_rate": 0.5, "mean_price": 0.031, "mean_seconds": None, "mean_steps": None}
    assert in_units("x", cheap, "p", cheap) == "x: 50% success at 0.031 cents, against 50% at 0.031 cents for always p."
    assert "nothing but the reward" in in_units("x", {}, "p", {})


@pytest.mark.parametrize(
    ("weights", "said"),
    [
        (RewardWeights(0.2, 0.005), "In this reward a success is worth 200 cents, ten times slower costs 0.2 of a success."),
        (RewardWeights(0.0, 0.0), "In this reward time and price count nothing."),
        (RewardWeights(0.001, 0.0, "steps"), "In this reward 100 steps more cost 0.1 of a success, price counts nothing."),
        (RewardWeights(0.0, 0.01, success="subgoals"), "In this reward a task done is worth 100 cents, time counts nothing."),
    ],
)
def test_what_the_weights_mean(weights: RewardWeights, said: str) -> None:
    assert worth(weights) == said


def test_pages_and_terminal_say_the_same_of_the_same_data(tmp_path: Path, capsys) -> None:
    from rich.console import Console

    log = made_log(tmp_path / "log", 60)
    flags = {"workers": 1, "no_frontier": True, "selectors": ["auto", "linucb"]}
    result = replay(tmp_path / "log", alpha_time=WEIGHTS.alpha_time, alpha_price=WEIGHTS.alpha_price, out=tmp_path / "replay", **flags)
    found = result.result["verdict"]
    of_replay, of_log = replay_page(result.folder, ReplayOptions()).verdict, log_page(log, WEIGHTS).verdict
    assert of_replay.headline == of_log.headline == found["headline"] and result.verdict.startswith(f"{found['headline']}. ")
    assert list(of_replay.sentences) == found["sentences"] and list(of_log.sentences)[:-1] == found["sentences"][:-1]
    assert of_log.sentences[-1].startswith(found["sentences"][-1])
    print_replay(Console(width=300), result.result)
    assert found["text"] in capsys.readouterr().out
    run = made_run(tmp_path / "run")
    of_run, again = run_page(run).verdict, replay(run, out=tmp_path / "again", **flags)
    assert of_run.headline == again.result["verdict"]["headline"]
    assert again.result["verdict"]["sentences"][:-1] == list(of_run.sentences)[1:-1] and "This run's ppo" in of_run.sentences[0]
    old = json.loads((result.folder / "replay.json").read_text())
    old |= {"schema_version": 1, "verdict": {"decision": "do_not_route", "policy": "far<i>", "text": "Do not route: as was said.", "stake": {}}}
    (result.folder / "replay.json").write_text(json.dumps(old))
    assert replay_page(result.folder, ReplayOptions()).verdict.sentences == ["Do not route: as was said."]
    assert read_replay(result.folder)[0]["schema_version"] == 1


@pytest.mark.slow
def test_error_rates_and_coverage() -> None:
    """Seeded, and smaller than `benchmarks/verdict.py`, whose figures docs/statistics.md has."""
    from verdict import coverage, decisions

    held = coverage("gain 0.10", 200, 400, 20)
    assert all(0.91 <= share <= 0.985 for share in held.values()), held
    for nothing in ("equal", "useless"):
        assert decisions(nothing, 40, 400, 10)["route"] <= 0.1
    assert decisions("gain 0.20", 10, 600, 10)["route"] == 1.0
    assert decisions("gain 0.05", 40, 400, 10)["do_not_route"] <= 0.1
