"""What a perturbed instance looks like: numbers, drawn from the seed alone, the same for every policy.

Every axis has a random stream of its own, fixed by task, split, seed, axis and the axis' level. So the scene beneath stays that of level 0, and an
axis alone does what it does within a level. The axes `start`, `distractors` and `phrasing` change what is drawn, in `osel_sim.sim.instance`.

A drawn number lies between half its limit and the limit, on either side of zero, so that no draw of a level is as good as clean.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from osel_sim.formats.task_schema import Region
from osel_sim.interface.robot import Robot

type Triple = tuple[float, float, float]
type Stream = Callable[[str], np.random.Generator]


@dataclass(frozen=True)
class CameraShift:
    """How far a camera is from its place: turned about the point it looks at, nearer or further, shifted, rolled.

    Attributes:
        azimuth, elevation, roll: radians.
        distance: factor.
        shift: metres, along x, y and z of the table.
        fovy: degrees added to the field of view.
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    roll: float = 0.0
    distance: float = 1.0
    shift: Triple = (0.0, 0.0, 0.0)
    fovy: float = 0.0


@dataclass(frozen=True)
class Perturbation:
    """All that makes an instance look other than clean; `asdict` of it is plain data.

    Attributes:
        lamp: red, green and blue of the lamp, as factors.
        lamp_turn: radians about x and y by which its light comes from elsewhere.
        ambient: factor of the light that comes from everywhere.
        camera: of the agentview camera.
        wrist: metres (3) and radians (3) by which the wrist camera sits otherwise, in its own frame.
        table: name of the table top (`osel_sim.sim.table_tops`); empty for its own.
        table_tint: factors of its red, green and blue.
        tints: thing -> (paleness, red, green, blue): so much white is mixed in, then colours are multiplied.
        sizes: object -> factor.
        joints: radians added to the robot's start joints; empty where it starts as it always does.
    """

    lamp: Triple = (1.0, 1.0, 1.0)
    lamp_turn: tuple[float, float] = (0.0, 0.0)
    ambient: float = 1.0
    camera: CameraShift = CameraShift()
    wrist: tuple[float, ...] = (0.0,) * 6
    table: str = ""
    table_tint: Triple = (1.0, 1.0, 1.0)
    tints: tuple[tuple[str, tuple[float, ...]], ...] = ()
    sizes: tuple[tuple[str, float], ...] = ()
    joints: tuple[float, ...] = ()


CLEAN = Perturbation()

# Limits at levels 0 to 3. Level 1 is mild, 2 is clear, 3 is hard, but a person would still manage.
LAMP = (0.0, 0.12, 0.25, 0.40)
"""Darker or brighter by this share; the cast of a colour is half of it."""
LAMP_TURN = (0.0, 0.2, 0.45, 0.8)
AZIMUTH = (0.0, 0.06, 0.14, 0.28)
ELEVATION = (0.0, 0.03, 0.07, 0.13)
ROLL = (0.0, 0.015, 0.035, 0.07)
NEARER, FURTHER = (0.0, 0.01, 0.02, 0.03), (0.0, 0.05, 0.10, 0.16)
SHIFT = (0.0, 0.006, 0.012, 0.02)
WIDER_VIEW = (0.0, 1.0, 2.5, 4.5)
"""Degrees; never a narrower view: what the instruction names must stay in it."""
WRIST = (0.0, 0.002, 0.004, 0.008)
"""Metres; ten times as many radians make its turn."""
TABLE_TINT = (0.0, 0.10, 0.15, 0.20)
PALENESS = (0.0, 0.05, 0.12, 0.22)
TINT = (0.0, 0.10, 0.22, 0.40)
SIZE = (0.0, 0.06, 0.12, 0.18)
"""The widest object is 6 cm across where it is grasped, the open gripper 8 cm."""
JOINTS = (0.0, 0.03, 0.07, 0.12)
WIDER = (0.0, 0.10, 0.20, 0.30)
"""Share of a start region's extent, or of a range of turns, by which each side moves out, ..."""
REACH_X, REACH_Y = (-0.18, 0.18), (-0.28, 0.28)
"""... as far as the arm reaches and the camera sees, metres on the table."""
MORE_DISTRACTORS = ((0, 0), (1, 1), (1, 2), (2, 3))
HELD_OUT = (0.0, 1 / 3, 2 / 3, 1.0)
"""Chance that a training phrasing of a test instance gives way to a held-out one. Half of them are held out to begin with."""


