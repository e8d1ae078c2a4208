"""Training on a flat world whose answer is known: squares whose place in the image gives their place in the world."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_demonstrations as world
import torch
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file

from osel_sim.core.errors import CheckpointError, ContentError, DataError, DivergedError, UnknownNameError, UsageError
from osel_sim.formats import library
from osel_sim.policy.language_chunk import LanguageChunkPolicy
from osel_sim.train import main
from osel_sim.training.batches import Batches, frames_of, statistics_of
from osel_sim.training.dataset import load_demonstrations
from osel_sim.training.instructions import Instructions
from osel_sim.training.loop import Problem, Trainer
from osel_sim.training.policy_training import Options, train
from osel_sim.training.recipe import Augmentation, Recipe, find_recipe, load_recipe
from osel_sim.training.source import Wanted

MODEL = {"chunk_size": 8, "image_size": 48, "stem_channels": 8, "channels": 24, "trunk_layers": 1, "keypoints": 4, "query_dim": 24}
MODEL |= {"vocabulary": 1024, "text_dim": 32, "text_layers": 0, "hidden": 64, "hidden_layers": 1}


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return world.write(tmp_path_factory.mktemp("data") / "flat", episodes=40)


def recipe(**optimisation: Any) -> Recipe:
    shipped = load_recipe(find_recipe("local_small"))
    settings = {"batch_size": 16, "warmup_steps": 10, "ema_decay": 0.98, "learning_rate": 3e-3} | optimisation
    return replace(shipped, model=MODEL, weights={}, episodes=None, validation_episodes=6, optimisation=replace(shipped.optimisation, **settings))


def run(folder: Path, data: Path, steps: int, **options: Any) -> dict[str, Any]:
    spec = replace(library.load_policy("local_small"), image_size=48)
    return train(spec, recipe(steps=steps), [data], Options(out=folder, threads=1, **options))


def test_demonstrations_are_read_as_they_were_written(demonstrations: Path) -> None:
    data = load_demonstrations(demonstrations, ("agentview",), progress=False)
    assert data.episodes == 40 and len(data.state) == len(data.images["agentview"]) == 480
    assert data.annotations is not None
    frame = 100
    positions, present = data.annotations.positions[frame], data.annotations.present[frame]
    drawn = world.render(positions, present, data.state[frame, :3])
    assert np.array_equal(data.images["agentview"][frame], drawn)
    episode = np.searchsorted(data.starts, frame, side="right") - 1
    assert data.starts[episode] <= frame < data.starts[episode + 1]
    named = data.tasks[data.task[frame]]
    target = data.annotations.target[frame]
    assert all(any(name in named for name in data.annotations.entities[index].names) for index in target)
    again = load_demonstrations(demonstrations, ("agentview",), progress=False)
    assert again.fingerprint == data.fingerprint
    assert not list(demonstrations.glob(".cache/*/*.partial"))


def test_a_missing_camera_and_a_wrong_folder_are_named(demonstrations: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"camera 'wrist'.*name one of observation\.images\.agentview with images = .*--map"):
        load_demonstrations(demonstrations, ("wrist",), progress=False)
    with pytest.raises(DataError, match=r"osel_sim\.collect"):
        load_demonstrations(tmp_path, ("agentview",), progress=False)


def make_batches(data: Path, **augmentation: Any) -> tuple[Batches, Any]:
    loaded = load_demonstrations(data, ("agentview",), progress=False)
    frames = frames_of(loaded, np.arange(loaded.episodes))
    none = dict.fromkeys(("brightness", "contrast", "colour", "state_noise", "state_dropout", "drop_word", "noise_word"), 0.0)
    settings = Augmentation(**({"shift": 0, "rephrase": 0.0} | none | augmentation))
    statistics = statistics_of([loaded], [frames])
    wanted = Wanted(chunk_size=8, image_size=48, queries=2, vocabulary=512, text_length=16, pairs=1)
    batches = Batches([loaded], [frames], statistics, wanted, settings, seed=3)
    return batches, loaded


def test_a_batch_depends_on_seed_and_step_only(demonstrations: Path) -> None:
    first, _ = make_batches(demonstrations, shift=4, brightness=0.1, rephrase=1.0, noise_word=0.3, state_noise=0.1)
    second, _ = make_batches(demonstrations, shift=4, brightness=0.1, rephrase=1.0, noise_word=0.3, state_noise=0.1)
    first.training(0, 16)
    one, two, other = first.training(40, 16), second.training(40, 16), second.training(41, 16)
    for key, value in one.items():
        assert value == two[key] if isinstance(value, list) else torch.equal(value, two[key]), key
    assert not torch.equal(one["observation.state"], other["observation.state"])


def test_an_epoch_sees_every_frame_once(demonstrations: Path) -> None:
    batches, data = make_batches(demonstrations)
    seen = torch.cat([batches.training(step, 48)["observation.state"] for step in range(10)])
    assert np.array_equal(np.sort(seen[:, 0].numpy()), np.sort(data.state[:, 0]))


def test_chunks_stop_at_the_episodes_end(demonstrations: Path) -> None:
    batches, data = make_batches(demonstrations)
    batch = batches.validation(0, 8, 8)  # frames 8 .. 15 of episodes of 12 frames
    assert batch["action_is_pad"].sum(dim=1).tolist() == [4, 5, 6, 7, 0, 0, 0, 0]
    assert torch.equal(batch["action"][0, :4], torch.from_numpy(data.action[8:12]))
    assert torch.equal(batch["action"][0, 4:], torch.from_numpy(data.action[11:12]).expand(4, 7))


def test_a_shift_moves_the_image_and_says_by_how_much(demonstrations: Path) -> None:
    plain, _ = make_batches(demonstrations)
    moved, _ = make_batches(demonstrations, shift=3)
    before, after = plain.training(0, 16), moved.training(0, 16)
    key = "observation.images.agentview"
    right, down = (after["image_shift"][0] * 48 / 2).round().int().tolist()
    assert (right, down) != (0, 0)
    inner = after[key][0, :, 3 + max(down, 0) : 45 + min(down, 0), 3 + max(right, 0) : 45 + min(right, 0)]
    rows, columns = slice(3 + max(down, 0) - down, 45 + min(down, 0) - down), slice(3 + max(right, 0) - right, 45 + min(right, 0) - right)
    assert torch.allclose(inner, before[key][0, :, rows, columns], atol=1 / 255)


def test_instructions_keep_their_names_whatever_else_changes(demonstrations: Path) -> None:
    data = load_demonstrations(demonstrations, ("agentview",), progress=False)
    assert data.annotations is not None
    instructions = Instructions(data.annotations, Augmentation(drop_word=0.5, noise_word=0.5))
    random = np.random.default_rng(0)
    for _ in range(50):
        pair = instructions.pair(data.annotations.present[0], random)
        entities = [data.annotations.entities[index] for index in pair]
        assert [entity.kind for entity in entities] == ["object", "container"]
        text = instructions.phrase(pair, random)
        assert all(any(name in text for name in entity.names) for entity in entities)
        assert "put" not in text.split()


def test_inserted_words_make_instructions_long_and_change_nothing_in_them(demonstrations: Path) -> None:
    data = load_demonstrations(demonstrations, ("agentview",), progress=False)
    assert data.annotations is not None
    random, none = np.random.default_rng(0), {"drop_word": 0.0, "noise_word": 0.0}
    target = data.annotations.target[0]
    plain = Instructions(data.annotations, Augmentation(**none))
    phrasings = {plain.phrase(target, random) for _ in range(300)}
    longest = max(len(text.split()) for text in phrasings)
    instructions = Instructions(data.annotations, Augmentation(insert_words=12, **none))
    lengths = []
    for _ in range(100):
        words = instructions.phrase(target, random).split()
        lengths.append(len(words))
        assert any(_is_within(text.split(), words) for text in phrasings), words
    assert longest < max(lengths) <= longest + 12


def test_words_are_shuffled_only_where_their_order_says_nothing(demonstrations: Path) -> None:
    data = load_demonstrations(demonstrations, ("agentview",), progress=False)
    annotations = data.annotations
    assert annotations is not None
    pair = np.array([next(i for i, thing in enumerate(annotations.entities) if thing.kind == kind) for kind in annotations.roles.values()])
    first, second = (annotations.entities[index].names for index in pair)
    of_two_kinds = replace(annotations, phrasings=("put {object} into {container}",))
    of_one_kind = replace(of_two_kinds, roles=dict.fromkeys(annotations.roles, "object"))
    for labels, orders in ((of_two_kinds, {True, False}), (of_one_kind, {True})):
        random, instructions = np.random.default_rng(0), Instructions(labels, Augmentation(shuffle_words=1.0))
        texts = [instructions.phrase(pair, random) for _ in range(50)]
        assert {max(map(text.find, first)) < max(map(text.find, second)) for text in texts} == orders
        assert all(max(map(text.find, names)) >= 0 for text in texts for names in (first, second))


def _is_within(part: list[str], words: list[str]) -> bool:
    """Whether these words are among those, in this order."""
    rest = iter(words)
    return all(word in rest for word in part)


@pytest.mark.slow
def test_training_finds_what_the_instruction_names(tmp_path: Path) -> None:
    """600 small steps: the named square is found to a few centimetres on unseen scenes, also in words never trained on."""
    data = world.write(tmp_path / "data", episodes=120)
    result = run(tmp_path / "out", data, 600, evaluate_every=600)
    final = result["validation"][-1]
    assert final["object_cm"] < 4 and final["container_cm"] < 4
    assert final["action_error"] < 0.2

    policy = LanguageChunkPolicy.from_pretrained(tmp_path / "out")
    before, _ = make_pre_post_processors(policy.config, str(tmp_path / "out"))
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
            actions, scene = policy.compute(batch)
        places = scene.fused[0, 0, :, :3].numpy() * spread + centre
        found += int((np.linalg.norm(places - positions[target], axis=1) < 0.05).all())
        approached += int(actions[0, 0, :2].numpy() @ (positions[target[0]] - gripper)[:2] > 0)
    assert found >= 36
    assert approached >= 28


def test_a_resumed_run_ends_with_the_same_weights(tmp_path: Path, demonstrations: Path) -> None:
    straight = run(tmp_path / "straight", demonstrations, 24, evaluate_every=12)
    run(tmp_path / "halves", demonstrations, 24, evaluate_every=12, until=10)
    resumed = run(tmp_path / "halves", demonstrations, 24, evaluate_every=12, resume=True)
    first, second = (load_file(tmp_path / name / "model.safetensors") for name in ("straight", "halves"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert straight["losses"] == resumed["losses"]
    assert json.loads((tmp_path / "halves" / "training.json").read_text())["steps"] == 24


def test_resume_refuses_another_seed(tmp_path: Path, demonstrations: Path) -> None:
    run(tmp_path, demonstrations, 4, until=2)
    with pytest.raises(CheckpointError, match="was trained with seed 0; give the same"):
        run(tmp_path, demonstrations, 4, resume=True, seed=1)
    with pytest.raises(UsageError, match="--resume"):
        run(tmp_path, demonstrations, 4)


def test_a_state_that_is_a_pickle_damaged_or_of_another_model_is_refused(tmp_path: Path, demonstrations: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    torch.save({"step": 2}, out / "training_state.pt")
    with pytest.raises(CheckpointError, match=r"training_state\.pt: is the state of an earlier version, a pickle, .* remove it to start over"):
        run(out, demonstrations, 4, resume=True)
    (out / "training_state.pt").unlink()
    run(out, demonstrations, 4, until=2)
    state = out / "training.state"
    whole = state.read_bytes()
    state.write_bytes(whole[:-10])
    with pytest.raises(DataError, match="training state cannot be read"):
        run(out, demonstrations, 4, resume=True)
    state.write_bytes(whole.replace(b'"weights.', b'"wEights.'))
    with pytest.raises(DataError, match="weights has other tensors than what is trained"):
        run(out, demonstrations, 4, resume=True)
    state.write_bytes(whole.replace(b'"optimiser.', b'"optimiser:'))
    with pytest.raises(DataError, match="optimiser belongs to other parameters"):
        run(out, demonstrations, 4, resume=True)


def test_measuring_the_speed_changes_nothing_that_is_trained(tmp_path: Path) -> None:
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))
    optimiser = torch.optim.AdamW(module.parameters(), lr=0.1)
    problem = Problem(
        module,
        lambda step: torch.ones(2, 3),
        lambda batch: (module(batch).sum(), {}),
        optimiser,
        lambda step, steps: 1.0,
        tuple(module.parameters()),
        0.0,
    )
    before = {name: value.clone() for name, value in module.state_dict().items()}
    trainer = Trainer(problem, 5, "cpu", tmp_path, {})
    assert trainer.steps_in(0.01) >= 1
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items()) and not optimiser.state


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_a_training_that_diverges_stops_with_the_last_good_weights(tmp_path: Path, where: str) -> None:
    module = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))

    def loss_of(step: int) -> tuple[torch.Tensor, dict[str, float]]:
        values = module(torch.full((4, 2), float("nan") if step == 3 and where == "loss" else 1.0) * torch.arange(4)[:, None])
        loss = values.square().mean()
        if step == 3 and where == "gradient":
            loss = loss + torch.sqrt(torch.clamp(module[0].weight.sum() * 0, min=0) ** 2)  # finite, with a slope that is not
        return loss, {"loss": loss.item()}

    problem = Problem(module, lambda step: step, loss_of, torch.optim.SGD(module.parameters(), 0.1), lambda step, steps: 1.0, (), 0.0, 0.5)
    problem = replace(problem, clipped=tuple(module.parameters()))
    trainer = Trainer(problem, 10, "cpu", tmp_path, {})
    with pytest.raises(DivergedError, match=r"step 4 of 10: loss .* keeps the weights of step 3"):
        trainer.run({}, save_every=100, label="test")
    again = Trainer(problem, 10, "cpu", tmp_path, {})
    assert again.resume() and again.progress.step == 3
    for values in (module.state_dict(), trainer.average):
        assert all(torch.isfinite(value).all() for value in values.values())


def test_a_policy_that_diverges_keeps_a_checkpoint_and_fails(tmp_path: Path, demonstrations: Path) -> None:
    with pytest.raises(DivergedError):
        spec = replace(library.load_policy("local_small"), image_size=48)
        wild = recipe(steps=40, learning_rate=1e6, gradient_clip=0.0)
        train(spec, wild, [demonstrations], Options(out=tmp_path / "out", threads=1))
    weights = load_file(tmp_path / "out" / "model.safetensors")
    assert all(torch.isfinite(value).all() for value in weights.values())


@pytest.mark.slow
def test_a_killed_run_continues(tmp_path: Path, demonstrations: Path) -> None:
    command = [sys.executable, "-m", "osel_sim.train", "--policy", "local_small", "--data", str(demonstrations), "--out", str(tmp_path / "out")]
    command += ["--steps", "12", "--batch-size", "4", "--save-every", "1", "--eval-every", "12", "--threads", "1"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})
    while process.poll() is None and not (tmp_path / "out" / "training.state").exists():
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert main([*command[3:], "--resume"]) == 0
    assert json.loads((tmp_path / "out" / "training.json").read_text())["steps"] == 12


def test_half_precision_is_half_the_size_and_loads(tmp_path: Path, demonstrations: Path) -> None:
    run(tmp_path, demonstrations, 3, half=True)
    saved = load_file(tmp_path / "model.safetensors")
    assert {value.dtype for value in saved.values()} == {torch.float16}
    policy = LanguageChunkPolicy.from_pretrained(tmp_path)
    assert {value.dtype for value in policy.parameters()} == {torch.float32}


def test_training_begins_with_a_checkpoint(tmp_path: Path, demonstrations: Path) -> None:
    run(tmp_path / "first", demonstrations, 3)
    spec = replace(library.load_policy("local_small"), image_size=48)
    still = recipe(steps=1, learning_rate=0.0)
    options = Options(out=tmp_path / "second", threads=1, seed=5, init=tmp_path / "first")
    result = train(spec, replace(still, episodes=3), [demonstrations], options)  # another seed, other statistics
    assert result["init"]["name"] == "first"
    for name in ("model.safetensors", next((tmp_path / "first").glob("policy_preprocessor_*.safetensors")).name):
        before, after = (load_file(tmp_path / folder / name) for folder in ("first", "second"))
        assert before and all(torch.equal(before[key], after[key]) for key in before)
    wider = replace(still, model=MODEL | {"hidden": 128})
    with pytest.raises(CheckpointError, match=r"head\.\S+ is .* there, .* here"):
        train(spec, wider, [demonstrations], replace(options, out=tmp_path / "third"))
    for nothing in (demonstrations, Path("somebody/nothing")):
        with pytest.raises(CheckpointError, match=r"no checkpoint to begin with: it has no model\.safetensors"):
            train(spec, still, [demonstrations], replace(options, out=tmp_path / "third", init=nothing))


def test_data_without_annotations_trains_actions_only(tmp_path: Path) -> None:
    data = world.write(tmp_path / "data", episodes=6, annotated=False)
    result = run(tmp_path / "out", data, 3)
    assert "grounding_loss" not in result["losses"] and "action_loss" in result["losses"]


def test_wrong_use_is_one_line(tmp_path: Path, demonstrations: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in {
        ("--policy", "local_smal", "--data", str(demonstrations)): "did you mean 'local_small'",
        ("--policy", "local_small", "--data", str(tmp_path / "none")): "osel_sim.collect",
        ("--policy", "local_small", "--data", str(demonstrations), "--steps", "0"): "--steps: must be 1 or more, got 0",
        ("--policy", "local_small"): "--data",
        ("--policy", "local_small", "--data", str(demonstrations), "--step", "3"): "did you mean '--steps'?",
        ("--encoder", "osel_small"): "--data",
    }.items():
        try:
            code = main(list(arguments))
        except SystemExit as ended:
            code = ended.code
        assert code == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and words in error and error.count("\n") == 1


def test_recipes(tmp_path: Path) -> None:
    for name in ("local_small", "remote_large"):
        assert load_recipe(find_recipe(name)).model
    with pytest.raises(UnknownNameError):
        find_recipe("nothing")
    file = tmp_path / "bad.toml"
    file.write_text('version = 1\n[model]\ntype = "language_chunk"\n[optimisation]\nlearning_rat = 1e-3\n')
    with pytest.raises(ContentError, match=r"optimisation\.learning_rat.*learning_rate"):
        load_recipe(file)
