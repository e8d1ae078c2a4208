"""Training of every model type, and of several datasets at once, on the flat world whose answer is known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_demonstrations as world
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from safetensors.torch import load_file

from osel_sim.core.errors import CheckpointError, ContentError, DataError, UnknownNameError, UsageError
from osel_sim.formats import library
from osel_sim.interface.specification import specification
from osel_sim.policy import register
from osel_sim.policy.lerobot_policy import load
from osel_sim.training.annotations import load_annotations
from osel_sim.training.batches import Batches, frames_of, statistics_of
from osel_sim.training.dataset import load_demonstrations
from osel_sim.training.instructions import Instructions
from osel_sim.training.policy_training import Options, train
from osel_sim.training.projection import Pinhole
from osel_sim.training.recipe import Augmentation, Recipe, find_recipe, load_recipe
from osel_sim.training.source import Wanted

ROBOT = specification()

SIZES: dict[str, dict[str, int]] = {
    "octo_chunk": {"chunk_size": 8, "image_size": 48, "stem_channels": 8, "channels": 24, "trunk_layers": 1, "query_dim": 24, "vocabulary": 1024}
    | {"text_dim": 32, "text_layers": 0, "queries": 2, "width": 48, "layers": 2, "hidden": 96, "hidden_layers": 2},
    "act": {"chunk_size": 8, "image_size": 48, "stem_channels": 8, "channels": 24, "trunk_layers": 1, "query_dim": 24, "vocabulary": 1024}
    | {"text_dim": 32, "text_layers": 0, "keypoints": 8, "dim_model": 64, "n_heads": 2, "dim_feedforward": 128, "n_encoder_layers": 1},
}


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return world.write(tmp_path_factory.mktemp("data") / "flat", episodes=20)


def lifting(folder: Path, episodes: int = 20) -> Path:
    """The same world as another task, whose instructions name one thing and whose side file has a property too."""
    world.write(folder, episodes, seed=5)
    side = json.loads((folder / "meta" / "osel_sim.json").read_text())
    side |= {"task": "lift", "roles": {"object": "object", "container": "container"}, "attributes": [{"name": "food", "names": ["the food"]}]}
    (folder / "meta" / "osel_sim.json").write_text(json.dumps(side))
    return folder


def recipe(kind: str, **optimisation: Any) -> Recipe:
    shipped = load_recipe(find_recipe("remote_large"))
    settings = {"batch_size": 8, "warmup_steps": 10, "ema_decay": 0.98, "learning_rate": 2e-3} | optimisation
    changes = {"type": kind, "model": SIZES[kind], "weights": {}, "validation_episodes": 4, "augmentation": replace(shipped.augmentation, shift=2)}
    return replace(shipped, **changes, optimisation=replace(shipped.optimisation, **settings))


def run(kind: str, folder: Path, data: list[Path], steps: int, changes: dict[str, Any] | None = None, **options: Any) -> dict[str, Any]:
    spec = replace(library.load_policy("local_small"), image_size=48)
    return train(spec, replace(recipe(kind, steps=steps), **(changes or {})), data, Options(out=folder, threads=1, **options))


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """Every tensor of a checkpoint, those of its processors included."""
    files = sorted(folder.glob("*.safetensors"))
    return {f"{file.name} {name}": value for file in files for name, value in load_file(file).items()}


@pytest.mark.parametrize("kind", ["octo_chunk", "act"])
def test_a_checkpoint_drives_after_a_few_steps_and_resumes_to_the_same_weights(kind: str, tmp_path: Path, demonstrations: Path) -> None:
    straight = run(kind, tmp_path / "straight", [demonstrations], 4, half=True)
    run(kind, tmp_path / "halves", [demonstrations], 4, until=2, half=True)
    resumed = run(kind, tmp_path / "halves", [demonstrations], 4, resume=True, half=True)
    first, second = (weights(tmp_path / name) for name in ("straight", "halves"))
    assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)
    assert straight["losses"] == resumed["losses"]
    assert {"action_loss", "grounding_loss", "attention_loss"} <= straight["losses"].keys()
    learned = [value for name, value in first.items() if "normalizer" not in name and value.is_floating_point()]
    assert {value.dtype for value in learned} == {torch.float16}

    spec = replace(library.load_policy("local_small"), checkpoint=str(tmp_path / "straight"), image_size=48)
    random = np.random.default_rng(0)
    positions, present, _ = world.scene(random)
    gripper = np.array([0.0, 0.0, 0.8])
    observation = {"observation.images.agentview": world.render(positions, present, gripper), "observation.state": world.state_of(gripper, 0.0)}
    answers = []
    for text in ("put the can in the basket", "put the can in the basket", "put the lemon in the tray"):
        policy = load(spec, ROBOT)()
        policy.reset(text)
        answers.append(policy.act({**observation, "task": text}))
    assert answers[0].shape == (8, 7) and np.array_equal(answers[0], answers[1])
    assert not np.array_equal(answers[0], answers[2])


@pytest.mark.slow
def test_the_octo_style_policy_finds_what_the_instruction_names(tmp_path: Path) -> None:
    """600 small steps: on unseen scenes, in words never trained on, its own readout looks at the thing to fetch, and it moves there."""
    data = world.write(tmp_path / "data", episodes=120)
    result = run(
        "octo_chunk", tmp_path / "out", [data], 600, evaluate_every=600, changes={"optimisation": recipe("octo_chunk", steps=600).optimisation}
    )
    final = result["validation"][-1]
    assert final["object_cm"] < 5 and final["container_cm"] < 5
    register()
    policy = get_policy_class("octo_chunk").from_pretrained(tmp_path / "out")
    before, after = make_pre_post_processors(policy.config, str(tmp_path / "out"))
    statistics = load_file(next((tmp_path / "out").glob("policy_preprocessor_*normalizer*.safetensors")))
    centre, spread = (statistics[f"observation.state.{key}"][:3].numpy() for key in ("mean", "std"))
    random, found, approached = np.random.default_rng(9), 0, 0
    for _ in range(40):
        positions, present, target = world.scene(random)
        gripper = np.array([0.0, 0.0, 0.8])
        image = torch.from_numpy(world.render(positions, present, gripper)).permute(2, 0, 1) / 255
        task = world.instruction(target, world.HELD_OUT, random)
        batch = before({"observation.images.agentview": image, "observation.state": torch.from_numpy(world.state_of(gripper, 0.0)), "task": task})
        with torch.inference_mode():
            busy = policy.read(batch)[3][0, 0, 0, :3].numpy() * spread + centre
            actions = after(policy.predict_action_chunk(batch)[0])
        found += int(np.linalg.norm(busy - positions[target[0]]) < 0.06)
        approached += int(actions[0, :2].numpy() @ (positions[target[0]] - gripper)[:2] > 0)
    assert found >= 32
    assert approached >= 30


@pytest.mark.slow
def test_act_moves_to_what_its_perception_found(tmp_path: Path) -> None:
    """1200 small steps: on unseen scenes, in words never trained on, LeRobot's ACT drives to the thing that is named."""
    data = world.write(tmp_path / "data", episodes=120)
    settings = recipe("act", steps=1200).optimisation
    result = run("act", tmp_path / "out", [data], 1200, evaluate_every=1200, changes={"optimisation": settings})
    final = result["validation"][-1]
    assert final["object_cm"] < 5 and final["container_cm"] < 5 and final["action_error"] < 0.2
    policy = load(replace(library.load_policy("local_small"), checkpoint=str(tmp_path / "out"), image_size=48), ROBOT)()
    random, approached = np.random.default_rng(9), 0
    for _ in range(40):
        positions, present, target = world.scene(random)
        gripper = np.array([0.0, 0.0, 0.8])
        policy.reset(world.instruction(target, world.HELD_OUT, random))
        actions = policy.act(
            {"observation.images.agentview": world.render(positions, present, gripper), "observation.state": world.state_of(gripper, 0.0)}
        )
        approached += int(actions[0, :2] @ (positions[target[0]] - gripper)[:2] > 0)
    assert approached >= 34


