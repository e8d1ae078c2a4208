"""The Octo-style policy's own parts: transformer blocks with readout tokens, and the flow-matching action head."""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from osel_sim.policy.grounding import mlp

TIME_FEATURES = 32


class Block(nn.Module):
    """Pre-norm self-attention and MLP; the mask says who may look at whom."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm, self.mlp_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.inward, self.outward = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = mlp(width, 4 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Tokens (batch, S, width), mask (batch, 1, S, S), true where the row may look at the column -> tokens."""
        batch, length, width = x.shape
        qkv = self.inward(self.attention_norm(x)).view(batch, length, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(qkv[0], qkv[1], qkv[2], attn_mask=mask)
        x = x + self.outward(mixed.transpose(1, 2).reshape(batch, length, width))
        result: Tensor = x + self.mlp(self.mlp_norm(x))
        return result


class Readout(nn.Module):
    """A transformer whose last tokens are learned and only read: they look at everything, nothing looks at them (as in Octo)."""

    def __init__(self, width: int, heads: int, layers: int, readouts: int) -> None:
        super().__init__()
        self.readouts = nn.Parameter(0.02 * torch.randn(readouts, width))
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, tokens: Tensor, used: Tensor) -> Tensor:
        """Tokens (batch, S, width) and which are no padding (batch, S) -> readouts (batch, readouts, width)."""
        batch, length, _ = tokens.shape
        count = len(self.readouts)
        x = torch.cat([tokens, self.readouts.to(tokens.dtype).expand(batch, -1, -1)], dim=1)
        columns = torch.cat([used, used.new_zeros(batch, count)], dim=1)
        itself = torch.eye(length + count, dtype=torch.bool, device=x.device)  # also saves padding from looking at nothing
        mask = (columns[:, None, :] | itself)[:, None]
        for block in self.blocks:
            x = block(x, mask)
        result: Tensor = self.norm(x[:, length:])
        return result


class FlowHead(nn.Module):
    """Chunks of actions by flow matching (Lipman et al., 2023), as a residual MLP conditioned by addition.

    Between noise at time 0 and actions at time 1 lie straight lines. The network guesses their end from a point on them; at time 0 that is plain
    regression, so what it learns first is already useful, and the way towards the guess is the flow.
    """

    def __init__(self, inputs: int, hidden: int, layers: int, chunk: int, action_dim: int) -> None:
        super().__init__()
        self.chunk, self.action_dim = chunk, action_dim
        self.condition = nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, hidden))
        self.time = mlp(TIME_FEATURES, hidden, hidden)
        self.inward = nn.Linear(chunk * action_dim, hidden)
        self.blocks = nn.ModuleList(nn.Sequential(nn.LayerNorm(hidden), mlp(hidden, 2 * hidden, hidden)) for _ in range(layers))
        self.norm = nn.LayerNorm(hidden)
        self.outward = nn.Linear(hidden, chunk * action_dim)

    def forward(self, condition: Tensor, noisy: Tensor, time: Tensor) -> Tensor:
        """Condition (batch, hidden) as `self.condition` gives it, points (batch, chunk, action_dim) and their times (batch,) -> the lines' ends."""
        x = self.inward(noisy.flatten(1)) + condition + self.time(time_features(time))
        for block in self.blocks:
            x = x + block(x)
        ends: Tensor = self.outward(functional.gelu(self.norm(x)))
        return ends.view(-1, self.chunk, self.action_dim)

    def integrate(self, inputs: Tensor, noise: Tensor, steps: int) -> Tensor:
        """Follow the flow from noise (batch, chunk, action_dim) in equal steps; returns actions of the same shape."""
        condition = self.condition(inputs)
        x = noise
        for step in range(steps):
            now = step / steps
            end = self(condition, x, torch.full((len(x),), now, device=x.device))
            x = x + (end - x) / (steps - step)  # velocity (end - x) / (1 - now) for a time of 1 / steps
        return x


def time_features(time: Tensor) -> Tensor:
    """Times (batch,) in [0, 1] as sines and cosines (batch, TIME_FEATURES)."""
    frequencies = torch.exp(torch.linspace(0.0, math.log(100.0), TIME_FEATURES // 2, device=time.device))
    angles = time[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
