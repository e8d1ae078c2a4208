"""Training on demonstrations of another suite's tasks: states, actions and control rate are its environment's own, and labels are of landmarks."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from osel_sim.core.errors import DataError, SettingError, UsageError
from osel_sim.formats import library
from osel_sim.policy.registry import make_policy
from osel_sim.suites.metaworld.tasks import SPECIFICATION
from osel_sim.training.annotations import ACTIONS, PLACES, POSITIONS, PRESENT, SIDE_FILE, TARGET
from osel_sim.training.batches import statistics_of
from osel_sim.training.collection import check_settings
from osel_sim.training.dataset import load_demonstrations
from osel_sim.training.demonstrations import write_shard
from osel_sim.training.policy_training import Options, train
from osel_sim.training.recipe import Augmentation, Recipe, find_recipe, load_recipe
from osel_sim.training.source import SampleSource, Wanted
from osel_sim.training.suite_demonstrations import features, label_features

CAMERAS, LANDMARKS = ("corner2", "gripperPOV"), ("object", "goal")
EVERY, FRAMES, SIZE = 4, 6, 40
CHUNK = {"chunk_size": 8, "image_size": SIZE, "text_dim": 16, "hidden": 32, "hidden_layers": 1, "channels": 16, "stem_channels": 8, "query_dim": 8}
SIZES = {"metaworld_small": CHUNK | {"keypoints": 4}, "metaworld_large": CHUNK | {"width": 32, "layers": 1, "patch": 5, "queries": 2}}


def written(folder: Path, task: str, every: int = EVERY, actions: int = 4) -> Path:
    """Five episodes of made-up frames as `collect` writes them of a task of Meta-World."""
    spec = (
        SPECIFICATION
        if actions == 4
        else replace(SPECIFICATION, action=replace(SPECIFICATION.action, names=("x", "gripper"), low=(-1,) * 2, high=(1,) * 2))
    )

    def frames(seed: int) -> list[dict[str, Any]]:
        rng = np.random.default_rng(seed)

        def frame(step: int) -> dict[str, Any]:
            own = rng.uniform(-1, 1, (every, spec.action.dimension)).astype(np.float32)
            images = {f"observation.images.{camera}": rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8) for camera in CAMERAS}
            labels = {POSITIONS: np.array([0, 0.6, 0.02, 0, 0, 0], np.float32), PRESENT: np.array([1, 0], np.float32), TARGET: np.array([0, -1])}
            places = {PLACES + camera: np.array([0.5, -0.5, 9, 9], np.float32) for camera in CAMERAS}
            between = {ACTIONS: own.ravel()} if every > 1 else {}
            state = {"observation.state": rng.random(4).astype(np.float32), "annotation.noise": np.zeros(1, np.float32)}
            return {**images, **state, "action": own[0], **between, **labels, **places, "task": "open the drawer"}

        return [frame(step) for step in range(FRAMES)]

    columns = features(spec, CAMERAS, SIZE, every) | label_features(LANDMARKS, CAMERAS)
    about = {"repo_id": "osel_sim/made_up", "fps": 80 // every, "features": columns, "robot_type": "sawyer"}
    write_shard(folder, range(5), lambda: (about, frames))
    things = [{"name": name, "role": name, "names": [name]} for name in LANDMARKS]
    side = {"task": task, "entities": things, "roles": {name: name for name in LANDMARKS}, "phrasings": {"train": ["open the drawer"]}}
    (folder / "meta" / SIDE_FILE).write_text(json.dumps(side))
    return folder


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("data") / "drawer", "metaworld:drawer-open-v3")


def small(policy: str, **optimisation: Any) -> Recipe:
    shipped = load_recipe(find_recipe(policy))
    settings = replace(shipped.optimisation, steps=3, batch_size=8, warmup_steps=1, **optimisation)
    return replace(shipped, model=SIZES[policy], optimisation=settings)


def test_a_chunk_has_an_action_for_every_control_step_between_frames(demonstrations: Path) -> None:
    data = load_demonstrations(demonstrations, CAMERAS, progress=False)
    assert (data.every, data.state.shape, data.action.shape) == (EVERY, (5 * FRAMES, 4), (5 * FRAMES * EVERY, 4))
    statistics = statistics_of([data], [np.arange(12)])
    torch.testing.assert_close(statistics["action"]["mean"], torch.from_numpy(data.action[: 12 * EVERY : EVERY].mean(axis=0)))
    center, spread = (statistics["observation.state"][key].numpy() for key in ("mean", "std"))
    batch = SampleSource(data, Wanted(8, SIZE, queries=2, active=True), Augmentation(), center, spread).validation(np.array([0, 4, 5, 6]))
    assert torch.equal(batch["action"][0], torch.from_numpy(data.action[:8]))
    assert batch["action_is_pad"].sum(dim=1).tolist() == [0, 0, 4, 0]  # frame 5 is the last of its episode: its own four actions, no more
    found = batch["grounding.positions"][0, 0].numpy() * spread[:3] + center[:3]
    np.testing.assert_allclose(found[0], [0, 0.6, 0.02], atol=1e-6)
    assert np.isnan(found[1]).all()  # the task has no goal


@pytest.mark.parametrize("policy", ["metaworld_small", "metaworld_large"])
def test_what_is_trained_drives_the_environment_it_was_shown(policy: str, demonstrations: Path, tmp_path: Path) -> None:
    spec = replace(library.load_policy(policy), image_size=SIZE, execute=8)
    report = train(spec, small(policy), [demonstrations], Options(out=tmp_path / "out", threads=1, evaluate_every=3))
    assert {"action_error", "gripper_accuracy", "object_cm"} <= set(report["validation"][0])
    local = replace(spec, checkpoint=str(tmp_path / "out"), remote=None)
    session = make_policy(local, SPECIFICATION)
    session.reset("open the drawer")
    images = {f"observation.images.{camera}": np.zeros((SIZE, SIZE, 3), np.uint8) for camera in spec.cameras}
    actions = session.act({**images, "observation.state": np.zeros(4, np.float32), "task": "open the drawer"})
    assert actions.shape == (8, 4) and np.abs(actions).max() <= 1.0


def test_demonstrations_of_environments_that_differ_are_not_mixed(demonstrations: Path, tmp_path: Path) -> None:
    other = written(tmp_path / "other", "metaworld:other", actions=2)
    spec = replace(library.load_policy("metaworld_small"), image_size=SIZE, execute=8)
    with pytest.raises(DataError, match=r"metaworld:drawer-open-v3, metaworld:other have different numbers of action.*one policy cannot learn both"):
        train(spec, small("metaworld_small"), [demonstrations, other], Options(out=tmp_path / "out", threads=1))


def test_act_and_our_own_tasks_say_what_they_do_not_take(demonstrations: Path, tmp_path: Path) -> None:
    import osel_sim

    act = load_recipe(find_recipe("remote_base"))
    recipe = replace(act, tasks=None, weights={}, model={**act.model, "image_size": SIZE})
    spec = replace(library.load_policy("metaworld_small"), image_size=SIZE)
    with pytest.raises(UsageError, match="type 'act' knows only the 8 numbers of our own state, these demonstrations have 4"):
        train(spec, recipe, [demonstrations], Options(out=tmp_path / "out", threads=1))
    with pytest.raises(SettingError, match="every: is for other suites"):
        osel_sim.collect(task=("lift",), episodes=1, every=4, out=tmp_path / "data")


def test_a_dataset_begun_at_every_step_is_not_gone_on_with_at_every_fourth(tmp_path: Path) -> None:
    check_settings(tmp_path, {"task": "metaworld:drawer-open-v3"})  # as before there was `every`
    check_settings(tmp_path, {"task": "metaworld:drawer-open-v3", "every": 1})
    with pytest.raises(UsageError, match="was collected with every = 1, not 4"):
        check_settings(tmp_path, {"task": "metaworld:drawer-open-v3", "every": 4})
