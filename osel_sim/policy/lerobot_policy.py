"""Drives the robot with any LeRobot checkpoint: a folder or a hub name, LeRobot's own types or a plugin's."""

import contextlib
import copy
import io
import logging
import zlib
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from torch import Tensor

from osel_sim.core import content
from osel_sim.core.errors import CheckpointError, PolicyError
from osel_sim.core.hub import download, offline_if_unreachable, why_silent
from osel_sim.core.torch_settings import threads
from osel_sim.core.trust import ForeignCodeError, no_foreign_code, what_failed
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Actions, Observation, Policy
from osel_sim.policy import register
from osel_sim.policy.fit import camera_keys, check_fit, check_normalisation, check_processors
from osel_sim.policy.history import split
from osel_sim.policy.mapping import actions_of, image_of, state_of
from osel_sim.policy.perception_step import PerceptionStep
from osel_sim.policy.row_random import drawing_by_row
from osel_sim.policy.text import embed
from osel_sim.policy.trust import check_checkpoint


def load(spec: PolicySpec, environment: EnvironmentSpec) -> Callable[[], Policy]:
    """Load the weights once; the result makes sessions that share them, each with its own state.

    Raises:
        CheckpointError: missing, unreadable, without access to the hub, asking for code that is not allowed, or not fitting the policy file.
    """
    if not spec.checkpoint:
        raise CheckpointError(f"{spec.file}: checkpoint: is missing, a policy of kind 'lerobot' needs a folder or a hub name")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    given = content.resolve_checkpoint(spec.checkpoint)
    with quiet(), no_foreign_code(), contextlib.nullcontext() if Path(given).is_dir() else offline_if_unreachable():
        register()
        register_third_party_plugins()
        checkpoint = str(_folder(spec, str(given)))
        _check_code(spec, checkpoint)
        config = _config(spec, checkpoint)
        config.device = device
        check_processors(spec, checkpoint)
        processors = _processors(spec, checkpoint, config, device)
        seen = {key: shape for step in processors[0].steps if isinstance(step, PerceptionStep) for key, shape in step.image_shapes.items()}
        check_fit(spec, config, environment, seen)
        policy = _weights(spec, checkpoint, config)
        _check_memory(spec, policy)
        check_normalisation(spec, config, *processors)
    images = {**{key: tuple(feature.shape) for key, feature in config.image_features.items()}, **seen}
    return lambda: LeRobotPolicy(spec, policy, processors, images, environment)


