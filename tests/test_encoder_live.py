"""`run --encoder auto`: a live run that finds out which encoder predicts rewards, and goes on with it."""

import json
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import osel_sim as osel
from osel_sim.analysis.live import read_live
from osel_sim.analysis.live_encoder_choice import choose_live, doubly_robust
from osel_sim.api.run_encoder import candidates, check_encoder
from osel_sim.api.run_settings import RunConfig
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError, UsageError
from osel_sim.episodes.changes import PolicyChanges
from osel_sim.episodes.encoder_trial import ASKED_AFTER, EncoderTrial, tell_again
from osel_sim.formats.encoder_checks import CHECKS, EncoderCheck, read_checks, write_checks
from osel_sim.formats.encoder_choice import EncoderChoice
from osel_sim.formats.journal import Decision, read_journal
from osel_sim.interface.outcome import Seconds
from osel_sim.run import main as run_main
from osel_sim.selection.registry import make_selector
from osel_sim.selection.state import load_state

FIRST = ASKED_AFTER[0]
TOTAL = FIRST + 4

PLUGIN = """
from dataclasses import replace

import numpy as np
from toy_suite import COLOURS, Toy


class Riddle(Toy):
    # Only a number is named; which goal it stands for neither the text nor the picture says.
    def instance(self, task, seed, level, split, axes):
        instance = super().instance(task, seed, level, split, axes)
        number = instance.simulator_seed % 100_000
        return replace(instance, instruction=f"go to number {number}", target=answer(number))


def answer(number):
    return ("red", "blue")[int(np.random.default_rng(number).integers(2))]


class Solves:
    # It knows what the numbers stand for.
    name, identity, dimension, image_size = "solves", "solves@1", 2, 16

    def encode(self, images, instruction):
        red = answer(int(instruction.split()[-1])) == "red"
        return np.array([red, not red], np.float32)


class Only:
    def __init__(self, colour):
        self.rgb = COLOURS[colour]

    def reset(self, instruction):
        pass

    def act(self, observation):
        picture, point = observation["observation.images.top"].astype(int), observation["observation.state"]
        found = np.argwhere(np.abs(picture - self.rgb).sum(axis=2) < 90)
        place = found.mean(axis=0)[::-1] / (len(picture) - 1) if len(found) else point
        return np.tile(np.clip((place - point) / 0.2, -1.0, 1.0), (4, 1)).astype(np.float32)


def load_red(spec, environment):
    return lambda: Only("red")


def load_blue(spec, environment):
    return lambda: Only("blue")
"""
POINTS = """[osel_sim.suites]
toy = riddle:Riddle
[osel_sim.policies]
only_red = riddle:load_red
only_blue = riddle:load_blue
[osel_sim.encoders]
solves = riddle:Solves
"""
POLICY = """version = 1
name = "{name}"
title = "test"
location = "local"
kind = "only_{name}"
execute = 4
inference_seconds = 0.01

[observation]
cameras = ["top"]
image_size = 64
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A suite whose instructions only one encoder understands, and two policies, each of which goes to one of the two goals."""
    folder = tmp_path_factory.mktemp("riddles")
    plugin, info = folder / "plugin", folder / "plugin" / "riddles-1.0.dist-info"
    info.mkdir(parents=True)
    shutil.copy(Path(__file__).parent / "toy_suite" / "toy_suite.py", plugin)
    (plugin / "riddle.py").write_text(PLUGIN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: riddles\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    (folder / "policies").mkdir()
    for name in ("red", "blue"):
        (folder / "policies" / f"{name}.toml").write_text(POLICY.format(name=name))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(plugin))
        yield folder


@pytest.fixture(scope="module")
def whole(world):
    """A run that went on with the encoder that solves the riddles."""
    settings = {"task": ["toy:reach"], "policies_dir": world / "policies", "selector": "linucb", "encoder": "auto"}
    return osel.run(**settings, episodes=TOTAL, out=world / "whole")


