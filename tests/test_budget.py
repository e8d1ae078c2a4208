"""Keeping to a budget: the price of a cent, every selector within one, live runs that end and resume, replays at several budgets."""

import json

import numpy as np
import pytest
from run_helpers import HORIZON
from synthetic_log import make_row, write_log

import osel_sim as osel
from osel_sim.analysis.budgets import best_within
from osel_sim.core.errors import BudgetError, DataError, SettingError, UsageError
from osel_sim.episodes.changes import apply
from osel_sim.episodes.most_costs import most_costs
from osel_sim.formats import library
from osel_sim.formats.budget import read_budget
from osel_sim.formats.journal import read_journal
from osel_sim.formats.merged_policy import merged
from osel_sim.formats.policy_changes import PolicyChange
from osel_sim.interface.selector import Choice
from osel_sim.reporting.budget_section import run_budget
from osel_sim.run import main as run_main
from osel_sim.selection.budget import Budget, Budgeted, dual_price
from osel_sim.selection.registry import BUILT_IN, make_selector
from osel_sim.selection.state import load_state
from osel_sim.suites.registry import select_tasks

POLICIES = ("local", "remote")
NAMES = ["fixed:remote" if name == "fixed" else name for name in sorted(BUILT_IN)]
SETTINGS = {"ppo": {"layers": (16,)}, "ppo_tuned": {"n_steps": 8}}


def budgeted(name: str, cents: float, decisions: int, dim: int = 4, seed: int = 0, most=(0.0, 2.0)) -> Budgeted:
    selector = make_selector(name, POLICIES, dim, seed, **SETTINGS.get(name, {}))
    return Budgeted(selector, Budget(cents, decisions, dict(zip(POLICIES, most, strict=True))), dim, seed)


def play(selector: Budgeted, contexts, rewards, prices) -> np.ndarray:
    chosen = []
    for row, context in enumerate(contexts):
        choice = selector.select(context)
        assert sum(choice.propensities.values()) == pytest.approx(1.0)
        chosen.append(POLICIES.index(choice.policy))
        selector.pay(choice.policy, float(prices[row, chosen[-1]]))
        selector.update(context, choice, float(rewards[row, chosen[-1]]))
    return np.array(chosen)


def knapsack(decisions: int, seed: int = 0):
    """The remote policy gains 0.4 on half of the contexts and 0.05 on the others; an episode of it costs a cent."""
    chance = np.random.default_rng([7, seed])
    good = chance.integers(2, size=decisions)
    contexts = (np.eye(4)[good] + 0.1 * chance.normal(size=(decisions, 4))).astype(np.float32)
    rates = np.stack([np.full(decisions, 0.5), np.where(good, 0.9, 0.55)], axis=1)
    return contexts, good, rates, (chance.random(rates.shape) < rates).astype(float), np.tile([0.0, 1.0], (decisions, 1))


def test_the_price_of_a_cent_is_where_the_pace_is_met():
    gains = np.linspace(0.0, 1.0, 101)
    expected = np.stack([np.zeros(101), gains], axis=1)
    assert dual_price(expected, np.array([0.0, 2.0]), 2.0) == 0.0  # the budget does not bind
    assert dual_price(expected, np.array([0.0, 2.0]), 0.5) == pytest.approx(0.375, abs=0.01)  # a quarter of them gain 0.75 and more
    assert dual_price(expected, np.array([0.0, 2.0]), 0.0) == pytest.approx(0.5, abs=0.01)
    assert dual_price(expected, np.array([1.0, 3.0]), 0.1) >= 0.5  # cannot be met: the cheaper one always
    assert dual_price(expected, np.array([3.0, 3.0]), 1.0) == 0.0  # nothing to choose by price


def test_the_oracle_within_a_budget_is_the_knapsack_s_optimum():
    rewards = np.stack([np.zeros(100), np.arange(100) / 100.0], axis=1)
    prices = np.tile([0.0, 2.0], (100, 1))
    value, dual = best_within(rewards, prices, 0.5, free=True)
    assert value == pytest.approx(np.arange(75, 100).sum() / 1e4, abs=1e-6)
    assert 0.3699 <= dual <= 0.3751
    assert best_within(rewards, prices, 5.0, free=True) == (pytest.approx(0.495), 0.0)
    assert best_within(rewards + 1.0, prices + 1.0, 0.5, free=False)[0] == pytest.approx(0.5 * 1.0, abs=0.2)  # some decisions are left out


