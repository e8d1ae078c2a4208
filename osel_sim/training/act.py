"""LeRobot's ACT trained from scratch on labelled demonstrations: what it needs beside its own loss. Nothing of this is in the checkpoint.

ACT sees instructions as a fixed embedding in its environment state. Its action loss alone teaches it that a thing is where the gripper is, so while
training a head reads the encoder's token of the instruction and must tell where the named things are, and which patch of each image shows them.
"""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn
from torchvision.ops.misc import FrozenBatchNorm2d  # type: ignore[import-untyped]

from osel_sim.policy.grounding import grid, laplace, miss, mlp
from osel_sim.policy.scene import ACTIVE_PLACES, ACTIVE_POSITIONS, GROUNDING_PLACES, GROUNDING_POSITIONS, IMAGE_SHIFT
from osel_sim.training.recipe import Optimisation

QUERIES = 2
"""Roles of an instruction that are asked for; besides them, the two things that the expert is busy with."""
INSTRUCTION_TOKEN = 2
"""Place of the environment state among the encoder's tokens: after the latent and the robot's state."""
ATTENTION_WEIGHT = 0.1
VARIANCE_FLOOR = 1e-3


class LabelledACT(nn.Module):
    """An ACT policy with a head that is asked for places; the Trainer's module.

    Args:
        policy: ACT with robot state, environment state and at least one image.
    """

    def __init__(self, policy: PreTrainedPolicy, settings: Optimisation) -> None:
        super().__init__()
        self.policy = policy
        self._cameras = len(policy.config.image_features)
        self._weight = settings.grounding_weight
        width, self._slots = policy.config.dim_model, QUERIES + 2
        self.position = mlp(width, width, 4 * self._slots)
        self.query = nn.Linear(width, self._slots * width)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """ACT's own loss and those of the labels, if the batch has them."""
        tokens: list[Tensor] = []
        handle = self.policy.model.encoder.register_forward_hook(lambda _module, _inputs, output: tokens.append(output))
        try:
            loss, report = self.policy(batch)
        finally:
            handle.remove()
        report = {"action_loss": report["l1_loss"]}
        if GROUNDING_POSITIONS not in batch or ACTIVE_POSITIONS not in batch:
            return loss, report
        encoded = tokens[0].float()
        asked = encoded[INSTRUCTION_TOKEN]
        with torch.autocast(asked.device.type, enabled=False):
            estimate = self.position(asked).view(len(asked), self._slots, 4)
            estimate = torch.cat([estimate[..., :3], 3 * nn.functional.softsign(estimate[..., 3:] / 3) - 1], dim=-1)
            truth = torch.cat([batch[GROUNDING_POSITIONS][:, 0], batch[ACTIVE_POSITIONS][:, 0]], dim=1)
            position = laplace(estimate, truth)
            loss = loss + self._weight * position
            report["grounding_loss"] = position.item()
            if GROUNDING_PLACES in batch:
                attention = self._attention(encoded, batch)
                loss = loss + ATTENTION_WEIGHT * attention
                report["attention_loss"] = attention.item()
        return loss, report

    def _attention(self, encoded: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """Cross-entropy of which patch of each image shows what."""
        asked, patches = encoded[INSTRUCTION_TOKEN], encoded[INSTRUCTION_TOKEN + 1 :].transpose(0, 1)
        queries = self.query(asked).view(len(asked), self._slots, -1)
        truth = torch.cat([batch[GROUNDING_PLACES][:, 0], batch[ACTIVE_PLACES][:, 0]], dim=1)
        side = round((patches.shape[1] / self._cameras) ** 0.5)
        places = grid(side, side, asked.device)[None] - batch[IMAGE_SHIFT][:, None]
        losses = []
        for camera, own in enumerate(patches.chunk(self._cameras, dim=1)):
            log_heat = ((queries @ own.transpose(1, 2)) / own.shape[-1] ** 0.5).log_softmax(dim=-1)[:, None]
            losses.append(miss(log_heat, places, truth[:, None, :, camera]))
        return torch.stack(losses).mean()


@torch.no_grad()
def calibrate(policy: PreTrainedPolicy, batch: dict[str, Tensor]) -> None:
    """Set the statistics of the backbone's frozen batch norms from one batch.

    ACT freezes them at those of ImageNet. Without a download there are none, and eighteen layers that normalise nothing hardly learn.
    """

    def adapt(module: Any, inputs: tuple[Tensor, ...]) -> None:
        values = inputs[0].float()
        module.running_mean.copy_(values.mean(dim=(0, 2, 3)))
        module.running_var.copy_(values.var(dim=(0, 2, 3)).clamp_min(VARIANCE_FLOOR))

    norms = [module for module in policy.model.backbone.modules() if isinstance(module, FrozenBatchNorm2d)]
    handles = [module.register_forward_pre_hook(adapt) for module in norms]
    try:
        policy.model.backbone(torch.cat([batch[key] for key in policy.config.image_features]))
    finally:
        for handle in handles:
            handle.remove()