def bytes_of(folder: Path) -> dict[str, bytes]:
    """What must not depend on how a run went."""
    run = json.loads((folder / "run.json").read_text())["configuration"]
    files = {name: (folder / name).read_bytes() for name in ("episodes.jsonl", "contexts.npz", CHECKS)}
    # The header of a tensor file has its keys in any order.
    return files | {"run.json": json.dumps(run).encode(), "selector": repr(sorted(load_state(folder / "selector.safetensors").items())).encode()}


def test_a_run_goes_on_with_the_encoder_that_tells_groups_apart(whole):
    [check] = read_checks(whole.folder)
    assert check.before == FIRST and check.final and check.choice.encoder == "solves@1"
    usual = check.choice.usual
    assert usual.startswith("osel_small@") and check.choice.gains["solves@1"][0] > 0.1 > check.choice.gains[usual][0]
    assert whole.summary["encoder"] == {"identity": "solves@1", "text": check.words} and "osel_small@" in check.words
    configuration = json.loads((whole.folder / "run.json").read_text())["configuration"]
    assert configuration["encoder"] == "solves@1" and configuration["encoders"] == candidates()
    later = [decision for decision in read_journal(whole.folder / "episodes.jsonl")[FIRST:]]
    assert all(decision.success for decision in later)  # it was told of all decisions before


def test_its_log_has_contexts_of_that_encoder_throughout(whole, tmp_path):
    live = read_live(whole.folder)
    assert live.outcomes.encoder == "solves@1" and live.outcomes.contexts.shape == (TOTAL, 2)
    cache = ContextCache(whole.folder)
    known = [sum(cache.get(encoder, key) is not None for key in live.outcomes.keys) for encoder in cache.encoders()]
    assert sorted(known) == [FIRST] * (len(candidates()) - 1) + [TOTAL]
    assert osel.replay(whole.folder, out=tmp_path).off_policy["run"]["decisions"] == TOTAL


def test_the_page_says_which_and_why(whole):
    page = (whole.folder / "report.html").read_text()
    assert "from decision 60 on encoder solves@1".capitalize()[:20] in page
    rows = (whole.folder / "tables" / "encoders.csv").read_text().splitlines()
    assert len(rows) == 1 + len(candidates()) and sum(row.endswith("yes") for row in rows) == 1


@pytest.mark.parametrize(("decisions", "noted", "named"), [(FIRST - 1, False, False), (FIRST, False, False), (FIRST + 2, True, False)])
def test_killed_and_resumed_gives_the_same_bytes(whole, tmp_path, decisions, noted, named):
    folder = tmp_path / "killed"
    shutil.copytree(whole.folder, folder)
    for name in ("summary.json", "selector.safetensors", "timing.jsonl", *(() if noted else (CHECKS,))):
        (folder / name).unlink()
    journal = folder / "episodes.jsonl"
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:decisions]) + b'{"torn": ')
    if not named:
        run = json.loads((folder / "run.json").read_text())
        run["configuration"]["encoder"] = read_checks(whole.folder)[0].choice.usual
        (folder / "run.json").write_text(json.dumps(run))
    osel.run(out=folder, resume=True, no_page=True)
    assert bytes_of(folder) == bytes_of(whole.folder)


def test_a_run_that_has_not_asked_yet_says_when_it_will(world, tmp_path, capsys):
    flags = ["--task", "toy:reach", "--policies-dir", world / "policies", "--selector", "thompson", "--encoder", "auto", "--episodes", 2, "--no-page"]
    assert run_main([*map(str, flags), "--out", str(tmp_path / "run")]) == 0
    assert f"is asked after {FIRST} decisions" in capsys.readouterr().out
    assert not (tmp_path / "run" / CHECKS).exists() and read_live(tmp_path / "run").outcomes.encoder.startswith("osel_small@")
    assert run_main(["--out", str(tmp_path / "run"), "--resume", "--encoder", "osel_small"]) == 2
    assert "encoders was" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "flag"),
    [
        ({"warm_start": Path(__file__).parent}, "--warm-start"),
        ({"monitor": "stall"}, "--monitor"),
        ({"robots": 2}, "--robots"),
        ({"budget_cents": 5.0}, "--budget-cents"),
    ],
)
def test_what_goes_with_one_encoder_only_is_refused(given, flag):
    with pytest.raises(UsageError, match=f"does not go with {flag}.* name"):
        check_encoder(RunConfig.of(task=["pick_place"], encoder="auto", **given))
    check_encoder(RunConfig.of(task=["pick_place"], encoder="osel_suite", **given))


