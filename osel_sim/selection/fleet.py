"""Selectors of several robots that exchange what they learn, in rounds: who decides when, and who knows what by then.

In a round every robot decides once, all at the same time: nobody knows in it what comes of the others' decisions in the same round. After every
`every`-th round each shares; what was shared arrives `delay` rounds later, before the robots decide again, and meanwhile they go on with what they
know. That order is declared, not an accident of timing, so that nothing depends on how many processes make the decisions: a robot need not wait for
the others' rounds to end, but for what is to have arrived by its next decision (`Fleet.can_decide`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, Selector, Shares, State


def robot_seed(seed: int, robot: int) -> int:
    """Seed of a robot's selector, in [0, 2**32): robots must not draw alike."""
    return int(np.random.SeedSequence([seed, robot]).generate_state(1)[0])


ROBOT = "robot"
"""How the names of a robot's values begin in a fleet's state: `robot0.`."""


@dataclass(frozen=True)
class Sharing:
    """What robots exchange and when.

    Attributes:
        every: rounds between two exchanges; None: never, each learns alone.
        delay: rounds that an exchange is under way, >= 0.
        central: one selector decides for all robots and learns from all of them.
    """

    every: int | None = None
    delay: int = 0
    central: bool = False

    @classmethod
    def parse(cls, text: str, delay: int = 0) -> "Sharing":
        """`none`, `all` or `every:N`.

        Raises:
            UsageError: none of these.
        """
        if text in ("none", "all"):
            if delay:
                raise UsageError(f"--share-delay {delay} is for --share every:N: with {text!r} nothing is sent")
            return cls(central=text == "all")
        word, _, number = text.partition(":")
        if word != "every" or not (number.isascii() and number.isdigit()) or not 1 <= int(number) <= 10**6:
            raise UsageError(f"--share must be none, all, or every:N with N from 1 to 1000000, such as every:20; got {text!r}")
        return cls(int(number), delay)

    def __str__(self) -> str:
        return "all" if self.central else "none" if self.every is None else f"every:{self.every}"


