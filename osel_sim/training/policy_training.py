"""Trains one policy by its recipe, on one or several datasets, and writes a LeRobot checkpoint folder."""

import copy
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from numpy.typing import NDArray

from osel_sim.core import content
from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.core.torch_settings import computes_bfloat16
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.training.batches import Batches, frames_of, statistics_of
from osel_sim.training.dataset import Demonstrations, dataset_folders, load_demonstrations, task_of
from osel_sim.training.evaluation import validate
from osel_sim.training.initial import Initial
from osel_sim.training.loop import Trainer
from osel_sim.training.memory import keep_memory
from osel_sim.training.models import make_model
from osel_sim.training.recipe import Recipe
from osel_sim.training.state import write_json


@dataclass(frozen=True)
class Options:
    """What the command line says beyond the recipe.

    Attributes:
        minutes: choose the number of steps so that training takes about so long; None: the recipe's steps.
        evaluate_every: steps between validations (and rollouts, if `rollouts` episodes of each task are wanted).
        half: save the weights in half precision.
        until: stop after so many steps, as if interrupted there.
        tasks: folder with the user's own task files, for rollouts.
        init: checkpoint folder whose weights, and what it normalises by, training begins with; None: fresh weights.
    """

    out: Path
    seed: int = 0
    threads: int = 0
    minutes: float | None = None
    resume: bool = False
    evaluate_every: int = 1000
    rollouts: int = 0
    save_every: int = 500
    half: bool = False
    until: int | None = None
    tasks: Path | None = None
    init: Path | None = None


def train(spec: PolicySpec, recipe: Recipe, folders: Sequence[Path], options: Options) -> dict[str, Any]:
    """Train `spec` on the demonstrations in `folders`; returns what `training.json` holds.

    Args:
        folders: datasets, or folders of datasets.

    Raises:
        DataError: a dataset or an earlier state does not fit.
        UsageError: `out` is in use and `resume` was not asked for.
        CheckpointError: `init` is no checkpoint, or one of another model.
    """
    began = time.time()
    if not options.resume and options.out.exists() and any(options.out.iterdir()):
        raise UsageError(f"{options.out} is not empty: continue it with --resume, or give another --out")
    torch.set_num_threads(options.threads or os.cpu_count() or 1)
    cv2.setNumThreads(0)  # images are small: threads would only get in the way of torch's
    keep_memory()
    torch.backends.cuda.enable_flash_sdp(torch.cuda.is_available())  # on a CPU its backward pass takes twice as long as plain matrix products
    device = "cuda" if torch.cuda.is_available() else "cpu"
    initial = Initial(options.init) if options.init is not None else None
    data = load_datasets(folders, spec, recipe)
    splits = [_split(one, recipe) for one in data]
    frames = [frames_of(one, training) for one, (training, _) in zip(data, splits, strict=True)]
    held_frames = [frames_of(one, held) for one, (_, held) in zip(data, splits, strict=True)]
    statistics = {**statistics_of(data, frames), **(initial.statistics if initial is not None else {})}
    torch.manual_seed(options.seed)
    model = make_model(spec, recipe, data, statistics, device)
    wanted = model.wanted(recipe.optimisation.grounding_pairs)
    weights = [recipe.weights.get(one.name, 1.0) for one in data]
    batches = Batches(data, frames, statistics, wanted, recipe.augmentation, options.seed, weights)
    held_batches = Batches(data, held_frames, statistics, wanted, recipe.augmentation, options.seed)
    (prepare, _), (prepare_held, finish) = model.preparing(), model.preparing()
    size = recipe.optimisation.batch_size
    trainee = model.trainee()
    if initial is not None:
        initial.fill(trainee, recipe.type)
    identity = json.dumps(
        [recipe.to_dict(), [one.fingerprint for one in data], options.seed, list(spec.cameras), initial and initial.digest], sort_keys=True
    )
    trainer = Trainer(
        trainee,
        lambda step: prepare(batches.training(step, size)),
        recipe.optimisation,
        device,
        options.out,
        sha256(identity.encode()).hexdigest(),
        options.seed,
    )
    resumed = options.resume and trainer.resume()
    if not resumed and options.minutes is not None:
        trainer.steps = trainer.steps_in(options.minutes)
    parameters = sum(parameter.numel() for parameter in trainee.parameters())
    print(
        f"{spec.name}: {recipe.type}, {parameters / 1e6:.2f}M parameters, {len(data)} dataset(s) with {sum(map(len, frames))} frames to train on, "
        f"{trainer.steps} steps of {size} on {device}" + (f", continued at {trainer.progress.step}" if resumed else ""),
        file=sys.stderr,
    )
    validations: list[dict[str, Any]] = []
    average = copy.deepcopy(trainee)

    def record(step: int) -> dict[str, Any]:
        return {
            "policy": spec.name,
            "command": " ".join(["python -m osel_sim.train", *sys.argv[1:]]),
            "seed": options.seed,
            "recipe": recipe.to_dict(),
            "init": {"name": initial.folder.name, "sha256": initial.digest} if initial is not None else None,
            "datasets": [
                {"task": one.name, "fingerprint": one.fingerprint, "episodes": one.episodes, "trained_on": len(training), "frames": len(own)}
                for one, (training, _), own in zip(data, splits, frames, strict=True)
            ],
            "parameters": parameters,
            "steps": step,
            "steps_planned": trainer.steps,
            "training_seconds": round(trainer.progress.seconds, 1),
            "wall_seconds": round(time.time() - began, 1),
            "threads": torch.get_num_threads(),
            "device": device,
            "precision": "bfloat16" if computes_bfloat16(device) else "float32",
            "losses": trainer.progress.losses,
            "validation": validations,
        }

    def evaluate(step: int) -> None:
        average.load_state_dict(trainer.average)
        spread = statistics[OBS_STATE]["std"][:3]
        by_task: dict[str, dict[str, float]] = {one.name: {} for one in data}
        for index, (one, held) in enumerate(zip(data, held_frames, strict=True)):
            if len(held):
                roles = list(one.annotations.roles) if one.annotations is not None else []
                by_task[one.name] |= validate(average, held_batches, index, len(held), roles, prepare_held, finish, spread, spec.execute)
        model.save(average, options.out, half=options.half)
        if options.rollouts:
            from osel_sim.training.rollouts import success_rate

            for one in data:
                task = _task(one)
                by_task[one.name]["success_rate"] = success_rate(spec, options.out, task, options.rollouts, options.seed, options.tasks)
        for task, result in by_task.items():
            print(f"{task}: " + "  ".join(f"{name} {value:.4g}" for name, value in result.items()), file=sys.stderr)
        validations.append({"step": step, **(next(iter(by_task.values())) if len(data) == 1 else {"tasks": by_task, **_means(by_task)})})
        write_json(options.out / "training.json", record(step))

    trainer.run({options.evaluate_every: evaluate}, save_every=options.save_every, label=spec.name, until=options.until)
    return record(trainer.progress.step)