def made_up(decisions: int, chance: np.random.Generator, error: float = 0.0) -> tuple[list[Decision], np.ndarray]:
    """Decisions of a selector that prefers the first policy more and more, on two groups, each of which one of two policies is good at."""
    groups, found = chance.integers(2, size=decisions), []
    for index, group in enumerate(groups.tolist()):
        first = 0.5 + 0.45 * index / decisions
        policy = "ab"[int(chance.random() >= first)]
        success = bool(chance.random() < (0.9 if "ab"[group] == policy else 0.3))
        about = ("t", index, 0, None, "test", "do it", "plain", "", "", policy, {"a": first, "b": 1.0 - first})
        failed = "broken" if chance.random() < error else None
        reward = None if failed else float(success)
        found.append(Decision(index, *about, success, 0.0, 1, Seconds(0.0, 0.0, 0.0, 0.0), 1, 1, 0.0, reward, None, failed))
    return found, groups


def tables(groups: np.ndarray, chance: np.random.Generator) -> dict[str, np.ndarray]:
    """Contexts of an encoder that is noise and of one that tells the groups apart."""
    noise = chance.normal(size=(len(groups), 16)).astype(np.float32)
    return {"noise": noise, "groups": np.eye(16, dtype=np.float32)[groups] + 0.1 * chance.normal(size=(len(groups), 16)).astype(np.float32)}


def test_rewards_of_all_policies_are_estimated_without_bias():
    chance = np.random.default_rng(0)
    decisions, groups = made_up(20_000, chance)
    told = doubly_robust(decisions, ["a", "b"])
    for group in (0, 1):
        assert told[groups == group].mean(axis=0) == pytest.approx([0.9, 0.3] if group == 0 else [0.3, 0.9], abs=0.04)


def test_the_encoder_that_tells_groups_apart_is_found_among_few_decisions():
    found = []
    for seed in range(10):
        chance = np.random.default_rng(seed)
        decisions, groups = made_up(240, chance, error=0.05)
        found.append(choose_live(decisions, ["a", "b"], tables(groups, chance)).encoder)
    assert found.count("groups") >= 8


def test_where_no_encoder_tells_anything_the_usual_one_stays():
    stays = 0
    for seed in range(20):
        chance = np.random.default_rng(seed)
        decisions, groups = made_up(120, chance)
        contexts = {"usual": tables(groups, chance)["noise"], "other": tables(groups, chance)["noise"]}
        stays += choose_live(decisions, ["a", "b"], contexts).encoder == "usual"
    assert stays >= 17


def test_too_little_to_learn_from_changes_nothing():
    chance = np.random.default_rng(0)
    for count in (0, 1, 3, 20):
        decisions, groups = made_up(count, chance, error=0.3)
        choice = choose_live(decisions, ["a", "b"], tables(groups, chance))
        assert choice.encoder == "noise" and all(gain == (0.0, 0.0) for gain in choice.gains.values())


class Named:
    """An encoder that nobody asks to encode anything."""

    dimension, image_size = 1, 16

    def __init__(self, identity):
        self.name = self.identity = identity


def test_it_is_asked_again_until_another_is_found_and_then_no_more(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps({"schema_version": 1, "configuration": {"encoder": "usual"}}))
    asked = []

    def judge(decisions, policies, contexts):
        asked.append(len(decisions))
        return EncoderChoice("other" if len(decisions) >= 8 else "usual", len(decisions), {"usual": (0.0, 0.0), "other": (0.5, 0.1)})

    encoders = [Named("usual"), Named("other")]

    def go(until):
        trial, now = EncoderTrial(tmp_path, encoders, judge, lambda encoder: None, asked_after=(4, 8, 16)), encoders[0]
        for count in range(1, until):
            if trial.due(count):
                now = trial.ask([None] * count, ["a"], lambda encoder, count=count: np.zeros((count, 1), np.float32))
        return trial, now

    trial, now = go(6)
    assert asked == [4] and now is encoders[0] and trial.tried == (encoders[1],) and "asked again" in trial.words
    trial, now = go(20)
    assert asked == [4, 8] and now is encoders[1] and not trial.tried and read_checks(tmp_path) == tuple(trial.checks)
    assert json.loads((tmp_path / "run.json").read_text())["configuration"]["encoder"] == "other"
    assert go(20)[1] is encoders[1] and asked == [4, 8]
    encoders[1] = Named("another")
    with pytest.raises(DataError, match="'other', which is none of usual, another"):
        go(20)


