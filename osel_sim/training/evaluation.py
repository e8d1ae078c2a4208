"""Held-out episodes: how far the actions and the places named by the instruction are off."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from osel_sim.policy.scene import GROUNDING_POSITIONS
from osel_sim.training.batches import Batches

BATCH = 64
MAX_FRAMES = 2048


@dataclass(frozen=True)
class HeldOut:
    """Held-out episodes and how to measure on them.

    Attributes:
        batches: of the held-out frames of every dataset.
        preprocess, postprocess: the policy's own.
        spread: (3,), metres a unit of the normalised position.
        executed: how many actions of a chunk will be executed; errors count over those.
    """

    batches: Batches
    preprocess: Callable[[dict[str, Any]], dict[str, Any]]
    postprocess: Callable[[Tensor], Tensor]
    spread: Tensor
    executed: int


def validate(policy: Any, held: HeldOut, index: int, frames: int, roles: list[str]) -> dict[str, float]:
    """Errors on held-out frames of one dataset (at most `MAX_FRAMES`, evenly spread in blocks).

    Args:
        policy: a LeRobot policy that predicts chunks; if it has `locate`, what it says about places is measured, too.
        index: which dataset.
        frames: how many held-out frames it has.
        roles: names of the roles of that dataset's instructions.

    Returns:
        action_error (mean absolute error of the motions), gripper_accuracy, and where labelled <role>_cm (median distance between estimated and
        true position, centimetres).
    """
    errors: list[Tensor] = []
    hits: list[Tensor] = []
    distances: list[Tensor] = []
    starts = range(0, frames, BATCH)
    keep = np.unique(np.linspace(0, len(starts) - 1, min(len(starts), MAX_FRAMES // BATCH)).astype(int))
    policy.eval()
    with torch.inference_mode():
        for block in keep:
            raw = held.batches.validation(index, starts[block], BATCH)
            truth, valid = raw[ACTION][:, : held.executed], ~raw["action_is_pad"][:, : held.executed]
            batch = held.preprocess(dict(raw))
            actions = held.postprocess(policy.predict_action_chunk(batch))[:, : held.executed].cpu()
            errors.append((actions[..., :-1].clamp(-1, 1) - truth[..., :-1]).abs().mean(-1)[valid])
            hits.append(((actions[..., -1] > 0) == (truth[..., -1] > 0))[valid].float())
            if GROUNDING_POSITIONS in raw and hasattr(policy, "locate"):
                offset = (policy.locate(batch).cpu() - raw[GROUNDING_POSITIONS][:, 0]) * held.spread
                distances.append(offset.norm(dim=-1))
    result = {"action_error": float(torch.cat(errors).mean()), "gripper_accuracy": float(torch.cat(hits).mean())}
    if distances:
        middle = 100 * torch.cat(distances).nanmedian(dim=0).values
        result |= {f"{role}_cm": float(value) for role, value in zip(roles, middle, strict=False) if not value.isnan()}
    return result
