"""The mapping file of a LeRobotDataset (`--map`): which of its columns are ours, and what its numbers mean."""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated

from pydantic.dataclasses import dataclass

from osel_sim.formats.conventions import FLIPS, GRIPPERS, STATE_FRAMES, Conventions
from osel_sim.formats.toml_file import load_toml
from osel_sim.formats.toml_types import TABLE, Number, OneOf, Text, Version, between

IMAGES = "observation.images."
STATE, ACTION = "observation.state", "action"
Columns = tuple[Annotated[int, between(0, 999)], ...]


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DatasetMapping:
    """What a dataset's own names and conventions are. Every key may be left out: it then is as this package has it."""

    version: Version = 1
    """Of the format."""
    images: Mapping[str, Text] = field(default_factory=dict)
    """Camera of the policy files -> column of the dataset."""
    flip: Mapping[str, Annotated[str, OneOf(FLIPS)]] = field(default_factory=dict)
    """Camera of the policy files -> how the dataset's images are turned over: LIBERO's are mirrored (`horizontal`)."""
    state: Text = STATE
    """Column of the state."""
    state_columns: Columns = ()
    """Which of its numbers are gripper position, axis-angle and both fingers, in that order, counted from 0; empty: it has just those."""
    state_frame: Annotated[str, OneOf(STATE_FRAMES)] = "grip"
    """Whose orientation the state has: the grip site's, or the hand's as in robosuite and LIBERO."""
    action: Text = ACTION
    """Column of the actions."""
    columns: Columns = ()
    """Which of an action's numbers are the six motions and the gripper, counted from 0; empty: it has just those."""
    scale: tuple[Number, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """What the motions are multiplied by: 20 for metres and 2 for radians a step, as 1 is 5 cm and 0.5 rad here."""
    gripper: Annotated[str, OneOf(GRIPPERS)] = "closed_positive"
    """What the gripper's number means: 1 closed and -1 open, 1 open and -1 closed, 1 closed and 0 open, 1 open and 0 closed."""

    def camera(self, camera: str) -> str:
        """The column of a camera's images."""
        return self.images.get(camera, IMAGES + camera)

    @property
    def actions(self) -> Conventions:
        """What its actions mean, in the words of a policy file."""
        return Conventions(columns=self.columns, scale=self.scale, gripper=self.gripper)


def load_dataset_mapping(file: Path | None) -> DatasetMapping:
    """Read and check a mapping file; None: the dataset has our names and conventions.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    return DatasetMapping() if file is None else load_toml(DatasetMapping, file)
