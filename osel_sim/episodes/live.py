"""The live loop: instance, context, choice, episode, reward, learning; one decision after another."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.episodes.drivers import Drivers
from osel_sim.episodes.loop import Subscriber, run_episode
from osel_sim.episodes.subscribers import RealTime, Timing
from osel_sim.episodes.video import Video
from osel_sim.episodes.view import view
from osel_sim.formats.journal import Decision, Lines, to_decision
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.outcome import Outcome
from osel_sim.interface.selector import Choice, Selector
from osel_sim.selection.reward import RewardWeights, reward

if TYPE_CHECKING:
    from osel_sim.interface.encoder import Encoder
    from osel_sim.sim.instance import Instance
    from osel_sim.sim.task_envs import TaskEnvs

SEEDS_PER_RUN = 1_000_000
"""Decision t of run seed s is made on the instance of seed s * 1,000,000 + t: no two runs share an instance."""

JOURNAL, TIMING, COUNTERFACTUAL = "episodes.jsonl", "timing.jsonl", "counterfactual.jsonl"


@dataclass(frozen=True)
class LiveOptions:
    """What a live run does, besides the parts it is made of.

    Attributes:
        counterfactual: also run the policies that were not chosen, from the same snapshot, for comparison only.
        video: indices of the decisions to film.
        realtime: sleep so that control steps happen at 20 Hz.
        levels: of which each instance has one, at random.
        axes: axis -> level, where it differs from the instance's level.
        action_noise: as `run_episode` takes it.
    """

    seed: int
    levels: tuple[int, ...] = (0,)
    split: str = "test"
    counterfactual: bool = False
    video: frozenset[int] = frozenset()
    realtime: bool = False
    axes: Mapping[str, int] = field(default_factory=dict)
    action_noise: float = 0.0


class LiveRun:
    """One run in one folder. Made on a folder with a journal, it learns from that first and goes on after it.

    Attributes:
        decisions: all so far.
        rewards: of every policy (columns) in every decision (rows), NaN where there is none; only chosen ones without `counterfactual`.
    """

    def __init__(
        self,
        folder: Path,
        tasks: Sequence[TaskSpec],
        envs: "TaskEnvs",
        encoder: "Encoder",
        drivers: Drivers,
        selector: Selector,
        weights: RewardWeights,
        options: LiveOptions,
    ) -> None:
        from osel_sim.context.cache import ContextCache

        self.folder, self.tasks, self.envs, self.encoder, self.cache = folder, tasks, envs, encoder, ContextCache(folder)
        self.drivers, self.selector, self.weights, self.options = drivers, selector, weights, options
        self._journal = Lines(folder / JOURNAL)
        self.decisions = [to_decision(data, index, self._journal.file) for index, (data, _) in enumerate(self._journal.rows)]
        self._timing = Lines(folder / TIMING, keep=len(self.decisions))
        self._others = Lines(folder / COUNTERFACTUAL, keep=len(self.decisions)) if options.counterfactual else None
        self._rows: list[list[float]] = []

    @property
    def rewards(self) -> NDArray[np.float64]:
        """(decisions, policies), in the order of the selector's policies."""
        return np.array(self._rows, np.float64).reshape(-1, len(self.selector.policies))

    def replay(self) -> None:
        """Let the selector live through the journal, so that it is what it was when the run was cut off.

        Raises:
            DataError: the selector decides otherwise than the journal says, or a line about the other policies is missing.
        """
        for decision in self.decisions:
            instance = self._instance(decision.index)
            context = self._context(instance, loaded=False)
            choice = self.selector.select(context)
            if choice.policy != decision.policy or choice.propensities != decision.propensities:
                raise DataError(
                    f"{self._journal.file}, line {decision.index + 1}: says {decision.policy!r} was chosen, this selector now chooses "
                    f"{choice.policy!r} with {choice.propensities}: the run was made with other versions or on another machine"
                )
            self._learn(context, choice, decision.reward)
            known = {decision.policy: decision.reward}
            if self._others is not None:
                if decision.index >= len(self._others.rows):
                    raise DataError(f"{self._others.file}: line {decision.index + 1} is missing, which the journal has")
                known |= {name: other["reward"] for name, other in self._others.rows[decision.index][0]["policies"].items()}
            self._remember(known)

    def decide(self) -> Decision:
        """Make the next decision and write it down."""
        start = time.perf_counter()
        index = len(self.decisions)
        instance = self._instance(index)
        env = self.envs[instance.task]
        env.load(instance)
        snapshot = env.snapshot()
        context = self._context(instance, loaded=True)
        choice = self.selector.select(context)
        selected = time.perf_counter()
        timings: dict[str, Timing] = {}

        def run(policy: str, chosen: bool) -> Outcome:
            env.restore(snapshot)
            timings[policy] = Timing()
            listeners = [timings[policy], *self._listeners(index, policy)] if chosen else [timings[policy]]
            return run_episode(env, instance, self.drivers[policy], self.drivers.fallback(policy), listeners, action_noise=self.options.action_noise)

        outcome = run(choice.policy, chosen=True)
        decision = self._decision(index, instance, choice, outcome)
        rewards = {choice.policy: decision.reward}
        if self._others is not None:
            others = {policy: run(policy, chosen=False) for policy in self.selector.policies if policy != choice.policy}
            rewards |= {policy: self._reward(other) for policy, other in others.items()}
            self._others.append(
                {"index": index, "policies": {policy: {**other.to_dict(), "reward": rewards[policy]} for policy, other in others.items()}}
            )
        self._timing.append(
            {
                "index": index,
                "seconds": time.perf_counter() - start,
                "context_and_choice": selected - start,
                "episodes": {policy: {"seconds": timing.seconds, "calls": timing.calls} for policy, timing in timings.items()},
            }
        )
        # The journal comes last: what it does not have did not happen.
        self._journal.append(decision.to_dict())
        self.decisions.append(decision)
        self._remember(rewards)
        self._learn(context, choice, decision.reward)
        return decision

    def instance_keys(self, count: int) -> frozenset[str]:
        """Keys of the instances of the first `count` decisions."""
        return frozenset(self._instance(index).key for index in range(count))

    def close(self) -> None:
        """Close the files and write the contexts."""
        self.cache.save()
        for lines in (self._journal, self._timing, self._others):
            if lines is not None:
                lines.close()

    def _instance(self, index: int) -> "Instance":
        from osel_sim.sim.instance import make_instance

        options = self.options
        chance = np.random.default_rng([options.seed, index])
        task = self.tasks[int(chance.integers(len(self.tasks)))]
        level = options.levels[int(chance.integers(len(options.levels)))]
        return make_instance(task, options.seed * SEEDS_PER_RUN + index, level, options.split, options.axes)

    def _context(self, instance: "Instance", loaded: bool) -> NDArray[np.float32]:
        def images() -> list[NDArray[np.uint8]]:
            env = self.envs[instance.task]
            if not loaded:
                env.load(instance)
            return view(env, self.encoder)

        return self.cache.encode(self.encoder, instance.key, images, instance.instruction)

    def _listeners(self, index: int, policy: str) -> Sequence[Subscriber]:
        listeners: list[Subscriber] = []
        if index in self.options.video:
            listeners.append(Video(self.folder / "videos" / f"{index:05d}-{policy}.mp4"))
        if self.options.realtime:
            listeners.append(RealTime())
        return listeners

    def _reward(self, outcome: Outcome) -> float | None:
        return None if outcome.error is not None else reward(outcome, self.weights)

    def _learn(self, context: NDArray[np.float32], choice: Choice, value: float | None) -> None:
        if value is not None:  # an error teaches nothing
            self.selector.update(context, choice, value)

    def _remember(self, rewards: dict[str, float | None]) -> None:
        row = [rewards.get(policy) for policy in self.selector.policies]
        self._rows.append([float("nan") if value is None else value for value in row])

    def _decision(self, index: int, instance: "Instance", choice: Choice, outcome: Outcome) -> Decision:
        own: dict[str, Any] = {key: value for key, value in vars(outcome).items() if key not in ("fallback", "error")}
        return Decision(
            index=index,
            task=instance.task,
            seed=instance.seed,
            level=instance.level,
            axes=instance.axes,
            split=instance.split,
            instruction=instance.instruction,
            phrasing=instance.phrasing,
            target=instance.target,
            container=instance.container,
            policy=choice.policy,
            propensities=dict(choice.propensities),
            reward=self._reward(outcome),
            fallback=outcome.fallback,
            error=outcome.error,
            robot=instance.other_robot,
            **own,
        )
