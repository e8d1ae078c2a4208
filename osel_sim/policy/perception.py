"""What the cameras show and the instruction says, as one vector: where the named things are, what is there, and keypoints.

`language_chunk` has it inside, before its action head. A policy without eyes and language of its own, such as LeRobot's ACT, reads it as its
environment state.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from osel_sim.policy.grounding import PLACE_FEATURES, STATE_FEATURES, GroundingCamera, Sizes, TextEncoder
from osel_sim.policy.scene import PerceivedScene, look


class PerceptionSizes(Sizes, Protocol):
    """Grounding's sizes and the number of keypoints a camera."""

    keypoints: int


@dataclass
class PerceptionConfig:
    """Sizes of a perception that stands alone (LanguageChunkConfig explains the entries)."""

    stem_channels: int = 16
    channels: int = 48
    trunk_layers: int = 2
    keypoints: int = 32
    query_dim: int = 64
    queries: int = 2
    vocabulary: int = 4096
    text_length: int = 32
    text_dim: int = 64
    text_layers: int = 1


class KeypointCamera(GroundingCamera):
    """A camera that also finds keypoints which depend on the instruction."""

    def __init__(self, config: PerceptionSizes, mounted: bool, state: int = STATE_FEATURES) -> None:
        super().__init__(config, mounted, config.queries, state)
        width = config.channels
        self.film = nn.Linear(config.text_dim, 2 * width)
        self.modulated = nn.Conv2d(width, width, 3, padding=1)
        self.points = nn.Linear(width, config.keypoints)
        nn.init.kaiming_normal_(self.modulated.weight, nonlinearity="relu")

    def keypoints(self, raw: Tensor, places: Tensor, sentence: Tensor) -> tuple[Tensor, Tensor]:
        """Spatial-softmax points (batch, 2 * keypoints) and mean features (batch, channels) of the map modulated by the sentence."""
        gain, bias = self.film(sentence)[..., None, None].chunk(2, dim=1)
        x = functional.relu(self.modulated(raw) * (1 + gain) + bias)
        with torch.autocast(raw.device.type, enabled=False):
            x = x.flatten(2).transpose(1, 2).float()
            heat = self.points(x).softmax(dim=1)
            return (heat.transpose(1, 2) @ places).flatten(1), x.mean(dim=1)


def percept_size(config: PerceptionSizes, cameras: int, state: int = STATE_FEATURES) -> int:
    """Length of the vector that `perceive` makes, with so many features of the state."""
    per_camera = config.queries * (PLACE_FEATURES + config.channels + 4) + 2 * config.keypoints + config.channels
    return cameras * per_camera + state + config.text_dim + config.queries * 7


def perceive(text: TextEncoder, cameras: nn.ModuleList, image_keys: list[str], batch: dict[str, Tensor]) -> tuple[Tensor, PerceivedScene]:
    """Look at a batch.

    Returns:
        everything that was found (batch, percept_size), float32; and the scene, for the losses of its labels.
    """
    scene = look(text, cameras, image_keys, batch)
    eyes = [camera for camera in cameras if isinstance(camera, KeypointCamera)]  # nn.ModuleList forgets the type
    points = [camera.keypoints(raw, view.places, scene.sentence) for camera, raw, view in zip(eyes, scene.raw, scene.views, strict=True)]
    state, fused = scene.state, scene.fused
    with torch.autocast(state.device.type, enabled=False):
        own = fused[:, 0]
        parts = [state, scene.sentence, own.flatten(1), (own[..., :3] - state[:, None, :3]).flatten(1)]
        for grounding in scene.grounded:
            parts += [part[:, 0].flatten(1) for part in (grounding.found, grounding.attended, grounding.estimate)]
        for keypoints, mean in points:
            parts += [keypoints, mean]
        return torch.cat(parts, dim=-1), scene


class Perception(nn.Module):
    """Perception of its own, for a policy that has none.

    Args:
        mounted: camera key -> whether the camera moves with the gripper; in the order of the vector.
    """

    def __init__(self, config: PerceptionSizes, mounted: dict[str, bool]) -> None:
        super().__init__()
        self.image_keys = list(mounted)
        self.text = TextEncoder(config)
        self.cameras = nn.ModuleList(KeypointCamera(config, moves) for moves in mounted.values())

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, PerceivedScene]:
        """See `perceive`."""
        return perceive(self.text, self.cameras, self.image_keys, batch)
