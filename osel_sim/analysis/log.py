"""A rollout log as arrays: what every policy did on every instance, and the instances' contexts."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.appended import TASK_NAME, own_encoder, parts_of, task_parts
from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.core.files import read_json
from osel_sim.formats.rollout_log import DECLARED, ROLLOUTS, Row, read_rollouts
from osel_sim.formats.run_config import RUN
from osel_sim.formats.shards import read_shards
from osel_sim.interface.outcome import stood_in
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.selection.reward import RewardWeights, combined, counted_time, total_seconds
from osel_sim.selection.skills import Skills

Array = NDArray[np.float64]
Half = Literal["choose", "score"]

MEASURES = ("success", "subgoals", "score", "steps", "upload", "inference", "download", "motion", "price")
"""Columns of the log that are kept as arrays."""

FLAGS = ("errors", "fallbacks", "solved_by_fallback")
"""What is kept of each episode as yes or no."""


@dataclass(frozen=True)
class LoggedInstance:
    """What an instance was about; a log from elsewhere may lack all but key and task.

    Attributes:
        robot: None where all of the log are the usual one's, or there is none.
        scene: digest of how the scene was set up; None where nobody told.
    """

    key: str
    task: str
    instruction: str | None = None
    phrasing: str | None = None
    target: str | None = None
    container: str | None = None
    seed: int | None = None
    level: int | None = None
    split: str | None = None
    robot: str | None = None
    scene: str | None = None

    @property
    def half(self) -> Half:
        """`choose` or `score`, by the hash of the key: the same in every log, on every machine, whatever else is in the log."""
        return "choose" if hashlib.sha256(self.key.encode()).digest()[0] & 1 else "score"


@dataclass(frozen=True)
class LoggedOutcomes:
    """N instances, P policies, up to R repeats each. An outcome that is missing, or ended in error, is NaN in every array: never a failure.

    Attributes:
        source: the folder it was read from.
        instances: (N,) in the order of the log.
        policies: (P,) names.
        contexts: float32 (N, D).
        encoder: identity of the encoder that made them.
        success: 1 or 0 for the goal, float64 (N, P, R), like all that follow; 0 where a fallback drove from the first call on.
        subgoals: fraction of the subgoals reached, likewise.
        score: a graded outcome, such as minus an action MSE.
        steps: control steps.
        upload, inference, download, motion: seconds.
        price: cents.
        errors: bool (N, P, R), the episode ended in error (the rest of what is NaN never ran).
        fallbacks: bool (N, P, R), a fallback took over.
        solved_by_fallback: bool (N, P, R), and reached the goal; a success of the policy asked as well only if that one drove before.
        metadata: of the log.
        skills: what its policies declared, in that encoder's eyes; None where the log does not say.
    """

    source: Path
    instances: tuple[LoggedInstance, ...]
    policies: tuple[str, ...]
    contexts: NDArray[np.float32]
    encoder: str
    success: Array
    subgoals: Array
    score: Array
    steps: Array
    upload: Array
    inference: Array
    download: Array
    motion: Array
    price: Array
    errors: NDArray[np.bool_]
    fallbacks: NDArray[np.bool_]
    solved_by_fallback: NDArray[np.bool_]
    metadata: dict[str, Any]
    skills: Skills | None = None

    def __len__(self) -> int:
        return len(self.instances)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the instances."""
        return tuple(instance.key for instance in self.instances)

    @property
    def repeats(self) -> int:
        """R: the most repeats that any (instance, policy) has."""
        return int(self.success.shape[2])

    @property
    def seconds(self) -> Array:
        """Seconds from instruction to end of each episode, (N, P, R), as `osel_sim.selection.reward.total_seconds`; NaN where unknown."""
        return total_seconds(self.upload, self.inference, self.download, self.motion)

    def rewards(self, weights: RewardWeights) -> Array:
        """Reward of every outcome, (N, P, R), as `osel_sim.selection.reward.reward`; NaN where there is no outcome.

        Raises:
            DataError: the log has outcomes, but lacks throughout what the weights ask for.
        """
        score: Array = getattr(self, weights.success)
        time, price = counted_time(weights, self.steps, self.seconds), self.price
        ran = np.isfinite(self.success)
        for name, values, weight, remedy in (
            (weights.success, score, 1.0, "choose success instead"),
            ("times" if weights.clock == "seconds" else "steps", time, weights.alpha_time, "give --alpha-time 0"),
            ("prices", price, weights.alpha_price, "give --alpha-price 0"),
        ):
            if weight > 0.0 and ran.any() and not np.isfinite(values).any():
                raise DataError(f"{self.source}: the log has no {name}, which the reward needs: {remedy}")
        return combined(weights, score, time, price)

    def expected_costs(self, weights: RewardWeights) -> dict[str, float]:
        """What a policy is charged for time and price on average where it succeeds: reward = success - cost.

        Stands for what `osel_sim.episodes.expected_costs` computes from a policy's file, which a log does not have. Of a policy that never succeeds
        it is the average over all its episodes; one without any valid outcome is left out.
        """
        score: Array = getattr(self, weights.success)
        costs = score - self.rewards(weights)
        known = np.isfinite(costs)
        solved = known & (self.success > 0.5)
        counted = np.where(solved.any(axis=(0, 2), keepdims=True), solved, known)
        return {policy: float(costs[:, column][counted[:, column]].mean()) for column, policy in enumerate(self.policies) if counted[:, column].any()}

    def mean_rewards(self, weights: RewardWeights) -> Array:
        """Mean reward over the repeats, (N, P); NaN where a policy has none on an instance."""
        return mean_over_repeats(self.rewards(weights))

    @property
    def parts(self) -> tuple[int, ...]:
        """Lengths of the encoder's own part of a context and of what is appended to it; empty where nothing is."""
        return parts_of(self.encoder, self.contexts.shape[1])

    def with_tasks(self) -> "LoggedOutcomes":
        """The same with the name of each instance's task appended to its context.

        Raises:
            UsageError: it is there already.
        """
        if self.encoder.endswith(TASK_NAME):
            raise UsageError(f"--context task: the contexts of {self.source} have the task already ({self.encoder})")
        appended = task_parts(self.labels("task"))
        return replace(self, contexts=np.concatenate([self.contexts, appended.parts], axis=1), encoder=self.encoder + appended.name)

    def half(self, which: Half) -> NDArray[np.bool_]:
        """Which instances, (N,), belong to a half: one to choose settings or policies by, the other to score them on."""
        return np.array([instance.half == which for instance in self.instances], bool)

    def first_half(self) -> NDArray[np.bool_]:
        """Which instances, (N,), are on one side of a cross-fit: those of the half `choose`; where all are of one half, a random half of them."""
        first = self.half("choose")
        if first.any() and not first.all():
            return first
        return np.asarray(np.random.default_rng(0).permutation(len(self)) % 2 == 0, bool)

    def labels(self, attribute: str) -> tuple[str, ...]:
        """An attribute of every instance (`task`, `target`, `phrasing` ...) as text, (N,); empty where the log does not have it."""
        values = (getattr(instance, attribute) for instance in self.instances)
        return tuple("" if value is None else str(value) for value in values)

    def take(self, rows: NDArray[Any] | Sequence[int]) -> "LoggedOutcomes":
        """Only these instances: indices, or a bool array (N,)."""
        index = np.asarray(rows)
        index = np.flatnonzero(index) if index.dtype == bool else index.astype(np.int64)
        arrays = {name: getattr(self, name)[index] for name in (*MEASURES, *FLAGS, "contexts")}
        return replace(self, instances=tuple(self.instances[row] for row in index), **arrays)

    def only(self, policies: Sequence[str]) -> "LoggedOutcomes":
        """Only these policies, in this order.

        Raises:
            UnknownNameError: the log does not have one of them.
            UsageError: none, or one twice.
        """
        for policy in policies:
            if policy not in self.policies:
                raise UnknownNameError("policy", policy, self.policies, f"the policies of {self.source}")
        if not policies or len(set(policies)) < len(policies):
            raise UsageError(f"give at least one policy, each once; got {', '.join(policies) or 'none'}")
        columns = [self.policies.index(policy) for policy in policies]
        return replace(self, policies=tuple(policies), **{name: getattr(self, name)[:, columns] for name in (*MEASURES, *FLAGS)})


