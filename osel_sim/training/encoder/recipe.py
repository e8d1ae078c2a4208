"""The embedded encoder: its architecture, and the batches it learns from."""

import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.names import CONFIG
from osel_sim.context.open_clip_encoder import VOCABULARY
from osel_sim.training.encoder.captions import Captions, truth
from osel_sim.training.encoder.scenes import Scenes

IMAGE_SIZE = 96
MERGES = 4096
"""How many of CLIP's 48,894 byte-pair merges the small vocabulary keeps; any text can still be written, rarer words in more pieces."""

MODEL = {
    "embed_dim": 128,
    "init_logit_scale": 2.3,
    "init_logit_bias": 0.0,
    "vision_cfg": {"image_size": IMAGE_SIZE, "layers": [1, 1, 1, 1], "width": 16, "head_width": 64},
    "text_cfg": {"context_length": 32, "vocab_size": MERGES + 514, "width": 128, "heads": 4, "layers": 2},
}
"""open_clip's model config: a small ModifiedResNet with attention pooling and a small causal text transformer."""

MEAN, STD = 0.5, 0.25
PREPROCESS = {"mean": [MEAN] * 3, "std": [STD] * 3, "interpolation": "bicubic", "resize_mode": "squash"}


@dataclass(frozen=True)
class Batch:
    """Views of one task's scenes, captions and what is true of them.

    Attributes:
        task: name of the task.
        images: float32 (B, 3, S, S), normalised.
        texts: M captions.
        instructions: bool (M,), which captions are instructions.
        truth: int8 (B, M), 1 true, -1 false, 0 cannot be told.
        pixels: float32 (B, E, 2), where each entity is, as fractions of the view; NaN where it is not in it.
    """

    task: str
    images: Any
    texts: list[str]
    instructions: NDArray[np.bool_]
    truth: NDArray[np.int8]
    pixels: NDArray[np.float32]


def write_architecture(folder: Path) -> None:
    """Write the open_clip folder's config and vocabulary: the first merges of CLIP's own, so that frequent words stay whole."""
    from open_clip.tokenizer import default_bpe

    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG).write_text(json.dumps({"model_cfg": MODEL, "preprocess_cfg": PREPROCESS}, indent=2) + "\n")
    with gzip.open(default_bpe(), "rt", encoding="utf-8") as handle:
        lines = [next(handle) for _ in range(MERGES + 1)]  # the first line is a heading
    # Without a last newline: open_clip would take the empty line for one more merge. A fixed time makes equal contents equal bytes.
    (folder / VOCABULARY).write_bytes(gzip.compress("".join(lines).removesuffix("\n").encode(), mtime=0))


def filler_words(tokenizer: Any) -> list[str]:
    """Whole words of the vocabulary."""
    return [token.removesuffix("</w>") for token in tokenizer.encoder if token.endswith("</w>") and token[:-4].isalpha() and len(token) > 6]


