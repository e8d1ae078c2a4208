"""The scripted expert: a chain of skills that reads the simulator's state. It shows how a task is done; policies never see what it sees.

Every skill is a function of the state alone, not of time, so that what it does can be learnt from observations.
"""

import numpy as np
from numpy.typing import NDArray

from osel_sim.formats.terms import skills
from osel_sim.sim import predicates
from osel_sim.sim.scene import TABLE_HEIGHT
from osel_sim.sim.world import World

Array = NDArray[np.float64]

OPEN, CLOSED = -1.0, 1.0
POSITION_GAIN = 20.0
"""Action (1 is 5 cm) for each metre of error."""
ROTATION_GAIN = 3.0
"""Action (1 is 0.5 rad) for each radian of error."""
HOVER = 0.09
"""Above the grasp point, metres, before going down."""
TRAVEL = 0.17
"""Height of a carried thing's lowest point above the table: clear of everything that stands on it."""
RELEASE = 0.005
"""Height above what a thing is put on at which it is let go."""
AWAY = 0.05
"""Height of the gripper above a thing it has left, metres."""
FITTING = ("peg", "object")
"""Kinds that a thing must be lined up with before it goes down on them."""
FIT = 0.012
"""How well it must be lined up, metres, no finer than it takes: the last millimetres show in no camera, and what learns from this waits for them."""
STEADY = 0.015
"""How far off the middle of another a thing still stands on it, metres."""
ROOMY = 0.09
"""Inner radius from which on a container takes more than one thing, metres."""
SPREAD = 0.5
"""How far from its middle they are put, a share of the inner radius."""
SHOVE_SPEED = 0.6
"""Largest action while something is shoved."""


