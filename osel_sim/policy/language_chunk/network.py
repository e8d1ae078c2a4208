"""The parts of the language-conditioned chunk policy that are its own: keypoints and the action head."""

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from osel_sim.policy.grounding import GroundingCamera, mlp
from osel_sim.policy.language_chunk.configuration_language_chunk import LanguageChunkConfig


class Camera(GroundingCamera):
    """A camera that also finds keypoints which depend on the instruction."""

    def __init__(self, config: LanguageChunkConfig, mounted: bool) -> None:
        super().__init__(config, mounted, config.queries)
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


class ActionHead(nn.Module):
    """Residual MLP from everything found to a chunk of actions."""

    def __init__(self, inputs: int, hidden: int, layers: int, chunk: int, action_dim: int) -> None:
        super().__init__()
        self.chunk, self.action_dim = chunk, action_dim
        self.inward = nn.Linear(inputs, hidden)
        self.blocks = nn.ModuleList(nn.Sequential(nn.LayerNorm(hidden), mlp(hidden, hidden, hidden)) for _ in range(layers))
        self.norm = nn.LayerNorm(hidden)
        self.outward = nn.Linear(hidden, chunk * action_dim)

    def forward(self, found: Tensor) -> Tensor:
        """Features (batch, inputs) -> actions (batch, chunk, action_dim), unbounded."""
        x = self.inward(found)
        for block in self.blocks:
            x = x + block(x)
        actions: Tensor = self.outward(functional.gelu(self.norm(x)))
        return actions.view(-1, self.chunk, self.action_dim)
