"""Trains one policy by its recipe, on one or several datasets, and writes a LeRobot checkpoint folder."""

import copy
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import torch
from lerobot.utils.constants import OBS_STATE
from torch import nn

from osel_sim.core.errors import DataError, DivergedError, UsageError
from osel_sim.core.files import finite, write_json
from osel_sim.core.shown import shown
from osel_sim.core.torch_settings import computes_bfloat16
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.training.batches import Batches, statistics_of
from osel_sim.training.dataset import Demonstrations, task_of
from osel_sim.training.evaluation import HeldOut, validate
from osel_sim.training.initial import Initial
from osel_sim.training.loop import Problem, Trainer, warm_up_then_cosine
from osel_sim.training.memory import keep_memory
from osel_sim.training.models import make_model
from osel_sim.training.recipe import Optimisation, Recipe
from osel_sim.training.split import load_datasets, split


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
        mapping: file of the datasets' own names and conventions; None: they have ours.
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
    mapping: Path | None = None


def train(spec: PolicySpec, recipe: Recipe, folders: Sequence[Path], options: Options) -> dict[str, Any]:
    """Train `spec` on the demonstrations in `folders`; returns what `training.json` holds.

    Args:
        folders: datasets, or folders of datasets.

    Raises:
        DataError: a dataset does not fit, or an earlier state is damaged.
        UsageError: `out` is in use and `resume` was not asked for.
        CheckpointError: `init` is no checkpoint, or one of another model; or an earlier state is of other data, another seed or recipe.
        DivergedError: the loss is no finite number any more; `out` keeps the last good weights.
    """
    if not options.resume and options.out.exists() and any(options.out.iterdir()):
        raise UsageError(f"{options.out} is not empty: continue it with --resume, or give another --out")
    torch.set_num_threads(options.threads or os.cpu_count() or 1)
    cv2.setNumThreads(0)  # images are small: threads would only get in the way of torch's
    keep_memory()
    torch.backends.cuda.enable_flash_sdp(torch.cuda.is_available())  # on a CPU its backward pass takes twice as long as plain matrix products
    return PolicyTraining(spec, recipe, folders, options).run()