class Fleet:
    """The selectors of several robots.

    Args:
        make: makes a robot's selector of its number; the first robot's decides for all where sharing is central.
        robots: how many.

    Raises:
        UsageError: the selectors are to exchange something and cannot.
    """

    def __init__(self, make: Callable[[int], Selector], robots: int, sharing: Sharing) -> None:
        self.sharing, self.robots = sharing, robots
        one = make(0)
        self.selectors = [one] * robots if sharing.central else [one, *(make(robot) for robot in range(1, robots))]
        if sharing.every is not None:
            self._members()
        self._asked = [0] * robots  # rounds in which each has chosen
        self._rounds = [0] * robots  # that each has ended
        self._decided: dict[int, tuple[Context, Choice, float]] = {}  # by robot, in the round at hand; not yet learned from
        self._shared: dict[int, dict[int, State]] = {}  # after which round -> robot -> its message, until all have taken it in
        self._taken = [0] * robots  # exchanges that each has taken in
        self._messages, self._bytes = 0, 0

    @property
    def message_bytes(self) -> float:
        """Mean size of the messages so far: that of their arrays, and 8 for every other value."""
        return self._bytes / max(1, self._messages)

    def begin(self) -> None:
        """Begin to share, once all selectors were shown what they are to know beforehand."""
        if self.sharing.every is None:
            return
        members = self._members()
        first = members[0].begin(None)
        for member in members[1:]:
            member.begin(first)

    def can_decide(self, robot: int) -> bool:
        """Whether all is there that a robot is to know, or that is to be drawn, before its next decision."""
        now = self._rounds[robot]
        if self.sharing.central:  # one selector draws for all, in their order, when it has learned from all
            return min(self._rounds) == now and min(self._asked[:robot], default=now + 1) > now
        return self.sharing.every is None or now < self._due(robot)

    def select(self, robot: int, context: Context) -> Choice:
        """What a robot chooses."""
        self._asked[robot] += 1
        return self.selectors[robot].select(context)

    def update(self, robot: int, context: Context, choice: Choice, reward: float) -> None:
        """What came of a robot's choice; it is learned at the end of the robot's round."""
        self._decided[robot] = (context, choice, reward)

    def end_round(self) -> None:
        """End the round of all robots, of those too that made no decision in it."""
        for robot in range(self.robots):
            self.end_turn(robot)

    def end_turn(self, robot: int) -> None:
        """End a robot's round: it learns from it, shares where it is time, and everyone takes in what has arrived by now."""
        self._rounds[robot] += 1
        self._asked[robot] = self._rounds[robot]  # also where it did not choose
        if not self.sharing.central:
            self._learn(robot)
        elif min(self._rounds) == self._rounds[robot]:  # the last of them
            for one in range(self.robots):
                self._learn(one)
        if self.sharing.every is None:
            return
        if self._rounds[robot] % self.sharing.every == 0:
            message = self._members()[robot].share()
            self._shared.setdefault(self._rounds[robot], {})[robot] = message
            self._messages += 1
            self._bytes += sum(value.nbytes if isinstance(value, np.ndarray) else 8 for value in message.values())
        for one in range(self.robots):
            self._take_in(one)

    def _learn(self, robot: int) -> None:
        if robot in self._decided:
            self.selectors[robot].update(*self._decided.pop(robot))

    def _due(self, robot: int) -> int:
        """Rounds that a robot can end before it must know the exchange that comes next."""
        return (self._taken[robot] + 1) * (self.sharing.every or 1) + self.sharing.delay

    def _take_in(self, robot: int) -> None:
        """Take in what is to have arrived by now, as far as it is there."""
        while self._rounds[robot] >= self._due(robot):
            messages = self._shared.get(sent := self._due(robot) - self.sharing.delay, {})
            if len(messages) < self.robots:
                return
            self._members()[robot].absorb([messages[one] for one in range(self.robots)], robot)
            self._taken[robot] += 1
            if min(self._taken) == self._taken[robot]:
                del self._shared[sent]

    def _members(self) -> list[Shares]:
        for selector in self.selectors:
            if not isinstance(selector, Shares):
                raise UsageError(f"selector {type(selector).__name__} cannot share: it lacks begin, share or absorb")
        return cast("list[Shares]", self.selectors)


def members(selector: Selector) -> list[Selector]:
    """The different selectors of a fleet; of any other selector, itself."""
    return list(dict.fromkeys(selector.fleet.selectors)) if isinstance(selector, InTurn) else [selector]


class InTurn:
    """A fleet as one selector of a stream in which robots take turns: decision t is robot t mod R's.

    Args:
        fleet: begun with the first decision: what its selectors were shown before is common knowledge.

    Attributes:
        decisions: made so far.
    """

    name = "several robots"

    def __init__(self, fleet: Fleet) -> None:
        self.fleet, self.policies, self.decisions = fleet, fleet.selectors[0].policies, 0

    def select(self, context: Context) -> Choice:
        """What the robot whose turn it is chooses. Before the first of a round what the last one taught is learned."""
        robot = self.decisions % self.fleet.robots
        if self.decisions == 0:
            self.fleet.begin()
        elif robot == 0:
            self.fleet.end_round()
        self.decisions += 1
        return self.fleet.select(robot, context)

    def update(self, context: Context, choice: Choice, reward: float) -> None:
        """What came of the last choice."""
        self.fleet.update((self.decisions - 1) % self.fleet.robots, context, choice, reward)

    def state_dict(self) -> State:
        """The robots' states, `robot0.` and so on before the names; what one selector knows for all is there once."""
        states = {f"{ROBOT}{number}.{key}": value for number, one in enumerate(members(self)) for key, value in one.state_dict().items()}
        return {"selector": "fleet", "robots": self.fleet.robots, "share": str(self.fleet.sharing), "decisions": self.decisions, **states}

    def load_state_dict(self, state: State) -> None:
        """A run that goes on learns from its journal."""
        raise UsageError("the state of robots that share is not loaded: what is under way between them is not in it; a run learns from its journal")

    def add_policy(self, name: str) -> None:
        """Refused: what is under way between robots is of the policies that there were."""
        raise UsageError(f"policy {name!r} cannot join: policies of several robots do not come and go")
