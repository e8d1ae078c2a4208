"""Streams that change: policies that join and leave, prices and policies that drift, and what selectors make of it."""

import json

import numpy as np
import pytest
from synthetic_log import clusters, make_row, write_log

import osel_sim
from osel_sim.analysis.changing_replay import NOBODY, ChangingLog, Piece, play, replay_changing
from osel_sim.analysis.changing_result import _until
from osel_sim.analysis.engine import Setup
from osel_sim.analysis.log import read_log
from osel_sim.analysis.stream_changes import timeline
from osel_sim.core.errors import SettingError, UnknownNameError, UsageError
from osel_sim.formats.replay_result import read_replay
from osel_sim.interface.selector import Choice
from osel_sim.replay import main
from osel_sim.reporting.changing_page import _arrived
from osel_sim.selection.registry import make_selector
from osel_sim.selection.reward import RewardWeights

POLICIES = ("cheap", "dear", "other")
WEIGHTS = RewardWeights(0.0, 0.1)
DECISIONS = 90


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """`dear` succeeds everywhere at 1 cent, `cheap` in a quarter of the instances and `other` never, for nothing."""
    generator = np.random.default_rng(0)
    rows, contexts = [], {}
    for index in range(DECISIONS):
        key = f"made_up/{index}"
        contexts[key] = generator.normal(size=6)
        for policy, success, price in (("cheap", index % 4 == 0, 0.0), ("dear", True, 1.0), ("other", False, 0.0)):
            rows += [make_row(key, policy, repeat, success, price=price) for repeat in range(2)]
    return write_log(tmp_path_factory.mktemp("log") / "log", rows, contexts)


def material(log, join=(), leave=(), drift=(), seeds=2):
    found = read_log(log)
    return ChangingLog.of(found, Setup(WEIGHTS), timeline(join, leave, drift, found.policies, DECISIONS), range(seeds))


def test_a_timeline_says_what_is_there_when():
    line = timeline(["dear@30"], ["dear@60", "cheap@60"], ["price:dear:x2@40", "cheap=other@40", "cheap=cheap@60"], POLICIES, DECISIONS)
    assert [(span.start, span.stop) for span in line.spans] == [(0, 30), (30, 40), (40, 60), (60, 90)]
    assert [span.columns.tolist() for span in line.spans] == [[0, 2], [0, 1, 2], [0, 1, 2], [2]]
    assert [span.source.tolist() for span in line.spans] == [[0, 1, 2], [0, 1, 2], [2, 1, 2], [0, 1, 2]]
    assert [span.factor[1] for span in line.spans] == [1.0, 1.0, 2.0, 2.0]
    back = timeline(["dear@60"], ["dear@30"], [], POLICIES, DECISIONS)
    assert [span.available[1] for span in back.spans] == [True, False, True]


@pytest.mark.parametrize(
    ("join", "leave", "drift", "error", "words"),
    [
        (["deer@30"], [], [], UnknownNameError, "did you mean 'dear'"),
        (["dear"], [], [], SettingError, "join: must be POLICY@DECISION, such as dear@45, got 'dear'"),
        (["dear@"], [], [], SettingError, "an integer from 1 to 89"),
        (["dear@0"], [], [], SettingError, "an integer from 1 to 89"),
        (["dear@90"], [], [], SettingError, "the stream has 90"),
        (["dear@1.5"], [], [], SettingError, "got '1.5'"),
        (["dear@30", "dear@50"], [], [], SettingError, "it must leave in between"),
        ([], ["dear@30", "dear@50"], [], SettingError, "leave: .* it must join in between"),
        (["dear@30"], ["dear@30"], [], SettingError, "it cannot do both at once"),
        ([], ["dear@30", "cheap@30", "other@40"], [], SettingError, "no policy is there at decision 40"),
        (["dear@30", "cheap@30", "other@30"], [], [], SettingError, "no policy is there at decision 0"),
        ([], [], ["prise:dear:x2@30"], SettingError, "did you mean 'price'"),
        ([], [], ["price:dear:2@30"], SettingError, "such as price:dear:x2@30"),
        ([], [], ["price:dear@30"], SettingError, "such as price:dear:x2@30"),
        ([], [], ["price:dear:xtwo@30"], SettingError, "a number of 0 or more"),
        ([], [], ["price:dear:x-1@30"], SettingError, "a number of 0 or more"),
        ([], [], ["price:dear:xnan@30"], SettingError, "a number of 0 or more"),
        ([], [], ["price:deer:x2@30"], UnknownNameError, "did you mean 'dear'"),
        ([], [], ["dear=chep@30"], UnknownNameError, "did you mean 'cheap'"),
        ([], [], ["dear=cheap"], SettingError, "which names no decision"),
        ([], [], ["dear=cheap@99"], SettingError, "an integer from 1 to 89"),
        ([], [], ["dear=cheap@30", "dear=other@30"], SettingError, "say one of them"),
        ([], [], [""], SettingError, "drift: must be"),
    ],
)
def test_a_change_of_another_form_is_refused(join, leave, drift, error, words):
    with pytest.raises(error, match=words):
        timeline(join, leave, drift, POLICIES, DECISIONS)