class LeRobotPolicy:
    """One session of a LeRobot policy; made by `load`.

    Args:
        images: shape (3, H, W) of every image that the policy or its preprocessor looks at.
        environment: what it drives.
    """

    def __init__(
        self,
        spec: PolicySpec,
        policy: PreTrainedPolicy,
        processors: tuple[Any, Any],
        images: dict[str, tuple[int, ...]],
        environment: EnvironmentSpec,
    ) -> None:
        self._environment = environment
        eyes = [step.perception.parameters() for step in processors[0].steps if isinstance(step, PerceptionStep)]
        shared = {id(tensor): tensor for tensor in chain(policy.parameters(), policy.buffers(), *eyes)}
        self._policy, self._before, self._after = copy.deepcopy((policy, *processors), shared)  # own queues and caches, shared weights
        self._mapping, self._cameras = spec.mapping, camera_keys(spec.mapping, spec.cameras)
        self._images = images
        self._instruction, self._calls = "", 0
        self._context: Tensor | None = None

    def reset(self, instruction: str) -> None:
        """Start a new episode."""
        self._instruction, self._calls = instruction, 0
        feature = self._policy.config.env_state_feature
        if feature is not None and self._mapping.environment_state:
            self._context = torch.from_numpy(embed(instruction, feature.shape[0]))
        self._policy.reset()
        self._before.reset()
        self._after.reset()

    def act(self, observation: Observation) -> Actions:
        """The next chunk of actions, (T, D) float32; the same bits for the same observations since the last reset."""
        with torch.inference_mode(), threads(1), no_foreign_code(), drawing(self._instruction, self._calls):
            prepared = [self._prepared(one) for one in split(observation)]
            # the postprocessor knows single actions (batch, D): a chunk's steps take the batch's place
            chunk = self._policy.predict_action_chunk(prepared[0])[0] if len(prepared) == 1 else self._planned(prepared)
            actions = self._after(chunk)
        self._calls += 1
        return self._finished(actions)

    @classmethod
    def act_batch(cls, sessions: Sequence["LeRobotPolicy"], observations: Sequence[Observation]) -> list[Actions]:
        """The next chunk of each session, with its own random numbers, in one pass of the network for all that are shown things of one shape."""
        shown = [split(observation) for observation in observations]
        if any(len(steps) > 1 for steps in shown):
            raise PolicyError("it looks at several observations at a call, from which LeRobot plans in queues of one session")
        chunks: dict[int, Tensor] = {}
        with torch.inference_mode(), threads(1), no_foreign_code():
            prepared = [session._prepared(steps[0]) for session, steps in zip(sessions, shown, strict=True)]
            for rows in _of_one_shape(prepared):
                seeds = [_seed(sessions[row]._instruction, sessions[row]._calls) for row in rows]
                with drawing_by_row(seeds):
                    together = {key: torch.cat([prepared[row][key] for row in rows]) for key in prepared[rows[0]]}
                    chunks |= zip(rows, sessions[rows[0]]._policy.predict_action_chunk(together), strict=True)
            actions = [session._finished(session._after(chunks[row])) for row, session in enumerate(sessions)]
        for session in sessions:
            session._calls += 1
        return actions

    def _finished(self, actions: Tensor) -> Actions:
        """Postprocessed actions (T, D) as the environment takes them."""
        action = self._environment.action
        return action.clip(actions_of(actions.float().cpu().numpy(), self._mapping, action))

    def _prepared(self, observation: Observation) -> dict[str, Tensor]:
        """One observation as the network takes it."""
        config = self._policy.config
        batch: dict[str, Any] = {"task": self._instruction}
        for key, shape in self._images.items():
            size = shape[-2:]
            batch[key] = _image(image_of(observation, self._cameras[key], self._mapping), size) if key in self._cameras else torch.zeros(3, *size)
        if config.robot_state_feature is not None:
            batch[OBS_STATE] = torch.from_numpy(state_of(observation, self._mapping, self._environment))
        if self._context is not None:
            batch[OBS_ENV_STATE] = self._context
        return {key: value for key, value in self._before(batch).items() if isinstance(value, Tensor)}

    def _planned(self, observations: list[dict[str, Tensor]]) -> Tensor:
        """The chunk (T, D) that a policy with a memory of observations plans from these.

        LeRobot's such policies keep observations and planned actions in queues, and plan when no action is left: with one in it, an observation is
        only remembered.
        """
        self._policy.reset()
        planned = self._policy._queues[ACTION]
        for observation in observations[:-1]:
            planned.append(torch.empty(0))
            self._policy.select_action(dict(observation))
        first = self._policy.select_action(dict(observations[-1]))
        return torch.cat([first, *planned])


def _folder(spec: PolicySpec, checkpoint: str) -> Path:
    """The checkpoint on this machine. What comes from the hub is fetched first and loaded from where it lies: what is checked is what is loaded."""
    if Path(checkpoint).is_dir():
        return Path(checkpoint)
    if checkpoint.startswith(("/", ".")) or checkpoint.count("/") != 1:  # hub names are owner/name
        raise CheckpointError(
            f"{spec.file}: checkpoint {spec.checkpoint!r} is no folder; train one with python -m osel_sim.train --policy {spec.name}"
        )
    try:
        return download(checkpoint)
    except Exception as error:  # the hub client has its own
        raise CheckpointError(f"{spec.file}: checkpoint {spec.checkpoint!r} cannot be read: {_line(error)}{why_silent()}") from error