def test_what_acts_perception_looks_at_must_be_given(tmp_path: Path, demonstrations: Path) -> None:
    run("act", tmp_path / "out", [demonstrations], 1)
    spec = replace(library.load_policy("local_small"), checkpoint=str(tmp_path / "out"), cameras=("wrist",))
    with pytest.raises(CheckpointError, match=r"it wants observation\.images\.agentview, the policy file gives observation\.images\.wrist"):
        load(spec, ROBOT)


def test_sizes_that_do_not_fit_are_one_line(tmp_path: Path, demonstrations: Path) -> None:
    with pytest.raises(UsageError, match=r"remote_large\.toml: the sizes of the model do not fit each other: .*num_heads"):
        run("act", tmp_path / "out", [demonstrations], 1, changes={"model": SIZES["act"] | {"n_heads": 3}})


def test_act_and_its_perception_begin_with_a_checkpoint(tmp_path: Path, demonstrations: Path) -> None:
    run("act", tmp_path / "first", [demonstrations], 2)
    still = recipe("act", steps=1, learning_rate=0.0)
    spec = replace(library.load_policy("local_small"), image_size=48)
    train(spec, still, [demonstrations], Options(out=tmp_path / "second", threads=1, seed=5, init=tmp_path / "first"))
    first, second = weights(tmp_path / "first"), weights(tmp_path / "second")
    assert any("perception" in name for name in first)
    assert all(torch.equal(first[name], second[name]) for name in first)
    with pytest.raises(CheckpointError, match=r"is of type 'act', the recipe wants 'octo_chunk'"):
        train(spec, recipe("octo_chunk", steps=1), [demonstrations], Options(out=tmp_path / "third", threads=1, init=tmp_path / "first"))


