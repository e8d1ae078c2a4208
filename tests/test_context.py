"""Encoders, the cache of contexts, and the embedded encoder's training."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from osel_sim.context.cache import ContextCache
from osel_sim.context.encoder import encode_many, load_encoder
from osel_sim.core import content
from osel_sim.core.errors import CheckpointError, DataError, UnknownNameError, UsageError
from osel_sim.formats.task_file import TaskSpec, load_task_file
from osel_sim.interface.encoder import Encoder
from osel_sim.training.encoder.captions import PLACES, Caption, Captions, truth
from osel_sim.training.encoder.evaluate import measure_task, neighbour_agreement
from osel_sim.training.encoder.scenes import Scenes, render_instances

TINY = "tiny_open_clip"


@pytest.fixture(scope="module")
def task() -> TaskSpec:
    return load_task_file(content.find("tasks", "pick_place"))


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return load_encoder()


@pytest.fixture(scope="module")
def scenes(task: TaskSpec) -> Scenes:
    return render_instances(task, range(5000, 5120), "test", 96)


@pytest.fixture(scope="module")
def contexts(encoder: Encoder, scenes: Scenes) -> np.ndarray:
    return encode_many(encoder, [([image], text) for image, text in zip(scenes.images, scenes.instructions.tolist(), strict=True)])


def test_importing_the_package_imports_no_torch() -> None:
    code = "import sys, osel_sim.context.encoder, osel_sim.context.cache, osel_sim.training.encoder.train as train; "
    code += "print([name for name in ('torch', 'open_clip', 'mujoco') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


# -- the embedded encoder ----------------------------------------------------------------------------------------------


def test_embedded_encoder_is_a_trained_open_clip_model_with_its_report(encoder: Encoder) -> None:
    import open_clip

    folder = content.root() / "assets" / "encoders" / "osel_small"
    assert isinstance(encoder.model, open_clip.CLIP)  # type: ignore[attr-defined]
    assert encoder.name == "osel_small" and encoder.identity.startswith("osel_small@")
    assert sum(file.stat().st_size for file in folder.iterdir()) < 15e6
    report = json.loads((folder / "training.json").read_text())
    assert report["measured"]["image_to_instruction"]["held_out_phrasings"] > 0.8


def test_contexts_have_the_promised_form_and_are_the_same_bits_each_time(encoder: Encoder, scenes: Scenes, contexts: np.ndarray) -> None:
    assert contexts.shape == (len(scenes), encoder.dimension) and contexts.dtype == np.float32
    half = encoder.dimension // 2
    np.testing.assert_allclose(np.linalg.norm(contexts[:, :half], axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(contexts[:, half:], axis=1), 1, atol=1e-5)
    again = load_encoder().encode([scenes.images[7]], str(scenes.instructions[7]))
    assert again.tobytes() == contexts[7].tobytes()


def test_image_and_instruction_both_matter(encoder: Encoder, scenes: Scenes, contexts: np.ndarray) -> None:
    half = encoder.dimension // 2
    other_image = encoder.encode([scenes.images[1]], str(scenes.instructions[0]))
    assert np.array_equal(other_image[half:], contexts[0, half:]) and np.abs(other_image[:half] - contexts[0, :half]).max() > 0.01
    other_text = encoder.encode([scenes.images[0]], "put the lemon in the basket, if you please")
    assert np.array_equal(other_text[:half], contexts[0, :half]) and np.abs(other_text[half:] - contexts[0, half:]).max() > 0.01


def test_several_images_are_averaged_and_keep_the_dimension(encoder: Encoder, scenes: Scenes, contexts: np.ndarray) -> None:
    same = encoder.encode([scenes.images[0], scenes.images[0]], str(scenes.instructions[0]))
    np.testing.assert_allclose(same, contexts[0], atol=1e-6)
    two = encoder.encode([scenes.images[0], scenes.images[1]], str(scenes.instructions[0]))
    assert two.shape == same.shape and not np.allclose(two, same, atol=1e-3)


def test_unseen_instances_with_the_same_object_lie_together(scenes: Scenes, contexts: np.ndarray) -> None:
    assert neighbour_agreement(contexts, scenes.targets, 5) > 0.8


def test_pictures_find_their_instructions_on_unseen_scenes(encoder: Encoder, task: TaskSpec, scenes: Scenes) -> None:
    measured = measure_task(encoder, task, scenes)  # type: ignore[arg-type]
    assert measured["image_to_instruction"]["trained_phrasings"] > 0.8
    assert measured["image_to_instruction"]["held_out_phrasings"] > 0.7
    assert measured["instruction_to_image"]["held_out_phrasings"] > 0.7
    assert measured["probes"]["object"] > 0.9


def test_the_encoder_of_all_tasks_tells_them_apart() -> None:
    tasks = [load_task_file(content.find("tasks", name)) for name in ("lift", "push", "open_drawer", "press_button")]
    scenes = [render_instances(task, range(8), "test", 96, (0, 2)) for task in tasks]
    pictured = [([image], text) for one in scenes for image, text in zip(one.images, one.instructions.tolist(), strict=True)]
    contexts = encode_many(load_encoder("osel_suite"), pictured)
    near = contexts @ contexts.T - 9.0 * np.eye(len(contexts))
    assert np.mean(near.argmax(axis=1) // 8 == np.arange(len(contexts)) // 8) > 0.8


def test_levels_of_scenes_take_turns(task: TaskSpec) -> None:
    turned = render_instances(task, range(2), "train", 48, (0, 2))
    for seed, level in ((0, 0), (1, 2)):
        alone = render_instances(task, [seed], "train", 48, (level,))
        np.testing.assert_array_equal(turned.images[seed], alone.images[0])
    assert not np.array_equal(turned.images[1], render_instances(task, [1], "train", 48).images[0])


@pytest.mark.parametrize("image", [np.zeros((96, 96), np.uint8), np.zeros((96, 96, 3), np.float32), np.zeros((3, 96, 96), np.uint8)])
def test_an_image_of_another_form_is_refused(encoder: Encoder, image: np.ndarray) -> None:
    with pytest.raises(UsageError, match=r"uint8 \(H, W, 3\)"):
        encoder.encode([image], "put the can in the bowl")


def test_no_image_is_refused(encoder: Encoder) -> None:
    with pytest.raises(UsageError, match="at least one image"):
        encoder.encode([], "put the can in the bowl")


# -- other encoders ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("osel_smal", UnknownNameError, "did you mean 'osel_small'"),
        ("ViT-L-14x:openai", UnknownNameError, "did you mean 'ViT-L-14'"),
        ("ViT-L-14:openia", UnknownNameError, "did you mean 'openai'"),
        ("ViT-L-14", UsageError, "ViT-L-14:TAG with one of openai"),
        ("ViT-L-14:/nowhere/weights.safetensors", CheckpointError, "no such file: /nowhere/weights.safetensors"),
    ],
)
def test_what_does_not_exist_is_named_with_the_nearest_that_does(name: str, error: type[Exception], says: str) -> None:
    with pytest.raises(error) as caught:
        load_encoder(name)
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_weights_that_cannot_be_had_end_soon_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """The hub is a closed port of this machine, and its local cache is empty."""
    for name, value in {"HF_HUB_OFFLINE": False, "ENDPOINT": "http://127.0.0.1:9", "HF_HUB_CACHE": str(tmp_path)}.items():
        monkeypatch.setattr(f"huggingface_hub.constants.{name}", value)
    start = time.monotonic()
    with pytest.raises(CheckpointError, match=r"^encoder 'RN50:openai'") as failure:
        load_encoder("RN50:openai")
    assert time.monotonic() - start < 15  # the hub's client alone would retry for most of a minute
    assert "\n" not in str(failure.value) and "use the embedded 'osel_small'" in str(failure.value)
    assert capfd.readouterr() == ("", "")


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Random weights of a model that open_clip is told about."""
    import open_clip
    import torch
    from open_clip import factory
    from safetensors.torch import save_file

    monkeypatch.setattr(factory, "_MODEL_CONFIG_PATHS", list(factory._MODEL_CONFIG_PATHS))
    monkeypatch.setattr(factory, "_MODEL_CONFIGS", dict(factory._MODEL_CONFIGS))
    vision = {"image_size": 32, "layers": 1, "width": 32, "head_width": 16, "patch_size": 16}
    config = {"embed_dim": 24, "vision_cfg": vision, "text_cfg": {"width": 32, "heads": 2, "layers": 1}}
    (tmp_path / f"{TINY}.json").write_text(json.dumps(config))
    open_clip.add_model_config(tmp_path / f"{TINY}.json")
    torch.manual_seed(0)
    save_file(open_clip.create_model(TINY).state_dict(), tmp_path / "weights.safetensors")
    return tmp_path / "weights.safetensors"