def mean_over_repeats(values: Array) -> Array:
    """Mean over the last axis of what is not NaN, (N, P); NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=-1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def read_log(folder: Path, encoder: str | None = None) -> LoggedOutcomes:
    """Read a rollout log and its contexts.

    Args:
        folder: with `rollouts.parquet` and `contexts.npz`.
        encoder: whose contexts: an identity, or a name where only one identity is there.
            None: the one that the log was recorded with, else the only one.

    Raises:
        DataError: no log there, or it is empty, has an outcome twice, a value out of range, or no contexts.
    """
    rows, metadata = read_rollouts(folder)
    if not rows:
        raise DataError(f"{folder / ROLLOUTS}: the log has no rows")
    instances = tuple(dict.fromkeys(row.instance for row in rows))
    identity, contexts = read_contexts(folder, instances, encoder or metadata.get("encoder"))
    return _logged(folder, rows, metadata, identity, contexts, read_skills(folder, own_encoder(identity), metadata.get(DECLARED)))


def read_outcomes(folder: Path) -> LoggedOutcomes:
    """Read a rollout log without its contexts, which need not be there; they are (N, 0), of no encoder.

    Raises:
        DataError: as `read_log`.
    """
    rows, metadata = read_rollouts(folder)
    if not rows:
        raise DataError(f"{folder / ROLLOUTS}: the log has no rows")
    return _logged(folder, rows, metadata, "", np.zeros((len({row.instance for row in rows}), 0), np.float32), None)


def read_unfinished(folder: Path) -> tuple[LoggedOutcomes, list[Row]]:
    """What a recording that goes on, or was killed, has so far, and its rows; nothing in the folder is touched.

    Raises:
        DataError: it has no instance yet, or is damaged.
    """
    configuration = read_json(folder / RUN).get("configuration", {})
    rows, contexts = read_shards(folder)
    known = contexts.get(configuration.get("encoder", ""), {})
    found = [row for instance in known for row in rows.get(instance, {}).values()]
    if not found:
        raise DataError(f"{folder}: the recording has no instance yet")
    stacked = np.stack([known[instance] for instance in dict.fromkeys(row.instance for row in found)])
    return _logged(folder, found, configuration, str(configuration["encoder"]), stacked, None), found


def _logged(
    folder: Path, rows: Sequence[Row], metadata: dict[str, Any], encoder: str, contexts: NDArray[np.float32], skills: Skills | None
) -> LoggedOutcomes:
    """Rows as arrays, instances in the order in which they first appear; `contexts` are in that order."""
    scenes = {row.instance: row.scene for row in reversed(rows) if row.scene is not None}
    instances = {row.instance: replace(_instance(row), scene=scenes.get(row.instance)) for row in reversed(rows)}
    keys = tuple(dict.fromkeys(row.instance for row in rows))
    named = metadata.get("policies")
    policies = tuple(dict.fromkeys([*(named if isinstance(named, list) else []), *(row.policy for row in rows)]))
    policies = tuple(name for name in policies if name in {row.policy for row in rows})
    arrays = dense(folder, rows, keys, policies)
    robots = named_robots(instances[key] for key in keys)
    return LoggedOutcomes(folder, robots, policies, contexts, encoder, **arrays, metadata=metadata, skills=skills)


def named_robots(instances: Iterable[LoggedInstance]) -> tuple[LoggedInstance, ...]:
    """The instances, the usual robot named as well where there is another one."""
    found = tuple(instances)
    if not any(instance.robot for instance in found):
        return found
    return tuple(replace(instance, robot=instance.robot or DEFAULT_ROBOT) for instance in found)


def read_contexts(folder: Path, instances: Sequence[str], encoder: str | None) -> tuple[str, NDArray[np.float32]]:
    """Identity of the encoder and contexts (N, D) of these instances.

    Raises:
        DataError: no contexts there, of that encoder, or of an instance; or several encoders and none named.
    """
    from osel_sim.context.cache import FILE, ContextCache

    if not (folder / FILE).is_file():
        raise DataError(f"{folder / FILE} does not exist: the log has no contexts")
    cache = ContextCache(folder)
    known = cache.encoders()
    if encoder is None:
        if len(known) != 1:
            raise DataError(f"{cache.file} has contexts of {', '.join(known) or 'no encoder'}; name one with --encoder")
        encoder = known[0]
    contexts = cache.table(encoder, instances)
    if not np.isfinite(contexts).all():
        raise DataError(f"{cache.file}: contexts of {encoder!r} are not all finite")
    return cache.identity(encoder), np.ascontiguousarray(contexts, np.float32)


def read_skills(folder: Path, encoder: str, declared: Any) -> Skills | None:
    """What a log's policies declared, with the examples that lie among its contexts; None where it does not say, or lacks examples of this encoder.

    Args:
        encoder: identity.
        declared: policy -> names of skills, of the log's metadata.

    Raises:
        DataError: `declared` has another form.
    """
    from osel_sim.context.cache import ContextCache

    if declared is None:
        return None
    if not isinstance(declared, dict) or not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in declared.values()
    ):
        raise DataError(f"{folder / ROLLOUTS}: {DECLARED} in its metadata must be an object of lists of names, got {declared!r}")
    cache = ContextCache(folder)
    examples = {name: cache.examples(encoder, name) for name in cache.skills(encoder)}
    if not examples or not {name for names in declared.values() for name in names} <= set(examples):
        return None
    return Skills(examples, {policy: tuple(names) for policy, names in declared.items()})


def dense(source: Path, rows: Sequence[Row], instances: Sequence[str], policies: Sequence[str]) -> dict[str, Any]:
    """Rows as one (N, P, R) array a measure and a flag.

    Raises:
        DataError: an outcome twice, or a number that is NaN, infinite or of the wrong sign.
    """
    at_instance = {key: index for index, key in enumerate(instances)}
    at_policy = {name: index for index, name in enumerate(policies)}
    at_repeat = {number: index for index, number in enumerate(sorted({row.repeat for row in rows}))}
    shape = (len(instances), len(policies), len(at_repeat))
    arrays = {name: np.full(shape, np.nan) for name in MEASURES}
    flags, seen = {name: np.zeros(shape, bool) for name in FLAGS}, np.zeros(shape, bool)
    for row in rows:
        place = at_instance[row.instance], at_policy[row.policy], at_repeat[row.repeat]
        if seen[place]:
            raise DataError(f"{source / ROLLOUTS}: instance {row.instance!r}, policy {row.policy!r}, repeat {row.repeat} is there twice")
        seen[place] = True
        flags["fallbacks"][place] = row.fallback is not None
        if row.error is not None:
            flags["errors"][place] = True
            continue
        flags["solved_by_fallback"][place] = row.fallback is not None and row.success
        for name in MEASURES:
            value = getattr(row, name)
            if value is None:
                continue
            number = 0.0 if name in ("success", "subgoals") and stood_in(row) else float(value)
            if not np.isfinite(number) or (number < 0.0 and name not in ("subgoals", "score")):
                raise DataError(f"{source / ROLLOUTS}: instance {row.instance!r}, policy {row.policy!r}: {name} is {number}")
            arrays[name][place] = number
    return {**arrays, **flags}


def _instance(row: Row) -> LoggedInstance:
    return LoggedInstance(row.instance, row.task, row.instruction, row.phrasing, row.target, row.container, row.seed, row.level, row.split, row.robot)
