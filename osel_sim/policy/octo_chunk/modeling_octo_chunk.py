"""The Octo-style policy: words, image patches and proprioception as tokens of one transformer, read out into a flow-matching action head.

After Octo (Octo Model Team, 2024, "Octo: An Open-Source Generalist Robot Policy"), with two additions that let it learn from hundreds of
demonstrations instead of a million:
- the words' queries find their things in the cameras before the transformer (as in `language_chunk`), and what they found are tokens too;
- two readouts make queries of their own: what is to be handled now and where it goes. An instruction such as "put the food into the tray" names
  neither, and which it is depends on what has been done; so these may look at everything, and labels say in training what the expert was busy with.
"""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from osel_sim.policy.grounding import PLACE_FEATURES, Grounding, GroundingCamera, TextEncoder, fuse, mlp, state_features
from osel_sim.policy.octo_chunk.configuration_octo_chunk import OctoChunkConfig
from osel_sim.policy.octo_chunk.network import FlowHead, Readout
from osel_sim.policy.scene import ChunkQueue, PerceivedScene, action_weight, grounding_losses, look, own_geometry

ACTIVE = 2  # readouts that find: the thing to handle now, and where it goes
NOISE_SEED = 20240513
TIME_POWER = 1 / 1.5  # times are 1 - u^(2/3) for uniform u: more of the early ones, where the observation matters most (as in pi0)


class OctoChunkPolicy(ChunkQueue, PreTrainedPolicy):  # type: ignore[misc]
    """See the module. Batches come from `make_octo_chunk_pre_post_processors`."""

    config_class = OctoChunkConfig
    name = "octo_chunk"

    def __init__(self, config: OctoChunkConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: OctoChunkConfig = config
        feature, state = config.action_feature, config.robot_state_feature
        if feature is None or state is None:  # validate_features has said so already; this is for the type checker
            raise ValueError("octo_chunk needs a state and an action feature")
        width, action_dim, own = config.width, feature.shape[0], state_features(state.shape[0])
        self.image_keys = list(config.image_features)
        mounted = [key.split(".")[-1] in config.mounted_cameras for key in self.image_keys]
        self.text = TextEncoder(config)
        self.cameras = nn.ModuleList(GroundingCamera(config, moves, config.queries + ACTIVE, own) for moves in mounted)
        self.words = nn.Linear(config.text_dim, width)
        self.patches = nn.ModuleList(nn.Conv2d(config.channels, width, config.patch, stride=config.patch) for _ in mounted)
        self.proprioception = mlp(own, width, width)
        self.things = nn.Linear(7 + len(mounted) * (PLACE_FEATURES + config.channels), width)
        self.kinds = nn.Parameter(0.02 * torch.randn(3 + len(mounted), width))  # tells words, state, things and each camera's patches apart
        self.roles = nn.Parameter(0.02 * torch.randn(config.queries, width))
        self.trunk = Readout(width, config.attention_heads, config.layers, ACTIVE + config.readouts)
        self.seek = nn.ModuleList(mlp(width, width, config.query_dim) for _ in range(ACTIVE))
        geometry = (config.queries + ACTIVE) * (7 + len(mounted) * (PLACE_FEATURES + 4))
        inputs = (ACTIVE + config.readouts) * width + own + geometry
        self.head = FlowHead(inputs, config.hidden, config.hidden_layers, config.chunk_size, action_dim)
        noise = torch.randn(config.chunk_size, action_dim, generator=torch.Generator().manual_seed(NOISE_SEED))
        self.register_buffer("noise", noise, persistent=False)
        self.reset()

    def read(self, batch: dict[str, Tensor]) -> tuple[Tensor, PerceivedScene, list[Grounding], Tensor]:
        """Everything before the action head.

        Returns:
            its inputs (batch, inputs); the scene; what the two active readouts found in each camera, and their fused estimates (batch, 1, 2, 4).
        """
        scene = look(self.text, self.cameras, self.image_keys, batch)
        rows = len(scene.state)
        pairs = len(scene.text.words) // rows
        words, used = (value.view(rows, pairs, *value.shape[1:])[:, 0] for value in (scene.text.words, scene.text.used))
        own = scene.fused[:, 0]
        found = [torch.cat([grounding.found[:, 0], grounding.attended[:, 0]], dim=-1) for grounding in scene.grounded]
        things = torch.cat([own, own[..., :3] - scene.state[:, None, :3], *found], dim=-1)
        patches = [embed(raw).flatten(2).transpose(1, 2) for embed, raw in zip(self.patches, scene.raw, strict=True)]
        parts = [self.words(words), self.proprioception(scene.state)[:, None], self.things(things) + self.roles, *patches]
        tokens = torch.cat([part + kind for part, kind in zip(parts, self.kinds, strict=True)], dim=1)
        others = used.new_ones(rows, tokens.shape[1] - used.shape[1])
        readouts = self.trunk(tokens, torch.cat([used, others], dim=1))
        with torch.autocast(scene.state.device.type, enabled=False):
            readouts = readouts.float()
            sought = torch.stack([head(readouts[:, index]) for index, head in enumerate(self.seek)], dim=1)[:, None]
            eyes = [camera for camera in self.cameras if isinstance(camera, GroundingCamera)]
            active = [camera.ground(view, sought, scene.state, self.config.queries) for camera, view in zip(eyes, scene.views, strict=True)]
            fused = fuse([grounding.estimate for grounding in active])
            geometry = own_geometry(scene.fused, scene.grounded, scene.state) + own_geometry(fused, active, scene.state)
            inputs = torch.cat([readouts.flatten(1), scene.state, *geometry], dim=-1)
        return inputs, scene, active, fused

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float] | None]:
        """Loss: squared error of the guessed chunks, actions beyond the episode's end not counted, plus those of the labels, if there are any."""
        inputs, scene, active, fused = self.read(batch)
        actions = batch[ACTION].float()
        times = 1 - torch.rand(self.config.flow_samples, len(actions), device=actions.device) ** TIME_POWER
        noise = torch.randn(self.config.flow_samples, *actions.shape, device=actions.device)
        with torch.autocast(actions.device.type, enabled=False):
            points = torch.lerp(noise, actions.expand_as(noise), times[..., None, None])
            condition = self.head.condition(inputs).repeat(self.config.flow_samples, 1)
            ends = self.head(condition, points.flatten(0, 1), times.flatten()).view_as(noise)
        weight = action_weight(batch, actions, self.config.gripper_weight)
        action_loss = ((ends - actions).square().mean(dim=0) * weight).sum()
        named, report = grounding_losses(scene.views, scene.grounded, scene.fused, batch, self.config)
        busy, more = grounding_losses(scene.views, active, fused, batch, self.config, "active")
        return action_loss + named + busy, {"action_loss": action_loss.item(), **report, **more}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Chunk of actions (batch, chunk_size, action_dim), not yet postprocessed; the same for the same batch."""
        self.eval()
        inputs = self.read(batch)[0]
        noise = self.config.noise_scale * self.get_buffer("noise")
        return self.head.integrate(inputs, noise.expand(len(inputs), -1, -1), self.config.integration_steps)

    @torch.no_grad()
    def locate(self, batch: dict[str, Tensor]) -> Tensor:
        """Where the things that the instruction names are thought to be: (batch, queries, 3), in the state's normalised coordinates."""
        return look(self.text, self.cameras, self.image_keys, batch).fused[:, 0, :, :3]
