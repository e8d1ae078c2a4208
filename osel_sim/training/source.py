"""One dataset's samples: raw observations with their actions and labels, augmented or as recorded."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from osel_sim.formats.dataset_mapping import IMAGES
from osel_sim.policy.scene import ACTIVE_PLACES, ACTIVE_POSITIONS, GROUNDING_PLACES, GROUNDING_POSITIONS, GROUNDING_TOKENS, IMAGE_SHIFT
from osel_sim.policy.text import tokenise
from osel_sim.training.annotations import Annotations
from osel_sim.training.dataset import Demonstrations
from osel_sim.training.instructions import Instructions
from osel_sim.training.recipe import Augmentation


@dataclass(frozen=True)
class Wanted:
    """What a policy wants of its samples.

    Attributes:
        chunk_size: actions of a sample.
        image_size: larger images are brought to this size.
        queries: things of an instruction that are labelled; 0: no labels.
        active: label what the expert is busy with, too.
        vocabulary, text_length: of the tokens of other instructions.
        pairs: other instructions about the same scene, for each sample.
    """

    chunk_size: int
    image_size: int
    queries: int = 0
    active: bool = False
    vocabulary: int = 0
    text_length: int = 0
    pairs: int = 0


class SampleSource:
    """Makes samples of one dataset.

    Args:
        center, spread: mean and standard deviation of the state, (state,) each, by which positions and noise are scaled.
    """

    def __init__(
        self, data: Demonstrations, wanted: Wanted, augmentation: Augmentation, center: NDArray[np.float32], spread: NDArray[np.float32]
    ) -> None:
        self._data, self._wanted, self._augmentation = data, wanted, augmentation
        self._center, self._spread = center, spread
        self._annotations = data.annotations if wanted.queries else None
        self._instructions = Instructions(data.annotations, augmentation) if data.annotations is not None else None
        self._last = np.repeat(data.starts[1:], np.diff(data.starts)) - 1

    def training(self, frames: NDArray[np.int64], random: np.random.Generator) -> dict[str, Any]:
        """Augmented samples of these frames."""
        batch = self._plain(frames)
        self._augment_images(batch, frames, random)
        self._augment_state(batch, random)
        self._instruct(batch, frames, random)
        return batch

    def validation(self, frames: NDArray[np.int64]) -> dict[str, Any]:
        """Samples of these frames as recorded, with the positions of what their instructions name."""
        batch = self._plain(frames)
        for camera, images in self._data.images.items():
            batch[IMAGES + camera] = as_floats(images[frames])
        if self._annotations is not None:
            batch[GROUNDING_POSITIONS] = self._positions(frames, self._slots(self._annotations.target[frames][:, None]))
        return batch

    def _plain(self, frames: NDArray[np.int64]) -> dict[str, Any]:
        every = self._data.every
        ahead = frames[:, None] * every + np.arange(self._wanted.chunk_size)
        last = (self._last[frames][:, None] + 1) * every - 1
        return {
            OBS_STATE: torch.from_numpy(self._data.state[frames]),
            ACTION: torch.from_numpy(self._data.action[np.minimum(ahead, last)]),
            "action_is_pad": torch.from_numpy(ahead > last),
            "task": [self._data.tasks[index] for index in self._data.task[frames]],
        }

    def _augment_images(self, batch: dict[str, Any], frames: NDArray[np.int64], random: np.random.Generator) -> None:
        """Shift and recolour, image by image in OpenCV: several times faster than the same in arrays of floats."""
        settings, count, margin = self._augmentation, len(frames), self._augmentation.shift
        shift = random.integers(-margin, margin + 1, (count, 2))
        levels = np.arange(256) / 255
        side = self._wanted.image_size
        for camera, images in self._data.images.items():
            height, width = images.shape[1:3]
            gain = (1 + settings.contrast * random.uniform(-1, 1, (count, 1, 1))) * (1 + settings.colour * random.uniform(-1, 1, (count, 1, 3)))
            offset = settings.brightness * random.uniform(-1, 1, (count, 1, 1)) + 0.5 * (1 - gain)
            tables = np.clip(255 * (levels[:, None] * gain + offset) + 0.5, 0, 255).astype(np.uint8)
            smaller = side < min(height, width)  # here, since the preprocessor's own way with floats is slow for many images
            pixels = np.empty((count, *((side,) * 2 if smaller else (height, width)), 3), np.uint8)
            for row, (frame, (right, down)) in enumerate(zip(frames, shift, strict=True)):
                framed = cv2.copyMakeBorder(images[frame], margin, margin, margin, margin, cv2.BORDER_REPLICATE)
                moved = framed[margin - down : margin - down + height, margin - right : margin - right + width]
                if smaller:
                    moved = cv2.resize(moved, (side, side), interpolation=cv2.INTER_AREA)
                cv2.LUT(np.ascontiguousarray(moved), tables[row][:, None], dst=pixels[row])
            batch[IMAGES + camera] = as_floats(pixels)
            batch[IMAGE_SHIFT] = torch.from_numpy(2.0 * shift / (width, height)).float()  # cameras have one size

    def _augment_state(self, batch: dict[str, Any], random: np.random.Generator) -> None:
        settings, state = self._augmentation, batch[OBS_STATE].numpy()
        state = state + (settings.state_noise * self._spread * random.standard_normal(state.shape)).astype(np.float32)
        hidden = random.random(len(state)) < settings.state_dropout
        state[hidden] = self._center
        batch[OBS_STATE] = torch.from_numpy(state)

    def _instruct(self, batch: dict[str, Any], frames: NDArray[np.int64], random: np.random.Generator) -> None:
        every, instructions, wanted = self._data.annotations, self._instructions, self._wanted
        if every is None or instructions is None:
            return
        for row in np.flatnonzero(random.random(len(frames)) < self._augmentation.rephrase):
            batch["task"][row] = instructions.phrase(every.target[frames[row]], random)
        if self._annotations is None:
            return
        targets = self._slots(every.target[frames][:, None])
        if wanted.pairs:
            pairs = np.stack([[instructions.pair(every.present[frame], random) for _ in range(wanted.pairs)] for frame in frames])
            texts = [instructions.phrase(pair, random) for pair in pairs.reshape(-1, pairs.shape[-1])]
            tokens = tokenise(texts, wanted.vocabulary, wanted.text_length)
            batch[GROUNDING_TOKENS] = torch.from_numpy(tokens.reshape(len(frames), wanted.pairs, *tokens.shape[1:]))
            targets = np.concatenate([targets, self._slots(pairs)], axis=1)
        batch[GROUNDING_POSITIONS] = self._positions(frames, targets)
        self._add_places(batch, GROUNDING_PLACES, frames, targets)
        if wanted.active:
            active = every.active[frames][:, None]
            batch[ACTIVE_POSITIONS] = self._positions(frames, active)
            self._add_places(batch, ACTIVE_PLACES, frames, active)

    def _slots(self, targets: NDArray[np.int64]) -> NDArray[np.int64]:
        """Targets (..., roles) as (..., queries): cut, or filled up with -1."""
        queries = self._wanted.queries
        padding = np.full((*targets.shape[:-1], queries), -1, np.int64)
        return np.concatenate([targets, padding], axis=-1)[..., :queries]

    def _positions(self, frames: NDArray[np.int64], targets: NDArray[np.int64]) -> Tensor:
        """Positions (frames, ..., 3) of the targets in the state's normalised coordinates."""
        return torch.from_numpy((self._labels.positions_of(frames, targets) - self._center[:3]) / self._spread[:3])

    def _add_places(self, batch: dict[str, Any], key: str, frames: NDArray[np.int64], targets: NDArray[np.int64]) -> None:
        if all(self._labels.sees(camera) for camera in self._data.images):
            state = self._data.state[frames]
            places = [self._labels.places_of(camera, frames, targets, state) for camera in self._data.images]
            batch[key] = torch.from_numpy(np.stack(places, axis=-2))

    @property
    def _labels(self) -> Annotations:
        if self._annotations is None:
            raise ValueError("the dataset has no annotations, or none are wanted")
        return self._annotations


def as_floats(pixels: NDArray[np.uint8]) -> Tensor:
    """uint8 (batch, H, W, 3) -> float (batch, 3, H, W) in [0, 1], channels last in memory, as convolutions like it."""
    return torch.from_numpy(pixels).permute(0, 3, 1, 2).float().mul_(1 / 255)
