"""Training of a policy from demonstrations, and of the context encoder."""

import os
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le
from pydantic import AllowInfNan

from osel_sim.api.settings import CONTENT, MAIN, OTHER, Count, Index, Names, Settings, TrustSettings, settings
from osel_sim.core.errors import SettingError, UnknownNameError, UsageError
from osel_sim.core.holding import held
from osel_sim.core.trust import trusting

Minutes = Annotated[float, Ge(0.001), Le(1e5), AllowInfNan(False)]


@settings
class TrainConfig(TrustSettings):
    """Train a policy on demonstrations (a LeRobotDataset, as osel_sim.collect writes it) into a LeRobot checkpoint folder.

    Uses a CUDA GPU where there is one.
    """

    policy: Annotated[str | None, MAIN] = None
    """policy file whose cameras and chunk it must fit, and whose recipe is used"""
    data: Annotated[tuple[Path, ...], MAIN] = ()
    """demonstrations: LeRobotDatasets with images, not videos, one a task, or folders of such datasets"""
    out: Annotated[Path | None, MAIN] = None
    """checkpoint folder to write (default: runs/train/NAME)"""
    steps: Annotated[Count | None, MAIN] = None
    """number of steps (default: the recipe's)"""
    minutes: Annotated[Minutes | None, MAIN] = None
    """as many steps as fit into so many minutes, measured first; prefer --steps to repeat a result"""
    resume: Annotated[bool, MAIN] = False
    """continue in --out exactly where the last saved state was"""
    init: Annotated[Path | None, MAIN] = None
    """begin with the weights of this checkpoint folder, of the same model"""
    seed: Annotated[Index, MAIN] = 0
    """fixes first weights, order and augmentation"""
    batch_size: Annotated[Count | None, OTHER] = None
    """samples a step (default: the recipe's)"""
    episodes: Annotated[Count | None, OTHER] = None
    """train on the first so many episodes of each dataset only (default: the recipe's)"""
    threads: Annotated[Index, OTHER] = 0
    """processor threads (default: all cores)"""
    eval_every: Annotated[Count, OTHER] = 1000
    """validate and write the checkpoint every so many steps"""
    eval_episodes: Annotated[Index, OTHER] = 0
    """episodes of each task in simulation at each validation"""
    save_every: Annotated[Count, OTHER] = 500
    """save the state for --resume every so many steps"""
    half: Annotated[bool, OTHER] = False
    """save the weights in half precision"""
    map: Annotated[Path | None, CONTENT] = None
    """file that says which names and conventions of the datasets are others than ours"""
    recipe: Annotated[Path | None, CONTENT] = None
    """file with sizes and settings (default: policies/training/NAME.toml)"""
    policies_dir: Annotated[Path | None, CONTENT] = None
    """further policy files"""
    tasks: Annotated[Path | None, CONTENT] = None
    """further task files, for --eval-episodes"""


@settings
class EncoderTrainConfig(Settings):
    """Train the context encoder on rendered scenes and their instructions, and measure it on unseen ones."""

    encoder: Annotated[str, MAIN] = "osel_small"
    """architecture: osel_small, the only one so far"""
    data: Annotated[Path | None, MAIN] = None
    """rendered scenes are kept here, and rendered if missing"""
    out: Annotated[Path | None, MAIN] = None
    """the checkpoint's folder (default: DATA/<encoder>); load it with --encoder DIR"""
    task: Annotated[Names, MAIN] = ("pick_place",)
    """names, tag:TAG, or all"""
    level: Annotated[tuple[Literal[0, 1, 2, 3], ...], MAIN] = (0,)
    """levels of the scenes, in turn"""
    steps: Annotated[Count, MAIN] = 1600
    """gradient steps"""
    minutes: Annotated[Minutes | None, MAIN] = None
    """as many steps as fit, timed on the first ones"""
    scenes: Annotated[Count, OTHER] = 8_000
    """training scenes of each task"""
    test_scenes: Annotated[Count, OTHER] = 600
    """test scenes of each task to measure on"""
    seed: Annotated[Index, OTHER] = 0
    """fixes first weights and order"""
    device: Annotated[str, OTHER] = ""
    """torch device (default: cuda if there, else cpu)"""
    resume: Annotated[bool, OTHER] = False
    """go on from the last saved state in the checkpoint's folder, to --steps"""


