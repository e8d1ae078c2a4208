"""LeRobot's ACT and the perception that makes its environment state, trained together; a checkpoint keeps the second in a processor step.

ACT has no language, and from a few hundred demonstrations and its action loss alone its ResNet learns that a thing is where the gripper is.
"""

from dataclasses import dataclass

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor, nn

from osel_sim.policy.perception import Perception
from osel_sim.policy.scene import grounding_losses


@dataclass
class LabelWeights:
    """Weights of the losses of the labels, the action loss having 1."""

    grounding_weight: float
    attention_weight: float = 0.1


class PerceivingACT(nn.Module):
    """Perception, then ACT.

    Args:
        policy: ACT with an environment state as long as the perception's vector, and no images.
    """

    def __init__(self, policy: PreTrainedPolicy, perception: Perception, weights: LabelWeights) -> None:
        super().__init__()
        self.policy, self.perception, self._weights = policy, perception, weights

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """ACT's own loss and those of the labels, if the batch has them."""
        found, scene = self.perception(batch)
        with torch.autocast(found.device.type, enabled=False):  # bfloat16 knows places to a centimetre only
            loss, report = self.policy({**batch, OBS_ENV_STATE: found})
        labelled, more = grounding_losses(scene.views, scene.grounded, scene.fused, batch, self._weights)
        return loss + labelled, {"action_loss": report["l1_loss"], **more}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor]) -> Tensor:
        """Chunk of actions (batch, chunk_size, action_dim), not yet postprocessed."""
        actions: Tensor = self.policy.predict_action_chunk({**batch, OBS_ENV_STATE: self.perception(batch)[0]})
        return actions

    @torch.no_grad()
    def locate(self, batch: dict[str, Tensor]) -> Tensor:
        """Where the things that the instruction names are thought to be: (batch, queries, 3), in the state's normalised coordinates."""
        fused: Tensor = self.perception(batch)[1].fused
        return fused[:, 0, :, :3]
