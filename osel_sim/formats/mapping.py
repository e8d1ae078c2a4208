"""The `[mapping]` table of a policy file: what a policy trained elsewhere calls its inputs, and what its numbers mean."""

from collections.abc import Mapping as AnyMapping
from dataclasses import dataclass, field

from osel_sim.formats.validate import Table

STATE_PARTS = {"position": 3, "axis_angle": 3, "quaternion": 4, "euler": 3, "fingers": 2, "gripper": 1}
"""What the state of one of our robots can be put together from, and how many numbers each has: gripper position (metres, world); its orientation as
axis-angle, quaternion (x, y, z, w) or roll-pitch-yaw (radians); both finger positions (metres), or how far the gripper is open (0 to 1)."""
GRIPPERS = ("closed_positive", "open_positive", "closed_one", "open_one")
"""What the gripper's number means: 1 closed and -1 open (as robosuite and LIBERO have it), 1 open and -1 closed, 1 closed and 0 open, 1 open and 0
closed."""
ENVIRONMENT_STATES = ("hashed_text",)


@dataclass(frozen=True)
class Mapping:
    """What a policy file says about a policy's own conventions.

    Attributes:
        images: camera here -> key there.
        blank: keys of further images that the policy wants and nothing here shows: they are black.
        state: key of the state; empty: it gets none. state_parts: what it is put together from, in
            order; empty: the environment's own parts.
        prompt: key of the instruction.
        actions: key of the answer's actions (openpi only). columns: which of an action's numbers are the motions and the
            gripper; empty: it has just those.
        gripper: what the gripper's number means.
        scale: what the motions are multiplied by: 20 for metres and 2 for radians a step, as 1 is 5 cm and 0.5 rad here.
        environment_state: what `observation.environment_state` is filled with: `hashed_text`, or empty where the policy has none.
        normalised: false if the checkpoint is known to come without the statistics it was trained with.
    """

    images: AnyMapping[str, str] = field(default_factory=dict)
    blank: tuple[str, ...] = ()
    state: str = "observation.state"
    state_parts: tuple[str, ...] = ()
    prompt: str = "task"
    actions: str = "actions"
    columns: tuple[int, ...] = ()
    gripper: str = "closed_positive"
    scale: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    environment_state: str = ""
    normalised: bool = True

    def key(self, camera: str) -> str:
        """What the policy calls a camera's image."""
        return self.images.get(camera, f"observation.images.{camera}")


def read_mapping(table: Table, cameras: tuple[str, ...]) -> Mapping:
    """Check a `[mapping]` table.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    plain = Mapping()
    names = table.table("images", {})
    images: dict[str, str] = {}
    for camera in names.data:
        names.one_of(camera, camera, cameras)
        images[camera] = names.get(camera, str)
    parts = table.strings("state_parts", list(plain.state_parts))
    columns = table.get("columns", list, list(plain.columns))
    if ("columns" in table.data and not columns) or not all(type(column) is int and 0 <= column < 1000 for column in columns):
        raise table.error("columns", f"must be column numbers of an action, counted from 0, got {columns!r}")
    result = Mapping(
        images=images,
        blank=table.strings("blank", []),
        state=table.get("state", str, plain.state),
        state_parts=parts,
        prompt=table.get("prompt", str, plain.prompt),
        actions=table.get("actions", str, plain.actions),
        columns=tuple(columns),
        gripper=table.choice("gripper", GRIPPERS, plain.gripper),
        scale=table.numbers("scale", len(table.get("scale", list))) if "scale" in table.data else plain.scale,
        environment_state=table.choice("environment_state", ENVIRONMENT_STATES) if "environment_state" in table.data else "",
        normalised=table.get("normalised", bool, True),
    )
    keys = [*(result.key(camera) for camera in cameras), *result.blank, result.prompt, *([result.state] if result.state else [])]
    for key in keys:
        if keys.count(key) > 1:
            raise table.error("images", f"two inputs have the name {key!r}")
    table.get("scale", list, [])
    table.get("environment_state", str, "")
    table.done()
    return result
