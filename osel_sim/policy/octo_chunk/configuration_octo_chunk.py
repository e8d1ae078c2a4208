"""Configuration of the Octo-style policy: one architecture, any size."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("octo_chunk")
@dataclass
class OctoChunkConfig(PreTrainedConfig):  # type: ignore[misc]  # LeRobot is untyped
    """Sizes of the Octo-style policy.

    Attributes:
        chunk_size: actions predicted at once, at the control rate of the environment.
        n_action_steps: how many of them `select_action` hands out before it looks again.
        image_size: images are brought to this square size (area average) by the preprocessor.
        stem_channels, channels: width of the first convolution (half resolution) and of the others (quarter resolution).
        trunk_layers: residual convolutions at quarter resolution that no text reaches.
        patch: side of an image patch, in cells of the quarter-resolution map; each patch is one token.
        query_dim, queries: width of the space in which a word meets a place, and how many things of an instruction are looked for.
        vocabulary, text_length, text_dim, text_layers: hashed tokens, words kept, embedding width, self-attention layers over the words alone.
        width, layers, attention_heads: of the transformer over words, patches, things found, proprioception and readouts.
        readouts: tokens whose outputs go to the action head, besides the two that find what is to be handled now.
        hidden, hidden_layers: width and number of residual blocks of the action head.
        integration_steps: Euler steps from noise to actions.
        noise_scale: standard deviation of the noise that acting starts from: the same noise at every call, so that acting is deterministic. 0 starts
            from its middle, and was nearer to the expert than 1 (pick_place, early in training: 0.11 against 0.15 mean absolute error).
        flow_samples: noise levels tried for each training sample; the head is small beside the rest.
        gripper_weight: weight of the gripper in the loss, the six motions having 1.
        grounding_weight: weight of the position losses, used where the batch carries such labels.
        attention_weight: weight of the losses that make queries look where their thing is in the image, likewise.
        mounted_cameras: cameras that move with the gripper, ours and Meta-World's; what they find is relative to it.
    """

    n_obs_steps: int = 1
    chunk_size: int = 16
    n_action_steps: int = 8
    image_size: int = 96
    stem_channels: int = 16
    channels: int = 48
    trunk_layers: int = 2
    patch: int = 4
    query_dim: int = 64
    queries: int = 3
    vocabulary: int = 4096
    text_length: int = 32
    text_dim: int = 96
    text_layers: int = 1
    width: int = 192
    layers: int = 4
    attention_heads: int = 4
    readouts: int = 2
    hidden: int = 512
    hidden_layers: int = 3
    integration_steps: int = 5
    noise_scale: float = 0.0
    flow_samples: int = 4
    gripper_weight: float = 0.5
    grounding_weight: float = 0.5
    attention_weight: float = 0.1
    mounted_cameras: tuple[str, ...] = ("wrist", "gripperPOV", "behindGripper")

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,  # noise of one size for all: small rotations count as much as large motions
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(f"n_action_steps must lie in [1, chunk_size = {self.chunk_size}], got {self.n_action_steps}")
        if self.width % self.attention_heads:
            raise ValueError(f"width = {self.width} must be a multiple of attention_heads = {self.attention_heads}")
        if self.image_size % (4 * self.patch):
            raise ValueError(f"image_size = {self.image_size} must be a multiple of four times patch = {self.patch}")

    def validate_features(self) -> None:
        """The policy needs at least one image, the state and an action."""
        if not self.image_features or self.robot_state_feature is None or self.action_feature is None:
            raise ValueError("octo_chunk needs at least one image, observation.state and action among its features")

    @property
    def observation_delta_indices(self) -> None:
        """Only the present observation is used."""
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        """The actions a training sample needs: now and the chunk ahead."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW as LeRobot's own training script would use it."""
        return AdamWConfig(lr=5e-4, weight_decay=1e-3)

    def get_scheduler_preset(self) -> None:
        """None: constant rate."""
        return None
