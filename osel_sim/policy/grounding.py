"""What our policies share: a text encoder, and camera trunks in which words are compared with places.

A policy that learns from actions alone need not look: "the thing is where my gripper is" explains most of them, and such a policy solves nothing.
So queries are made of words, are compared with a map computed without any text or state, and are told in training where their things are.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from osel_sim.policy.text import PADDING

STATE_FEATURES = 11
"""Of our own state: position 3, rotation 6, fingers 2."""
OWN_STATE = 8
"""Numbers of our own state, whose orientation is turned into columns of a matrix. Those of other environments are taken as they are, and begin with
the hand's position as well."""
PLACE_FEATURES = 3  # column, row and how peaked the heatmap is


class Sizes(Protocol):
    """What a policy's configuration says about these parts (LanguageChunkConfig explains the entries)."""

    stem_channels: int
    channels: int
    trunk_layers: int
    query_dim: int
    queries: int
    vocabulary: int
    text_length: int
    text_dim: int
    text_layers: int


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a GELU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))


class WordLayer(nn.Module):
    """Self-attention over the words, pre-norm, with a residual MLP."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.attention_norm, self.mlp_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, 4, batch_first=True)
        self.mlp = mlp(width, 2 * width, width)

    def forward(self, words: Tensor, padding: Tensor) -> Tensor:
        """Words (batch, length, width) and which of them are padding (batch, length) -> words."""
        normed = self.attention_norm(words)
        words = words + self.attention(normed, normed, normed, key_padding_mask=padding, need_weights=False)[0]
        mixed: Tensor = words + self.mlp(self.mlp_norm(words))
        return mixed


@dataclass
class Text:
    """Encoded instructions.

    Attributes:
        sentence: (batch, text_dim).
        queries: (batch, queries, query_dim), one for each role of the task's instructions.
        words: (batch, length, text_dim), and which of them are words, not padding (batch, length).
    """

    sentence: Tensor
    queries: Tensor
    words: Tensor
    used: Tensor


class TextEncoder(nn.Module):
    """Hashed tokens -> words in context, a sentence vector and one grounding query for each thing that an instruction can name."""

    def __init__(self, config: Sizes) -> None:
        super().__init__()
        width = config.text_dim
        self.pieces = nn.Embedding(config.vocabulary, width, padding_idx=PADDING)
        self.positions = nn.Parameter(0.02 * torch.randn(config.text_length, width))
        self.layers = nn.ModuleList(WordLayer(width) for _ in range(config.text_layers))
        self.norm = nn.LayerNorm(width)
        self.pool = nn.Linear(width, 1 + config.queries)
        self.sentence = nn.Linear(width, width)
        self.queries = nn.ModuleList(mlp(width, 2 * width, config.query_dim) for _ in range(config.queries))

    def forward(self, tokens: Tensor) -> Text:
        """Tokens (batch, length, pieces) -> text."""
        used = tokens[..., 0] != PADDING
        length = int(used.sum(dim=1).max())
        tokens, used = tokens[:, :length], used[:, :length]
        count = (tokens != PADDING).sum(dim=-1, keepdim=True).clamp_min(1)
        words = self.pieces(tokens).sum(dim=2) / count
        if self.layers:
            words = words + self.positions[:length]
        for layer in self.layers:
            words = layer(words, ~used)
        words = self.norm(words)
        weights = self.pool(words).masked_fill(~used[..., None], float("-inf")).softmax(dim=1)
        pooled = weights.transpose(1, 2) @ words
        queries = torch.stack([head(pooled[:, 1 + index]) for index, head in enumerate(self.queries)], dim=1)
        return Text(functional.gelu(self.sentence(pooled[:, 0])), queries, words, used)


@dataclass
class View:
    """One camera's features, float32; places are flattened to P.

    Attributes:
        features: (batch, P, channels), not touched by any text.
        keys: (batch, P, query_dim).
        places: (batch, P, 2), column and row in [-1, 1] of the image as it was before a random shift.
    """

    features: Tensor
    keys: Tensor
    places: Tensor


@dataclass
class Grounding:
    """What queries found in one camera.

    Attributes:
        found: (batch, pairs, queries, 3), column, row and how peaked the heatmap is.
        attended: (batch, pairs, queries, channels), features there.
        estimate: (batch, pairs, queries, 4), position in the state's normalised coordinates and the logarithm of its expected error.
        log_heat: (batch, pairs, queries, P).
    """

    found: Tensor
    attended: Tensor
    estimate: Tensor
    log_heat: Tensor


def miss(log_heat: Tensor, places: Tensor, truth: Tensor) -> Tensor:
    """Cross-entropy of heatmaps against where the entities are, mean over those in view.

    Args:
        log_heat: (batch, pairs, queries, P).
        places: (batch, P, 2), column and row of each place in [-1, 1].
        truth: (batch, pairs, queries, 2), column and row in [-1, 1]; NaN where out of view.
    """
    cell = 2 / places.shape[1] ** 0.5
    offset = (places[:, None, None] - truth[..., None, :]).abs() / cell
    target = (1 - offset).clamp_min(0).prod(dim=-1)  # bilinear over the four nearest places; NaN stays NaN
    seen = target.sum(dim=-1) > 0.5
    loss = -(target.nan_to_num() * log_heat).sum(dim=-1)
    mean: Tensor = (loss * seen).sum() / seen.sum().clamp_min(1)
    return mean


def grid(rows: int, columns: int, device: torch.device) -> Tensor:
    """Column and row in [-1, 1] of every place of a map, row by row: (rows * columns, 2)."""
    y = (torch.arange(rows, device=device) + 0.5) / rows * 2 - 1
    x = (torch.arange(columns, device=device) + 0.5) / columns * 2 - 1
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], dim=-1).reshape(-1, 2)


def state_features(state: int) -> int:
    """How many features are made of a state of so many numbers."""
    return STATE_FEATURES if state == OWN_STATE else state


class GroundingCamera(nn.Module):
    """Convolutions of one camera, and the grounding of queries in it.

    Args:
        slots: how many kinds of queries there are; each has its own way from what it saw to a position.
        mounted: it moves with the gripper. Only then may the state enter an estimate, which is relative to the gripper: a fixed camera that
            knew the state would learn that things are where the gripper is, which is true of all that is carried, and never look.
        state: features of the state.
    """

    def __init__(self, config: Sizes, mounted: bool, slots: int, state: int = STATE_FEATURES) -> None:
        super().__init__()
        self.mounted = mounted
        pose = state - 2 if mounted else 0
        stem, width = config.stem_channels, config.channels
        self.stem = nn.Conv2d(3, stem, 5, stride=2, padding=2)
        self.reduce = nn.Conv2d(stem, width, 3, stride=2, padding=1)
        self.place = nn.Linear(2, width)
        trunk = [nn.Conv2d(width, width, 3, padding=1) for _ in range(config.trunk_layers)]
        self.trunk = nn.ModuleList(trunk)
        self.norm = nn.LayerNorm(width)
        self.key = nn.Linear(width, config.query_dim)
        self.scale = nn.Parameter(torch.tensor(2.0))
        self.locate = nn.ModuleList(mlp(PLACE_FEATURES + 2 + width + pose, 128, 4) for _ in range(slots))
        for layer in (self.stem, self.reduce, *trunk):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        for layer in trunk:
            with torch.no_grad():
                layer.weight.mul_(0.5)  # residual branches add up: keep the sum's variance near that of its input

    def view(self, image: Tensor, shift: Tensor) -> tuple[View, Tensor]:
        """Image (batch, 3, H, W) in [0, 1] -> its features, and the raw map (batch, channels, rows, columns).

        Args:
            shift: (batch, 2), how far (columns, rows) the image was moved by augmentation, in units of half an image.
        """
        x = (2 * image - 1).contiguous(memory_format=torch.channels_last)
        x = functional.relu(self.reduce(functional.relu(self.stem(x))))
        places = grid(x.shape[-2], x.shape[-1], x.device)[None] - shift[:, None]
        embedded = self.place(places).transpose(1, 2).reshape(x.shape)
        x = x + embedded.to(x.dtype)
        for layer in self.trunk:
            x = x + functional.relu(layer(x))
        with torch.autocast(x.device.type, enabled=False):
            features = self.norm(x.flatten(2).transpose(1, 2).float())
            return View(features, self.key(features), places), x

    def ground(self, view: View, queries: Tensor, state: Tensor, first: int = 0) -> Grounding:
        """Where each query's entity is.

        Args:
            queries: (batch, pairs, queries, query_dim).
            state: (batch, state features).
            first: slot of the first of them.
        """
        batch, pairs, count, width = queries.shape
        flat = queries.reshape(batch, pairs * count, width)
        logits = (flat @ view.keys.transpose(1, 2)) * (self.scale / width**0.5)
        log_heat = logits.log_softmax(dim=-1)
        heat = log_heat.exp()
        place = heat @ view.places
        peak = heat.square().sum(dim=-1, keepdim=True).sqrt()  # 1: a single place, 1/sqrt(P): anywhere
        attended = heat @ view.features
        found = torch.cat([place, peak], dim=-1).view(batch, pairs, count, PLACE_FEATURES)
        attended = attended.view(batch, pairs, count, -1)
        seen = torch.cat([found, found[..., :2].square(), attended], dim=-1)
        if self.mounted:
            pose = state[:, None, None, 2:].expand(batch, pairs, count, -1)  # height, orientation, fingers
            seen = torch.cat([seen, pose], dim=-1)
        estimate = torch.stack([head(seen[:, :, index]) for index, head in enumerate(self.locate[first : first + count])], dim=2)
        position = estimate[..., :3] + state[:, None, None, :3] if self.mounted else estimate[..., :3]
        scale = 3 * functional.softsign(estimate[..., 3:] / 3) - 1  # log of the expected error within (-4, 2)
        return Grounding(found, attended, torch.cat([position, scale], dim=-1), log_heat.view(batch, pairs, count, -1))


def fuse(estimates: list[Tensor]) -> Tensor:
    """One estimate (..., 4) from several, each weighted by its own confidence."""
    stacked = torch.stack(estimates)
    weights = (-stacked[..., 3:]).softmax(dim=0)
    return (weights * stacked).sum(dim=0)


def laplace(estimate: Tensor, truth: Tensor) -> Tensor:
    """Negative log-likelihood, up to a constant, of positions under Laplace distributions; mean over those that are known.

    Args:
        estimate: (..., 4), centre and the logarithm of the scale.
        truth: (..., 3); NaN where there is nothing to find.
    """
    scale, known = estimate[..., 3], ~truth[..., 0].isnan()
    error = (estimate[..., :3] - truth.nan_to_num()).abs().mean(dim=-1)
    loss: Tensor = ((error * torch.exp(-scale) + scale) * known).sum() / known.sum().clamp_min(1)
    return loss