def make_batch(scenes: Scenes, captions: Captions, views: int, texts: int, rng: np.random.Generator, words: Sequence[str]) -> Batch:
    """Draw views (the whole picture, or a cut-out of it at random) and captions about them."""
    import torch
    import torch.nn.functional as functional

    chosen = rng.integers(len(scenes), size=views)
    # Half of the views are the whole picture moved a little, the others a cut-out down to a third of its side.
    side = np.where(rng.random(views) < 0.5, rng.uniform(0.94, 1.06, views), rng.uniform(0.33, 0.9, views))
    corner = rng.uniform(0, 1, (views, 2)) * (1 - side[:, None])
    pixels = ((scenes.pixels[chosen] - corner[:, None]) / side[:, None, None]).astype(np.float32)
    facts = captions.facts(pixels)
    drawn = captions.draw(facts, texts, rng, words)

    images = torch.from_numpy(scenes.images[chosen]).permute(0, 3, 1, 2).float() / 255
    images = images * torch.from_numpy(rng.uniform(0.75, 1.25, (views, 1, 1, 1)).astype(np.float32))
    images = images + torch.from_numpy(rng.normal(0, 0.04, (views, 3, 1, 1)).astype(np.float32))
    images = (images.clamp(0, 1) - MEAN) / STD
    # affine_grid maps the output's [-1, 1] to the input's: scale by the side, move to the cut-out's middle.
    middle = torch.from_numpy((2 * corner + side[:, None] - 1).astype(np.float32))
    theta = torch.zeros(views, 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = torch.from_numpy(side.astype(np.float32))
    theta[:, :, 2] = middle
    grid = functional.affine_grid(theta, [views, 3, IMAGE_SIZE, IMAGE_SIZE], align_corners=False)
    images = functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
    pixels[facts[:, : pixels.shape[1]] != 1] = np.nan
    instructions = np.array([caption.is_instruction for caption in drawn], bool)
    return Batch(captions.task.name, images, [caption.text for caption in drawn], instructions, truth(facts, drawn), pixels)


class Objective:
    """What is minimised: the pairwise sigmoid loss, and linear readouts that are thrown away after training.

    Pairs teach quickly what is there, and slowly where; a readout of where things are speeds that up. Captions that claim the same should embed
    alike, but a selector may want to know how something was said; a readout of the words used keeps that in the text embedding. Pairs say nothing
    of what is to be done with the things named; where there are several tasks, a readout of an instruction's task does. It reads from angles alone
    and wants them wide: that tasks can be told apart is not enough for a selector that goes by distances.

    Args:
        entities: task -> how many things can be in its scenes.
    """

    where_weight, wording_weight, task_weight, task_scale = 1.0, 0.05, 0.3, 5.0

    def __init__(self, model: Any, entities: Mapping[str, int]) -> None:
        import torch

        self.model, self._tasks = model, list(entities)
        width = model.text_projection.shape[1]
        where = {f"where_{task}": torch.nn.Linear(width, 2 * count) for task, count in entities.items()}
        told = {"task": torch.nn.Linear(width, len(entities), bias=False)} if len(entities) > 1 else {}
        self.readouts = torch.nn.ModuleDict({**where, "wording": torch.nn.Linear(width, model.vocab_size), **told})
        self.readouts.to(model.logit_scale.device)

    def __call__(self, batch: Batch, tokens: Any) -> Any:
        """The loss (a scalar tensor) of a batch; `tokens` (M, L) are its captions."""
        import torch

        model, device = self.model, self.model.logit_scale.device
        tokens = tokens.to(device)
        images = model.encode_image(batch.images.to(device, memory_format=torch.channels_last), normalize=True).float()
        texts = model.encode_text(tokens, normalize=True).float()
        pairwise = self._pairwise(images, texts, torch.from_numpy(batch.truth).float().to(device))
        where = self._where(batch.task, images, torch.from_numpy(batch.pixels).to(device))
        told = self._task(batch.task, texts[torch.from_numpy(batch.instructions).to(device)])
        return pairwise + self.where_weight * where + self.wording_weight * self._wording(texts, tokens) + self.task_weight * told

    def _pairwise(self, images: Any, texts: Any, truths: Any) -> Any:
        """Sigmoid loss over the pairs that can be told (SigLIP, arXiv:2303.15343), true and false ones weighing the same."""
        import torch.nn.functional as functional

        losses = -functional.logsigmoid(truths * (self.model.logit_scale.exp() * images @ texts.T + self.model.logit_bias))
        return sum(0.5 * (losses * (truths == sign)).sum() / (truths == sign).sum().clamp(min=1) for sign in (1, -1))

    def _where(self, task: str, images: Any, pixels: Any) -> Any:
        """Mean absolute error of the places of what is in view, as fractions of the view."""
        there = ~pixels.isnan()
        errors = (self.readouts[f"where_{task}"](10 * images).view_as(pixels) - pixels.nan_to_num()).abs()
        return (errors * there).sum() / there.sum().clamp(min=1)

    def _wording(self, texts: Any, tokens: Any) -> Any:
        """Cross entropy of the tokens used; 0 fills up, and the two highest mark start and end."""
        import torch.nn.functional as functional

        said = functional.log_softmax(self.readouts["wording"](10 * texts), dim=1).gather(1, tokens)
        word = (tokens > 0) & (tokens < self.model.vocab_size - 2)
        return -((said * word).sum(dim=1) / word.sum(dim=1).clamp(min=1)).mean()

    def _task(self, task: str, texts: Any) -> Any:
        """Cross entropy of the task, from instructions; 0 where there is one task only."""
        import torch.nn.functional as functional

        if "task" not in self.readouts or not len(texts):
            return texts.new_zeros(())
        prototypes: Any = self.readouts["task"].weight
        said = functional.log_softmax(self.task_scale * texts @ functional.normalize(prototypes, dim=1).T, dim=1)
        return -said[:, self._tasks.index(task)].mean()
