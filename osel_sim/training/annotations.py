"""Labels of demonstrations, for training only: where things are, which of them an instruction names, which one the expert is busy with.

They come from the dataset's `annotation.*` columns and its side file `meta/osel_sim.json`; datasets of different tasks have different things in them,
so labels are by the roles of a task's instructions.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.training.projection import Pinhole

SIDE_FILE = "osel_sim.json"
ATTRIBUTE = "attribute"
LEGACY_ROLES = {"object": "object", "container": "container"}
"""Roles of datasets whose side file names none."""
POSITIONS, PRESENT, TARGET, ACTIVE, PLACES = (
    "annotation.entity_positions",
    "annotation.entity_present",
    "annotation.target",
    "annotation.active",
    "annotation.places.",
)
ACTIONS = "annotation.actions"
"""The actions of all control steps from a frame to the next, where frames are fewer than steps."""


@dataclass(frozen=True)
class Nameable:
    """What an instruction can name: a thing of the scene, or a property that a rule goes by. Names: what instructions call it."""

    name: str
    kind: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Annotations:
    """Labels for training only, never shown to a policy.

    Attributes:
        entities: things, in the order of the columns below.
        attributes: properties; a target of len(entities) + i names the i-th of them.
        roles: role -> kind, in the order of `target`'s columns.
        phrasings: training phrasings, with `{role}` fields.
        positions: (frames, entities, 3), metres, world.
        present: (frames, entities), whether the entity is in the scene.
        target: (frames, roles), what fills each role; -1 where nothing does.
        active: (frames, 2), the thing that the expert is busy with and where it is to go; -1 where there is none.
        cameras: where the cameras are, those that the side file tells of.
        places: camera -> (frames, entities, 2), column and row in [-1, 1]; for datasets in which cameras move from episode to episode.
    """

    entities: tuple[Nameable, ...]
    attributes: tuple[Nameable, ...]
    roles: dict[str, str]
    phrasings: tuple[str, ...]
    positions: NDArray[np.float32]
    present: NDArray[np.bool_]
    target: NDArray[np.int64]
    active: NDArray[np.int64]
    cameras: dict[str, Pinhole]
    places: dict[str, NDArray[np.float32]]

    @property
    def nameable(self) -> tuple[Nameable, ...]:
        """Things, then properties."""
        return self.entities + self.attributes

    def positions_of(self, frames: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.float32]:
        """World positions (frames, ..., 3) of the entities of these indices (frames, ...); NaN where an index is none of an entity."""
        return self._pick(self.positions, frames, wanted)

    def places_of(self, camera: str, frames: NDArray[np.int64], wanted: NDArray[np.int64], state: NDArray[np.float32]) -> NDArray[np.float32]:
        """Column and row (frames, ..., 2) in [-1, 1] of these entities in a camera's image; NaN where out of view.

        Args:
            state: (frames, 8), of these frames.
        """
        if camera in self.places:
            places = self._pick(self.places[camera], frames, wanted)
            places[~(np.abs(places) <= 1).all(axis=-1)] = np.nan
            return places
        points = self.positions_of(frames, wanted)
        return self.cameras[camera].places(points.reshape(len(frames), -1, 3), state).reshape(*wanted.shape, 2)

    def sees(self, camera: str) -> bool:
        """Whether it is known where things are in this camera's images."""
        return camera in self.places or camera in self.cameras

    def _pick(self, values: NDArray[np.float32], frames: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.float32]:
        known = (wanted >= 0) & (wanted < len(self.entities))
        rows = frames.reshape(-1, *(1,) * (wanted.ndim - 1))
        picked: NDArray[np.float32] = values[rows, np.where(known, wanted, 0)].copy()
        picked[~known] = np.nan
        return picked


def load_annotations(folder: Path, columns: dict[str, NDArray[Any]]) -> Annotations | None:
    """The labels of a dataset, or None where it has none.

    Raises:
        DataError: side file and columns contradict each other.
    """
    side = folder / "meta" / SIDE_FILE
    if not side.is_file() or any(name not in columns for name in (POSITIONS, PRESENT, TARGET)):
        return None
    try:
        data = read_json(side)
        entities = tuple(Nameable(str(item["name"]), str(item["role"]), tuple(map(str, item["names"]))) for item in data["entities"])
        attributes = tuple(Nameable(str(item["name"]), ATTRIBUTE, tuple(map(str, item["names"]))) for item in data.get("attributes", []))
        roles = {str(role): str(kind) for role, kind in data.get("roles", LEGACY_ROLES).items()}
        phrasings = tuple(str(text) for text in data["phrasings"]["train"])
        cameras = {name: Pinhole.from_dict(camera) for name, camera in data.get("cameras", {}).items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{side}: entities, attributes, roles, phrasings.train and cameras do not have the promised form ({error!r})") from None
    positions, present, target = (columns[name] for name in (POSITIONS, PRESENT, TARGET))
    widths = {POSITIONS: 3 * len(entities), PRESENT: len(entities), TARGET: len(roles), ACTIVE: 2}
    widths |= {name: 2 * len(entities) for name in columns if name.startswith(PLACES)}
    for name, width in widths.items():
        if name in columns and columns[name].shape[1] != width:
            raise DataError(f"{side}: {len(entities)} entities and {len(roles)} roles do not fit {name}, which is {columns[name].shape[1]} wide")
    moved = data.get("axes", {}).get("camera", max(data.get("levels", [0]), default=0))
    if moved and not any(name.startswith(PLACES) for name in columns):
        raise DataError(f"{side}: its cameras move from episode to episode (level {moved}), but it has no {PLACES}* columns; collect it anew")
    if not phrasings:
        raise DataError(f"{side}: phrasings.train is empty")
    target = target.astype(np.int64)
    if target.max(initial=-1) >= len(entities) + len(attributes):
        raise DataError(f"{side}: {TARGET} has the index {target.max()}, there are {len(entities)} entities and {len(attributes)} attributes")
    return Annotations(
        entities=entities,
        attributes=attributes,
        roles=roles,
        phrasings=phrasings,
        positions=positions.reshape(len(positions), -1, 3).astype(np.float32),
        present=present > 0.5,
        target=target,
        active=columns[ACTIVE].astype(np.int64) if ACTIVE in columns else _first_two(target, len(entities)),
        cameras=cameras,
        places={
            name.removeprefix(PLACES): columns[name].reshape(len(target), -1, 2).astype(np.float32) for name in columns if name.startswith(PLACES)
        },
    )


def _first_two(target: NDArray[np.int64], entities: int) -> NDArray[np.int64]:
    """Where the dataset does not say what the expert is busy with: the first two roles, properties left out."""
    padded = np.concatenate([target, np.full((len(target), 2), -1)], axis=1)[:, :2]
    return np.where(padded < entities, padded, -1)
