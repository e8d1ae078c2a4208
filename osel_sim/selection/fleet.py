"""Selectors of several robots that exchange what they learn, in rounds: who decides when, and who knows what by then.

In a round every robot decides once, all at the same time: nobody knows in it what comes of the others' decisions in the same round. After every
`every`-th round each shares; what was shared arrives `delay` rounds later, before the robots decide again, and meanwhile they go on with what they
know. That order is declared, not an accident of timing, so that nothing depends on how many processes make the decisions.
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
        self._rounds = 0
        self._decided: list[tuple[int, Context, Choice, float]] = []  # in this round, not yet learned from
        self._under_way: list[tuple[int, list[State]]] = []  # from which round on it is known, what was shared
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

    def select(self, robot: int, context: Context) -> Choice:
        """What a robot chooses."""
        return self.selectors[robot].select(context)

    def update(self, robot: int, context: Context, choice: Choice, reward: float) -> None:
        """What came of a robot's choice; it is learned at the end of the round."""
        self._decided.append((robot, context, choice, reward))

    def end_round(self) -> None:
        """Learn from the round, share where it is time, and take in what has arrived by now."""
        for robot, context, choice, reward in sorted(self._decided, key=lambda one: one[0]):
            self.selectors[robot].update(context, choice, reward)
        self._decided.clear()
        self._rounds += 1
        if self.sharing.every is None:
            return
        if self._rounds % self.sharing.every == 0:
            messages = [member.share() for member in self._members()]
            self._under_way.append((self._rounds + self.sharing.delay, messages))
            self._messages += len(messages)
            self._bytes += sum(value.nbytes if isinstance(value, np.ndarray) else 8 for message in messages for value in message.values())
        while self._under_way and self._under_way[0][0] <= self._rounds:
            _, messages = self._under_way.pop(0)
            for robot, member in enumerate(self._members()):
                member.absorb(messages, robot)

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
    """

    name = "several robots"

    def __init__(self, fleet: Fleet) -> None:
        self.fleet, self.policies, self._decisions = fleet, fleet.selectors[0].policies, 0

    def select(self, context: Context) -> Choice:
        """What the robot whose turn it is chooses. Before the first of a round what the last one taught is learned."""
        robot = self._decisions % self.fleet.robots
        if self._decisions == 0:
            self.fleet.begin()
        elif robot == 0:
            self.fleet.end_round()
        self._decisions += 1
        return self.fleet.select(robot, context)

    def update(self, context: Context, choice: Choice, reward: float) -> None:
        """What came of the last choice."""
        self.fleet.update((self._decisions - 1) % self.fleet.robots, context, choice, reward)

    def state_dict(self) -> State:
        """The robots' states, `robot0.` and so on before the names; what one selector knows for all is there once."""
        states = {f"{ROBOT}{number}.{key}": value for number, one in enumerate(members(self)) for key, value in one.state_dict().items()}
        return {"selector": "fleet", "robots": self.fleet.robots, "share": str(self.fleet.sharing), "decisions": self._decisions, **states}

    def load_state_dict(self, state: State) -> None:
        """A run that goes on learns from its journal."""
        raise UsageError("the state of robots that share is not loaded: what is under way between them is not in it; a run learns from its journal")

    def add_policy(self, name: str) -> None:
        """Refused: what is under way between robots is of the policies that there were."""
        raise UsageError(f"policy {name!r} cannot join: policies of several robots do not come and go")