def test_two_datasets_are_sampled_by_weight_and_reported_by_task(tmp_path: Path, demonstrations: Path) -> None:
    home = tmp_path / "all"
    home.mkdir()
    (home / "pick_place").symlink_to(demonstrations)
    lifting(home / "lift")
    result = run("octo_chunk", tmp_path / "out", [home], 4, changes={"weights": {"lift": 3.0, "stack": 2.0}})
    assert [dataset["task"] for dataset in result["datasets"]] == ["lift", "pick_place"]
    final = result["validation"][-1]
    assert final["tasks"].keys() == {"lift", "pick_place"} and final["action_error"] > 0
    with pytest.raises(DataError, match=r"wants demonstrations of 'stack', there are those of: lift, pick_place"):
        run("octo_chunk", tmp_path / "other", [home], 4, changes={"tasks": ("stack",)})
    with pytest.raises(UnknownNameError, match=r"'stak': did you mean 'stack'.*data\.weights"):
        run("octo_chunk", tmp_path / "other", [home], 4, changes={"weights": {"stak": 2.0}})
    with pytest.raises(DataError, match="is given twice"):
        run("octo_chunk", tmp_path / "other", [home, demonstrations], 4)


def test_an_epoch_gives_each_dataset_its_share(tmp_path: Path, demonstrations: Path) -> None:
    data = [load_demonstrations(folder, ("agentview",), progress=False) for folder in (demonstrations, lifting(tmp_path / "lift", 10))]
    frames = [frames_of(one, np.arange(one.episodes)) for one in data]
    batches = Batches(data, frames, statistics_of(data, frames), Wanted(8, 48), Augmentation(), 0, (1.0, 2.0))
    epoch = batches._shuffled(0)
    assert len(epoch) == 360 and (epoch[:, 0] == 1).sum() == 240
    assert set(epoch[epoch[:, 0] == 1, 1]) == set(range(120))  # each of its frames twice
    assert not np.array_equal(epoch, batches._shuffled(1))
    assert len(batches.training(0, 32)["task"]) == 32


