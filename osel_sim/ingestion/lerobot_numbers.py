"""States and actions of a LeRobotDataset in our own conventions, with a warning where they cannot be meant as they are."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import ContentError, DataError
from osel_sim.formats.dataset_mapping import DatasetMapping
from osel_sim.ingestion.lerobot_files import DatasetFiles
from osel_sim.interface.specification import ACTION, ACTION_DIM, STATE, STATE_DIM
from osel_sim.policy.mapping import actions_of, grip_orientation

logger = logging.getLogger(__name__)

SLACK = 1.001
"""Actions up to this are taken for rounding."""


def check_mapping(mapping: DatasetMapping, file: Path | None, cameras: tuple[str, ...]) -> None:
    """Whether a mapping file fits the policies' cameras and our actions and states.

    Raises:
        ContentError: it does not.
    """
    where = file or "mapping"
    for table in ("images", "flip"):
        for camera in getattr(mapping, table):
            if camera not in cameras:
                raise ContentError(where, f"{table}.{camera}", f"no policy has that camera; cameras: {', '.join(cameras)}")
    for key, given, wanted, names in (
        ("state_columns", mapping.state_columns, STATE_DIM, ", ".join(f"{part} {size}" for part, size in STATE.items())),
        ("columns", mapping.columns, ACTION_DIM, ", ".join(ACTION.names)),
        ("scale", mapping.scale, len(ACTION.motions), ", ".join(ACTION.names[index] for index in ACTION.motions)),
    ):
        if given and len(given) != wanted:
            raise ContentError(where, key, f"must have {wanted} numbers ({names}), got {len(given)}: {list(given)}")


def states(files: DatasetFiles, mapping: DatasetMapping) -> NDArray[np.float32]:
    """The state of each frame, (frames, STATE_DIM).

    Raises:
        DataError: the column is missing, of another shape, or has numbers that are none.
    """
    values = files.numbers(mapping.state)
    chosen = _chosen(files, values, mapping.state, mapping.state_columns, STATE_DIM, "state_columns")
    if mapping.state_frame == "hand":
        turn = slice(STATE["position"], STATE["position"] + STATE["axis_angle"])
        chosen = chosen.copy()
        chosen[:, turn] = grip_orientation(chosen[:, turn])
    return chosen.astype(np.float32)


def actions(files: DatasetFiles, mapping: DatasetMapping) -> NDArray[np.float32]:
    """The action of each frame, (frames, ACTION_DIM), not clipped.

    Raises:
        DataError: the column is missing, of another shape, or has numbers that are none.
    """
    values = files.numbers(mapping.action)
    _chosen(files, values, mapping.action, mapping.columns, ACTION_DIM, "columns")
    result: NDArray[np.float32] = actions_of(values, mapping.actions, ACTION).astype(np.float32)
    _warn(files, mapping, result)
    return result


def _chosen(files: DatasetFiles, values: NDArray[np.float64], name: str, columns: tuple[int, ...], size: int, key: str) -> NDArray[np.float64]:
    width = values.shape[1]
    if columns and max(columns) >= width:
        raise DataError(f"{files.folder}: {name!r} has {width} numbers, counted from 0, and {key} of the mapping file asks for number {max(columns)}")
    if not columns and width != size:
        raise DataError(
            f"{files.folder}: {name!r} must have the shape ({size},) that the policies know, got ({width},); "
            f"a mapping file (--map) says with {key} which of its numbers those are"
        )
    return values[:, list(columns)] if columns else values


def _warn(files: DatasetFiles, mapping: DatasetMapping, values: NDArray[np.float32]) -> None:
    beyond = (np.abs(values) > SLACK).any(axis=1)
    if beyond.any():
        frame, number = (int(index) for index in np.unravel_index(np.abs(values).argmax(), values.shape))
        logger.warning(
            f"{files.where(frame, mapping.action)}: {ACTION.names[number]} is {values[frame, number]:.4g}, and {beyond.mean():.0%} of the "
            "frames have actions beyond [-1, 1], which no policy here answers; in other units or order? a mapping file (--map) says so"
        )
    gripper = values[:, ACTION.gripper_index or -1]
    if gripper.min() >= 0.0 and gripper.min() < 0.5 < gripper.max():
        logger.warning(
            f"{files.folder}: the gripper's number in {mapping.action!r} is never below 0; if it does not run from -1 (open) to 1 (closed), "
            'say gripper = "closed_one" or "open_one" in a mapping file (--map)'
        )
