"""The language-conditioned chunk policy: finds the object and the container named by the instruction, then moves.

Words become queries; each is compared with every place of every camera's feature map, and the place it matches, with an estimate
of its position in the world, goes into the action head together with keypoints, proprioception and the sentence. The map that queries
are compared with is computed without any text, so in training each image also serves instructions about the other things in the scene.
"""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from osel_sim.policy.grounding import TextEncoder, state_features
from osel_sim.policy.language_chunk.configuration_language_chunk import LanguageChunkConfig
from osel_sim.policy.language_chunk.network import ActionHead
from osel_sim.policy.perception import KeypointCamera, perceive, percept_size
from osel_sim.policy.scene import ChunkQueue, PerceivedScene, action_weight, grounding_losses, look


class LanguageChunkPolicy(ChunkQueue, PreTrainedPolicy):  # type: ignore[misc]
    """See the module. Batches come from `make_language_chunk_pre_post_processors`."""

    config_class = LanguageChunkConfig
    name = "language_chunk"

    def __init__(self, config: LanguageChunkConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: LanguageChunkConfig = config
        action, state = config.action_feature, config.robot_state_feature
        if action is None or state is None:  # validate_features has said so already; this is for the type checker
            raise ValueError("language_chunk needs a state and an action feature")
        own = state_features(state.shape[0])
        self.image_keys = list(config.image_features)
        self.text = TextEncoder(config)
        self.cameras = nn.ModuleList(KeypointCamera(config, key.split(".")[-1] in config.mounted_cameras, own) for key in self.image_keys)
        self.head = ActionHead(
            percept_size(config, len(self.image_keys), own), config.hidden, config.hidden_layers, config.chunk_size, action.shape[0]
        )
        self.reset()

    def compute(self, batch: dict[str, Tensor]) -> tuple[Tensor, PerceivedScene]:
        """The network: actions (batch, chunk, action_dim), and what was seen."""
        found, scene = perceive(self.text, self.cameras, self.image_keys, batch)
        with torch.autocast(found.device.type, enabled=False):
            return self.head(found), scene

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float] | None]:
        """Loss: L1 of the actions not beyond the episode's end, plus those of the labelled positions and places, if there are any."""
        actions, scene = self.compute(batch)
        action_loss = ((actions - batch[ACTION]).abs() * action_weight(batch, actions, self.config.gripper_weight)).sum()
        labelled, report = grounding_losses(scene.views, scene.grounded, scene.fused, batch, self.config)
        return action_loss + labelled, {"action_loss": action_loss.item(), **report}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Chunk of actions (batch, chunk_size, action_dim), not yet postprocessed."""
        self.eval()
        return self.compute(batch)[0]

    @torch.no_grad()
    def locate(self, batch: dict[str, Tensor]) -> Tensor:
        """Where the things that the instruction names are thought to be: (batch, queries, 3), in the state's normalised coordinates."""
        return look(self.text, self.cameras, self.image_keys, batch).fused[:, 0, :, :3]
