"""Pictures of a task's instances with what is where on them: what the embedded encoder learns from and is measured on."""

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.arrays import read_arrays
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic
from osel_sim.core.progress import progress
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.specification import CONTEXT_CAMERA as CAMERA


@dataclass(frozen=True)
class Scenes:
    """N instances of one task, S pixels wide and high, with E entities in all (objects first, as in the task file).

    Attributes:
        images: uint8 (N, S, S, 3).
        pixels: float32 (N, E, 2), x and y of each entity's middle as fractions of the image, NaN where it is not in the scene.
        positions: float32 (N, E, 2), the same in metres on the table.
        instructions, phrasings, targets, containers: str (N,), as in `Instance`.
        seeds: int64 (N,).
    """

    images: NDArray[np.uint8]
    pixels: NDArray[np.float32]
    positions: NDArray[np.float32]
    instructions: NDArray[np.str_]
    phrasings: NDArray[np.str_]
    targets: NDArray[np.str_]
    containers: NDArray[np.str_]
    seeds: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.images)

    def save(self, file: Path) -> None:
        """Write them, at once or not at all."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic(file) as partial, partial.open("wb") as handle:
            np.savez(handle, allow_pickle=False, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, file: Path) -> "Scenes":
        """Read a file that `save` wrote.

        Raises:
            DataError: it is something else.
        """
        try:
            arrays = read_arrays(file, "scenes")
            return cls(**{field.name: arrays[field.name] for field in fields(cls)})
        except DataError as error:
            raise DataError(f"{error}; remove it to render them again") from None
        except KeyError as error:
            raise DataError(f"{file}: not a file of scenes ({error}); remove it to render them again") from None


def render_instances(task: TaskSpec, seeds: Iterable[int], split: str, size: int, levels: Sequence[int] = (0,)) -> Scenes:
    """Load each instance into the simulator and take its picture; seeds go through `levels` in turn."""
    from osel_sim.sim.env import TaskEnv
    from osel_sim.sim.instance import make_instance

    order = {entity.name: index for index, entity in enumerate(task.entities)}
    rows: dict[str, list[Any]] = {field.name: [] for field in fields(Scenes)}
    wanted = list(seeds)
    with closing(TaskEnv(task)) as env, progress(len(wanted), "scene", f"rendering {split} scenes") as bar:
        for seed in wanted:
            instance = make_instance(task, seed, levels[seed % len(levels)], split)
            env.load(instance)
            pixels, positions = (np.full((len(order), 2), np.nan, np.float32) for _ in range(2))
            for name, place in env.entity_positions().items():
                pixels[order[name]] = env.project(place[None], CAMERA, size)[0] / size
                positions[order[name]] = place[:2]
            rows["images"].append(env.observe((CAMERA,), size)[f"observation.images.{CAMERA}"])
            rows["pixels"].append(pixels)
            rows["positions"].append(positions)
            rows["instructions"].append(instance.instruction)
            rows["phrasings"].append(instance.phrasing)
            rows["targets"].append(instance.target)
            rows["containers"].append(instance.container)
            rows["seeds"].append(seed)
            bar.update()
    return Scenes(**{name: np.array(values) for name, values in rows.items()})


def cached_scenes(folder: Path, task: TaskSpec, count: int, split: str, size: int, levels: Sequence[int] = (0,)) -> Scenes:
    """The first `count` instances of a split, from `folder` or rendered and kept there."""
    turned_up = "" if tuple(levels) == (0,) else "_level" + "".join(map(str, levels))
    file = folder / f"scenes_{task.name}_{split}_{count}_{size}px{turned_up}.npz"
    if not file.is_file():
        render_instances(task, range(count), split, size, levels).save(file)
    return Scenes.load(file)
