"""The checkpoints in assets/ as a user gets them."""

import dataclasses
import json

import numpy as np
import pytest
from safetensors import safe_open

from osel_sim.core import content
from osel_sim.episodes.drivers import choose_policies
from osel_sim.episodes.loop import Driver, run_episode
from osel_sim.formats import library
from osel_sim.interface.specification import specification
from osel_sim.policy.local import LocalCaller
from osel_sim.policy.registry import make_policy
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.instance import make_instance
from osel_sim.suites.environments import environment
from osel_sim.suites.metaworld.tasks import SPECIFICATION
from osel_sim.suites.registry import find_task

METAWORLD = ("metaworld_small", "metaworld_large")
POLICIES = ("local_small", "remote_base", "remote_large", "remote_specialist", *METAWORLD)
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


@pytest.mark.parametrize("name", METAWORLD)
def test_drives_meta_worlds_environment(name):
    spec = dataclasses.replace(library.load_policy(name), remote=None)
    policy = make_policy(spec, SPECIFICATION)
    policy.reset("open the drawer")
    images = {f"observation.images.{camera}": np.zeros((spec.image_size, spec.image_size, 3), np.uint8) for camera in spec.cameras}
    actions = policy.act({**images, "observation.state": np.zeros(4, np.float32), "task": "open the drawer"})
    assert len(actions) >= spec.execute and actions.shape[1] == 4 and np.abs(actions).max() <= 1.0


def test_each_world_is_offered_its_own_policies():
    assert [spec.name for spec in choose_policies(None, SPECIFICATION)] == sorted(METAWORLD)
    assert not {spec.name for spec in choose_policies(None, specification())} & set(METAWORLD)


@pytest.mark.slow
@pytest.mark.skipif(not environment("metaworld").installed, reason="the suite's environment has not been made")
@pytest.mark.parametrize("name", METAWORLD)
def test_solves_unseen_instances_of_meta_world(name):
    task = find_task("metaworld:drawer-open-v3")
    env, spec = task.open(), dataclasses.replace(library.load_policy(name), remote=None)
    driver = Driver(spec, LocalCaller(make_policy(spec, env.specification), spec, env.specification))
    outcomes = []
    for seed in range(4):
        instance = task.instance(seed)
        env.load(instance)
        outcomes.append(run_episode(env, instance, driver))
    env.close()
    assert [outcome.error for outcome in outcomes] == [None] * 4 and sum(outcome.success for outcome in outcomes) >= 2


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
