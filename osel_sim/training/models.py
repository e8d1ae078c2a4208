"""The models that recipes name: LeRobot configurations, policies and processors, made by LeRobot's own factory."""

import copy
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from osel_sim.errors import UsageError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.policy import register
from osel_sim.policy.base import ACTION_DIM, STATE_DIM
from osel_sim.policy.processing import ImageSizeStep, TextEmbeddingStep
from osel_sim.policy.scene import LABELS
from osel_sim.training.act import QUERIES, LabelledACT, calibrate
from osel_sim.training.batches import Statistics
from osel_sim.training.dataset import IMAGES, Demonstrations
from osel_sim.training.recipe import Recipe
from osel_sim.training.source import Wanted

ACT_IMAGE, ACT_TEXT = 96, 256
"""Side of the images that ACT sees and width of its instructions, where a recipe does not say."""
PIXELS = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)}

Prepare = Callable[[dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Model:
    """A configuration with what belongs to it."""

    config: PreTrainedConfig
    statistics: Statistics
    recipe: Recipe

    def policy(self) -> PreTrainedPolicy:
        """A policy with fresh weights, in torch's current random state."""
        policy = get_policy_class(self.config.type)(self.config)
        return policy.to(self.config.device).to(memory_format=torch.channels_last)

    def trainee(self, batch: dict[str, Tensor]) -> tuple[nn.Module, Callable[[nn.Module], PreTrainedPolicy]]:
        """A module to train, whose forward gives the loss, and how to get the policy out of it or of a copy.

        Args:
            batch: a prepared batch, for statistics that the policy's layers want.
        """
        policy = self.policy()
        if self.config.type != "act":
            return policy, lambda module: module
        calibrate(policy, batch)
        return LabelledACT(policy, self.recipe.optimisation).to(self.config.device), lambda module: module.policy

    def pipelines(self, config: PreTrainedConfig | None = None) -> tuple[Any, Any]:
        """Pre- and postprocessor."""
        before, after = make_pre_post_processors(config or self.config, dataset_stats=self.statistics)
        if self.config.type == "act":
            own = [TextEmbeddingStep(self.config.env_state_feature.shape[0]), ImageSizeStep(self._image_size)]
            before.steps = [*before.steps[:2], *own, *before.steps[2:]]  # after renaming and batching, before the device and normalisation
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
        if config.type == "act":
            return Wanted(config.chunk_size, self._image_size, QUERIES, True)
        active = config.type == "octo_chunk"
        return Wanted(config.chunk_size, config.image_size, config.queries, active, config.vocabulary, config.text_length, pairs)

    @property
    def _image_size(self) -> int:
        """Side of the images that ACT sees."""
        return int(next(iter(self.config.image_features.values())).shape[-1])

    def save(self, policy: PreTrainedPolicy, folder: Path, *, half: bool) -> None:
        """Write config.json, model.safetensors and the processors; in half precision the file is half as big and loads as float32 all the same."""
        portable = copy.copy(self.config)
        portable.device = "cpu"
        partial = folder / "checkpoint.partial"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        dtype = torch.float16 if half else torch.float32
        state = policy.state_dict()
        weights = {name: value.to("cpu", dtype if value.is_floating_point() else value.dtype).contiguous() for name, value in state.items()}
        policy.save_pretrained(partial, state_dict=weights)
        portable._save_pretrained(partial)
        for pipeline in self.pipelines(portable):
            pipeline.save_pretrained(partial)
        for file in sorted(partial.iterdir()):
            file.replace(folder / file.name)
        partial.rmdir()


def make_model(spec: PolicySpec, recipe: Recipe, data: list[Demonstrations], statistics: Statistics, device: str) -> Model:
    """Sizes from the recipe, features from the policy file and the datasets.

    Raises:
        UsageError: the policy file executes more actions than a chunk has, or the datasets' images differ in size.
    """
    register()
    sizes = {camera: {one.images[camera].shape[1:3] for one in data} for camera in spec.cameras}
    if any(len(shapes) > 1 for shapes in sizes.values()):
        raise UsageError(f"the datasets' images differ in size ({sizes}): collect them with one --image-size")
    given = {camera: next(iter(shapes)) for camera, shapes in sizes.items()}
    settings: dict[str, Any] = {**recipe.model, "n_action_steps": 1, "device": device, "push_to_hub": False}
    inputs = {OBS_STATE: PolicyFeature(FeatureType.STATE, (STATE_DIM,))}
    if recipe.type == "act":
        side, width = settings.pop("image_size", ACT_IMAGE), settings.pop("text_dim", ACT_TEXT)
        if any(side > min(shape) for shape in given.values()):
            raise UsageError(f"{recipe.file}: image_size = {side} is more than the datasets' images have: {given}")
        given = dict.fromkeys(given, (side, side))
        inputs[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (width,))
        settings |= {"use_vae": False, "pretrained_backbone_weights": None}
        statistics = {**statistics, **{IMAGES + camera: PIXELS for camera in spec.cameras}}
    else:
        settings |= {"gripper_weight": recipe.optimisation.gripper_weight, "grounding_weight": recipe.optimisation.grounding_weight}
    inputs |= {IMAGES + camera: PolicyFeature(FeatureType.VISUAL, (3, *shape)) for camera, shape in given.items()}
    settings["input_features"], settings["output_features"] = inputs, {ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))}
    config = make_policy_config(recipe.type, **settings)
    if spec.execute > config.chunk_size:
        raise UsageError(f"{spec.file}: execute = {spec.execute} is more than the recipe's chunk_size = {config.chunk_size}")
    return Model(replace(config, n_action_steps=spec.execute), statistics, recipe)