def test_auto_spends_where_it_helps_most_and_knows_what_a_cent_is_worth():
    decisions, cents = 500, 100.0
    contexts, good, rates, rewards, prices = knapsack(decisions)
    selector = budgeted("auto", cents, decisions, most=(0.0, 1.0))
    chosen = play(selector, contexts, rewards, prices)
    assert cents - 1.0 <= selector.total <= cents
    assert good[chosen == 1].mean() > 0.8  # bought where they gain 0.4
    gained = (rates[np.arange(decisions), chosen] - rates[:, 0]).sum()
    assert gained > 0.8 * 0.4 * cents  # the optimum; a mix without context gains 0.225 a cent
    assert selector.dual == pytest.approx(0.4, abs=0.15)


@pytest.mark.parametrize("name", NAMES)
def test_every_selector_keeps_to_it_period_by_period_and_goes_on_from_its_state(name):
    chance = np.random.default_rng(3)
    contexts = chance.normal(size=(24, 4)).astype(np.float32)
    prices = np.stack([np.zeros(24), 2.0 * chance.random(24)], axis=1)
    rewards = chance.random((24, 2))
    whole, first = budgeted(name, 4.0, 12), budgeted(name, 4.0, 12)
    chosen = play(whole, contexts, rewards, prices)
    spent = prices[np.arange(24), chosen]
    assert spent[:12].sum() <= 4.0
    assert spent[12:].sum() <= 4.0
    assert (chosen[spent == 0.0] == 0).all()
    play(first, contexts[:15], rewards[:15], prices[:15])
    second = budgeted(name, 4.0, 12)
    second.load_state_dict(first.state_dict())
    assert (play(second, contexts[15:], rewards[15:], prices[15:]) == chosen[15:]).all()


@pytest.mark.parametrize("name", NAMES)
def test_policies_come_and_go_within_a_budget(name):
    paid = {"local": 0.0, "remote": 1.8, "new": 0.9}
    budget = Budget(4.0, 12, {"local": 0.0, "remote": 2.0, "new": 1.0})
    selector = Budgeted(make_selector(name, POLICIES, 4, 0, **SETTINGS.get(name, {})), budget, 4, 0)
    changes = {8: "add", 14: "retire", 20: "add"}
    spent = []
    for index, context in enumerate(np.random.default_rng(3).normal(size=(24, 4)).astype(np.float32)):
        if index in changes:
            apply(selector, PolicyChange(index, changes[index], "new", {}), {})
        choice = selector.select(context)
        assert tuple(choice.propensities) == selector.policies == (*POLICIES, *(["new"] if 8 <= index < 14 or index >= 20 else []))
        spent.append(paid[choice.policy])
        selector.pay(choice.policy, spent[-1])
        selector.update(context, choice, float(choice.policy != "local"))
    assert max(sum(spent[:12]), sum(spent[12:])) <= 4.0


class InTurn:
    """A selector of one's own: it tells nothing of what it expects, and keeps what it is taught."""

    policies = POLICIES

    def __init__(self) -> None:
        self.taught: list[float] = []

    def select(self, context):
        return Choice(POLICIES[len(self.taught) % 2], dict.fromkeys(POLICIES, 0.5))

    def update(self, context, choice, reward):
        self.taught.append(reward)


def test_one_that_tells_no_expectations_learns_rewards_less_what_their_cents_are_worth():
    contexts, _, _, rewards, prices = knapsack(200)
    inner = InTurn()
    selector = Budgeted(inner, Budget(40.0, 200, {"local": 0.0, "remote": 1.0}), 4, 0)
    chosen = play(selector, contexts, rewards, prices)
    assert chosen.tolist() == [index % 2 if index < 80 else 0 for index in range(200)]  # then there are no cents left
    came = rewards[np.arange(81), chosen[:81]] - np.array(selector.duals[:81]) * chosen[:81]
    assert inner.taught == pytest.approx(came.tolist())  # and not what came of choices that were not its own
    assert max(selector.duals[1:80:2]) > 0.1


