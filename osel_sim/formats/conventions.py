"""The `[mapping]` table of a policy file: what a policy trained elsewhere calls its inputs, and what its numbers mean."""

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo
from pydantic.dataclasses import dataclass

from osel_sim.formats.toml_types import TABLE, Faults, Number, OneOf, Switch, Texts, between, quoted, unknown_value

STATE_PARTS = {"position": 3, "axis_angle": 3, "quaternion": 4, "euler": 3, "fingers": 2, "gripper": 1}
"""What the state of one of our robots can be put together from, and how many numbers each has: gripper position (metres, world); its orientation as
axis-angle, quaternion (x, y, z, w) or roll-pitch-yaw (radians); both finger positions (metres), or how far the gripper is open (0 to 1)."""
GRIPPERS = ("closed_positive", "open_positive", "closed_one", "open_one")
"""What the gripper's number means: 1 closed and -1 open (as robosuite and LIBERO have it), 1 open and -1 closed, 1 closed and 0 open, 1 open and 0
closed."""
FLIPS = ("horizontal", "vertical", "both")
"""How an image is turned over: left and right change places, top and bottom do, or both (half a turn)."""
STATE_FRAMES = ("grip", "hand")
"""Whose orientation the state tells: the grip site's, between the fingers; or that of the hand's body, as robosuite's `robot0_eef_quat` and LIBERO
have it, a quarter of a turn about the approach axis from it."""
ENVIRONMENT_STATES = ("hashed_text",)


def _some(columns: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
    if info.context is not None and not columns:  # in a file: whoever writes the key wants to say something by it
        raise ValueError("must be column numbers of an action, counted from 0, got []")
    return columns


@dataclass(frozen=True, config=TABLE)
class Conventions:
    """What a policy file says about a policy's own names and conventions."""

    images: Mapping[str, str] = field(default_factory=dict)
    """Camera here -> key there."""
    blank: Texts = ()
    """Keys of further images that the policy wants and nothing here shows: they are black."""
    flip: Mapping[str, Annotated[str, OneOf(FLIPS)]] = field(default_factory=dict)
    """Camera here -> how its image is turned over: the policy learnt from mirrored (`horizontal`) or turned (`vertical`, `both`) images."""
    resize: Annotated[int, between(16, 1024)] | None = None
    """Pixels, square, to which images are brought from `image_size`, bilinearly as Pillow does; left out: they stay as they are."""
    state: str = "observation.state"
    """Key of the state; empty: it gets none."""
    state_parts: Texts = ()
    """What the state is put together from, in order; empty: the environment's own parts."""
    state_frame: Annotated[str, OneOf(STATE_FRAMES)] = "grip"
    """Whose orientation axis-angle, quaternion and Euler angles of the state are: the grip site's, or the hand's as in robosuite and LIBERO."""
    prompt: str = "task"
    """Key of the instruction."""
    actions: str = "actions"
    """Key of the answer's actions (openpi only)."""
    columns: Annotated[tuple[Annotated[int, between(0, 999)], ...], AfterValidator(_some)] = ()
    """Which of an action's numbers are the motions and the gripper, counted from 0; empty: it has just those."""
    gripper: Annotated[str, OneOf(GRIPPERS)] = "closed_positive"
    """What the gripper's number means: 1 closed and -1 open, 1 open and -1 closed, 1 closed and 0 open, 1 open and 0 closed."""
    scale: tuple[Number, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """What the motions are multiplied by: 20 for metres and 2 for radians a step, as 1 is 5 cm and 0.5 rad here."""
    environment_state: Annotated[str, OneOf(("", *ENVIRONMENT_STATES))] = ""
    """What `observation.environment_state` is filled with; empty where the policy has none."""
    normalised: Switch = True
    """False if the checkpoint is known to come without the statistics it was trained with."""

    def key(self, camera: str) -> str:
        """What the policy calls a camera's image."""
        return self.images.get(camera, f"observation.images.{camera}")

    def faults(self, cameras: tuple[str, ...]) -> Faults:
        """What does not fit the cameras of a policy: (keys within the table, problem)."""
        for table in ("images", "flip"):
            for camera in getattr(self, table):
                if camera not in cameras:
                    yield (table, camera), unknown_value(camera, cameras)
        keys = [*map(self.key, cameras), *self.blank, self.prompt, *([self.state] if self.state else [])]
        for key in dict.fromkeys(keys):
            if keys.count(key) > 1:
                yield ("images",), f"two inputs have the name {quoted(key)}"
