"""Processor steps of our policies: tokens, rotation, image size. They are saved with a checkpoint under the names registered here."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import ObservationProcessorStep, PolicyAction, PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines
from lerobot.utils.constants import OBS_IMAGES, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor

from osel_sim.policy.grounding import OWN_STATE
from osel_sim.policy.scene import OBS_ROTATION
from osel_sim.policy.text import PIECES, tokenise

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register(name="osel_sim_hashed_text")
@dataclass
class HashedTextStep(ObservationProcessorStep):  # type: ignore[misc]
    """Adds `observation.language.tokens`, int64 (batch, length, pieces), made from the `task` strings."""

    vocabulary: int = 4096
    length: int = 24

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """What the step makes of an observation."""
        texts = _texts(self.transition)
        observation[OBS_LANGUAGE_TOKENS] = torch.from_numpy(tokenise(texts, self.vocabulary, self.length))
        return observation

    def get_config(self) -> dict[str, Any]:
        """What the pipeline's JSON keeps of the step."""
        return {"vocabulary": self.vocabulary, "length": self.length}

    def transform_features(self, features: Features) -> Features:
        """The features after the step."""
        features[PipelineFeatureType.OBSERVATION][OBS_LANGUAGE_TOKENS] = PolicyFeature(FeatureType.LANGUAGE, (self.length, PIECES))
        return features


@ProcessorStepRegistry.register(name="osel_sim_rotation")
@dataclass
class RotationStep(ObservationProcessorStep):  # type: ignore[misc]
    """Adds `observation.rotation`, (batch, 6): the first two columns of the gripper's rotation matrix.

    The state's axis-angle jumps between v and -v near half a turn, which is where a gripper pointing down is; the matrix does not
    (Zhou et al., 2019, "On the Continuity of Rotation Representations in Neural Networks").
    """

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """What the step makes of an observation."""
        observation[OBS_ROTATION] = rotation_columns(observation[OBS_STATE][..., 3:6])
        return observation

    def transform_features(self, features: Features) -> Features:
        """The features after the step."""
        features[PipelineFeatureType.OBSERVATION][OBS_ROTATION] = PolicyFeature(FeatureType.STATE, (6,))
        return features


@ProcessorStepRegistry.register(name="osel_sim_image_size")
@dataclass
class ImageSizeStep(ObservationProcessorStep):  # type: ignore[misc]
    """Brings every image, float (batch, 3, H, W), to size x size by averaging areas; images of that size pass untouched."""

    size: int = 96

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """What the step makes of an observation."""
        for key, image in observation.items():
            if key.startswith(f"{OBS_IMAGES}.") and image.shape[-2:] != (self.size, self.size):
                rows, columns = (area_weights(length, self.size).to(image) for length in image.shape[-2:])
                observation[key] = rows @ image @ columns.T
        return observation

    def get_config(self) -> dict[str, Any]:
        """What the pipeline's JSON keeps of the step."""
        return {"size": self.size}

    def transform_features(self, features: Features) -> Features:
        """The features after the step."""
        return features


def _texts(transition: Any) -> list[str]:
    """The instructions of a batch."""
    task = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
    texts = [task] if isinstance(task, str) else task
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"the batch needs 'task', a string or a list of strings, got {task!r}")
    return list(texts)


@lru_cache(maxsize=16)
def area_weights(inputs: int, outputs: int) -> Tensor:
    """Matrix (outputs, inputs) that averages each output's exact share of the inputs, fractions of pixels included (unlike torch)."""
    edges = torch.arange(outputs + 1, dtype=torch.float64) * inputs / outputs
    pixels = torch.arange(inputs, dtype=torch.float64)
    overlap = (torch.minimum(edges[1:, None], pixels + 1) - torch.maximum(edges[:-1, None], pixels)).clamp_min(0)
    return (overlap / overlap.sum(dim=1, keepdim=True)).float()


def rotation_columns(axis_angle: Tensor) -> Tensor:
    """First two columns, (..., 6), of the rotation matrix of an axis-angle vector (..., 3) in radians (Rodrigues' formula).

    On the tensor's device and in its precision, as the checkpoints were trained; scipy's Rotation would fetch every batch from a GPU.
    """
    angle = axis_angle.norm(dim=-1, keepdim=True)
    x, y, z = (axis_angle / angle.clamp_min(1e-8)).unbind(-1)
    cosine, sine = angle.cos()[..., 0], angle.sin()[..., 0]
    rest = 1 - cosine
    first = (cosine + x * x * rest, y * x * rest + z * sine, z * x * rest - y * sine)
    second = (x * y * rest - z * sine, cosine + y * y * rest, z * y * rest + x * sine)
    return torch.stack(first + second, dim=-1)


class Reading(Protocol):
    """What a policy's configuration says about its inputs."""

    vocabulary: int
    text_length: int
    image_size: int


Pipelines = tuple[PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]]


def make_pipelines(config: Any, dataset_stats: dict[str, dict[str, Any]] | None) -> Pipelines:
    """Pre- and postprocessor of a policy of ours.

    Args:
        config: a `PreTrainedConfig` that is also a `Reading`.
        dataset_stats: LeRobot statistics of what the configuration normalises.
    """
    reading: Reading = config
    state = config.robot_state_feature
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    before = [
        steps.rename_observations,
        steps.add_batch_dim,
        HashedTextStep(reading.vocabulary, reading.text_length),
        *([RotationStep()] if state is None or state.shape[0] == OWN_STATE else []),
        ImageSizeStep(reading.image_size),
        steps.to_device,
        steps.normalize,
    ]
    pipelines: Pipelines = make_policy_processor_pipelines(before, [steps.unnormalize, steps.to_cpu])
    return pipelines