def test_what_a_budget_refuses():
    with pytest.raises(BudgetError, match=r"1 cents pay for no decision: the cheapest policy, local, may cost 1\.5"):
        Budget(1.0, 10, {"local": 1.5, "remote": 2.0})
    with pytest.raises(UsageError, match="at least 1 decision"):
        Budget(1.0, 0, {"local": 0.0})
    with pytest.raises(UsageError, match="remote"):
        Budgeted(make_selector("random", POLICIES, 4, 0), Budget(1.0, 10, {"local": 0.0}), 4, 0)
    with pytest.raises(DataError, match="no selector with a budget"):
        budgeted("random", 1.0, 10).load_state_dict(make_selector("random", POLICIES, 4, 0).state_dict())
    paid = budgeted("random", 3.0, 10, most=(1.0, 2.0))
    paid.pay("remote", 2.5)
    with pytest.raises(BudgetError, match=r"0\.5 cents are left of 3"):
        paid.select(np.zeros(4, np.float32))


def arguments(world, *more) -> list[str]:
    fixed = ["--task", "short", "--tasks", world / "tasks", "--policies-dir", world / "policies", "--encoder", "colours", "--no-page"]
    return [str(word) for word in (*fixed, *more)]


def test_no_episode_costs_more_than_its_policy_s_file_allows(world):
    specs = [library.load_policy(name, world / "policies") for name in ("calm", "wild")]
    task = select_tasks(("short",), world / "tasks", None)[0]
    most = most_costs(specs, specs, HORIZON, task.specification)
    assert most["calm"] == 0.0
    assert 0.02 * HORIZON + 4 * 0.1 < most["wild"] < 0.02 * HORIZON + 4 * 0.3  # and what the messages weigh
    both = merged("merge:calm+wild", lambda name: library.load_policy(name, world / "policies"))
    assert most_costs([both], [both, *specs], HORIZON, task.specification)["merge:calm+wild"] == most["wild"]  # whose own price is nothing


