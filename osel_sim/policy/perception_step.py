"""The processor step by which a policy without eyes and language of its own, such as LeRobot's ACT, gets both."""

from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from osel_sim.policy.perception import Perception, PerceptionConfig, percept_size
from osel_sim.policy.processing import Features

PERCEPTION = "osel_sim_perception"


@ProcessorStepRegistry.register(name=PERCEPTION)
@dataclass
class PerceptionStep(ObservationProcessorStep):  # type: ignore[misc]
    """Sets `observation.environment_state`, float32 (batch, percept_size), to what a trained perception makes of images, instruction and state.

    It comes after the steps that make tokens, rotation columns and the normalised state. Its weights are saved with the pipeline, as a step's state.

    Attributes:
        sizes: keyword arguments of PerceptionConfig.
        mounted: image key -> whether that camera moves with the gripper.
        image_size: side of the images that it looks at.
        half: save the weights in half precision; they are computed with in single precision all the same.
    """

    sizes: dict[str, int] = field(default_factory=lambda: asdict(PerceptionConfig()))
    mounted: dict[str, bool] = field(default_factory=dict)
    image_size: int = 96
    half: bool = False
    perception: Perception = field(init=False, repr=False)

    def __post_init__(self) -> None:
        with torch.random.fork_rng(devices=[]):  # the weights come from the file: making room for them must not move anyone's random numbers
            self.perception = Perception(PerceptionConfig(**self.sizes), self.mounted).eval().requires_grad_(False)

    @property
    def image_shapes(self) -> dict[str, tuple[int, ...]]:
        """Image key -> shape (3, H, W) of what it looks at."""
        return dict.fromkeys(self.mounted, (3, self.image_size, self.image_size))

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """What the step makes of an observation."""
        observation[OBS_ENV_STATE] = self.perception.to(observation[OBS_STATE].device)(observation)[0]
        return observation

    def get_config(self) -> dict[str, Any]:
        """What the pipeline's JSON keeps of the step."""
        return {"sizes": self.sizes, "mounted": self.mounted, "image_size": self.image_size, "half": self.half}

    def state_dict(self) -> dict[str, Tensor]:
        """The weights."""
        dtype = torch.float16 if self.half else torch.float32
        return {name: value.to("cpu", dtype).contiguous() for name, value in self.perception.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take weights; raises RuntimeError if they are of another perception."""
        self.perception.load_state_dict(state)

    def transform_features(self, features: Features) -> Features:
        """The features after the step."""
        size = percept_size(PerceptionConfig(**self.sizes), len(self.mounted))
        features[PipelineFeatureType.OBSERVATION][OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (size,))
        return features