def test_rewards_follow_the_changes(log):
    found = material(log, drift=["price:dear:x3@30", "dear=cheap@60"])
    first, dearer, worse = found.timeline.spans
    plain = found.log.rewards(WEIGHTS)
    for seed in range(2):
        assert (found.rewards(seed, first) == found.streams.rewards(plain, seed)).all()
    assert (found.means(dearer)[:, 1] == 1.0 - 0.3).all() and (found.means(dearer)[:, 0] == found.means(first)[:, 0]).all()
    assert np.allclose(found.means(worse)[:, 1], found.means(first)[:, 0] - 0.3)
    assert (found.rewards(0, worse)[:, 1] == found.rewards(0, worse)[:, 0] - 0.1 * 3.0).all()


@pytest.mark.parametrize("name", ["auto", "ppo_tuned", "thompson", "linucb", "random"])
def test_nobody_chooses_what_is_not_there(log, name):
    found = material(log, join=["dear@30"], leave=["dear@60", "cheap@60"], seeds=1)
    settings = {} if name != "ppo_tuned" else {"ppo_tuned": {"n_steps": 8}}
    found = ChangingLog(found.log, Setup(WEIGHTS, settings), *(getattr(found, part) for part in ("timeline", "streams", "seeds", "gains", "charges")))
    ways = replay_changing(found, [name])[name]
    for way, chosen in ways.items():
        for span in found.timeline.spans:
            own = chosen[:, span.decisions]
            if way != "through" and span.start == 0:
                assert (own == NOBODY).all()
            else:
                assert set(np.unique(own).tolist()) <= set(span.columns.tolist())
    assert (ways["through"][:, 60:] == 2).all()
    assert (ways["through"][:, 30:60] == 1).any()


def test_what_comes_before_a_change_is_as_if_there_were_none(log):
    """The part of a stream before the first change is that of a replay of the policies that are there."""
    changed = replay_changing(material(log, leave=["dear@60"]), ["auto"])["auto"]["through"]
    never = replay_changing(material(log, drift=["price:other:x1@89"]), ["auto"])["auto"]["through"]
    assert (changed[:, :60] == never[:, :60]).all()


def test_compiled_ppo_grows_and_shrinks_as_that_of_stable_baselines(log):
    settings = {"layers": (16,), "n_steps": 4, "batch_size": 4, "learning_rate": 3e-3}
    generator = np.random.default_rng(1)
    contexts, rewards = generator.normal(size=(60, 6)).astype(np.float32), generator.random((60, 3))
    parts = [(slice(0, 17), [0, 1]), (slice(17, 40), [0, 1, 2]), (slice(40, 50), [0, 1, 2]), (slice(50, 60), [1, 2])]
    pieces = [Piece(contexts[where], rewards[where], np.array(columns)) for where, columns in parts]
    fast = play(make_selector("ppo", POLICIES[:2], 6, 0, **settings), pieces, POLICIES)
    slow = play(make_selector("ppo", POLICIES[:2], 6, 0, **settings, clip_range_vf=1e9), pieces, POLICIES)  # which is not compiled
    assert fast.tolist() == slow.tolist()


class Stranger:
    """Knows nothing of changes."""

    policies: tuple[str, ...] = ()

    def __init__(self, policies, context_dim, seed):
        self.policies = tuple(policies)

    def select(self, context):
        return Choice(self.policies[0], {policy: float(policy == self.policies[0]) for policy in self.policies})

    def update(self, context, choice, reward):
        return None


def test_a_selector_that_cannot_is_named(log, tmp_path):
    common = {"seeds": 1, "workers": 1, "alpha_time": 0.0, "alpha_price": 0.1}
    with pytest.raises(UsageError, match="'Stranger' lacks add_policy and retire_policy"):
        osel_sim.replay(log, selectors=[Stranger], join="dear@30", out=tmp_path / "one", **common)
    done = osel_sim.replay(log, selectors=[Stranger], drift="price:dear:x2@30", out=tmp_path / "other", **common)  # nobody comes or goes
    assert done.result is not None and done.result["selectors"]["Stranger"]["shares"]["cheap"] == 1.0


@pytest.mark.parametrize("setting", [{"margin": 0.01}, {"route_with": ["linucb"]}])
def test_what_is_for_a_verdict_is_refused_where_there_is_none(log, tmp_path, setting):
    with pytest.raises(SettingError, match="streams that change have none"):
        osel_sim.replay(log, selectors=["linucb"], join="dear@30", out=tmp_path / "out", **setting)
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def replayed(log, tmp_path_factory):
    out = tmp_path_factory.mktemp("replay") / "out"
    flags = ["--selectors", "thompson", "ucb1", "--seeds", "3", "--workers", "1", "--alpha-time", "0", "--alpha-price", "0.1", "--out", out]
    flags += ["--join", "dear@30", "--leave", "dear@70", "--drift", "price:dear:x20@50"]
    assert main([str(log), *map(str, flags)]) == 0
    return out


