"""The decisions of several robots whose episodes run in worker processes.

The selectors stay in this process: only looking at instances and playing episodes is given away. Which robot may decide when is declared
(`osel_sim.selection.fleet`), and decisions are written down in their order, so nothing depends on the number of processes. What was played and not
yet written when this process is killed is played again, to the same bytes.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import cast

from osel_sim.core.errors import WorkerError
from osel_sim.core.processes import Lost, Pool
from osel_sim.episodes.live import LiveRun
from osel_sim.episodes.played import Played
from osel_sim.episodes.robot_workers import Equipment, Look, Play, Seen, equipped
from osel_sim.episodes.worker_imports import worker_imports
from osel_sim.interface.instance import Instance
from osel_sim.interface.selector import Choice
from osel_sim.interface.suite import Prepares
from osel_sim.selection.fleet import InTurn

AHEAD = 2
"""Rounds that a robot may be ahead of the one that is furthest behind: what is played ahead waits to be written."""


@dataclass(frozen=True)
class SideBySide:
    """Makes the decisions of a run of several robots.

    Args:
        workers: processes.
        equipment: of each.
    """

    workers: int
    equipment: Equipment

    def __call__(self, run: LiveRun, decisions: int, stop: Callable[[], bool]) -> None:
        """Make decisions until there are so many; after `stop` none is begun but those before others that were begun.

        Raises:
            WorkerError: a worker process died twice in the same episode.
        """
        if len(run.decisions) < decisions and not stop():
            for suite in {id(task.suite): task.suite for task in self.equipment.tasks}.values():
                if isinstance(suite, Prepares):
                    suite.prepare()  # here, once, rather than in every worker
            workers, imports = min(self.workers, run.options.robots), worker_imports(self.equipment.tasks, torch=True)
            with closing(Pool(partial(equipped, self.equipment), workers, imports=imports)) as pool:
                _Decisions(run, pool, decisions).make(stop)


class _Decisions:
    """Those to come.

    Args:
        end: how many there are to be.
    """

    def __init__(self, run: LiveRun, pool: "Pool[Look | Play, Seen | Played]", end: int) -> None:
        self.run, self.pool, self.end, self.turns = run, pool, end, cast(InTurn, run.selector)
        self.fleet, self.robots = self.turns.fleet, run.options.robots
        made, self.last_round = len(run.decisions), (end - 1) // self.robots
        self.next = [made + (robot - made) % self.robots for robot in range(self.robots)]  # decision of each robot that is not begun
        self.free = set(range(self.robots))
        self.seen: dict[int, tuple[Instance, Seen]] = {}  # decision -> what it is about, until it can be made
        self.chosen: dict[int, tuple[Instance, Seen, Choice]] = {}  # until it is written
        self.played: dict[int, Played] = {}
        if not made:
            self.fleet.begin()
        # Of the last round the robots have not learned when they go through the journal.
        for index in range(max(0, made - 1) // self.robots * self.robots, made):
            self._end_turn(index)

    def make(self, stop: Callable[[], bool]) -> None:
        """Make them."""
        self._begin()
        for event in self.pool.work():
            if isinstance(event, Lost):
                raise event.error or WorkerError(f"a worker process died twice at {event.job} ({event.cause}; out of memory?); go on with --resume")
            if isinstance(event.value, Seen):
                self._saw(event.job.index, event.job.instance, event.value)
            else:
                self._came_of(event.job.index, event.value)
            if stop():
                self.end = min(self.end, max(self.next) - self.robots + 1)
            self._begin()

    def _begin(self) -> None:
        """Begin all decisions that can be begun, and make those that can be made."""
        for robot in sorted(self.free, key=lambda robot: self.next[robot]):
            index = self.next[robot]
            if index >= min(self.end, len(self.run.decisions) + AHEAD * self.robots):
                continue
            self.free.remove(robot)
            self.next[robot] += self.robots
            instance = self.run.instance(index)
            context = self.run.cache.get(self.run.encoder.identity, instance.key)
            if context is None:
                self.pool.add(Look(index, instance))
            else:
                self.seen[index] = instance, Seen(context)
        for index in sorted(self.seen):
            if self.fleet.can_decide(index % self.robots):
                self._decide(index)

    def _saw(self, index: int, instance: Instance, seen: Seen) -> None:
        self.run.cache.put(self.run.encoder.identity, instance.key, seen.context)
        self.seen[index] = instance, seen

    def _decide(self, index: int) -> None:
        instance, seen = self.seen.pop(index)
        choice = self.fleet.select(index % self.robots, self.run.shown(seen.context, instance))
        others = [policy for policy in self.turns.policies if policy != choice.policy] if self.run.options.counterfactual else []
        self.chosen[index] = instance, seen, choice
        self.pool.add(Play(index, instance, choice, tuple(others)))

    def _came_of(self, index: int, played: Played) -> None:
        """Let the robot learn, and write down what can be."""
        self.played[index] = played
        instance, seen, choice = self.chosen[index]
        reward, robot = self.run.reward(played.outcome), index % self.robots
        if reward is not None:  # an error teaches nothing
            self.fleet.update(robot, self.run.shown(seen.context, instance), choice, reward)
        self._end_turn(index)
        self.free.add(robot)
        while (first := len(self.run.decisions)) in self.played:
            self._write(first)

    def _write(self, index: int) -> None:
        (instance, seen, choice), played = self.chosen.pop(index), self.played.pop(index)
        for subscriber in self.run.subscribers:
            subscriber.on_instance(index)
            subscriber.on_choice(index, choice.policy)
            subscriber.on_elsewhere(index, {"seconds": seen.seconds + played.seconds, "context_and_choice": seen.seconds, "episodes": played.took})
        decision = self.run.write(instance, choice, played)
        self.turns.decisions += 1
        self.run.look_back(decision)

    def _end_turn(self, index: int) -> None:
        """End a robot's round, unless no other follows: that is when a run in one process ends it."""
        if index // self.robots < self.last_round:
            self.fleet.end_turn(index % self.robots)
