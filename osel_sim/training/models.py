"""The models that recipes name: LeRobot configurations, policies and processors, made by LeRobot's own factory."""

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from osel_sim.core.errors import UsageError
from osel_sim.core.files import atomic_files
from osel_sim.formats.dataset_mapping import IMAGES
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.specification import STATE_DIM
from osel_sim.policy import register
from osel_sim.policy.language_chunk import LanguageChunkConfig
from osel_sim.policy.perception import Perception, PerceptionConfig, percept_size
from osel_sim.policy.perception_step import PerceptionStep
from osel_sim.policy.processing import HashedTextStep, ImageSizeStep, RotationStep
from osel_sim.policy.scene import LABELS
from osel_sim.training.act import LabelWeights, PerceivingACT
from osel_sim.training.batches import Statistics
from osel_sim.training.dataset import Demonstrations
from osel_sim.training.recipe import Recipe
from osel_sim.training.source import Wanted

ACT_IMAGE = 96
"""Side of the images that ACT's perception sees, where a recipe does not say."""

Prepare = Callable[[dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Model:
    """A configuration with what belongs to it.

    Attributes:
        perception: what ACT's environment state is made by; None: the policy sees and reads for itself.
    """

    config: PreTrainedConfig
    statistics: Statistics
    recipe: Recipe
    perception: PerceptionStep | None = None

    def trainee(self) -> nn.Module:
        """A module with fresh weights, in torch's current random state: its forward gives the loss; it predicts action chunks and locates things.

        Raises:
            UsageError: sizes of the recipe do not fit each other, which only the layers themselves know.
        """
        try:
            module: Any = get_policy_class(self.config.type)(self.config)
        except (ValueError, AssertionError) as error:
            raise UsageError(f"{self.recipe.file}: the sizes of the model do not fit each other: {' '.join(str(error).split())}") from None
        if self.perception is not None:
            seeing = Perception(PerceptionConfig(**self.perception.sizes), self.perception.mounted)
            module = PerceivingACT(module, seeing, LabelWeights(self.recipe.optimisation.grounding_weight))
        placed: nn.Module = module.to(self.config.device).to(memory_format=torch.channels_last)
        return placed

    def pipelines(self, config: PreTrainedConfig | None = None, last: PerceptionStep | None = None) -> tuple[Any, Any]:
        """Pre- and postprocessor.

        Args:
            last: for ACT, the step with the trained perception; without it nothing makes the environment state, as in training.
        """
        before, after = make_pre_post_processors(config or self.config, dataset_stats=self.statistics)
        if self.perception is not None:
            own = PerceptionConfig(**self.perception.sizes)
            steps = [HashedTextStep(own.vocabulary, own.text_length), RotationStep(), ImageSizeStep(self.perception.image_size)]
            # after renaming and batching, before the device and normalisation
            before.steps = [*before.steps[:2], *steps, *before.steps[2:], *([last] if last is not None else [])]
        return before, after

    def preparing(self) -> tuple[Prepare, Callable[[Tensor], Tensor]]:
        """The policy's own preprocessor, letting training labels pass, and its postprocessor. For one thread: a pipeline keeps what it works on."""
        before, after = self.pipelines()

        def prepare(batch: dict[str, Any]) -> dict[str, Any]:
            extra = {key: batch[key] for key in LABELS if key in batch}  # LeRobot's pipelines pass on observations and actions only
            prepared: dict[str, Any] = before(batch)
            prepared.update(extra)
            return {name: value for name, value in prepared.items() if isinstance(value, Tensor)}

        return prepare, after

    def wanted(self, pairs: int) -> Wanted:
        """What it wants of its training samples."""
        config = self.config
        if self.perception is not None:
            own = PerceptionConfig(**self.perception.sizes)
            return Wanted(config.chunk_size, self.perception.image_size, own.queries, False, own.vocabulary, own.text_length, pairs)
        active = config.type == "octo_chunk"
        return Wanted(config.chunk_size, config.image_size, config.queries, active, config.vocabulary, config.text_length, pairs)

    def save(self, trained: nn.Module, folder: Path, *, half: bool) -> None:
        """Write config.json, model.safetensors and the processors; in half precision the file is half as big and loads as float32 all the same."""
        portable = copy.copy(self.config)
        portable.device = "cpu"
        dtype = torch.float16 if half else torch.float32
        policy: Any = trained.policy if isinstance(trained, PerceivingACT) else trained
        state = policy.state_dict()
        weights = {name: value.to("cpu", dtype if value.is_floating_point() else value.dtype).contiguous() for name, value in state.items()}
        last = None
        if isinstance(trained, PerceivingACT) and self.perception is not None:
            last = replace(self.perception, half=half)
            last.load_state_dict(trained.perception.state_dict())
        with atomic_files(folder) as partial:
            policy.save_pretrained(partial, state_dict=weights)
            portable._save_pretrained(partial)
            for pipeline in self.pipelines(portable, last):
                pipeline.save_pretrained(partial)


def make_model(spec: PolicySpec, recipe: Recipe, data: list[Demonstrations], statistics: Statistics, device: str) -> Model:
    """Sizes from the recipe, features from the policy file and the datasets.

    Raises:
        UsageError: the policy file executes more actions than a chunk has, or the datasets' images differ in size.
    """
    register()
    shapes = {camera: {one.images[camera].shape[1:3] for one in data} for camera in spec.cameras}
    if any(len(own) > 1 for own in shapes.values()):
        raise UsageError(f"the datasets' images differ in size ({shapes}): collect them with one --image-size")
    given = {camera: next(iter(own)) for camera, own in shapes.items()}
    settings: dict[str, Any] = {**recipe.model, "n_action_steps": 1, "device": device, "push_to_hub": False}
    state, action = (_width(statistics[key]) for key in (OBS_STATE, ACTION))
    inputs = {OBS_STATE: PolicyFeature(FeatureType.STATE, (state,))}
    perception = None
    if recipe.type == "act":
        if state != STATE_DIM:
            raise UsageError(f"{recipe.file}: type 'act' knows only the {STATE_DIM} numbers of our own state, these demonstrations have {state}")
        side = settings.pop("image_size", ACT_IMAGE)
        if any(side > min(shape) for shape in given.values()):
            raise UsageError(f"{recipe.file}: image_size = {side} is more than the datasets' images have: {given}")
        sizes = {name: settings.pop(name, default) for name, default in asdict(PerceptionConfig()).items()}
        perception = PerceptionStep(sizes, {IMAGES + camera: camera in LanguageChunkConfig.mounted_cameras for camera in spec.cameras}, side)
        inputs[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (percept_size(PerceptionConfig(**sizes), len(spec.cameras)),))
        # There is one right action, hence no variational part. Without pre-norm it does not learn at the rate that the perception wants.
        settings |= {"use_vae": False, "pretrained_backbone_weights": None, "pre_norm": True, "dropout": 0.0}
        settings["normalization_mapping"] = {"STATE": NormalizationMode.MEAN_STD, "ACTION": NormalizationMode.IDENTITY}
    else:
        settings |= {"gripper_weight": recipe.optimisation.gripper_weight, "grounding_weight": recipe.optimisation.grounding_weight}
        inputs |= {IMAGES + camera: PolicyFeature(FeatureType.VISUAL, (3, *shape)) for camera, shape in given.items()}
    settings["input_features"], settings["output_features"] = inputs, {ACTION: PolicyFeature(FeatureType.ACTION, (action,))}
    config = make_policy_config(recipe.type, **settings)
    if spec.execute > config.chunk_size:
        raise UsageError(f"{spec.file}: execute = {spec.execute} is more than the recipe's chunk_size = {config.chunk_size}")
    return Model(replace(config, n_action_steps=spec.execute), statistics, recipe, perception)


def _width(statistics: dict[str, Tensor]) -> int:
    """How many numbers a feature has."""
    return len(statistics["mean"])