def draw(levels: Mapping[str, int], things: Sequence[str], objects: Sequence[str], robot: Robot, stream: Stream) -> Perturbation:
    """The appearance of one instance.

    Args:
        levels: axis -> level; axes that are missing are clean.
        things, objects: everything that gets another tint, another size; whether it is in the scene or not, so that it does not depend on that.
        stream: axis -> its random stream.
    """
    parts: dict[str, object] = {}
    if level := levels.get("light", 0):
        parts |= _light(level, stream("light"))
    if level := levels.get("camera", 0):
        parts |= _camera(level, stream("camera"))
    if level := levels.get("texture", 0):
        parts |= _table(level, stream("texture"))
    if level := levels.get("colours", 0):
        rng = stream("colours")
        parts["tints"] = tuple((name, _tint(level, rng)) for name in things)
    if level := levels.get("sizes", 0):
        rng = stream("sizes")
        parts["sizes"] = tuple((name, 1.0 + _either(rng, SIZE[level])) for name in objects)
    if level := levels.get("robot", 0):
        parts["joints"] = _joints(level, robot, stream("robot"))
    return dataclasses.replace(CLEAN, **parts)  # type: ignore[arg-type]


def widen(region: Region, level: int) -> Region:
    """A start region at a level of the axis `start`; what has a fixed place keeps it."""
    share, anywhere = WIDER[level], (-np.inf, np.inf)
    ranges = ((region.x, REACH_X), (region.y, REACH_Y), (region.yaw, anywhere))
    x, y, yaw = (_wider(limits, share, reach) for limits, reach in ranges)
    return dataclasses.replace(region, x=x, y=y, yaw=yaw)


def _wider(limits: tuple[float, float], share: float, reach: tuple[float, float]) -> tuple[float, float]:
    margin = share * (limits[1] - limits[0])
    return min(limits[0], max(limits[0] - margin, reach[0])), max(limits[1], min(limits[1] + margin, reach[1]))


def _light(level: int, rng: np.random.Generator) -> dict[str, object]:
    brightness = 1.0 + _either(rng, LAMP[level])
    cast = [1.0 - rng.uniform(0.0, LAMP[level] / 2) for _ in range(3)]
    turn = (_either(rng, LAMP_TURN[level]), _either(rng, LAMP_TURN[level]))
    return {"lamp": tuple(float(brightness * own) for own in cast), "lamp_turn": turn, "ambient": 1.0 + _either(rng, LAMP[level])}


def _camera(level: int, rng: np.random.Generator) -> dict[str, object]:
    azimuth, elevation, roll = (_either(rng, limit[level]) for limit in (AZIMUTH, ELEVATION, ROLL))
    elevation = max(elevation, -ELEVATION[level] / 2)  # seen from lower down, things hide each other
    distance = 1.0 + float(rng.uniform(-NEARER[level], FURTHER[level]))
    shift = (_either(rng, SHIFT[level]), _either(rng, SHIFT[level]), _either(rng, SHIFT[level]))
    wrist = tuple(_either(rng, WRIST[level] * scale) for scale in (1, 1, 1, 10, 10, 10))
    fovy = float(rng.uniform(WIDER_VIEW[level] / 2, WIDER_VIEW[level]))
    return {"camera": CameraShift(azimuth, elevation, roll, distance, shift, fovy), "wrist": wrist}


def _table(level: int, rng: np.random.Generator) -> dict[str, object]:
    from osel_sim.sim.table_tops import OF_LEVEL

    names = OF_LEVEL[level]
    tint = tuple(1.0 - float(rng.uniform(0.0, TABLE_TINT[level])) for _ in range(3))
    return {"table": names[int(rng.integers(len(names)))], "table_tint": tint}


def _tint(level: int, rng: np.random.Generator) -> tuple[float, ...]:
    paleness, brightness = float(rng.uniform(0.0, PALENESS[level])), 1.0 - float(rng.uniform(0.0, TINT[level]))
    # The cast is the lesser part: a white thing must not become a yellow one.
    return (paleness, *(brightness * (1.0 - float(rng.uniform(0.0, TINT[level] / 3))) for _ in range(3)))


def _joints(level: int, robot: Robot, rng: np.random.Generator) -> tuple[float, ...]:
    offsets = np.array([_either(rng, JOINTS[level]) for _ in range(robot.joints)]) * robot.start_weights
    if np.array(robot.start_lift) @ offsets < 0:  # the hand starts a hand's breadth above the tallest things: it may start higher, not lower
        offsets = -offsets
    return tuple(float(offset) for offset in offsets)


def _either(rng: np.random.Generator, limit: float) -> float:
    """Between half the limit and the limit, to either side."""
    size = rng.uniform(limit / 2, limit)
    return float(size if rng.random() < 0.5 else -size)
