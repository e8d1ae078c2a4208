"""Configuration of the language-conditioned chunk policy: one architecture, any size."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("language_chunk")
@dataclass
class LanguageChunkConfig(PreTrainedConfig):  # type: ignore[misc]  # LeRobot is untyped
    """Sizes of the language-conditioned chunk policy.

    Attributes:
        chunk_size: actions predicted at once, at the control rate of the environment.
        n_action_steps: how many of them `select_action` hands out before it looks again.
        image_size: images are brought to this square size (area average) by the preprocessor.
        stem_channels, channels: width of the first convolution (half resolution) and of the others (quarter resolution).
        trunk_layers: residual convolutions at quarter resolution that no text reaches.
        keypoints: spatial-softmax points a camera, on features modulated by the instruction.
        query_dim: width of the space in which a word meets a place in the image.
        queries: how many things of an instruction are looked for, in the order of the task's roles (the thing to move, where it goes, ...).
        vocabulary, text_length, text_dim, text_layers: hashed tokens, words kept, embedding width, self-attention layers over the words.
        hidden, hidden_layers: width and number of residual blocks of the action head.
        gripper_weight: weight of the gripper in the L1 loss, the six motions having 1.
        grounding_weight: weight of the entity-position loss, used where the batch carries such labels.
        attention_weight: weight of the loss that makes queries look where their entity is in the image, likewise.
        mounted_cameras: cameras that move with the gripper, ours and Meta-World's; what they find is relative to it.
    """

    n_obs_steps: int = 1
    chunk_size: int = 16
    n_action_steps: int = 8
    image_size: int = 96
    stem_channels: int = 32
    channels: int = 64
    trunk_layers: int = 2
    keypoints: int = 32
    query_dim: int = 64
    queries: int = 2
    vocabulary: int = 4096
    text_length: int = 24
    text_dim: int = 64
    text_layers: int = 1
    hidden: int = 512
    hidden_layers: int = 3
    gripper_weight: float = 0.5
    grounding_weight: float = 0.5
    attention_weight: float = 0.1
    mounted_cameras: tuple[str, ...] = ("wrist", "gripperPOV", "behindGripper")

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.IDENTITY,  # OSC deltas lie in [-1, 1] already
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(f"n_action_steps must lie in [1, chunk_size = {self.chunk_size}], got {self.n_action_steps}")

    def validate_features(self) -> None:
        """The policy needs at least one image, the state and an action."""
        if not self.image_features or self.robot_state_feature is None or self.action_feature is None:
            raise ValueError("language_chunk needs at least one image, observation.state and action among its features")

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
        return AdamWConfig(lr=1e-3, weight_decay=1e-4)

    def get_scheduler_preset(self) -> None:
        """None: constant rate."""
        return None
