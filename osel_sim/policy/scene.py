"""How our policies look at a scene: the instruction's words find their things in every camera, and labels say in training where those are."""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from lerobot.utils.constants import OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor, nn

from osel_sim.policy.grounding import Grounding, GroundingCamera, Text, TextEncoder, View, fuse, laplace, miss

OBS_ROTATION = "observation.rotation"
"""First two columns of the gripper's rotation matrix, (batch, 6); a processor step of ours adds it."""
GROUNDING_TOKENS = "grounding.tokens"
"""Optional label: tokens (batch, pairs, length, pieces) of other instructions about the same scene."""
GROUNDING_POSITIONS = "grounding.positions"
"""Optional label: (batch, 1 + pairs, queries, 3), where the things named by its own and the other instructions are, in normalised coordinates; NaN
where an instruction names fewer."""
GROUNDING_PLACES = "grounding.places"
"""Optional label: (batch, 1 + pairs, queries, cameras, 2), column and row in [-1, 1] where they are in each image; NaN where out of view."""
ACTIVE_POSITIONS = "active.positions"
"""Optional label: (batch, 1, 2, 3), the thing that the expert is busy with now and where it is to go; NaN where there is none."""
ACTIVE_PLACES = "active.places"
"""Optional label: (batch, 1, 2, cameras, 2), where those are in each image."""
IMAGE_SHIFT = "image_shift"
"""Optional: (batch, 2), how far augmentation moved the images (columns, rows), in units of half an image."""
LABELS = (GROUNDING_TOKENS, GROUNDING_POSITIONS, GROUNDING_PLACES, ACTIVE_POSITIONS, ACTIVE_PLACES, IMAGE_SHIFT)


@dataclass
class PerceivedScene:
    """What a policy made of a batch before it thinks about actions.

    Attributes:
        state: (batch, features): position, rotation columns, fingers; of another environment's state its own numbers.
        text: of its own instruction and the others, the latter flattened into the batch: (batch * (1 + pairs), ...).
        sentence: (batch, text_dim), of its own instruction.
        views: what each camera saw; raw: its map before the norm; grounded: what the instruction's queries found in it.
        fused: (batch, 1 + pairs, queries, 4), position estimates of all cameras together and the logarithm of the expected error.
    """

    state: Tensor
    text: Text
    sentence: Tensor
    views: list[View]
    raw: list[Tensor]
    grounded: list[Grounding]
    fused: Tensor


def look(text: TextEncoder, cameras: Iterable[nn.Module], image_keys: list[str], batch: Mapping[str, Tensor]) -> PerceivedScene:
    """See and read: nothing here knows the state but cameras that move with the gripper."""
    state = batch[OBS_STATE].float()
    if OBS_ROTATION in batch:
        state = torch.cat([state[:, :3], batch[OBS_ROTATION].float(), state[:, 6:8]], dim=-1)
    tokens = batch[OBS_LANGUAGE_TOKENS][:, None]
    if GROUNDING_TOKENS in batch:
        tokens = torch.cat([tokens, batch[GROUNDING_TOKENS]], dim=1)
    rows, pairs = tokens.shape[:2]
    shift = batch.get(IMAGE_SHIFT, torch.zeros(rows, 2, device=state.device))
    eyes = [camera for camera in cameras if isinstance(camera, GroundingCamera)]  # nn.ModuleList forgets the type
    seen = [camera.view(batch[key], shift) for camera, key in zip(eyes, image_keys, strict=True)]
    views, raw = [view for view, _ in seen], [pixels for _, pixels in seen]
    with torch.autocast(state.device.type, enabled=False):
        read = text(tokens.flatten(0, 1))
        queries = read.queries.view(rows, pairs, *read.queries.shape[1:])
        grounded = [camera.ground(view, queries, state) for camera, view in zip(eyes, views, strict=True)]
        fused = fuse([grounding.estimate for grounding in grounded])
    return PerceivedScene(state, read, read.sentence.view(rows, pairs, -1)[:, 0], views, raw, grounded, fused)


class Weights(Protocol):
    """What a policy's configuration says about the losses (LanguageChunkConfig explains them)."""

    grounding_weight: float
    attention_weight: float


def grounding_losses(
    views: list[View], grounded: list[Grounding], fused: Tensor, batch: Mapping[str, Tensor], weights: Weights, kind: str = "grounding"
) -> tuple[Tensor, dict[str, float]]:
    """Weighted loss of the labels `<kind>.positions` and `<kind>.places`, as far as the batch has them, and what to report of it."""
    loss = fused.new_zeros(())
    report: dict[str, float] = {}
    if f"{kind}.positions" in batch:
        truth = batch[f"{kind}.positions"]
        position = torch.stack([laplace(estimate, truth) for estimate in [*(grounding.estimate for grounding in grounded), fused]]).mean()
        loss = loss + weights.grounding_weight * position
        report[f"{kind}_loss"] = position.item()
    if f"{kind}.places" in batch:
        places = batch[f"{kind}.places"].unbind(dim=3)
        misses = [miss(found.log_heat, view.places, place) for view, found, place in zip(views, grounded, places, strict=True)]
        attention = torch.stack(misses).mean()
        loss = loss + weights.attention_weight * attention
        report["attention_loss" if kind == "grounding" else f"{kind}_attention_loss"] = attention.item()
    return loss, report


def own_geometry(fused: Tensor, grounded: list[Grounding], state: Tensor) -> list[Tensor]:
    """Where the own instruction's things are: positions, from the gripper as well, and where they are in each image; (batch, ...) each."""
    own = fused[:, 0]
    parts = [own.flatten(1), (own[..., :3] - state[:, None, :3]).flatten(1)]
    for grounding in grounded:
        parts += [grounding.found[:, 0].flatten(1), grounding.estimate[:, 0].flatten(1)]
    return parts


def action_weight(batch: Mapping[str, Tensor], action: Tensor, gripper_weight: float) -> Tensor:
    """Weight of every number of a chunk (batch, chunk, action_dim) in a mean: 0 beyond the episode's end, the gripper's own; they sum to 1."""
    weight = torch.ones_like(action)
    weight[..., -1] = gripper_weight
    if "action_is_pad" in batch:
        weight = weight * (~batch["action_is_pad"])[..., None]
    return weight / weight.sum().clamp_min(1e-8)


class ChunkQueue:
    """LeRobot's one-action-at-a-time interface on top of a policy that predicts chunks; to be inherited from beside PreTrainedPolicy."""

    config: Any
    _queue: deque[Tensor]

    def get_optim_params(self) -> dict[str, Any]:
        """All parameters in one group."""
        return {"params": self.parameters()}  # type: ignore[attr-defined]  # nn.Module's

    def reset(self) -> None:
        """Forget the actions that `select_action` still had in hand."""
        self._queue = deque()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """The next single action (batch, action_dim); looks again after `n_action_steps`."""
        if not self._queue:
            chunk = self.predict_action_chunk(batch)  # type: ignore[attr-defined]
            self._queue.extend(chunk[:, : self.config.n_action_steps].transpose(0, 1))
        return self._queue.popleft()