@pytest.mark.parametrize("name", ["auto", "linucb", "linucb_discounted", "thompson", "epsilon_greedy", "ppo", "ppo_tuned", "neural_linear"])
def test_a_selector_that_is_told_again_knows_what_it_was_told(name):
    chance = np.random.default_rng(0)
    decisions, groups = made_up(200, chance, error=0.05)
    contexts = list(np.eye(4, dtype=np.float32)[groups])
    selector, fresh = (make_selector(name, ["a", "b"], 4, seed, **({"layers": (16,)} if name == "ppo" else {})) for seed in (1, 1))

    def learn(context, choice, decision):
        assert choice.propensities == decision.propensities
        if decision.reward is not None:
            selector.update(context, choice, decision.reward)

    tell_again(selector, PolicyChanges(), decisions, contexts, learn)
    before, after = (one.select(contexts[0]).propensities["ab"[groups[0]]] for one in (fresh, selector))
    assert after > before if name in ("auto", "linucb", "linucb_discounted", "neural_linear") else after != before


def test_what_ppo_recalls_of_its_own_choice_is_what_it_chose():
    for name in ("ppo", "ppo_tuned"):
        selector = make_selector(name, ["a", "b", "c"], 4, 0)
        context = np.array([1.0, 0.0, 0.5, 0.0], np.float32)
        choice = selector.select(context)
        again = selector.recall(context, choice.policy, choice.propensities)
        assert again.policy == choice.policy and again.details == pytest.approx(choice.details)


def make_checks(folder: Path) -> list[EncoderCheck]:
    folder.mkdir(exist_ok=True)
    (folder / "run.json").write_text(json.dumps({"schema_version": 1, "configuration": {"encoder": "a@1"}}))
    gains = {"a@1": (0.0125, 0.02), "b@2": (0.1, 0.03)}
    checks = [EncoderCheck(60, EncoderChoice("a@1", 58, gains), False), EncoderCheck(120, EncoderChoice("b@2", 117, gains), True)]
    write_checks(folder, checks)
    return checks


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda lines: [lines[0].replace("0.02]", "0.03]"), lines[1]], "line 1: is not what was written"),
        (lambda lines: [lines[0].replace("0.02]", "-0.02]"), lines[1]], "line 1: not a choice of an encoder .gains must be"),
        (lambda lines: [lines[0].replace('"final": false', '"final": 0'), lines[1]], "line 1: not a choice of an encoder .final must be"),
        (lambda lines: [lines[1], lines[0]], "line 2: before must be above 120"),
        (lambda lines: [lines[0], lines[1][:-9]], "cut off"),
        (lambda lines: ["[]\n", *lines], "line 1: expected an object"),
    ],
)
def test_a_damaged_file_of_choices_is_refused(tmp_path, damage, complaint):
    assert list(read_checks(tmp_path)) == [] and list(make_checks(tmp_path)) == list(read_checks(tmp_path))
    file = tmp_path / CHECKS
    file.write_text("".join(damage(file.read_text().splitlines(keepends=True))))
    with pytest.raises(DataError, match=complaint):
        read_checks(tmp_path)


def test_no_bit_of_it_can_flip_unseen(tmp_path):
    make_checks(tmp_path)
    file, chance = tmp_path / CHECKS, random.Random(0)
    raw = file.read_bytes()
    for _ in range(200):
        place = chance.randrange(len(raw))
        for other in (bytes([raw[place] ^ 1 << chance.randrange(8)]), b"\n"):
            file.write_bytes(damaged := raw[:place] + other + raw[place + 1 :])
            if damaged != raw:
                with pytest.raises(DataError, match=re.escape(str(file))):
                    read_checks(tmp_path)