def load_datasets(folders: Sequence[Path], spec: PolicySpec, recipe: Recipe) -> list[Demonstrations]:
    """The datasets of the recipe's tasks among those given.

    Raises:
        DataError: one cannot be read, two are of one task, one that the recipe wants is missing, or only some are annotated.
        UnknownNameError: the recipe weighs a task that there is not.
    """
    found = {task_of(folder) or folder.resolve().name: folder for folder in dataset_folders(folders)}
    if len(found) < len(dataset_folders(folders)):
        raise DataError(f"{', '.join(map(str, folders))}: two datasets are of one task; there can be one of each of {', '.join(found)}")
    for task in recipe.weights:  # of a task that is not trained on: no matter, but a wrong name is one
        if task not in found and task not in content.files("tasks"):
            raise UnknownNameError("task", task, {**found, **content.files("tasks")}, f"data.weights of {recipe.file}")
    for task in recipe.tasks or ():
        if task not in found:
            raise DataError(f"{recipe.file}: wants demonstrations of {task!r}, there are those of: {', '.join(sorted(found))}")
    data = [load_demonstrations(folder, spec.cameras) for task, folder in found.items() if recipe.tasks is None or task in recipe.tasks]
    labelled = {one.name: one.annotations is not None for one in data}
    located = {one.name: one.annotations is not None and all(one.annotations.sees(camera) for camera in spec.cameras) for one in data}
    for known, what in ((labelled, "annotations"), (located, "known places in the images")):
        lacking = [task for task, has in known.items() if not has]
        if 0 < len(lacking) < len(data):
            raise DataError(f"{', '.join(lacking)}: no {what}, which the other datasets have; collect them anew, or train without the others")
    return data


def _means(by_task: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean over the tasks of what all of them have."""
    results = list(by_task.values())
    return {key: sum(result[key] for result in results) / len(results) for key in results[0] if all(key in result for result in results)}


def _split(data: Demonstrations, recipe: Recipe) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Training episodes (the first ones, as many as the recipe wants) and validation episodes (the last ones)."""
    held = min(recipe.validation_episodes, data.episodes // 5)
    available = data.episodes - held
    wanted = recipe.episodes if recipe.episodes is not None else available
    if wanted > available:
        print(f"{data.folder}: {wanted} training episodes wanted, {available} there", file=sys.stderr)
    if available < 1:
        raise DataError(f"{data.folder}: no episodes to train on")
    return np.arange(min(wanted, available)), np.arange(available, data.episodes)


def _task(data: Demonstrations) -> str:
    """The task the demonstrations are of, as the side file says."""
    task = task_of(data.folder)
    if task is None:
        raise DataError(f"{data.folder}: does not say which task the demonstrations are of, so there are no rollouts (--eval-episodes 0)")
    return task


__all__ = ["Options", "load_datasets", "train"]