def test_weights_from_a_file_load(tiny: Path) -> None:
    encoder = load_encoder(f"{TINY}:{tiny}")
    assert (encoder.dimension, encoder.image_size) == (48, 32)
    assert encoder.identity.startswith(f"{TINY}@")  # the weights' digest, not where they lie
    assert encoder.encode([np.zeros((64, 48, 3), np.uint8)], "put the can in the bowl").shape == (48,)


def test_weights_that_do_not_fit_or_are_no_weights_are_refused(tiny: Path) -> None:
    with pytest.raises(CheckpointError, match=f"encoder 'RN50:{tiny}'"):
        load_encoder(f"RN50:{tiny}")
    tiny.write_bytes(b"nothing of the kind")
    with pytest.raises(CheckpointError, match="embedded"):
        load_encoder(f"{TINY}:{tiny}")


# -- cache -------------------------------------------------------------------------------------------------------------


def test_cache_gives_back_what_was_put_and_encodes_only_what_is_new(tmp_path: Path, encoder: Encoder, scenes: Scenes) -> None:
    rendered: list[int] = []

    def picture(index: int) -> list[np.ndarray]:
        rendered.append(index)
        return [scenes.images[index]]

    cache = ContextCache(tmp_path)
    first = [cache.encode(encoder, f"i{index}", lambda i=index: picture(i), str(scenes.instructions[index])) for index in range(3)]
    cache.save()
    resumed = ContextCache(tmp_path)
    second = [resumed.encode(encoder, f"i{index}", lambda i=index: picture(i), str(scenes.instructions[index])) for index in range(4)]
    assert rendered == [0, 1, 2, 3]
    assert [c.tobytes() for c in first] == [c.tobytes() for c in second[:3]]
    np.testing.assert_array_equal(resumed.table("osel_small", ["i2", "i0"]), np.stack([first[2], first[0]]))
    assert resumed.get("osel_small", "i9") is None and resumed.get("another", "i0") is None


