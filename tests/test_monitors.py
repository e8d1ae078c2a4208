"""Monitors on decision points that were written down, and on made-up problems whose answer is known."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_moments import ENCODER, POLICIES, stuck_log

from osel_sim.analysis.moment_warm_start import check_can_start_warm, read_warm_start, show_moments
from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.formats.journal import to_line
from osel_sim.formats.points import Points, to_points
from osel_sim.interface.monitor import Candidate, DecisionPoint, Told, Turn, Watched
from osel_sim.interface.outcome import Monitored, Outcome, Seconds
from osel_sim.selection.monitors.registry import ABOUT, BUILT_IN, make_monitor, monitor_locations
from osel_sim.selection.reward import RewardWeights, reward, to_go

CANDIDATES = (Candidate("small", False), Candidate("large", True), Candidate("special", True))
TWO = CANDIDATES[:2]
DIM = 6


def point(call=4, driver="small", picture=None, **values):
    look = Told(np.zeros(DIM, np.float32) if picture is None else picture, (values.pop("change", 0.02),), values.pop("differences", {}))
    defaults = {"step": 8 * call, "seconds": 0.4 * call, "price": 0.0, "time_used": min(1.0, call / 24), "overlap": 0.1, "moved": 0.05}
    return DecisionPoint(call=call, driver=driver, instruction="do it", look=look, **{**defaults, **values})


def outcome(steps=200, duty=0.0):
    return Outcome(False, 0.0, steps, Seconds(motion=steps / 20), 1, 1, 0.0, monitored=Monitored(1, (), duty, duty, {}))


def begun(name, candidates=CANDIDATES, driver="small"):
    monitor = make_monitor(name, candidates, DIM, 0)
    monitor.reset("do it", driver, (1, 2, 3))
    return monitor


def test_every_monitor_is_listed_with_a_line_about_it():
    assert set(ABOUT) == set(BUILT_IN) <= set(monitor_locations())


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("valu", "did you mean 'value'"),
        ("", "unknown monitor ''"),
        ("never:1", "write never"),
        ("blind", "write blind:K or blind:K:TO"),
        ("blind:8:large:1", "write blind:K or blind:K:TO"),
        ("blind:0", "K must be an integer of at least 1, got '0'"),
        ("blind:2.5", "K must be an integer of at least 1, got '2.5'"),
        ("blind:x", "got 'x'"),
        ("blind:8:", "write blind:K or blind:K:TO"),
        ("blind:" + "9" * 400, "K must be an integer"),
        ("blind:8:larg", "did you mean 'large'"),
        ("random:1.5", r"P must be a number in \[0, 1\], got '1.5'"),
        ("random:nan", "got 'nan'"),
        ("random", "write random:P"),
        ("stall:larg", "did you mean 'large'"),
        ("disagreement:-1", "LIMIT must be a number of at least 0"),
        ("disagreement:inf", "got 'inf'"),
        ("disagreement:0.1:larg", "did you mean 'large'"),
        ("value:0", "MOST must be an integer of at least 1"),
    ],
)
def test_a_name_that_is_none_says_what_would_be_right(name, said):
    with pytest.raises((UnknownNameError, UsageError), match=said):
        make_monitor(name, CANDIDATES, DIM, 0)


def test_random_needs_both_sides():
    with pytest.raises(UsageError, match="a remote and a local one"):
        make_monitor("random:0.5", CANDIDATES[1:], DIM, 0)


def test_never_and_blind():
    assert begun("never").drives_on(point()) == Turn("small")
    blind = begun("blind:8:special")
    assert [blind.drives_on(point(call)).policy for call in (4, 8, 12)] == ["small", "special", "small"]  # once: it does as the loop has it then
    assert begun("blind:6").drives_on(point(8)).policy == "large"  # the first across the network, at the first point from then on
    assert begun("blind:6", driver="special").drives_on(point(8, driver="special")).policy == "small"
    assert begun("blind:6", (Candidate("a", False), Candidate("b", False))).drives_on(point(8, driver="a")).policy == "b"
    assert begun("blind:6", TWO[:1]).drives_on(point(8)).policy == "small"


def test_a_parameter_may_be_a_merge():
    both = "merge:small+large"
    for name in (f"blind:4:{both}", f"stall:{both}", f"disagreement:0.1:{both}"):
        at = point(moved=0.0, change=0.0, differences={both: 0.2})
        assert begun(name, (*TWO, Candidate(both, True))).drives_on(at).policy == both
    with pytest.raises(UsageError, match="write blind:K or blind:K:TO"):
        begun(f"blind:4:{both}:2")


@pytest.mark.parametrize("duty", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("first", ["small", "large"])
def test_random_keeps_its_duty(duty, first):
    monitor, remote = make_monitor(f"random:{duty}", CANDIDATES, DIM, 0), 0
    for episode in range(100):
        driver, own = first, 0
        monitor.reset("do it", driver, (episode,))
        for call in range(1, 13):
            own += 8 * (driver != "small")
            turn = monitor.drives_on(point(call, driver))
            turn.check(monitor.policies)
            driver = turn.policy
        remote += own
        monitor.learn(Watched((), (), outcome(96, own / 96), 0.0, ()))
    assert remote / (100 * 96) == pytest.approx(duty, abs=0.09)  # who drives until the first point is not its choice


def test_stall_hands_over_where_nothing_moves():
    stall = begun("stall")
    assert stall.drives_on(point(moved=0.001, change=0.001)).policy == "large"
    assert "picture 0.0010" in stall.drives_on(point(moved=None, change=0.001)).why  # an environment without state
    for moving in (point(moved=0.1, change=0.001), point(moved=0.001, change=0.2), point(moved=0.001, change=None)):
        assert stall.drives_on(moving).policy == "small"


def test_disagreement_of_chunks_of_one_or_two_policies():
    own, asks = begun("disagreement:0.3"), begun("disagreement:0.3:special")
    assert own.drives_on(point(overlap=0.4)) == Turn("large", "chunks differ by 0.400")
    assert own.drives_on(point(overlap=0.2)).policy == own.drives_on(point(overlap=None)).policy == "small"
    assert asks.drives_on(point(overlap=0.0, differences={"special": 0.4})).policy == "special"
    assert asks.drives_on(point(overlap=9.0, differences={"special": 0.2})).policy == "small"
    assert asks.drives_on(point(overlap=9.0, differences={"special": None})).policy == "small"
    assert asks.drives_on(point(driver="special", overlap=9.0)).policy == "special"  # nobody is asked


def stuck(monitor, episodes, seed=0, first="small"):
    """A made-up problem: in half of the episodes `small` is stuck, which the picture shows, and `large` alone would come to 0.8 instead of 1 else."""
    chance, rewards = np.random.default_rng(seed), []
    for episode in range(episodes):
        monitor.reset("do it", first, (episode,))
        is_stuck, driver, points, turns = chance.random() < 0.5, first, [], []
        for call in (4, 8, 12, 16, 20):
            picture = (0.3 * chance.normal(size=DIM)).astype(np.float32)
            picture[0] += 1.5 if is_stuck else -1.5
            points.append(point(call, driver, picture))
            turns.append(monitor.drives_on(points[-1]))
            turns[-1].check(monitor.policies)
            driver = turns[-1].policy
        reward = 0.8 if driver == "large" else 0.0 if is_stuck else 1.0
        monitor.learn(Watched(points, turns, outcome(), reward, [reward] * len(points)))
        rewards.append(reward)
    return rewards


def test_value_learns_when_to_hand_over():
    rewards = stuck(make_monitor("value", TWO, DIM, 0), 250)
    assert np.mean(rewards[-100:]) > 0.86  # 0.9 is best, 0.8 always large, 0.5 never


def test_value_hands_over_as_often_as_it_may_with_exact_propensities():
    for most in (1, 2):
        monitor, drawn, told = make_monitor(f"value:{most}", TWO, DIM, 1), 0, 0.0
        for episode in range(200):
            monitor.reset("do it", "small", (episode,))
            driver, handoffs = "small", 0
            for call in (4, 8, 12, 16, 20):
                turn = monitor.drives_on(point(call, driver))
                assert math.isclose(sum(turn.propensities.values()), 1.0)
                if call == 4:
                    drawn, told = drawn + (turn.policy == "large"), told + turn.propensities["large"]
                handoffs += turn.policy != driver
                driver = turn.policy
            assert handoffs <= most
        assert drawn == pytest.approx(told, abs=4 * math.sqrt(told))


def test_value_starts_warm_from_episodes_of_others():
    """As of a log of moments: one point an episode, and what came of going on and of handing over there."""
    warm, chance = make_monitor("value", TWO, DIM, 0), np.random.default_rng(5)
    for _ in range(150):
        is_stuck = chance.random() < 0.5
        picture = (0.3 * chance.normal(size=DIM)).astype(np.float32)
        picture[0] += 1.5 if is_stuck else -1.5
        for policy in ("small", "large"):
            reward = 0.8 if policy == "large" else 0.0 if is_stuck else 1.0
            warm.learn(Watched([point(8, picture=picture)], [Turn(policy)], outcome(), reward, [reward]))
    assert np.mean(stuck(warm, 60, seed=1)) > 0.84


@pytest.mark.parametrize("name", ["value", "ppo", "random:0.4"])
def test_told_the_same_again_a_monitor_is_the_same(name):
    first, again = (make_monitor(name, TWO, DIM, 3) for _ in range(2))
    assert stuck(first, 30) == stuck(again, 30)
    one, other = point(), point()
    for monitor in (first, again):
        monitor.reset("do it", "small", (99,))
    assert first.drives_on(one) == again.drives_on(other)


def test_ppo_learns_when_to_hand_over_and_from_its_own_decisions_only():
    monitor = make_monitor("ppo", TWO, DIM, 0)
    rewards = stuck(monitor, 500)
    assert np.mean(rewards[-100:]) > 0.8
    monitor.reset("do it", "small", (0,))
    with pytest.raises(UsageError, match="its own decisions only"):
        monitor.learn(Watched([point()], [Turn("small")], outcome(), 1.0, [1.0]))


def problem(generator):
    """The same as a sequence: the picture says whether the driver is stuck, every step costs 0.01, and the end is worth 1 unless it is."""
    is_stuck, driver, reward = bool(generator.random() < 0.5), 0, 0.0
    for step in range(3):
        row = np.array([1.0 if is_stuck else -1.0, driver, step / 3], np.float32)
        driver = yield row, (reward if step else 0.0)
        reward = -0.01 - 0.1 * driver
    return reward + (1.0 if driver == 1 or not is_stuck else 0.0)


def test_environment_is_one_of_gymnasium():
    import gymnasium
    from gymnasium.utils.env_checker import check_env

    from osel_sim.selection.monitors.environment import HandoffEnv

    env = HandoffEnv(problem, ("small", "large"), 3)
    check_env(env, skip_render_check=True)
    env.reset(seed=4)
    taken = [env.step(action)[1:] for action in (0, 1, 1)]
    assert [told["policy"] for *_, told in taken] == ["small", "large", "large"] and [over for _, over, _, _ in taken] == [False, False, True]
    assert sum(reward for reward, *_ in taken) == pytest.approx(1.0 - 0.03 - 0.2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    with pytest.raises(UsageError, match=r"in \[0, 1\], got 2"):
        env.step(2)

    def over(generator):
        return 1.0
        yield

    with pytest.raises(UsageError, match="before their first decision point"):
        HandoffEnv(over, ("small",), 1).reset()


@pytest.mark.slow
def test_sb3_learns_on_the_environment():
    from stable_baselines3 import PPO

    from osel_sim.selection.monitors.environment import HandoffEnv

    env = HandoffEnv(problem, ("small", "large"), 3)
    learned = PPO("MlpPolicy", env, gamma=1.0, n_steps=128, batch_size=64, learning_rate=3e-3, seed=0, device="cpu").learn(6_000)
    total, episodes = 0.0, 200
    for _ in range(episodes):
        row, over = env.reset()[0], False
        while not over:
            row, reward, over, _, _ = env.step(int(learned.predict(row, deterministic=True)[0]))
            total += reward
    assert total / episodes > 0.85  # best: 0.97 unless stuck, then 0.87, or 0.77 handing over at once


def written():
    picture = np.array([0.1, -2.0], np.float32)
    seen = replace(point(picture=picture, change=None, overlap=None), look=Told(picture, (None,), {"large": 0.25}))
    blind = replace(point(8, "large"), look=Told())
    return Points(3, (seen, blind), (Turn("large", "why", {"small": 0.25, "large": 0.75}), Turn("large")))


def test_points_are_read_as_they_were_written():
    line = json.loads(to_line(written().to_dict()))
    again = to_points(line, 3, Path("points.jsonl"), ("small", "large"), "do it")
    assert again.to_dict() == written().to_dict() and again.turns == written().turns
    assert (again.points[0].look.picture() == written().points[0].look.picture()).all()
    assert again.points[0].look.change() is None and again.points[0].look.difference("large") == 0.25
    for looked in (lambda look: look.picture(), lambda look: look.change(), lambda look: look.difference("large")):
        with pytest.raises(DataError, match=r"kept|was not asked"):
            looked(again.points[1].look)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda line: line.update(version=2), "version must be 1, got 2"),
        (lambda line: line.update(index=4), "index must be 3, got 4"),
        (lambda line: line.pop("points"), "points is missing"),
        (lambda line: line.update(points=[1]), "points must be a list of objects"),
        (lambda line: line["points"][0].update(call=-1), "point 0: call must be an integer of 0 or more"),
        (lambda line: line["points"][1].pop("moved"), "point 1: moved is missing"),
        (lambda line: line["points"][0].update(truth=1), "point 0: has an unknown field"),
        (lambda line: line["points"][0].update(picture="?"), "point 0: picture is no Base64"),
        (lambda line: line["points"][0].update(picture="AADAfw=="), "point 0: picture is not all finite"),
        (lambda line: line["points"][0].update(policy="larger"), "point 0: .*larger.* is no policy of the run"),
        (lambda line: line["points"][0].update(propensities={"small": 0.5}), "point 0: propensities must be probabilities"),
        (lambda line: line["points"][0].update(changes=[2.0]), "point 0: changes must be"),
    ],
)
def test_points_that_cannot_be_are_refused(change, said):
    line = written().to_dict()
    change(line)
    with pytest.raises(DataError, match=rf"points.jsonl, line 4: .*{said}"):
        to_points(line, 3, Path("points.jsonl"), ("small", "large"), "do it")


def test_listing_shows_monitors():
    from osel_sim.cli.listing import listing

    assert {row["name"]: row["about"] for row in listing()["monitors"]}.items() >= ABOUT.items()


def test_reward_to_go_leaves_out_what_was_spent():
    weights = RewardWeights(0.2, 0.01)
    end = replace(outcome(200), success=True, price=3.0)
    total = reward(end, weights)
    rest = to_go(total, [1.0, 10.0], [20, 200], [0.0, 3.0], weights)
    assert rest == (pytest.approx(total), pytest.approx(1.0))  # after one second log10 has taken nothing off; at the end all was spent


def test_value_starts_warm_from_a_table_of_moments(tmp_path):
    """Where the local policy is stuck, the picture shows it, and the remote one helps before call 4 and no more before call 8."""
    weights = RewardWeights(0.0, 0.005)
    log = read_warm_start(stuck_log(tmp_path / "log"), ENCODER, POLICIES)
    monitor = make_monitor("value", (Candidate("local", False), Candidate("remote", True)), log.seen.pictures.shape[1], 0)
    own = set(log.whole.keys[:40])
    assert show_moments(monitor, log, weights, own) == len(log) - 40
    seen = {"overlap": 0.0, "moved": 0.0, "change": 0.0, "seconds": 0.0, "price": 0.0, "time_used": 0.0}
    for stuck in (False, True):
        picture = np.array([3.0 * stuck] + [0.0] * 7, np.float32)
        expected = monitor.expected(point(4, "local", picture, **seen))
        assert (expected["remote"] > expected["local"] + 0.1) == stuck
    with pytest.raises(UsageError, match="give the same --encoder"):
        read_warm_start(tmp_path / "log", "another@2", POLICIES)


@pytest.mark.parametrize("name", ["never", "blind:4", "ppo"])
def test_what_learns_nothing_of_others_cannot_start_warm(name):
    with pytest.raises(UsageError, match="cannot start warm"):
        check_can_start_warm(name, make_monitor(name, TWO, DIM, 0))
