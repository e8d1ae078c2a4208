"""Whether a LeRobot checkpoint and a policy file fit together, said before anything runs."""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from osel_sim.core.errors import CheckpointError, nearest
from osel_sim.formats.conventions import ENVIRONMENT_STATES, Conventions
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.policy.mapping import known_parts, state_size, wanted_parts

PREPROCESSOR = "policy_preprocessor.json"


def check_fit(spec: PolicySpec, config: PreTrainedConfig, environment: EnvironmentSpec, seen: Collection[str] = ()) -> None:
    """Whether the policy file gives what a checkpoint wants.

    Args:
        environment: what it will drive.
        seen: images that the checkpoint's own preprocessor looks at to make `observation.environment_state`.

    Raises:
        CheckpointError: saying what the checkpoint wants, what the policy file gives, and what to write instead.
    """
    problems = [
        *_images(spec, [*config.image_features, *seen]),
        *_state(spec, config, environment),
        *_action(spec, config, environment.action),
        *_others(spec, config, bool(seen)),
    ]
    if problems:
        raise CheckpointError(f"{spec.file}: checkpoint {spec.checkpoint!r} does not fit: {'; '.join(problems)}")


def check_normalisation(spec: PolicySpec, config: PreTrainedConfig, before: Any, after: Any) -> None:
    """Whether the processors know the statistics by which the checkpoint's inputs and actions were normalised.

    LeRobot passes a feature without statistics as it is: the policy would be shown metres where it learnt standard deviations.

    Raises:
        CheckpointError: naming the features without statistics.
    """
    if not spec.mapping.normalised:
        return
    modes = {FeatureType(kind) if not isinstance(kind, FeatureType) else kind: mode for kind, mode in (config.normalization_mapping or {}).items()}
    sides = ((before, NormalizerProcessorStep, config.input_features or {}), (after, UnnormalizerProcessorStep, config.output_features or {}))
    lacking: list[str] = []
    for pipeline, kind, features in sides:
        known = {name.rpartition(".")[0] for step in pipeline.steps if isinstance(step, kind) for name in step.state_dict()}
        normalised = [key for key, feature in features.items() if modes.get(feature.type, NormalizationMode.IDENTITY) != NormalizationMode.IDENTITY]
        lacking += [key for key in normalised if key not in known]
    if lacking:
        raise CheckpointError(
            f"{spec.file}: checkpoint {spec.checkpoint!r} was trained with normalised {', '.join(lacking)}, but its processors hold no statistics "
            "for that: save the processors with the dataset's statistics beside the weights, or say normalised = false in [mapping] if that is meant"
        )


def check_processors(spec: PolicySpec, checkpoint: str) -> None:
    """Whether a local checkpoint has processors at all; those saved before LeRobot 0.4 kept their statistics among the weights.

    Raises:
        CheckpointError: it has none.
    """
    folder = Path(checkpoint)
    if folder.is_dir() and not (folder / PREPROCESSOR).is_file():
        raise CheckpointError(
            f"{spec.file}: checkpoint {spec.checkpoint!r} has no {PREPROCESSOR}: it was saved without its processors, or before LeRobot 0.4; "
            f"python -m lerobot.processor.migrate_policy_normalization --pretrained-path {checkpoint} makes them"
        )


def camera_keys(mapping: Conventions, cameras: tuple[str, ...]) -> dict[str, str]:
    """Checkpoint's image key -> camera here."""
    return {mapping.key(camera): camera for camera in cameras}


def _images(spec: PolicySpec, wanted: list[str]) -> Iterator[str]:
    given = camera_keys(spec.mapping, spec.cameras)
    for key in sorted(set(wanted) - set(given) - set(spec.mapping.blank)):
        free = [name for name in given if name not in wanted]
        near = next(iter(nearest(key, free, cutoff=0.0)), None)
        advice = "name a camera for it in [observation] cameras" if near is None else f'perhaps [mapping.images] {given[near]} = "{key}"'
        yield f'it wants {key}, the policy file gives {", ".join(sorted(given))} ({advice}; or leave it black: [mapping] blank = ["{key}"])'
    for key in sorted((set(given) | set(spec.mapping.blank)) - set(wanted)):
        if key in spec.mapping.images.values() or key in spec.mapping.blank:
            meant = nearest(key, wanted, cutoff=0.0)
            yield f"[mapping] gives it {key}, which it does not know" + (f": did you mean {meant[0]!r}?" if meant else "")


def _state(spec: PolicySpec, config: PreTrainedConfig, environment: EnvironmentSpec) -> Iterator[str]:
    wanted, size = config.robot_state_feature, state_size(spec.mapping, environment)
    if wanted is None or tuple(wanted.shape) == (size,):
        return
    known = known_parts(environment)
    parts = " + ".join(f"{part} {known[part]}" for part in wanted_parts(spec.mapping, environment))
    sizes = ", ".join(f"{part} {numbers}" for part, numbers in known.items())
    yield (
        f"it wants {OBS_STATE} of shape {tuple(wanted.shape)}, the simulation gives ({size},): {parts or 'nothing'} "
        f"([mapping] state_parts can be put together from {sizes})"
    )


def _action(spec: PolicySpec, config: PreTrainedConfig, robot: ActionSpec) -> Iterator[str]:
    action, columns = config.action_feature, spec.mapping.columns
    if action is None or len(action.shape) != 1:
        yield f"it gives {ACTION} of shape {tuple(action.shape) if action else 'none'}, the robot takes ({robot.dimension},)"
        return
    size = action.shape[0]
    if not columns and size != robot.dimension:
        names = ", ".join(robot.names)
        yield f"it gives {ACTION} of shape ({size},), the robot takes ({robot.dimension},): {names}; say in [mapping] columns which"
    elif columns and max(columns) >= size:
        yield f"[mapping] columns names number {max(columns)} of an action, it gives {ACTION} of shape ({size},)"


def _others(spec: PolicySpec, config: PreTrainedConfig, fills: bool) -> Iterator[str]:
    features = config.input_features or {}
    if config.env_state_feature is not None and not fills and not spec.mapping.environment_state:
        known = ", ".join(f'"{name}"' for name in ENVIRONMENT_STATES)
        yield f"it wants {OBS_ENV_STATE}, which nothing here gives unless [mapping] environment_state says what it is (known: {known})"
    for key in sorted(set(features) - {*config.image_features, OBS_STATE, OBS_ENV_STATE}):
        hint = f"; is it an image? then it must be called {OBS_IMAGES}.NAME" if "image" in key else ""
        yield f"it wants {key}, which nothing here gives{hint}"
    steps = getattr(config, "n_action_steps", None) or getattr(config, "action_chunk_size", None)
    chunk = steps if (config.n_obs_steps or 1) > 1 else getattr(config, "chunk_size", None)
    if chunk is not None and chunk < spec.execute:
        yield f"its chunks hold {chunk} actions, execute = {spec.execute}"
    if (config.n_obs_steps or 1) != spec.history:
        yield f"it looks at the last {config.n_obs_steps or 1} observations: set history = {config.n_obs_steps or 1} in [observation]"
