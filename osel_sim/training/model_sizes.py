"""Sizes of the models that are trained here: what the `[model]` table of a recipe may say.

What a recipe leaves out is as the type's configuration has it (ACT's perception: PerceptionConfig).
"""

from typing import Annotated, Literal

from pydantic import Discriminator
from pydantic.dataclasses import dataclass

from osel_sim.formats.toml_types import TABLE, between


@dataclass(frozen=True, kw_only=True, config=TABLE)
class _Chunk:
    chunk_size: Annotated[int, between(1, 200)] | None = None
    """Actions predicted at once, at 20 Hz."""
    image_size: Annotated[int, between(16, 512)] | None = None
    """Images are brought to this square size (pixels)."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class _Perception(_Chunk):
    stem_channels: Annotated[int, between(4, 512)] | None = None
    """Width of the first convolution (half resolution)."""
    channels: Annotated[int, between(8, 1024)] | None = None
    """Width of the other convolutions (quarter resolution)."""
    trunk_layers: Annotated[int, between(0, 16)] | None = None
    """Residual convolutions at quarter resolution that no text reaches."""
    query_dim: Annotated[int, between(4, 1024)] | None = None
    """Width of the space in which a word meets a place in the image."""
    queries: Annotated[int, between(1, 16)] | None = None
    """How many things of an instruction are looked for, in the order of the task's roles."""
    vocabulary: Annotated[int, between(64, 1_000_000)] | None = None
    """Hashed tokens."""
    text_length: Annotated[int, between(4, 256)] | None = None
    """Words of an instruction that are kept."""
    text_dim: Annotated[int, between(8, 1024)] | None = None
    """Embedding width of a word."""
    text_layers: Annotated[int, between(0, 12)] | None = None
    """Self-attention layers over the words."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class _Head(_Perception):
    hidden: Annotated[int, between(16, 8192)] | None = None
    """Width of the action head."""
    hidden_layers: Annotated[int, between(0, 32)] | None = None
    """Residual blocks of the action head."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class LanguageChunk(_Head):
    """Sizes of a `language_chunk`."""

    keypoints: Annotated[int, between(1, 512)] | None = None
    """Spatial-softmax points a camera, on features modulated by the instruction."""
    type: Literal["language_chunk"]
    """The convolutional policy of this package."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class OctoChunk(_Head):
    """Sizes of an `octo_chunk`."""

    patch: Annotated[int, between(1, 64)] | None = None
    """Side of an image patch, in cells of the quarter-resolution map; each patch is one token."""
    width: Annotated[int, between(16, 4096)] | None = None
    """Width of the transformer."""
    layers: Annotated[int, between(1, 48)] | None = None
    """Layers of the transformer."""
    attention_heads: Annotated[int, between(1, 64)] | None = None
    """Attention heads of the transformer."""
    readouts: Annotated[int, between(1, 64)] | None = None
    """Tokens whose outputs go to the action head, besides the two that find what is to be handled now."""
    integration_steps: Annotated[int, between(1, 100)] | None = None
    """Euler steps from noise to actions."""
    flow_samples: Annotated[int, between(1, 64)] | None = None
    """Noise levels tried for each training sample."""
    type: Literal["octo_chunk"]
    """The Octo-style transformer of this package."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class Act(_Perception):
    """Sizes of an `act`."""

    keypoints: Annotated[int, between(1, 512)] | None = None
    """Spatial-softmax points a camera, on features modulated by the instruction."""
    dim_model: Annotated[int, between(16, 4096)] | None = None
    """Width of the transformer."""
    n_heads: Annotated[int, between(1, 64)] | None = None
    """Attention heads."""
    dim_feedforward: Annotated[int, between(16, 16384)] | None = None
    """Width of the feed-forward blocks."""
    n_encoder_layers: Annotated[int, between(1, 48)] | None = None
    """Layers of the encoder."""
    n_decoder_layers: Annotated[int, between(1, 48)] | None = None
    """Layers of the decoder."""
    type: Literal["act"]
    """LeRobot's ACT, on a perception of this package."""


ModelSizes = Annotated[LanguageChunk | OctoChunk | Act, Discriminator("type")]
