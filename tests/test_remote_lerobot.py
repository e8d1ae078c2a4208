"""A real LeRobot checkpoint behind the real command: what comes over the wire is what the policy gives when it runs here."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from remote_helpers import observation, policy_spec

from osel_sim.interface.specification import specification
from osel_sim.policy.registry import session_factory
from osel_sim.remote.policy import open_remote

pytestmark = pytest.mark.slow  # each process imports LeRobot


def save_checkpoint(folder: Path) -> None:
    """LeRobot's own ACT, untrained and tiny."""
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    torch.manual_seed(0)
    images = {f"observation.images.{camera}": PolicyFeature(FeatureType.VISUAL, (3, 32, 32)) for camera in ("agentview", "wrist")}
    config = ACTConfig(
        input_features={**images, "observation.state": PolicyFeature(FeatureType.STATE, (8,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        chunk_size=8,
        n_action_steps=8,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        use_vae=False,
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    ACTPolicy(config).save_pretrained(folder)
    unit = {"mean": torch.zeros(1), "std": torch.ones(1)}
    statistics = {
        **{key: {name: value.reshape(1, 1, 1).expand(3, 1, 1) for name, value in unit.items()} for key in images},
        "observation.state": {name: value.expand(8) for name, value in unit.items()},
        "action": {name: value.expand(7) for name, value in unit.items()},
    }
    for processor in make_pre_post_processors(config, dataset_stats=statistics):
        processor.save_pretrained(folder)


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    save_checkpoint(folder / "checkpoint")
    policy_spec(folder, name="act", kind="lerobot")
    file = folder / "act.toml"
    file.write_text(file.read_text().replace('kind = "lerobot"', f'kind = "lerobot"\ncheckpoint = "{folder / "checkpoint"}"'))
    from osel_sim.formats.policy_file import load_policy_file

    return load_policy_file(file)


def test_the_wire_changes_no_bit(spec):
    local = session_factory(spec, specification())()
    remote = open_remote(spec, specification(), timeout=30)
    try:
        random = np.random.default_rng(0)
        for episode in range(2):
            local.reset("pick up the can")
            remote.reset("pick up the can", (episode,))
            for _ in range(3):
                value = observation()
                for camera in ("agentview", "wrist"):
                    value[f"observation.images.{camera}"] = random.integers(0, 256, (32, 32, 3), np.uint8)
                value["observation.state"] = random.standard_normal(8).astype(np.float32)
                call = remote.call(value)
                assert call.failure is None, call.failure
                np.testing.assert_array_equal(call.actions, local.act(value))
    finally:
        remote.close()


def test_a_missing_checkpoint_is_one_line(spec, tmp_path):
    file = tmp_path / "act.toml"
    file.write_text(spec.file.read_text().replace("/checkpoint", "/nowhere"))
    command = [sys.executable, "-m", "osel_sim.serve", "act", "--policies-dir", str(tmp_path), "--port", "0"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2 and "Traceback" not in result.stderr
    assert "nowhere" in result.stderr.splitlines()[-1] and result.stderr.splitlines()[-1].startswith("error: ")