def test_cache_file_is_a_function_of_its_contents(tmp_path: Path) -> None:
    rows = {f"i{index}": np.full(4, index, np.float32) for index in range(5)}
    for folder, order in (("a", list(rows)), ("b", list(rows)[::-1])):
        cache = ContextCache(tmp_path / folder, autosave=2)
        for name in order:
            cache.put("one@1", name, rows[name])
            cache.put("two@1", name, rows[name][:3])
        cache.save()
    assert (tmp_path / "a" / "contexts.npz").read_bytes() == (tmp_path / "b" / "contexts.npz").read_bytes()
    assert ContextCache(tmp_path / "a").encoders() == ["one@1", "two@1"]


def test_cache_keeps_what_was_saved_before_a_kill(tmp_path: Path) -> None:
    cache = ContextCache(tmp_path, autosave=2)
    for index in range(5):
        cache.put("one", f"i{index}", np.full(4, index, np.float32))
    left = ContextCache(tmp_path)  # no save: as after kill -9
    assert [left.get("one", f"i{index}") is not None for index in range(5)] == [True] * 4 + [False]


def test_cache_refuses_other_files_other_lengths_and_missing_instances(tmp_path: Path) -> None:
    cache = ContextCache(tmp_path)
    cache.put("one", "i0", np.zeros(4, np.float32))
    with pytest.raises(UsageError, match="have length 4, got 5"):
        cache.put("one", "i1", np.zeros(5, np.float32))
    with pytest.raises(UsageError, match="finite float32"):
        cache.put("one", "i1", np.full(4, np.nan, np.float32))
    with pytest.raises(DataError, match="no context of 1 instances, the first of them 'i7'"):
        cache.table("one", ["i0", "i7"])
    with pytest.raises(DataError, match="only of: one"):
        cache.table("two", ["i0"])
    (tmp_path / "contexts.npz").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match="not a file of contexts"):
        ContextCache(tmp_path)


# -- training ----------------------------------------------------------------------------------------------------------