def test_roles_that_nothing_fills_and_properties_have_no_place(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    (folder / "meta").mkdir(parents=True)
    side = {
        "entities": [{"name": "can", "role": "object", "names": ["can"]}, {"name": "tray", "role": "container", "names": ["tray", "dish"]}],
        "attributes": [{"name": "food", "names": ["the food"]}],
        "roles": {"rule": "attribute", "place": "container", "other": "container"},
        "phrasings": {"train": ["put {rule} in the {place}"]},
    }
    (folder / "meta" / "osel_sim.json").write_text(json.dumps(side))
    columns: dict[str, Any] = {
        "annotation.entity_positions": np.arange(12, dtype=np.float32).reshape(2, 6),
        "annotation.entity_present": np.ones((2, 2), np.float32),
        "annotation.target": np.array([[2, 1, -1], [2, 1, -1]]),
        "annotation.active": np.array([[0, 1], [-1, -1]]),
        "annotation.places.agentview": np.array([[0.5, 0.5, 2.0, 2.0]] * 2, np.float32),
    }
    annotations = load_annotations(folder, columns)
    assert annotations is not None
    found = annotations.positions_of(np.array([0, 1]), annotations.target)
    assert np.isnan(found[:, [0, 2]]).all() and found[1, 1].tolist() == [9, 10, 11]
    places = annotations.places_of("agentview", np.array([0, 1]), annotations.active, np.zeros((2, 8), np.float32))
    assert places[0, 0].tolist() == [0.5, 0.5] and np.isnan(places[0, 1]).all() and np.isnan(places[1]).all()
    instructions, random = Instructions(annotations, Augmentation(drop_word=0, noise_word=0)), np.random.default_rng(0)
    assert instructions.phrase(annotations.target[0], random) in ("put the food in the tray", "put the food in the dish")
    assert instructions.pair(annotations.present[0], random).tolist() == [2, 1, -1]  # one container cannot fill two roles
    (folder / "meta" / "osel_sim.json").write_text(json.dumps(side | {"levels": [0, 2]}))
    assert load_annotations(folder, columns) is not None
    with pytest.raises(DataError, match=r"cameras move .*level 2.*annotation\.places\."):
        load_annotations(folder, {name: value for name, value in columns.items() if "places" not in name})
    columns["annotation.target"] = np.array([[3, 1, -1]] * 2)
    with pytest.raises(DataError, match="the index 3, there are 2 entities and 1 attributes"):
        load_annotations(folder, columns)


def test_places_of_points_in_a_camera(demonstrations: Path) -> None:
    """The flat world's camera sees columns grow with x and rows with y."""
    pose = json.loads((demonstrations / "meta" / "osel_sim.json").read_text())["cameras"]["agentview"]
    points = np.array([[0.2, -0.1, 0.8], [9.0, 0.0, 0.8]], np.float32)
    seen, hidden = Pinhole.from_dict(pose).places(points[None], world.state_of(np.zeros(3), 0.0)[None])[0]
    assert seen == pytest.approx([0.5, -0.25]) and np.isnan(hidden).all()


def test_recipes_of_all_types_and_what_they_refuse(tmp_path: Path) -> None:
    for name, kind in {
        "local_small": "language_chunk",
        "remote_large": "octo_chunk",
        "remote_base": "act",
        "remote_specialist": "language_chunk",
    }.items():
        assert load_recipe(find_recipe(name)).type == kind
    file = tmp_path / "bad.toml"
    for text, message in {
        '[model]\ntype = "octo"\n': "did you mean 'octo_chunk'",
        '[model]\ntype = "act"\npatch = 3\n': r"model\.patch.*is not a known key",
        '[model]\ntype = "act"\n[data]\nweights = { lift = 0 }\n': r"data\.weights\.lift.*must lie in",
    }.items():
        file.write_text("version = 1\n" + text)
        with pytest.raises(ContentError, match=message):
            load_recipe(file)
