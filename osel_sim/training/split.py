"""Which datasets and which of their episodes a policy is trained on, and which are held out."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from osel_sim.core import content
from osel_sim.core.errors import DataError, UnknownNameError
from osel_sim.formats.dataset_mapping import load_dataset_mapping
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.ingestion.lerobot_numbers import check_mapping
from osel_sim.training.batches import frames_of
from osel_sim.training.dataset import Demonstrations, dataset_folders, load_demonstrations, task_of
from osel_sim.training.recipe import Recipe


@dataclass(frozen=True)
class Part:
    """One dataset.

    Attributes:
        episodes: how many are trained on.
        frames, held: numbers of the frames to train on, and of those to validate on.
    """

    data: Demonstrations
    episodes: int
    frames: NDArray[np.int64]
    held: NDArray[np.int64]


def split(data: Demonstrations, recipe: Recipe) -> Part:
    """The first episodes, as many as the recipe wants, to train on; the last ones to validate on.

    Raises:
        DataError: there are no episodes to train on.
    """
    held = min(recipe.validation_episodes, data.episodes // 5)
    available = data.episodes - held
    wanted = recipe.episodes if recipe.episodes is not None else available
    if wanted > available:
        print(f"{data.folder}: {wanted} training episodes wanted, {available} there", file=sys.stderr)
    if available < 1:
        raise DataError(f"{data.folder}: no episodes to train on")
    training = np.arange(min(wanted, available))
    return Part(data, len(training), frames_of(data, training), frames_of(data, np.arange(available, data.episodes)))


def load_datasets(folders: Sequence[Path], spec: PolicySpec, recipe: Recipe, mapping: Path | None = None) -> list[Demonstrations]:
    """The datasets of the recipe's tasks among those given.

    Args:
        mapping: file of the datasets' own names and conventions.

    Raises:
        ContentError: the mapping file is wrong.
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
    wanted = [folder for task, folder in found.items() if recipe.tasks is None or task in recipe.tasks]
    conventions = load_dataset_mapping(mapping)
    check_mapping(conventions, mapping, spec.cameras)
    data = [load_demonstrations(folder, spec.cameras, mapping=conventions) for folder in wanted]
    for kind in ("state", "action"):
        widths = {one.name: getattr(one, kind).shape[1] for one in data}
        if len(set(widths.values())) > 1:
            raise DataError(f"the demonstrations of {', '.join(widths)} have different numbers of {kind}: {widths}; one policy cannot learn both")
    labelled = {one.name: one.annotations is not None for one in data}
    located = {one.name: one.annotations is not None and all(one.annotations.sees(camera) for camera in spec.cameras) for one in data}
    for known, what in ((labelled, "annotations"), (located, "known places in the images")):
        lacking = [task for task, has in known.items() if not has]
        if 0 < len(lacking) < len(data):
            raise DataError(f"{', '.join(lacking)}: no {what}, which the other datasets have; collect them anew, or train without the others")
    return data
