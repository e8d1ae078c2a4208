"""The live loop: instance, context, choice, episode, reward, learning; one decision after another."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.appended import name_part
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError
from osel_sim.episodes.changes import PolicyChanges
from osel_sim.episodes.drivers import Drivers
from osel_sim.episodes.encoder_trial import EncoderTrial, tell_again
from osel_sim.episodes.loop import run_episode
from osel_sim.episodes.played import Played
from osel_sim.episodes.run_subscribers import RunSubscriber
from osel_sim.episodes.start import Start
from osel_sim.episodes.view import view
from osel_sim.episodes.warnings import Watch
from osel_sim.episodes.watching import RunMonitor
from osel_sim.formats.counterfactual import COUNTERFACTUAL, Others, to_others
from osel_sim.formats.journal import (
    JOURNAL,
    SEEDS_PER_RUN,
    TIMING,
    Decision,
    Lines,
    as_read,
    check_beside,
    check_digests,
    line_digest,
    read_lines,
    to_decision,
)
from osel_sim.formats.points import POINTS
from osel_sim.formats.policy_file import Price
from osel_sim.formats.run_warnings import RunWarning
from osel_sim.formats.summary import check_summary
from osel_sim.interface.encoder import Encoder
from osel_sim.interface.instance import Instance
from osel_sim.interface.outcome import Outcome
from osel_sim.interface.selector import Choice, Pays, Selector
from osel_sim.interface.suite import Task
from osel_sim.selection.dealing import By, robots_share
from osel_sim.selection.reward import RewardWeights, check_reward, reward
from osel_sim.suites.open_tasks import OpenTasks


@dataclass(frozen=True)
class LiveOptions:
    """What a live run does, besides the parts it is made of.

    Attributes:
        weights: of the reward.
        counterfactual: also run the policies that were not chosen, from the same start, for comparison only.
        levels: of which each instance has one, at random.
        axes: axis -> level, where it differs from the instance's level.
        action_noise: as `run_episode` takes it.
        context: `task` appends the task's name to the contexts that the selector is shown.
        robots: how many take turns, decision by decision.
        robots_by: what their instances differ in (`osel_sim.selection.dealing`); None: nothing.
        changes: policies that join and leave.
        prices: what policies cost by their files, for warnings.
        trial: finds out with which encoder to go on; None: with the one that it began with.
    """

    seed: int
    weights: RewardWeights
    levels: tuple[int, ...] = (0,)
    split: str = "test"
    counterfactual: bool = False
    axes: Mapping[str, int] = field(default_factory=dict)
    action_noise: float = 0.0
    context: str | None = None
    robots: int = 1
    robots_by: By | None = None
    changes: PolicyChanges = field(default_factory=PolicyChanges)
    prices: Mapping[str, Price] = field(default_factory=dict)
    trial: EncoderTrial | None = None


class LiveRun:
    """One run in one folder. Made on a folder with a journal, it learns from that first and goes on after it. Close it.

    What the folder holds is looked at before any of it is changed.

    Args:
        subscribers: watch it (`osel_sim.episodes.run_subscribers`); the run itself writes its journal, counterfactual outcomes, contexts, and what a
            monitor saw.
        monitor: says who drives on within the chosen policies' episodes.

    Attributes:
        decisions: all so far.
        warnings: all so far (`osel_sim.episodes.warnings`).
        rewards: of every policy (columns) in every decision (rows), NaN where there is none; only chosen ones without `counterfactual`.
        alone: with `counterfactual` and a monitor, what each chosen policy comes to without it; None after an error.

    Raises:
        DataError: the folder's files are damaged, or do not fit together.
    """

    def __init__(
        self,
        folder: Path,
        tasks: Sequence[Task],
        encoder: Encoder,
        drivers: Drivers,
        selector: Selector,
        options: LiveOptions,
        subscribers: Sequence[RunSubscriber] = (),
        monitor: RunMonitor | None = None,
    ) -> None:
        self.folder, self.tasks, self.encoder = folder, tasks, encoder
        self.drivers, self.selector, self.options = drivers, selector, options
        self.subscribers, self.monitor = subscribers, monitor
        # Contexts are on disk about as soon as their decisions: a run that goes on, or was killed, can be reported on.
        self.envs, self.cache = OpenTasks(tasks), ContextCache(folder, autosave=1, mend=True)
        self.decisions = [to_decision(data, index, folder / JOURNAL) for index, (data, _) in enumerate(read_lines(folder / JOURNAL))]
        check_beside(folder / COUNTERFACTUAL, len(self.decisions), complete=options.counterfactual, going_on=True)
        check_beside(folder / TIMING, len(self.decisions), going_on=True)
        check_summary(folder, len(self.decisions))
        for name in (JOURNAL, COUNTERFACTUAL):
            check_digests(folder / name)
        if monitor is not None:
            monitor.open(folder, len(self.decisions))
        self._journal = Lines(folder / JOURNAL)
        self._others = Lines(folder / COUNTERFACTUAL, keep=len(self.decisions)) if options.counterfactual else None
        self.warnings: list[RunWarning] = []
        self._watch = Watch(options.prices, [(task.name, level) for task in tasks for level in options.levels])
        self._ever, self._changes = tuple(selector.policies), options.changes
        self._rows: list[dict[str, float | None]] = []
        self.alone: list[float | None] = []
        self._horizons = {task.name: max(1, task.info.horizon) for task in tasks}
        # A journal begun by a version that did not tell scenes stays as it would have been.
        self._tells_scenes = not self.decisions or self.decisions[0].scene is not None

    @property
    def policies(self) -> Sequence[str]:
        """Names of the policies that were ever chosen from; `selector.policies` are those that are now."""
        return self._ever

    @property
    def rewards(self) -> NDArray[np.float64]:
        """(decisions, policies), in the order of `policies`."""
        table = [[float("nan") if (value := row.get(policy)) is None else value for policy in self._ever] for row in self._rows]
        return np.array(table, np.float64).reshape(-1, len(self._ever))

    def run(self, decisions: int, stop: Callable[[], bool] = lambda: False, make: "MakeDecisions | None" = None) -> None:
        """Make decisions until there are so many, or `stop` says so. The run is closed then; its subscribers are told of all of it.

        Args:
            stop: asked before each decision.
            make: makes them; None: `one_after_another`.
        """
        with contextlib.ExitStack() as stack:
            for subscriber in self.subscribers:
                stack.callback(subscriber.close)
            with contextlib.closing(self):
                for subscriber in self.subscribers:
                    subscriber.on_start(self)
                self._tell_changes(len(self.decisions))
                (make or one_after_another)(self, decisions, stop)
            for subscriber in self.subscribers:
                subscriber.on_end(self)

    def replay(self) -> None:
        """Let the selector live through the journal, so that it is what it was when the run was cut off, and through what changes right after it.

        Raises:
            DataError: the selector decides otherwise than the journal says, or a line is not of the run's instance, or its reward is wrong.
        """
        for decision in self.decisions:
            self._change(decision.index)
            instance = self.instance(decision.index)
            self._check(decision, instance)
            context = self._context(instance, loaded=False)
            choice = self.selector.select(context)
            if choice.policy != decision.policy or choice.propensities != decision.propensities:
                raise DataError(
                    f"{self._journal.file}, line {decision.index + 1}: says {decision.policy!r} was chosen, this selector now chooses "
                    f"{choice.policy!r} with {choice.propensities}: the run was made with other versions or on another machine"
                )
            self._learn(context, choice, decision)
            self.warnings += self._watch.see(decision)
            if self.monitor is not None:
                self.monitor.replay(decision)
            known = {decision.policy: decision.reward}
            if self._others is not None:
                others = self._checked_others(self._others.rows[decision.index][0], decision.index, decision.policy)
                known |= others.rewards
                self.alone += [others.alone_reward] if others.alone is not None else []
            self._rows.append(known)
            self._choose_encoder(decision.index + 1)
        self._change(len(self.decisions))

    def decide(self) -> Decision:
        """Make the next decision and write it down."""
        index = len(self.decisions)
        for subscriber in self.subscribers:
            subscriber.on_instance(index)
        instance = self.instance(index)
        start = Start(self.envs[instance.task], instance)
        context = self._context(instance, loaded=True)
        choice = self.selector.select(context)
        for subscriber in self.subscribers:
            subscriber.on_choice(index, choice.policy)
        self.drivers.trust(choice.propensities)
        outcome, others, alone = self._episode(index, instance, start, choice.policy, chosen=True), dict[str, Outcome](), None
        if self._others is not None:
            rest = [policy for policy in self.selector.policies if policy != choice.policy]
            others = {policy: self._episode(index, instance, start, policy, chosen=False) for policy in rest}
            if self.monitor is not None:
                alone = self._episode(index, instance, start, choice.policy, chosen=False)
        decision = self.write(instance, choice, Played(outcome, start.scene, others, alone))
        self._learn(context, choice, decision)
        self.look_back(decision)
        return decision

    def write(self, instance: Instance, choice: Choice, played: Played) -> Decision:
        """Write the next decision down, with what came of it."""
        index, place = len(self.decisions), f"{self._journal.file}, line {len(self.decisions) + 1}"
        decision = self._decision(index, instance, choice, played.outcome, played.scene if self._tells_scenes else None)
        # What a suite or a selector of others got wrong is told now, not when the journal is read.
        to_decision(as_read(decision.to_dict(), place), index, self._journal.file)
        rewards, checksums = {choice.policy: decision.reward}, {JOURNAL: line_digest(decision.to_dict())}
        if self._others is not None:
            others = Others(index, played.others, {policy: self.reward(other) for policy, other in played.others.items()}, *self._alone(played))
            rewards |= others.rewards
            self._checked_others(as_read(others.to_dict(), f"{self._others.file}, line {index + 1}"), index, choice.policy)
            self._others.append(others.to_dict())
            checksums[COUNTERFACTUAL] = line_digest(others.to_dict())
        if self.monitor is not None:
            checksums[POINTS] = self.monitor.write(decision)
        for subscriber in self.subscribers:
            subscriber.on_decision(decision, rewards)
            subscriber.on_lines(index, checksums)
        # The journal comes last: what it does not have did not happen.
        self._journal.append(decision.to_dict())
        self.decisions.append(decision)
        self._rows.append(rewards)
        return decision

    def look_back(self, decision: Decision) -> None:
        """What follows a decision that the selector has learned from."""
        if self.monitor is not None:
            self.monitor.learn(decision)
        for warning in self._watch.see(decision):
            self.warnings.append(warning)
            for subscriber in self.subscribers:
                subscriber.on_warning(warning)
        self._choose_encoder(decision.index + 1)
        if self._change(decision.index + 1):
            self._tell_changes(decision.index + 1)

    def instance_keys(self, count: int) -> frozenset[str]:
        """Keys of the instances of the first `count` decisions."""
        return frozenset(self.instance(index).key for index in range(count))

    def close(self) -> None:
        """Close the files and the environments, and write the contexts. May be called twice."""
        self.cache.save()
        self.envs.close()
        for lines in (self._journal, self._others, self.monitor):
            if lines is not None:
                lines.close()

    def _episode(self, index: int, instance: Instance, start: Start, policy: str, chosen: bool) -> Outcome:
        """One policy on the instance, from its beginning; the chosen one with the monitor."""
        start.again()
        watching = [listener for subscriber in self.subscribers for listener in subscriber.watch(index, policy, chosen)]
        env, fallback = self.envs[instance.task], self.drivers.fallback(policy)
        handoffs = None
        if chosen and self.monitor is not None:
            handoffs = self.monitor.handoffs(self.drivers, env.specification.horizon or self._horizons[instance.task])
            watching.append(self.monitor.watch())
        return run_episode(env, instance, self.drivers[policy], fallback, watching, action_noise=self.options.action_noise, handoffs=handoffs)

    def _alone(self, played: Played) -> tuple[Outcome, float | None] | tuple[()]:
        """What the chosen policy comes to without the monitor, with its reward; nothing where there is none."""
        if played.alone is None:
            return ()
        self.alone.append(self.reward(played.alone))
        return played.alone, self.alone[-1]

    def instance(self, index: int) -> Instance:
        """What a decision is about."""
        options = self.options
        chance = np.random.default_rng([options.seed, index])
        tasks, levels = robots_share(self.tasks, options.levels, index % options.robots, options.robots, options.robots_by)
        task = tasks[int(chance.integers(len(tasks)))]
        level = levels[int(chance.integers(len(levels)))]
        return task.instance(options.seed * SEEDS_PER_RUN + index, level, options.split, options.axes)

    def _check(self, decision: Decision, instance: Instance) -> None:
        """Refuse a decision of the journal that is not about this instance, or has another reward than its outcome comes to."""
        place = f"{self._journal.file}, line {decision.index + 1}"
        for name, now in _about(instance).items():
            if (then := getattr(decision, name)) != now:
                raise DataError(f"{place}: {name} is {then!r}, of the run's instance it is {now!r}: damaged, or made with other versions")
        check_reward(decision.reward, decision.outcome, self.options.weights, place)

    def _checked_others(self, data: dict[str, Any], index: int, chosen: str) -> Others:
        """A line about the policies that were not chosen."""
        file = self.folder / COUNTERFACTUAL
        others = to_others(data, index, file, self.selector.policies, chosen)
        for policy, outcome in others.outcomes.items():
            check_reward(others.rewards[policy], outcome, self.options.weights, f"{file}, line {index + 1}: {policy}")
        if others.alone is not None:
            check_reward(others.alone_reward, others.alone, self.options.weights, f"{file}, line {index + 1}: alone")
        return others

    def _context(self, instance: Instance, loaded: bool) -> NDArray[np.float32]:
        for encoder in self.options.trial.tried if self.options.trial is not None else ():
            self._encoded(encoder, instance, loaded)
        return self._shown(instance, loaded)

    def _shown(self, instance: Instance, loaded: bool = False) -> NDArray[np.float32]:
        return self.shown(self._encoded(self.encoder, instance, loaded), instance)

    def shown(self, context: NDArray[np.float32], instance: Instance) -> NDArray[np.float32]:
        """The encoder's context of an instance as the selector is shown it."""
        return np.concatenate([context, name_part(instance.task)]) if self.options.context else context

    def _encoded(self, encoder: Encoder, instance: Instance, loaded: bool = False) -> NDArray[np.float32]:
        def images() -> list[NDArray[np.uint8]]:
            env = self.envs[instance.task]
            if not loaded:
                env.load(instance)
            return view(env, encoder)

        return self.cache.encode(encoder, instance.key, images, instance.instruction)

    def _choose_encoder(self, count: int) -> None:
        """Go on with the encoder that the first so many decisions speak for, where it is to be asked after them."""
        if (trial := self.options.trial) is None or not trial.due(count):
            return
        decisions, instances = self.decisions[:count], [self.instance(index) for index in range(count)]
        found = trial.ask(decisions, self.selector.policies, lambda encoder: np.stack([self._encoded(encoder, item) for item in instances]))
        if found is not self.encoder:
            self.encoder = found
            self.selector, self._changes = trial.make(found)
            tell_again(self.selector, self._changes, decisions, [self._shown(item) for item in instances], self._learn)

    def reward(self, outcome: Outcome) -> float | None:
        """What the selector learns of an outcome; None of an error."""
        return None if outcome.error is not None else reward(outcome, self.options.weights)

    def _learn(self, context: NDArray[np.float32], choice: Choice, decision: Decision) -> None:
        if isinstance(self.selector, Pays):
            self.selector.pay(decision.policy, decision.price)
        if decision.reward is not None:  # an error teaches nothing
            self.selector.update(context, choice, decision.reward)

    def _change(self, index: int) -> bool:
        """Let policies join and leave before a decision. Returns whether any does."""
        changed = self._changes.apply(self.selector, index)
        self._ever = tuple(dict.fromkeys([*self._ever, *(change.policy for change in changed)]))
        return bool(changed)

    def _tell_changes(self, index: int) -> None:
        for change in self._changes.made:
            for subscriber in self.subscribers if change.before == index else ():
                subscriber.on_event(change)

    def _decision(self, index: int, instance: Instance, choice: Choice, outcome: Outcome, scene: str | None) -> Decision:
        own: dict[str, Any] = {key: value for key, value in vars(outcome).items() if key not in ("fallback", "error")}
        return Decision(
            index=index,
            policy=choice.policy,
            propensities=dict(choice.propensities),
            reward=self.reward(outcome),
            fallback=outcome.fallback,
            error=outcome.error,
            scene=scene,
            **_about(instance),
            **own,
        )


def _about(instance: Instance) -> dict[str, Any]:
    """What a decision says of its instance."""
    names = ("task", "seed", "level", "axes", "split", "instruction", "phrasing", "target", "container")
    return {**{name: getattr(instance, name) for name in names}, "robot": instance.other_robot}


MakeDecisions = Callable[[LiveRun, int, Callable[[], bool]], None]
"""Makes the decisions of a run until there are so many, or the function last given says to stop."""


def one_after_another(run: LiveRun, decisions: int, stop: Callable[[], bool]) -> None:
    """Make them in this process."""
    while len(run.decisions) < decisions and not stop():
        run.decide()