def _check_code(spec: PolicySpec, checkpoint: str) -> None:
    try:
        check_checkpoint(Path(checkpoint))
    except CheckpointError as error:
        raise type(error)(f"{spec.file}: {error}") from None


def _config(spec: PolicySpec, checkpoint: str) -> PreTrainedConfig:
    try:
        return PreTrainedConfig.from_pretrained(checkpoint)
    except Exception as error:  # JSON and draccus have their own
        raise CheckpointError(f"{spec.file}: checkpoint {spec.checkpoint!r} cannot be read: {_line(error)}") from error


def _processors(spec: PolicySpec, checkpoint: str, config: PreTrainedConfig, device: str) -> tuple[Any, Any]:
    try:
        overrides = {"device_processor": {"device": device}}
        before, after = make_pre_post_processors(config, checkpoint, preprocessor_overrides=overrides, postprocessor_overrides={})
    except Exception as error:
        raise CheckpointError(f"{spec.file}: checkpoint {spec.checkpoint!r} of type {config.type!r} cannot be loaded: {_line(error)}") from error
    return before, after


def _weights(spec: PolicySpec, checkpoint: str, config: PreTrainedConfig) -> PreTrainedPolicy:
    try:
        policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config, strict=True)
    except Exception as error:
        raise CheckpointError(f"{spec.file}: checkpoint {spec.checkpoint!r} of type {config.type!r} cannot be loaded: {_line(error)}") from error
    policy.eval()
    for parameter in policy.parameters():
        parameter.requires_grad_(False)
    return policy


def _check_memory(spec: PolicySpec, policy: PreTrainedPolicy) -> None:
    """Whether a policy that looks at several observations keeps them as LeRobot's own do."""
    queues = getattr(policy, "_queues", None)
    if spec.history > 1 and not (isinstance(queues, dict) and ACTION in queues):
        raise CheckpointError(
            f"{spec.file}: checkpoint {spec.checkpoint!r} of type {policy.config.type!r} looks at {spec.history} observations, "
            "and does not keep them in queues, as LeRobot's diffusion, vqbet and multi_task_dit do"
        )


def _line(error: Exception) -> str:
    """The first line of an error, which is what fits into one."""
    failed = what_failed(error)
    lines = str(failed).strip().splitlines() or [""]
    return lines[0] if isinstance(failed, ForeignCodeError) else f"{type(failed).__name__}: {lines[0]}"


def _image(image: np.ndarray[Any, Any], size: tuple[int, ...]) -> Tensor:
    """uint8 (H, W, 3) -> float (3, h, w) in [0, 1] as LeRobot's datasets give it, brought to the size the checkpoint was trained with."""
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255
    if pixels.shape[-2:] != tuple(size):
        pixels = torch.nn.functional.interpolate(pixels[None], size=tuple(size), mode="bilinear", antialias=True)[0].clamp(0, 1)
    return pixels


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without what LeRobot prints while it loads and what the hub's client logs about each of its retries: the error says it once."""
    logger = logging.getLogger("huggingface_hub")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def drawing(instruction: str, call: int) -> Iterator[None]:
    """With torch's random numbers those of an instruction and call, for policies that start from noise; put back afterwards."""
    with torch.random.fork_rng(devices=[torch.cuda.current_device()] if torch.cuda.is_available() else []):
        torch.manual_seed(_seed(instruction, call))
        yield


def _seed(instruction: str, call: int) -> int:
    return zlib.crc32(instruction.encode()) + call


def _of_one_shape(prepared: Sequence[dict[str, Tensor]]) -> list[list[int]]:
    """Which observations go through the network together: those with the same tensors, but for their first dimension, which must be 1."""
    groups: dict[Any, list[int]] = {}
    for row, tensors in enumerate(prepared):
        alike = tuple((key, tensor.dtype, tuple(tensor.shape)) for key, tensor in tensors.items())
        alone = any(tensor.ndim == 0 or tensor.shape[0] != 1 for tensor in tensors.values())
        groups.setdefault((alike, row if alone else None), []).append(row)
    return list(groups.values())
