"""What a robot is: an arm of robosuite with its gripper, as everything in the simulation that depends on it needs to know."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

DEFAULT_ROBOT = "Panda"
"""The robot of a task that names none; it is not said in the keys of its instances."""

type Triple = tuple[float, float, float]
type Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class Gains:
    """Settings of robosuite's OSC_POSE controller: fixed impedance, deltas in the frame of the base, position and orientation uncoupled.

    Attributes:
        kp, damping_ratio: of the gripper's pose; 1 is critically damped.
        null_kp: of the joints towards the home pose, in the null space of the gripper's pose; critically damped.
        output_max: what an action of 1 means (6,): metres and radians a control step.
    """

    kp: float = 150.0
    damping_ratio: float = 1.0
    null_kp: float = 10.0
    output_max: tuple[float, ...] = (0.05, 0.05, 0.05, 0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Gripper:
    """A gripper with two fingers, which open along the x axis of its grip site.

    Attributes:
        model: its class in robosuite, `module:Class`.
        rest: its joints when it is open, in the model's order, radians or metres.
        closing: for each of its actuators 1 or -1: the way in which a positive command moves its control.
        tip: metres that the scripted expert keeps its closed fingers further off a button, for what they reach further down than the Panda's.
        prepare: changes robosuite's model of it (`robosuite.models.grippers.GripperModel`) before it is mounted.
        speed: how much a control step changes the command, which runs from -1 (open) to 1 (closed).
        left, right: colliding geoms of each finger.
        pads: the geoms between which things are held, boxes whose smallest side lies across; how far each is from the middle is the state of the
            fingers. Without any, the gripper's two joints are.
    """

    model: str
    rest: tuple[float, ...]
    closing: tuple[float, ...]
    left: tuple[str, ...]
    right: tuple[str, ...]
    pads: tuple[str, str] | None = None
    tip: float = 0.0
    prepare: Callable[[Any], None] | None = None
    speed: float = 0.2


@dataclass(frozen=True)
class WristCamera:
    """The camera that a robot carries.

    Attributes:
        name: in the model.
        position, quaternion: metres and (w, x, y, z), in the frame of the body that carries it; None: where robosuite has it.
    """

    name: str = "robot0_eye_in_hand"
    position: Triple | None = None
    quaternion: Quaternion | None = None


@dataclass(frozen=True)
class LightMeshes:
    """How visual meshes are decimated for quick images.

    Attributes:
        keep: fraction of the faces kept.
        fewest: meshes with no more faces than this stay as they are.
        most: meshes with more faces than this after decimation are welded more coarsely first: those made of thousands of loose pieces do not
            decimate.
        join: metres: corners this close become one where a mesh is in pieces; of several the first that is coarse enough for `most`. 6 cm are four
            pixels of the robot's pedestal.
    """

    keep: float = 0.04
    fewest: int = 250
    most: int = 600
    join: tuple[float, ...] = (0.01, 0.06)


@dataclass(frozen=True)
class Robot:
    """One arm with its gripper. Its joints and actuators are the first of the model, those of its gripper follow, as in every model of robosuite.

    Attributes:
        name: as `--robot` and task files call it; letters, digits, underscores.
        model: the arm's class in robosuite, `module:Class`.
        home: joints at the start of an episode (n,), radians; the null space pulls towards them.
        start_weights, start_lift: of the axis `robot`, which perturbs that start: how much of it each joint gets (n,), and metres a radian by which
            each lifts the hand there (n,).
        nearer: metres by which its base stands nearer to the table than robosuite puts it.
        grip_site, base_site: the pose that is controlled, and the frame in which actions are given.
        centred: metres by which a thing may be off the middle of the gripper when the scripted expert begins to close it.
        lowering: largest downward motion that the scripted expert asks of it while it puts something down, in units of action.
    """

    name: str
    model: str
    gripper: Gripper
    home: tuple[float, ...]
    start_weights: tuple[float, ...]
    start_lift: tuple[float, ...]
    nearer: float = 0.0
    gains: Gains = Gains()
    grip_site: str = "gripper0_right_grip_site"
    base_site: str = "robot0_right_center"
    wrist_camera: WristCamera = WristCamera()
    meshes: LightMeshes = LightMeshes()
    centred: float = math.inf
    lowering: float = math.inf

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w+", self.name):
            raise ValueError(f"name must be letters, digits and underscores, got {self.name!r}")
        for field in ("start_weights", "start_lift"):
            if len(getattr(self, field)) != self.joints:
                raise ValueError(f"{field} must have {self.joints} numbers, one a joint of home, got {len(getattr(self, field))}")
        if len(self.gains.output_max) != 6:
            raise ValueError(f"gains.output_max must have 6 numbers, got {len(self.gains.output_max)}")

    @property
    def joints(self) -> int:
        """How many joints the arm has."""
        return len(self.home)