class Expert:
    """Drives a world's loaded instance through its task's plan.

    Usage: `reset()` after each `World.load`, then `world.step(expert.act())` until the goal holds.

    Attributes:
        finished: it came to the end of the plan; it looks from there on for what has been undone.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self._stage, self.finished = 0, False

    def reset(self) -> None:
        """Begin the plan anew."""
        self._stage, self.finished = 0, False

    @property
    def stage(self) -> int:
        """Which step of the plan it is at, from 0; the plan's length where all is done."""
        return self._stage

    @property
    def focus(self) -> tuple[str, str]:
        """What is being handled and where it goes (itself, where it goes nowhere): names of things."""
        plan, roles = self.world.task.plan, self.world.instance.roles
        stage = min(self._stage, len(plan) - 1)
        wider = next((term for term in plan[stage:] if len(term.roles) > 1 and term.roles[0] == plan[stage].roles[0]), plan[stage])
        return roles[wider.roles[0]], roles[wider.roles[-1]]

    def act(self) -> NDArray[np.float32]:
        """The clean next action (7,) in [-1, 1]."""
        plan, roles = self.world.task.plan, self.world.instance.roles
        for _ in range(2 * len(plan)):
            if self._stage == len(plan):
                self._stage = 0  # all done, unless something has been undone meanwhile
                self.finished = True
            if (after := self._achieved()) is not None:
                self._stage = after
                continue
            term = plan[self._stage]
            action, done = skills.load(term.name).act(self, *(roles[role] for role in term.roles))
            if not done:
                return np.clip(action, -1.0, 1.0).astype(np.float32)
            self._stage += 1
        return np.zeros(7, np.float32)

    # -- skills: (action, done) ----------------------------------------------------------------------------------------

    def reach(self, thing: str) -> tuple[Array, bool]:
        """Open, above the thing and turned as it is; then down to its grasp point."""
        return self._reach(thing, self._grasp_yaw(thing))

    def grasp(self, thing: str) -> tuple[Array, bool]:
        """Close until both fingers hold the thing firmly."""
        world = self.world
        off = float(np.linalg.norm(world.grasp_point(thing) - world.grip_position))
        if off > 0.05:
            return self._again(thing)
        held = all(world.touches(finger, thing) for finger in ("left", "right"))
        gripper = OPEN if world.gripper_command < -0.9 and off > world.robot.centred else CLOSED
        return self.towards(world.grasp_point(thing), self._grasp_yaw(thing), gripper, self._lean(thing)), held and world.gripper_command > 0.5

    def lift(self, thing: str) -> tuple[Array, bool]:
        """Straight up to travelling height."""
        if self._lost(thing):
            return self._again(thing)
        rise = TABLE_HEIGHT + TRAVEL - self.world.lowest_point(thing)
        return self.towards(self.world.grip_position + np.array([0.0, 0.0, rise + 0.02]), 0.0, CLOSED), rise < 0.06

    def move(self, thing: str, place: str) -> tuple[Array, bool]:
        """Carry the thing over where it goes."""
        if self._lost(thing):
            return self._again(thing)
        offset = self._spot(thing, place) - self.world.position(thing)
        offset[2] = TABLE_HEIGHT + TRAVEL - self.world.lowest_point(thing)
        return self.towards(self.world.grip_position + offset, 0.0, CLOSED), float(np.hypot(offset[0], offset[1])) < 0.02

    def place(self, thing: str, place: str) -> tuple[Array, bool]:
        """Lower the thing to where it goes and let go; then up and away."""
        world, entity = self.world, self.world.task.entity(place)
        spot = self._spot(thing, place)
        offset = spot - world.position(thing)
        height = world.lowest_point(thing) - spot[2]
        sideways = float(np.hypot(offset[0], offset[1]))
        if height < entity.floor + RELEASE + 0.006 and sideways < self._tolerance(place):
            if world.gripper_command > -0.5:
                return self.towards(world.grip_position, 0.0, OPEN), False
            above = world.highest_point(thing) + AWAY - float(world.grip_position[2])
            return self.towards(world.grip_position + np.array([0.0, 0.0, above + 0.01]), 0.0, OPEN), above < 0.0
        if self._lost(thing):
            return self._again(thing)
        offset[2] = entity.floor + RELEASE - height
        if entity.kind in FITTING and sideways > FIT:
            offset[2] = max(world.highest_point(place) + 0.015 - world.lowest_point(thing), offset[2])
        offset[2] = max(-world.robot.lowering / POSITION_GAIN, offset[2])
        return self.towards(world.grip_position + offset, 0.0, CLOSED), False

    def push(self, thing: str, zone: str) -> tuple[Array, bool]:
        """Slide the thing along the table into the zone, between open fingers turned so that one of them is behind it."""
        world = self.world
        way = (world.position(zone) - world.position(thing))[:2]
        distance = float(np.linalg.norm(way))
        if distance < 0.4 * world.task.entity(zone).inner:
            return self.towards(world.grip_position + np.array([0.0, 0.0, 0.1]), self._turn(0.0), OPEN), not self._touched(thing)
        way = way / distance
        yaw = float(np.arctan2(-way[0], way[1]))
        yaw -= np.pi * np.round(yaw / np.pi)
        point = world.grasp_point(thing)
        off = world.grip_position - point
        beside = off[:2] - float(off[:2] @ way) * way
        if float(np.hypot(off[0], off[1])) > 0.04 or abs(off[2]) > 0.02 or float(np.linalg.norm(beside)) > 0.02:
            return self._reach(thing, yaw)[0], False
        action = self.towards(np.array([*world.grip_position[:2], point[2]]), yaw, OPEN)
        action[:2] = SHOVE_SPEED * way - POSITION_GAIN * beside
        return action, False

    def open(self, thing: str) -> tuple[Array, bool]:
        """Draw the handle, held, along the way it moves."""
        world = self.world
        if self._lost(thing):
            return self._again(thing)
        target = world.grasp_point(thing) + 0.035 * world.opening_direction(thing)
        return self.towards(target, self._grasp_yaw(thing), CLOSED, self._lean(thing)), world.opening(thing) > 0.95

    def close(self, thing: str) -> tuple[Array, bool]:
        """Shove the handle back."""
        world = self.world
        way = -world.opening_direction(thing)[:2]
        return self._shove(world.grasp_point(thing), way / np.linalg.norm(way), 0.05), world.opening(thing) < 0.02

    def press(self, button: str) -> tuple[Array, bool]:
        """Closed, above the button; then down on it."""
        world = self.world
        target = world.grasp_point(button)
        offset = target - world.grip_position
        sideways = float(np.hypot(offset[0], offset[1]))
        height = -0.03 if sideways < 0.012 else HOVER * min(1.0, sideways * 8.0) + world.robot.gripper.tip
        return self.towards(target + np.array([0.0, 0.0, height]), 0.0, CLOSED), world.opening(button) > 0.9

    # -- helpers -------------------------------------------------------------------------------------------------------

    def _reach(self, thing: str, yaw: float) -> tuple[Array, bool]:
        target = self.world.grasp_point(thing)
        offset = target - self.world.grip_position
        sideways = float(np.hypot(offset[0], offset[1]))
        done = sideways < 0.012 and abs(offset[2]) < 0.010
        if sideways > 0.02 and self._touched(thing):  # a finger is on it: let it go before it is dragged along
            return self.towards(self.world.grip_position + np.array([0.0, 0.0, 0.1]), yaw, OPEN, self._lean(thing)), False
        # A funnel: the closer above the thing and the better turned, the lower.
        turn = abs(self._turn(yaw))
        height = float(np.clip(max((sideways - 0.010) * 4.0, (turn - 0.10) * 4.0), 0.0, 1.0)) * HOVER
        if sideways > 0.06:
            height = max(HOVER, TABLE_HEIGHT + 0.20 - target[2])
        return self.towards(target + np.array([0.0, 0.0, height]), yaw, OPEN, self._lean(thing)), done

    def _achieved(self) -> int | None:
        """The stage to go on with if what begins at this one has been achieved already."""
        plan, roles = self.world.task.plan, self.world.instance.roles
        if self._stage and skills.load(plan[self._stage - 1].name).achieved is None:
            return None  # in the midst of it
        for stage in range(self._stage, len(plan)):
            if test := skills.load(plan[stage].name).achieved:
                return stage + 1 if test(self, *(roles[role] for role in plan[stage].roles)) else None
        return None

    def has_put(self, thing: str, place: str) -> bool:
        """Whether the thing is where it goes, and let go."""
        is_object = self.world.task.entity(place).kind == "object"
        return not self._touched(thing) and (predicates.on if is_object else predicates.inside)(self.world, thing, place)

    def _again(self, thing: str) -> tuple[Array, bool]:
        """Start over with reaching for the thing."""
        plan = self.world.task.plan
        self._stage = next(stage for stage in range(self._stage, -1, -1) if plan[stage].name == "reach" or stage == 0)
        return self.reach(thing)[0], False

    def _touched(self, thing: str) -> bool:
        return any(self.world.touches(finger, thing) for finger in ("left", "right"))

    def _lost(self, thing: str) -> bool:
        """Whether the thing is no longer between the fingers."""
        return not self._touched(thing)

    def _spot(self, thing: str, place: str) -> Array:
        """Where in a place to put a thing (3,): its middle, or in a roomy one the end, before or behind, that is farther from what lies there.

        Before or behind, since the fingers open to both sides, where they would meet the rim.
        """
        world, entity = self.world, self.world.task.entity(place)
        middle = world.place_point(place)
        others = [
            one.entity for one in world.instance.placements if one.entity not in (thing, place) and world.task.entity(one.entity).kind == "object"
        ]
        there = [world.position(name)[:2] for name in others if float(np.hypot(*(world.position(name) - middle)[:2])) < entity.radius]
        if entity.inner < ROOMY:
            return middle
        spots = [middle[:2] + np.array([side * SPREAD * entity.inner, 0.0]) for side in (-1, 1)]
        best = max(spots, key=lambda spot: min((float(np.hypot(*(spot - other))) for other in there), default=0.0))
        return np.array([*best, middle[2]])

    def _tolerance(self, place: str) -> float:
        entity = self.world.task.entity(place)
        return entity.inner if entity.kind != "object" else STEADY

    def _shove(self, point: Array, way: Array, room: float) -> Array:
        """Closed fingers behind a point, `room` metres away from it; then through it in a horizontal direction."""
        grip = self.world.grip_position
        relative = grip[:2] - point[:2]
        along = float(relative @ way)
        beside = relative - along * way
        if abs(float(grip[2] - point[2])) < 0.03 and along < 0.0 and float(np.linalg.norm(beside)) < 0.025:
            # Not down as well: fingers that press what they shove against the table hardly move it.
            action = self.towards(np.array([*grip[:2], max(float(grip[2]), point[2])]), 0.0, CLOSED)
            action[:2] = SHOVE_SPEED * way - POSITION_GAIN * beside  # back onto the line as it goes: what is shoved from beside it turns away
            return action
        behind = point[:2] - room * way
        there = float(np.linalg.norm(grip[:2] - behind)) < 0.012
        height = point[2] if there else point[2] + 0.12
        if not there and grip[2] < point[2] + 0.08:
            return self.towards(np.array([*grip[:2], height]), 0.0, CLOSED)  # straight up first
        return self.towards(np.array([*behind, height]), 0.0, CLOSED)

    def _lean(self, thing: str) -> Array:
        """Rotation (3, 3) by which a gripper that holds the thing leans away from what its handle is fixed to.

        Rodrigues' formula: scipy's Rotation differs in the last bits, and with them the episodes of the expert would.
        """
        angle = np.radians(self.world.task.entity(thing).lean)
        if not angle:
            return np.eye(3)
        way = self.world.opening_direction(thing)
        axis = np.array([-way[1], way[0], 0.0]) / np.hypot(way[0], way[1])
        cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
        rotation: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        return rotation

    def _grasp_yaw(self, thing: str) -> float:
        """The least turn of the gripper that fits the thing: two parallel fingers look the same after half a turn."""
        period = np.radians(self.world.task.entity(thing).symmetry)
        if not period:
            return 0.0
        yaw = self.world.yaw(thing)
        turn = float(yaw - period * np.round(yaw / period))
        if abs(turn) > 0.45 * period:  # as far either way: the way the gripper is turned already, lest it waver between the two
            turn -= float(period * np.round((turn - self._turn(0.0)) / period))
        return turn

    def _turn(self, yaw: float) -> float:
        """Radians by which the gripper is off `yaw` about the vertical."""
        matrix = self.world.grip_matrix
        return float(np.arctan2(-matrix[0, 0], matrix[1, 0]) - yaw)

    def towards(self, position: Array, yaw: float, gripper: float, lean: Array | None = None) -> Array:
        """Action (7,) towards a position of the grip site, gripper pointing down and turned by `yaw`, then leaning.

        Args:
            position: (3,), metres, world.
            yaw: radians about the vertical.
            gripper: `OPEN` or `CLOSED`.
            lean: rotation (3, 3) applied last.
        """
        action = np.empty(7)
        step = POSITION_GAIN * (position - self.world.grip_position)
        action[:3] = step / max(1.0, float(np.abs(step).max()))  # a straight line, also where the limit of 1 cuts in
        cosine, sine = np.cos(yaw), np.sin(yaw)
        desired = np.array([[-sine, cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, -1.0]])
        if lean is not None:
            desired = lean @ desired
        # Half the sum of the cross products of the axes that are with those that should be.
        product = self.world.grip_matrix @ desired.T
        error = product - product.T
        action[3:6] = 0.5 * ROTATION_GAIN * np.array([error[1, 2], error[2, 0], error[0, 1]])
        action[6] = gripper
        return action