def train(config: TrainConfig | None = None, /, **values: Any) -> tuple[Path, dict[str, Any]]:
    """Train a policy on demonstrations.

    Args:
        config: settings as one object; `values` change some of them.
        values: settings by name, as `TrainConfig` has them.

    Returns:
        the checkpoint's folder, and what its `training.json` says.

    Raises:
        OselError: whatever is wrong with the settings, the recipe or the demonstrations; the message says what.
    """
    from osel_sim.formats import library
    from osel_sim.training.recipe import find_recipe, load_recipe

    config = TrainConfig.of(**values) if config is None else config.changed(**values)
    if config.policy is None or not config.data:
        raise SettingError("data" if config.policy else "policy", "is missing")
    if config.steps is not None and config.minutes is not None:
        raise SettingError("minutes", "does not go with --steps")
    for folder in config.data:
        if not folder.is_dir():
            raise UsageError(f"{folder} is not a folder of demonstrations; python -m osel_sim.collect writes one")
    spec = library.load_policy(config.policy, config.policies_dir)
    recipe = load_recipe(config.recipe or find_recipe(config.policy))
    changes = {key: getattr(config, key) for key in ("steps", "batch_size") if getattr(config, key) is not None}
    recipe = replace(recipe, optimisation=replace(recipe.optimisation, **changes), episodes=config.episodes or recipe.episodes)

    # Threads that wait by spinning waste the core another process could use; read by OpenMP when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from osel_sim.training import policy_training

    out = config.out or Path("runs") / "train" / spec.name
    options = policy_training.Options(
        out=out,
        seed=config.seed,
        threads=config.threads,
        minutes=config.minutes,
        resume=config.resume,
        evaluate_every=config.eval_every,
        rollouts=config.eval_episodes,
        save_every=config.save_every,
        half=config.half,
        tasks=config.tasks,
        init=config.init,
        mapping=config.map,
    )
    with trusting(config.trust), held(out) if config.resume and out.is_dir() else nullcontext():
        return out, policy_training.train(spec, recipe, config.data, options)


def train_encoder(config: EncoderTrainConfig | None = None, /, **values: Any) -> tuple[Path, dict[str, Any]]:
    """Train the context encoder, and measure it on unseen scenes.

    Args:
        config: settings as one object; `values` change some of them.
        values: settings by name, as `EncoderTrainConfig` has them.

    Returns:
        the checkpoint's folder, and what its `training.json` says.

    Raises:
        OselError: whatever is wrong with the settings or the folder; the message says what.
    """
    from osel_sim.context.names import DEFAULT_ENCODER
    from osel_sim.suites.registry import select_task_files
    from osel_sim.training.encoder import train as encoder_training

    config = EncoderTrainConfig.of(**values) if config is None else config.changed(**values)
    if config.encoder != DEFAULT_ENCODER:
        raise UnknownNameError("encoder to train", config.encoder, [DEFAULT_ENCODER])
    if config.data is None:
        raise SettingError("data", "is missing: give the folder of rendered scenes")
    tasks = tuple(task.name for task in select_task_files(config.task))
    wanted = encoder_training.EncoderSettings(tasks, tuple(config.level), config.steps, config.seed, config.scenes, config.test_scenes)
    out = config.out or config.data / config.encoder
    with held(out) if config.resume and out.is_dir() else nullcontext():
        return out, encoder_training.train(wanted, config.data, out, config.minutes, config.device, config.resume)