def test_a_live_run_keeps_to_its_budget_and_resumes_to_the_same_bytes(world, capsys):
    whole, cut = world / "whole", world / "cut"
    flags = ["--policies", "calm", "wild", "--selector", "fixed:wild", "--budget-cents", "2"]
    assert run_main(arguments(world, *flags, "--episodes", "4", "--out", whole)) == 0
    assert "of a budget of 2" in capsys.readouterr().out
    decisions = read_journal(whole / "episodes.jsonl")
    spent = sum(decision.price for decision in decisions)
    assert 0.0 < spent <= 2.0
    assert [decision.policy for decision in decisions] == ["wild", "wild", "calm", "calm"]  # a third might have cost more than was left
    assert decisions[-1].propensities == {"calm": 1.0, "wild": 0.0}
    found = read_budget(whole)
    assert (found.cents, found.period, found.decisions, found.ended) == (2.0, 4, 4, "")
    assert found.spent == pytest.approx(spent)
    assert len(found.prices) == 4
    [section] = run_budget(whole, decisions)
    assert section.blocks[0].startswith("The run spent")
    assert section.blocks[1].spec
    # Cut off after three decisions, as a killed process leaves it, and gone on with.
    cut.mkdir()
    for name in ("run.json", "contexts.npz"):
        (cut / name).write_bytes((whole / name).read_bytes())
    lines = (whole / "episodes.jsonl").read_bytes().splitlines(keepends=True)
    (cut / "episodes.jsonl").write_bytes(b"".join(lines[:3]))
    settings = json.loads((cut / "run.json").read_text())
    settings["settings"]["out"] = str(cut)
    (cut / "run.json").write_text(json.dumps(settings))
    assert run_main(["--out", str(cut), "--resume"]) == 0
    for name in ("episodes.jsonl", "summary.json", "budget.json"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes(), name
    one, other = (load_state(folder / "selector.safetensors") for folder in (cut, whole))  # whose keys stand in any order
    assert {key: np.asarray(value).tolist() for key, value in one.items()} == {key: np.asarray(value).tolist() for key, value in other.items()}
    capsys.readouterr()
    assert run_main(["--out", str(whole), "--resume", "--episodes", "9"]) == 2
    assert "budget.decisions was 4 at the beginning" in capsys.readouterr().err


def test_without_a_free_policy_the_run_ends_with_its_budget(world, capsys):
    flags = ["--policies", "wild", "--selector", "random", "--episodes", "6", "--out"]
    assert run_main(arguments(world, *flags, world / "paid", "--budget-cents", "3.5")) == BudgetError.exit_code
    assert "decisions: the budget is spent: " in capsys.readouterr().err
    assert 0 < len(read_journal(world / "paid" / "episodes.jsonl")) < 6
    assert read_budget(world / "paid").ended
    assert run_main(arguments(world, *flags, world / "poor", "--budget-cents", "0.5")) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("error: --budget-cents: 0.5 cents pay for no decision: the cheapest policy, wild, may cost ")
    assert not (world / "poor").exists()
    assert run_main(arguments(world, *flags, world / "poor", "--budget-per", "3")) == 2
    assert capsys.readouterr().err.startswith("error: --budget-per: is the number of decisions that --budget-cents is for")


@pytest.mark.parametrize("damage", [{"schema_version": 2}, {"spent": -1.0}, {"prices": ["a"]}, {"ended": None}])
def test_a_damaged_budget_file_is_refused(tmp_path, damage):
    good = {"schema_version": 1, "cents": 1.0, "period": 2, "decisions": 2, "spent": 0.5, "ended": "", "prices": [0.0, 0.1]}
    good |= {"reward_of_a_dollar": 1.0, "success_of_a_dollar": 2.0}
    (tmp_path / "budget.json").write_text(json.dumps(good))
    assert read_budget(tmp_path).spent == 0.5
    (tmp_path / "budget.json").write_text(json.dumps(good | damage))
    with pytest.raises(DataError, match=r"budget\.json: "):
        read_budget(tmp_path)


def priced_log(folder, decisions: int = 300, free: float = 0.0):
    contexts, _, _, rewards, prices = knapsack(decisions)
    rows = [
        make_row(f"i/{row}", name, success=bool(rewards[row, at]), price=float(prices[row, at]) or free)
        for row in range(decisions)
        for at, name in enumerate(POLICIES)
    ]
    return write_log(folder, rows, {f"i/{row}": context for row, context in enumerate(contexts)})


def test_a_replay_within_budgets_against_the_oracle_with_as_much(tmp_path):
    log = priced_log(tmp_path / "log")
    common = {"seeds": 1, "workers": 1, "no_frontier": True, "alpha_time": 0.0, "alpha_price": 0.0}
    made = osel.replay(log, selectors=["auto", "thompson"], budget_cents=60, out=tmp_path / "out", **common)
    found = made.result["budget"]
    assert found["cents"] == [15.0, 30.0, 60.0, 120.0, 240.0]
    for entries in found["selectors"].values():
        assert all(entry["most_spent"] <= cents for entry, cents in zip(entries, found["cents"], strict=True))
    auto, mix, best = ([*found["selectors"]["auto"]], found["oracles"]["mix"], found["oracles"]["hindsight"])
    assert all(entry["reward"] <= bound for entry, bound in zip(auto, best, strict=True))
    assert auto[2]["reward"] > mix[2]
    assert found["dual_prices"] == sorted(found["dual_prices"], reverse=True)
    page = osel.report(tmp_path / "out")
    assert "Reward at several budgets" in page.page.read_text()


def test_a_replay_s_budget_that_pays_for_nothing_is_refused(tmp_path):
    log = priced_log(tmp_path / "log", 30, free=0.5)
    common = {"seeds": 1, "workers": 1, "no_frontier": True, "selectors": ["thompson"]}
    with pytest.raises(SettingError, match=r"budget_cents: 0\.2 cents pay for no decision"):
        osel.replay(log, budget_cents=0.2, out=tmp_path / "none", **common)
    with pytest.raises(SettingError, match="budget_cents: is for streams that do not change"):
        osel.replay(log, budget_cents=4, join="remote@5", out=tmp_path / "none", **common)
    with pytest.raises(SettingError, match="budget_per: is the number of decisions"):
        osel.replay(log, budget_per=4, out=tmp_path / "none", **common)
    found = osel.replay(log, budget_cents=4, decisions=20, out=tmp_path / "out", **common).result["budget"]
    assert (found["cents"][0], found["period"], found["decisions"]) == (1.0, 20, 20)
    assert 0.0 < found["selectors"]["thompson"][2]["made"] < 1.0  # some decisions could not be paid
