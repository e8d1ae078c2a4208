"""The checkpoints in assets/ as a user gets them."""

import dataclasses
import json

import pytest
from safetensors import safe_open

from osel_sim.core import content
from osel_sim.episodes.loop import Driver, run_episode
from osel_sim.formats import library
from osel_sim.policy.local import LocalCaller
from osel_sim.policy.registry import make_policy
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.instance import make_instance

POLICIES = ("local_small", "remote_base", "remote_large", "remote_specialist")
INSTANCES = 12


@pytest.mark.parametrize(
    ("name", "task", "at_least"),
    [
        ("local_small", "pick_place", 3),
        ("remote_specialist", "open_drawer", 8),
        pytest.param("remote_base", "pick_place", 7, marks=pytest.mark.slow),
        pytest.param("remote_large", "pick_place", 8, marks=pytest.mark.slow),
    ],
)
def test_solves_unseen_instances(name, task, at_least):
    env = TaskEnv(task)
    spec = dataclasses.replace(library.load_policy(name), remote=None)
    driver = Driver(spec, LocalCaller(make_policy(spec, env.specification), spec, env.specification))
    solved = 0
    for seed in range(INSTANCES):
        instance = make_instance(env.task, seed)
        env.load(instance)
        outcome = run_episode(env, instance, driver)
        assert outcome.error is None
        solved += outcome.success
        if solved == at_least:  # whatever becomes of the others
            break
    env.close()
    assert solved == at_least


@pytest.mark.parametrize("name", POLICIES)
def test_loads_through_lerobots_own_from_pretrained(name):
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    from osel_sim.policy import register

    register()
    folder = content.resolve_checkpoint(library.load_policy(name).checkpoint)
    policy = get_policy_class(PreTrainedConfig.from_pretrained(folder).type).from_pretrained(folder)
    assert not any("annotation" in key for key in policy.config.input_features)  # nothing privileged


def test_local_small_is_small():
    folder = content.resolve_checkpoint(library.load_policy("local_small").checkpoint)
    with safe_open(f"{folder}/model.safetensors", "np") as file:
        sizes = [file.get_slice(key).get_shape() for key in file.keys()]  # noqa: SIM118 (not a dictionary)
    parameters = 0
    for shape in sizes:
        product = 1
        for side in shape:
            product *= side
        parameters += product
    assert parameters <= 5_000_000


@pytest.mark.parametrize("name", POLICIES)
def test_says_how_it_was_made(name):
    folder = content.resolve_checkpoint(library.load_policy(name).checkpoint)
    report = json.loads((folder / "training.json").read_text())
    assert report["command"].startswith(f"python -m osel_sim.train --policy {name}")
    assert all(dataset["trained_on"] > 0 for dataset in report["datasets"])
    # The command writes this checkpoint again: at its end, or on its way there.
    _, _, every = report["command"].partition("--eval-every ")
    assert report["steps"] == report["steps_planned"] or report["steps"] % int(every.split()[0]) == 0
