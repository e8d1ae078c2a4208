"""What policies declare: whose word it is, what it says of a context, and that outcomes overrule it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from osel_sim.context.encoder import load_encoder
from osel_sim.core.errors import ContentError, DataError, UsageError
from osel_sim.episodes.declared_skills import EXAMPLES, declare, declared_skills
from osel_sim.formats import library
from osel_sim.selection.registry import make_selector
from osel_sim.selection.skills import UNKNOWN, Skills
from osel_sim.suites.registry import select_tasks

DIM, KINDS = 16, 4
CENTRES = np.eye(KINDS, DIM, dtype=np.float32)
POLICIES = ("first", "second")


def near(kind: int, count: int, seed: int = 0) -> np.ndarray:
    """Contexts that ask for one kind of thing: text around its centre; the last eight numbers are the picture, which may be anything."""
    chance = np.random.default_rng([seed, kind])
    contexts = CENTRES[kind] + 0.05 * chance.normal(size=(count, DIM))
    contexts[:, 8:] = chance.normal(size=(count, 8))
    return contexts.astype(np.float32)


def skills(able: dict[str, tuple[str, ...]]) -> Skills:
    examples = {f"kind{kind}": near(kind, 6) for kind in range(KINDS)}
    for contexts in examples.values():
        contexts[:, 8:] = 0.3  # a blank picture
    return Skills(examples, able)


def test_a_context_is_taken_for_the_skill_whose_words_it_has():
    known = skills({"first": ("kind0", "kind1"), "second": ("kind2",)})
    assert known.reliability == 1.0
    for kind in range(KINDS):
        assert {known.nearest(context) for context in near(kind, 20, seed=1)} == {f"kind{kind}"}
    assert known.share(near(1, 1)[0], ("second", "first", "stranger")).tolist() == [0.0, 1.0, UNKNOWN]


def test_skills_that_sound_alike_say_little():
    chance = np.random.default_rng(0)
    alike = Skills({name: chance.normal(size=(8, DIM)).astype(np.float32) for name in ("a", "b")}, {"first": ("a",), "second": ("b",)})
    assert alike.reliability < 0.8
    assert np.ptp(alike.share(alike.examples["a"][0], POLICIES)) == pytest.approx(alike.reliability)


def test_wrong_skills_are_refused():
    with pytest.raises(UsageError, match="one length"):
        Skills({"a": np.zeros((2, 3), np.float32), "b": np.zeros((2, 4), np.float32)}, {})
    with pytest.raises(UsageError, match="one length"):
        Skills({}, {})
    with pytest.raises(UsageError, match="finite"):
        Skills({"a": np.full((2, 3), np.nan, np.float32)}, {})
    with pytest.raises(UsageError, match=r"'first' declares kind9, of which there are no examples"):
        skills({"first": ("kind9",)})
    with pytest.raises(UsageError, match=r"skills have length 16, contexts 17"):
        make_selector("auto", POLICIES, DIM + 1, 0, skills=skills({"first": ("kind0",)}))


def received(told: Skills | None, rates: np.ndarray, decisions: int, seed: int) -> np.ndarray:
    """Success rate of what `auto` chose, decision by decision."""
    chance = np.random.default_rng(seed)
    selector = make_selector("auto", POLICIES, DIM, seed, skills=told)
    result = np.zeros(decisions)
    for decision in range(decisions):
        kind = int(chance.integers(KINDS))
        context = near(kind, 1, seed=1000 + decision)[0]
        choice = selector.select(context)
        result[decision] = rates[kind, POLICIES.index(choice.policy)]
        selector.update(context, choice, float(chance.random() < result[decision]))
    return result


def test_true_skills_spare_the_beginning_and_false_ones_are_overruled():
    rates = np.array([[0.8, 0.1], [0.8, 0.1], [0.1, 0.8], [0.1, 0.8]])
    true = skills({"first": ("kind0", "kind1"), "second": ("kind2", "kind3")})
    false = skills({"first": ("kind2", "kind3"), "second": ("kind0", "kind1")})
    runs = {
        name: np.mean([received(told, rates, 300, seed) for seed in range(4)], axis=0)
        for name, told in (("true", true), ("false", false), ("none", None))
    }
    assert runs["true"][:40].mean() > 0.72 > runs["none"][:40].mean()
    assert runs["false"][:10].mean() < 0.6
    assert min(run[-100:].mean() for run in runs.values()) > 0.7


def test_a_state_belongs_to_its_skills():
    told = make_selector("auto", POLICIES, DIM, 0, skills=skills({"first": ("kind0",)}))
    for row, context in enumerate(near(0, 12)):
        told.update(context, told.select(context), float(row % 2))
    again = make_selector("auto", POLICIES, DIM, 1, skills=skills({"first": ("kind0",)}))
    again.load_state_dict(told.state_dict())
    assert again.select(near(2, 1)[0]).propensities == told.select(near(2, 1)[0]).propensities
    for other in (skills({"first": ("kind1",)}), None):
        with pytest.raises(DataError, match="settings"):
            make_selector("auto", POLICIES, DIM, 0, skills=other).load_state_dict(told.state_dict())


def test_a_policy_that_is_added_brings_its_skills():
    selector = make_selector("auto", POLICIES, DIM, 0, skills=skills({"first": ("kind0",), "second": ("kind0",), "late": ("kind3",)}))
    selector.add_policy("late")
    assert selector.select(near(3, 1)[0]).propensities["late"] > 0.9


def test_the_file_has_the_first_word_and_the_checkpoint_the_second(tmp_path: Path):
    spec = library.load_policy("remote_specialist")
    assert declared_skills(spec) == ("close_drawer", "door", "open_drawer", "press_button", "push")
    assert declared_skills(replace(spec, skills=("push", "tag:long"))) == ("push", "sort", "tidy")
    with pytest.raises(ContentError, match=r"remote_specialist\.toml: skills: .*did you mean 'push'"):
        declared_skills(replace(spec, skills=("pusch",)))
    own = replace(spec, checkpoint=str(tmp_path))
    assert declared_skills(own) is None
    trained = json.dumps({"datasets": [{"task": name} for name in ("lift", "mine", "lift")]})
    for text, expected in (("{}", None), ("not json", None), (trained, ("lift",))):
        (tmp_path / "training.json").write_text(text)
        assert declared_skills(own) == expected
    assert declared_skills(replace(spec, checkpoint="somebody/something")) is None


def test_what_the_shipped_policies_declare_is_found_in_unseen_words():
    encoder = load_encoder("osel_suite")
    names = ("remote_specialist", "remote_base")
    told = declare([library.load_policy(name) for name in names], encoder, select_tasks(["sort"]))
    assert told is not None and set(told.able) == set(names) and {len(contexts) for contexts in told.examples.values()} == {EXAMPLES}
    picture = np.full((96, 96, 3), 200, np.uint8)
    wide = {
        "lift": "remote_base",
        "stack": "remote_base",
        "pick_place": "remote_base",
        "nut_assembly": "remote_base",
        "push": "remote_specialist",
        "press_button": "remote_specialist",
    }
    for task, policy in wide.items():
        for seed in range(4):
            instance = select_tasks([task])[0].instance(seed, 2)
            shares = dict(zip(names, told.share(encoder.encode([picture], instance.instruction), names), strict=True))
            assert max(shares, key=shares.__getitem__) == policy, instance.instruction
    for seed in range(4):  # nobody declares it: it is not taken for the nearest that somebody does
        instance = select_tasks(["sort"])[0].instance(seed, 2)
        assert told.share(encoder.encode([picture], instance.instruction), names).tolist() == [0.0, 0.0]
    assert declare([replace(library.load_policy("local_small"), checkpoint="")], encoder, ()) is None