def test_captions_are_judged_by_what_is_in_view(task: TaskSpec) -> None:
    captions, order = Captions(task), [entity.name for entity in task.entities]
    pixels = np.full((1, len(order), 2), np.nan, np.float32)
    pixels[0, order.index("can")] = 0.2, 0.7
    pixels[0, order.index("lemon")] = 0.01, 0.5  # on the edge: cannot be told
    pixels[0, order.index("bowl")] = 0.8, 0.3
    facts = captions.facts(pixels)
    can, lemon, milk, bowl, basket = (order.index(name) for name in ("can", "lemon", "milk", "bowl", "basket"))
    left = len(order) + can * len(PLACES) + list(PLACES).index("on the left")
    right = len(order) + can * len(PLACES) + list(PLACES).index("on the right")
    one_object = captions.count - 4
    claims = [(can, bowl), (can, basket), (milk, bowl), (lemon, bowl), (lemon, basket), (left,), (right,), (one_object,)]
    assert truth(facts, [Caption("", claim) for claim in claims])[0].tolist() == [1, -1, -1, 0, -1, 1, -1, 0]


def test_an_instruction_is_drawn_to_its_task_where_there_are_several() -> None:
    import open_clip
    import torch

    from osel_sim.training.encoder.recipe import MODEL, Objective

    model = open_clip.CLIP(**MODEL)
    both, one = Objective(model, {"lift": 1, "push": 1}), Objective(model, {"lift": 1})
    towards_lift = torch.nn.functional.normalize(both.readouts["task"].weight, dim=1)[:1]
    assert both._task("lift", towards_lift) < both._task("push", towards_lift)
    assert one._task("lift", towards_lift) == both._task("lift", towards_lift[:0]) == 0.0


@pytest.mark.slow
def test_training_writes_a_folder_that_loads_and_resumes_to_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from osel_sim.training.encoder import recipe
    from osel_sim.training.encoder import train as training
    from osel_sim.training.encoder.train import EncoderSettings, train

    settings = EncoderSettings(tasks=("pick_place", "sort"), levels=(0, 2), steps=4, scenes=24, test_scenes=12, views=8, texts=8)
    whole = train(settings, tmp_path, tmp_path / "whole")
    batches: list[recipe.Batch] = []
    make_batch = recipe.make_batch

    def interrupted(*given: Any) -> recipe.Batch:
        if len(batches) == 2:
            raise KeyboardInterrupt
        batches.append(make_batch(*given))
        return batches[-1]

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(recipe, "make_batch", interrupted)
        patch.setattr(training, "SAVE_EVERY", 1)
        train(settings, tmp_path, tmp_path / "cut")
    assert (tmp_path / "cut" / "training.state").exists()
    with pytest.raises(CheckpointError, match="was trained with seed 0"):
        train(replace(settings, seed=1), tmp_path, tmp_path / "cut", resume=True)
    train(settings, tmp_path, tmp_path / "cut", resume=True)
    assert (tmp_path / "whole" / "open_clip_model.safetensors").read_bytes() == (tmp_path / "cut" / "open_clip_model.safetensors").read_bytes()
    measured = whole["measured"]
    assert measured["task"]["neighbours"]["chance"] == 0.5
    assert "image_to_instruction" in measured["tasks"]["pick_place"] and "image_to_instruction" not in measured["tasks"]["sort"]  # names no object
    assert whole["settings"]["steps"] == 4 and not (tmp_path / "cut" / "training.state").exists()
    assert load_encoder(str(tmp_path / "whole")).dimension == 256
    with pytest.raises(UsageError, match="holds a checkpoint already"):
        train(settings, tmp_path, tmp_path / "whole")


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"steps": 0}, "steps must be 1 or more"),
        ({"views": 0}, "views must be 1 or more"),
        ({"levels": (0, 4)}, "unknown level '4'"),
        ({"tasks": ()}, "at least one task"),
        ({"rate": float("nan")}, "rate must be a positive number"),
    ],
)
def test_settings_are_checked_when_they_are_made(settings: dict[str, Any], says: str) -> None:
    from osel_sim.training.encoder.train import EncoderSettings

    with pytest.raises(UsageError, match=says):
        EncoderSettings(**settings)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--encoder", "osel_smal"], "did you mean 'osel_small'"),
        (["--task", "pick_plac"], "did you mean 'pick_place'"),
        (["--steps", "0"], "--steps: must be 1 or more, got 0"),
        (["--minutes", "-1"], "--minutes: must lie in [0.001, 100000.0], got -1.0"),
    ],
)
def test_wrong_training_arguments_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], says: str) -> None:
    from osel_sim.train import main

    assert main(["--encoder", "--data", str(tmp_path), *arguments]) == 2
    message = capsys.readouterr().err
    assert says in message and message.count("\n") == 1
