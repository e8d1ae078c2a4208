"""Training that begins with the weights of a checkpoint."""

from pathlib import Path

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep
from safetensors.torch import load_file
from torch import nn

from osel_sim.core.errors import CheckpointError
from osel_sim.core.files import content_digest
from osel_sim.core.trust import ForeignCodeError, no_foreign_code, what_failed
from osel_sim.policy import register
from osel_sim.policy.perception_step import PerceptionStep
from osel_sim.policy.trust import check_checkpoint
from osel_sim.training.batches import Statistics

WEIGHTS = "model.safetensors"


class Initial:
    """A LeRobot checkpoint folder to begin with.

    Raises:
        CheckpointError: it is none, cannot be read, or asks for code that is not allowed.
    """

    def __init__(self, folder: Path) -> None:
        register()
        self.folder = folder
        if not (folder / WEIGHTS).is_file():  # LeRobot would take it for a hub name
            raise CheckpointError(f"{folder}: is no checkpoint to begin with: it has no {WEIGHTS}")
        check_checkpoint(folder)
        try:
            with no_foreign_code():
                self.config = PreTrainedConfig.from_pretrained(folder)
                self._weights = load_file(folder / WEIGHTS)
                before, _ = make_pre_post_processors(self.config, str(folder), preprocessor_overrides={"device_processor": {"device": "cpu"}})
        except Exception as error:  # the hub client, JSON, safetensors and draccus all have their own
            failed = what_failed(error)
            if isinstance(failed, ForeignCodeError):
                raise ForeignCodeError(f"{folder}: {failed}") from None
            raise CheckpointError(f"{folder}: is no checkpoint to begin with ({type(error).__name__}: {' '.join(str(error).split())})") from None
        found = [step.stats for step in before.steps if isinstance(step, NormalizerProcessorStep)]
        self.statistics: Statistics = {
            key: {name: torch.as_tensor(value, dtype=torch.float32) for name, value in values.items()} for key, values in (found or [{}])[0].items()
        }
        for step in before.steps:
            if isinstance(step, PerceptionStep):
                parts = {"policy": self._weights, "perception": step.state_dict()}
                self._weights = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        self.digest = content_digest(*(file.read_bytes() for file in sorted(folder.glob("*.safetensors"))))

    def fill(self, trainee: nn.Module, kind: str) -> None:
        """Give a module in training the checkpoint's weights.

        Args:
            kind: the recipe's type of policy.

        Raises:
            CheckpointError: it has other parts, or parts of another size.
        """
        if kind != self.config.type:
            raise CheckpointError(f"{self.folder}: is of type {self.config.type!r}, the recipe wants {kind!r}")
        own = trainee.state_dict()
        for name in sorted({*own, *self._weights}):
            sizes = [tuple(state[name].shape) if name in state else None for state in (self._weights, own)]
            if sizes[0] != sizes[1]:
                raise CheckpointError(f"{self.folder}: does not fit the recipe and the policy file: {name} is {sizes[0]} there, {sizes[1]} here")
        trainee.load_state_dict(self._weights)