def test_what_is_reported(replayed, capsys):
    result, choices = read_replay(replayed)
    found = result["changes"]
    assert [span["changes"] for span in found["spans"]] == [
        [],
        ["dear joins at decision 30"],
        ["dear costs x20 at decision 50"],
        ["dear leaves at decision 70"],
    ]
    assert [span["best_single"]["policy"] for span in found["spans"]] == ["cheap", "dear", "cheap", "cheap"]
    assert [sorted(span["always"]) for span in found["spans"]] == [["cheap", "other"]] + [sorted(POLICIES)] * 2 + [["cheap", "other"]]
    assert [span["oracle"] for span in found["spans"]][1] == pytest.approx(0.9, abs=0.1)
    own = found["selectors"]["thompson"]
    assert [span["soon"]["decisions"] for span in own["spans"]] == [20, 20, 20]
    for span in own["spans"]:
        soon = span["soon"]
        assert soon["against_knew"]["mean"] == pytest.approx(soon["mean_reward"] - soon["mean_reward_knew"])
        assert soon["against_afresh"]["sum"] == pytest.approx(soon["decisions"] * soon["against_afresh"]["mean"])
    [newcomer] = own["newcomers"]
    assert newcomer["policy"] == "dear" and newcomer["of"] == 20 and newcomer["fair_share"] == newcomer["late_share"] / 2
    assert (choices.chosen["thompson"][:, 70:] != 1).all() and (choices.chosen["thompson"][:, :30] != 1).all()
    assert (replayed / "changes.csv").read_text().startswith("selector,at,change,part,decisions,mean_reward")
    assert "after dear joins at decision 30" in result["verdict"]["text"]


def test_it_has_a_page_and_frames(replayed, log):
    from osel_sim.api.results import ReplayResult
    from osel_sim.report import main as report

    assert report([str(replayed)]) == 0
    page = (replayed / "report.html").read_text()
    for words in ("How soon a newcomer is chosen", "dear costs x20 at decision 50", "Decisions until a newcomer has its fair share"):
        assert words in page
    done = ReplayResult(replayed, read_replay(replayed)[0])
    assert set(done.selectors["selector"]) == {"thompson", "ucb1"}
    assert "reward" in done.curve.title.lower()


@pytest.mark.slow
def test_workers_do_not_matter(log, replayed, tmp_path):
    common = {"selectors": ["thompson", "ucb1"], "seeds": 3, "alpha_time": 0.0, "alpha_price": 0.1, "workers": 2, "out": tmp_path / "two"}
    osel_sim.replay(log, join="dear@30", leave="dear@70", drift="price:dear:x20@50", **common)
    for name in ("replay.json", "choices.npz", "changes.csv"):
        assert (tmp_path / "two" / name).read_bytes() == (replayed / name).read_bytes()


def test_a_change_that_is_none_is_one_line(log, tmp_path, capsys):
    assert main([str(log), "--selectors", "thompson", "--join", "deer@30", "--out", str(tmp_path / "out")]) == 2
    assert "did you mean 'dear'" in capsys.readouterr().err
    assert main([str(log), "--selectors", "thompson", "--drift", "price:dear:2@30", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error: --drift: must be price:POLICY:xFACTOR@DECISION, such as price:dear:x2@30")
    assert not (tmp_path / "out").exists()


def test_the_newcomers_share_is_counted_from_the_first_run_of_decisions_that_gives_it():
    share = np.concatenate([np.zeros(40), np.ones(60)])
    assert _until(share, 1.0) == 40
    assert _until(share, 0.5) == 28  # 13 of the 25 that follow
    assert _until(np.zeros(10), 0.1) is None
    assert _until(np.ones(10), 0.5) == 0


def test_a_share_that_is_there_at_once_is_not_told_as_one_that_never_comes():
    newcomers = [{"policy": name, "decisions": {"through": after}} for name, after in (("soon", 0), ("late", None))]
    assert _arrived(newcomers) == "soon 0, late never"


def test_a_better_policy_is_taken_up_from_what_was_learned(tmp_path):
    """The best policy of a log joins late: `auto` keeps what it knew of the others, and gives it its share within decisions."""
    made = clusters(tmp_path / "log", instances=240, clusters=4, dim=8, policies=3)
    best = made.policies[int(made.rates.mean(axis=0).argmax())]
    common = {"seeds": 3, "workers": 1, "alpha_time": 0.0, "alpha_price": 0.0, "out": tmp_path / "out"}
    done = osel_sim.replay(made.folder, selectors="auto", join=f"{best}@120", **common)
    assert done.result is not None
    [newcomer] = done.result["changes"]["selectors"]["auto"]["newcomers"]
    assert newcomer["decisions"]["through"] is not None and newcomer["decisions"]["through"] < 60
    assert json.dumps(done.result)
