"""LeRobot's own policies as their authors ship them, tiny and untrained: saved by LeRobot, loaded by a policy file.

Diffusion and SmolVLA want packages that make every import of LeRobot slower where they are installed, so they lie in a folder of their own
(`make stock`).
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE

from osel_sim.core.errors import CheckpointError
from osel_sim.episodes.drivers import Drivers
from osel_sim.episodes.loop import run_episode
from osel_sim.formats import library
from osel_sim.formats.conventions import Conventions
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.specification import specification
from osel_sim.policy.history import History
from osel_sim.policy.lerobot_policy import load
from osel_sim.sim.env import TaskEnv

SIZE = 64
IMAGE = "observation.images.image"
ROBOT = specification()
FEATURES: dict[str, Any] = {
    "device": "cpu",
    "input_features": {IMAGE: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)), OBS_STATE: PolicyFeature(FeatureType.STATE, (8,))},
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (7,))},
}


def save(folder: Path, policy: Any, config: Any) -> Path:
    policy(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=None):
        pipeline.save_pretrained(folder)
    return folder


def diffusion(folder: Path) -> Path:
    pytest.importorskip("diffusers", reason="make stock")
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    small: dict[str, Any] = {"down_dims": (16, 32), "pretrained_backbone_weights": None, "num_inference_steps": 2, "crop_shape": None}
    small |= {"horizon": 16, "n_action_steps": 8}
    return save(folder, DiffusionPolicy, DiffusionConfig(**FEATURES, **small))


def smolvla(folder: Path) -> Path:
    pytest.importorskip("transformers", reason="make stock")
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    small = {"resize_imgs_with_padding": (SIZE, SIZE), "num_vlm_layers": 2, "num_steps": 2, "chunk_size": 8, "n_action_steps": 8}
    return save(folder, SmolVLAPolicy, SmolVLAConfig(**FEATURES, **small, vlm_model_name=str(tiny_smolvlm(folder.parent / "smolvlm"))))


def tiny_smolvlm(folder: Path) -> Path:
    """SmolVLM's architecture with next to nothing in it, as transformers saves it."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

    words = ["<pad>", "<unk>", "<image>", "<fake_token_around_image>", "<global-img>", "<end_of_utterance>", "pick", "up", "the", "can"]
    tokenizer = Tokenizer(models.WordLevel({word: index for index, word in enumerate(words)}, "<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    special = {"image_token": "<image>", "fake_image_token": "<fake_token_around_image>", "global_image_token": "<global-img>"}
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", extra_special_tokens={**special, "end_of_utterance_token": words[5]}
    )
    SmolVLMProcessor(SmolVLMImageProcessor(), fast, SmolVLMVideoProcessor(), image_seq_len=4, chat_template="").save_pretrained(folder)
    text = {"model_type": "llama", "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    text |= {"num_key_value_heads": 2, "head_dim": 8, "vocab_size": len(words), "pad_token_id": 0}
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 4, "image_size": SIZE, "patch_size": 16}
    SmolVLMConfig(text_config=text, vision_config=vision, image_token_id=2, scale_factor=2, pad_token_id=0).save_pretrained(folder)
    return folder


def spec_of(folder: Path, **changes: Any) -> PolicySpec:
    mapping = Conventions(images={"agentview": IMAGE}, normalised=False)
    return dataclasses.replace(
        library.load_policy("local_small"), name="stock", cameras=("agentview",), image_size=SIZE, checkpoint=str(folder), mapping=mapping, **changes
    )


@pytest.mark.parametrize(("make", "history"), [(diffusion, 2), (smolvla, 1)])
def test_it_loads_and_drives(make: Callable[[Path], Path], history: int, tmp_path: Path) -> None:
    spec = spec_of(make(tmp_path / "stock"), history=history, execute=8)
    env = TaskEnv("lift")
    env.task = dataclasses.replace(env.task, horizon=20)
    env.load(env.instance)
    with Drivers([spec], ROBOT) as drivers:
        outcome = run_episode(env, env.instance, drivers["stock"])
    env.close()
    assert outcome.error is None and outcome.steps == 20
    assert (outcome.calls, outcome.actions) == (3, 20)  # billed by how often it plans


def test_diffusion_plans_as_lerobot_lets_it(tmp_path: Path) -> None:
    """Asked every eight steps with the last two observations, it does what LeRobot's `select_action` does when asked at each step."""
    spec = spec_of(diffusion(tmp_path / "stock"), history=2, execute=8)
    import torch

    from osel_sim.policy.lerobot_policy import drawing

    random = np.random.default_rng(0)
    seen = [
        {
            "observation.images.agentview": random.integers(0, 256, (SIZE, SIZE, 3), np.uint8),
            OBS_STATE: random.normal(size=8).astype(np.float32),
            "task": "lift",
        }
        for _ in range(16)
    ]
    ours, theirs = load(spec, ROBOT)(), load(spec, ROBOT)()
    history, made = History(2), []
    ours.reset("lift")
    for step, observation in enumerate(seen):
        if step % 8 == 0:
            made += list(ours.act(history.with_present(observation)))[:8]
        history.remember(observation)
    theirs.reset("lift")
    wanted = []
    for step, observation in enumerate(seen):
        with torch.inference_mode(), drawing("lift", step // 8):
            wanted.append(theirs._after(theirs._policy.select_action(theirs._prepared(observation)))[0].numpy())
    assert np.allclose(made, np.clip(wanted, -1, 1), atol=1e-6)


def test_a_history_of_another_length_is_refused(tmp_path: Path) -> None:
    folder = diffusion(tmp_path / "stock")
    with pytest.raises(CheckpointError, match=r"it looks at the last 2 observations: set history = 2 in \[observation\]"):
        load(spec_of(folder, execute=8), ROBOT)
    with pytest.raises(CheckpointError, match=r"its chunks hold 8 actions, execute = 9"):
        load(spec_of(folder, history=2, execute=9), ROBOT)