class PolicyTraining:
    """The training of one policy: see `train`."""

    def __init__(self, spec: PolicySpec, recipe: Recipe, folders: Sequence[Path], options: Options) -> None:
        self._began = time.time()
        self._spec, self._recipe, self._options = spec, recipe, options
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._initial = Initial(options.init) if options.init is not None else None
        data = load_datasets(folders, spec, recipe, options.mapping)
        self._parts = [split(one, recipe) for one in data]
        frames = [part.frames for part in self._parts]
        statistics = {**statistics_of(data, frames), **(self._initial.statistics if self._initial is not None else {})}
        torch.manual_seed(options.seed)
        self._model = make_model(spec, recipe, data, statistics, self._device)
        wanted = self._model.wanted(recipe.optimisation.grounding_pairs)
        weights = [recipe.weights.get(one.name, 1.0) for one in data]
        batches = Batches(data, frames, statistics, wanted, recipe.augmentation, options.seed, weights)
        held = Batches(data, [part.held for part in self._parts], statistics, wanted, recipe.augmentation, options.seed)
        prepare, _ = self._model.preparing()
        self._held = HeldOut(held, *self._model.preparing(), statistics[OBS_STATE]["std"][:3], spec.execute)
        trainee = self._model.trainee()
        if self._initial is not None:
            self._initial.fill(trainee, recipe.type)
        self._parameters = sum(parameter.numel() for parameter in trainee.parameters())
        self._average = copy.deepcopy(trainee)
        self._validations: list[dict[str, Any]] = []
        size, settings = recipe.optimisation.batch_size, recipe.optimisation
        problem = Problem(
            module=trainee,
            batch_of=lambda step: prepare(batches.training(step, size)),
            loss_of=lambda batch: trainee({name: value.to(self._device, non_blocking=True) for name, value in batch.items()}),
            optimiser=_optimiser(trainee, settings),
            rate=warm_up_then_cosine(settings.warmup_steps),
            clipped=tuple(trainee.parameters()),
            clip=settings.gradient_clip,
            ema_decay=settings.ema_decay,
            seed=options.seed,
        )
        self._trainer = Trainer(problem, settings.steps, self._device, options.out, self._identity())

    def run(self) -> dict[str, Any]:
        """Train, validate and save; returns what `training.json` holds."""
        options, trainer = self._options, self._trainer
        resumed = options.resume and trainer.resume()
        if not resumed and options.minutes is not None:
            trainer.steps = trainer.steps_in(options.minutes)
        frames = sum(len(part.frames) for part in self._parts)
        print(
            f"{self._spec.name}: {self._recipe.type}, {self._parameters / 1e6:.2f}M parameters, {len(self._parts)} dataset(s) with {frames} frames "
            f"to train on, {trainer.steps} steps of {self._recipe.optimisation.batch_size} on {self._device}"
            + (f", continued at {trainer.progress.step}" if resumed else ""),
            file=sys.stderr,
        )
        try:
            trainer.run({options.evaluate_every: self._evaluate}, save_every=options.save_every, label=self._spec.name, until=options.until)
        except DivergedError:
            if trainer.progress.step:
                self._save_average()
            raise
        return self._record(trainer.progress.step)

    def _identity(self) -> dict[str, Any]:
        """What must be the same to continue."""
        return {
            "recipe": self._recipe.to_dict(),
            "data": [part.data.fingerprint for part in self._parts],
            "seed": self._options.seed,
            "cameras": list(self._spec.cameras),
            "init": self._initial.digest if self._initial is not None else None,
        }

    def _evaluate(self, step: int) -> None:
        """Save the averaged weights as a checkpoint, with their errors on held-out episodes and the success of rollouts."""
        options, data = self._options, [part.data for part in self._parts]
        self._save_average()
        by_task: dict[str, dict[str, float]] = {one.name: {} for one in data}
        for index, part in enumerate(self._parts):
            if len(part.held):
                roles = list(part.data.annotations.roles) if part.data.annotations is not None else []
                by_task[part.data.name] |= validate(self._average, self._held, index, len(part.held), roles)
        if options.rollouts:
            from osel_sim.training.rollouts import success_rate

            for one in data:
                task = _task(one)
                by_task[one.name]["success_rate"] = success_rate(self._spec, options.out, task, options.rollouts, options.seed, options.tasks)
        for task, result in by_task.items():
            print(f"{shown(task)}: " + "  ".join(f"{name} {value:.4g}" for name, value in result.items()), file=sys.stderr)
        self._validations.append({"step": step, **(next(iter(by_task.values())) if len(data) == 1 else {"tasks": by_task, **_means(by_task)})})
        write_json(options.out / "training.json", finite(self._record(step)))

    def _save_average(self) -> None:
        """Write the averaged weights as a checkpoint."""
        self._average.load_state_dict(self._trainer.average)
        self._model.save(self._average, self._options.out, half=self._options.half)

    def _record(self, step: int) -> dict[str, Any]:
        """What `training.json` holds after so many steps."""
        initial, progress = self._initial, self._trainer.progress
        return {
            "policy": self._spec.name,
            "command": " ".join(["python -m osel_sim.train", *sys.argv[1:]]),
            "seed": self._options.seed,
            "recipe": self._recipe.to_dict(),
            "init": {"name": initial.folder.name, "sha256": initial.digest} if initial is not None else None,
            "datasets": [
                {
                    "task": part.data.name,
                    "fingerprint": part.data.fingerprint,
                    "episodes": part.data.episodes,
                    "trained_on": part.episodes,
                    "frames": len(part.frames),
                }
                for part in self._parts
            ],
            "parameters": self._parameters,
            "steps": step,
            "steps_planned": self._trainer.steps,
            "training_seconds": round(progress.seconds, 1),
            "wall_seconds": round(time.time() - self._began, 1),
            "threads": torch.get_num_threads(),
            "device": self._device,
            "precision": "bfloat16" if computes_bfloat16(self._device) else "float32",
            "losses": progress.losses,
            "validation": self._validations,
        }


def _optimiser(trainee: nn.Module, settings: Optimisation) -> torch.optim.Optimizer:
    """AdamW, without weight decay for biases and scales."""
    decayed = [parameter for parameter in trainee.parameters() if parameter.ndim > 1]
    others = [parameter for parameter in trainee.parameters() if parameter.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)


def _means(by_task: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean over the tasks of what all of them have."""
    results = list(by_task.values())
    return {key: sum(result[key] for result in results) / len(results) for key in results[0] if all(key in result for result in results)}


def _task(data: Demonstrations) -> str:
    """The task the demonstrations are of, as the side file says."""
    task = task_of(data.folder)
    if task is None:
        raise DataError(f"{data.folder}: does not say which task the demonstrations are of, so there are no rollouts (--eval-episodes 0)")
    return task
