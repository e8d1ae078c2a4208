"""The action head of the language-conditioned chunk policy."""

import torch.nn.functional as functional
from torch import Tensor, nn

from osel_sim.policy.grounding import mlp


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
