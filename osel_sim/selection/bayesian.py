"""Bayesian linear regression of each policy's reward on features of the context, and choosing by it."""

import math
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.change_point import PIECES, change_point
from osel_sim.selection.features import Array, Features, Part, Sketch, warm_table
from osel_sim.selection.regression import Moments, SharedRegression, fit
from osel_sim.selection.shared_rows import SharedRows, part_of
from osel_sim.selection.skills import DECLARED, NOT_DECLARED, UNKNOWN, Skills
from osel_sim.statistics.best import probability_of_best

MEAN = 1.0
"""Prior variance of a policy's mean reward, its own and what all have in common, relative to the noise: one decision outweighs it."""

DEVIATION = 0.5
"""Standard deviation of rewards to expect before any two have differed: that of a success with probability 1/2."""

FEW = 12.0
"""A policy's mean after n decisions is drawn with 1 + FEW * n / (n + 1)^2 times the Gaussian's variance: a success is not Gaussian at all, so that
after two failures that would be far too sure of the next, and policies that had bad luck at first would never be tried again."""

NOTHING = 1e-6
"""Prior variance, relative to the noise, of what is not there; 0 could not be inverted."""

GROWTH = 1.25
"""Features and evidence are computed afresh whenever there are this many times as many decisions."""

LOOK = 32
"""Between fits a change is looked for whenever so many decisions more were made, or about a thirtieth of all where that is more."""


@dataclass(frozen=True)
class Prior:
    """What a `BayesianSelector` is told before its first decision, and how it explores.

    Attributes:
        signals: candidates for the prior variance of how policies differ by context, relative to the noise, > 0; a signal of nothing is always one.
        shared: candidates for the prior variance of what contexts change for all policies alike, relative to the noise, >= 0.
        optimism, chance: weights of two ways to explore what a policy's success in this context is, >= 0.
        mean_optimism, mean_chance: the same for what its success is in any context.
        floor: the probability with which the n-th choice is made at random is floor / sqrt(n), half at most; in [0, 1].
        least: it is never below that, so that a policy that nobody chooses any more is seen to become better; in [0, 1].
        alarm: what was seen before a change is forgotten once rewards are so many times as probable with it as without; > 1, infinite for never.
        expected_costs: policy -> what of its reward is known beforehand, alpha_time * time + alpha_price * price, so that only success must be
            learned (`episodes.expected_costs` computes them from policy files). May name policies to be added later. None: learned with the rest.
        warm_contexts: (n, context_dim) contexts without outcomes, from which features are learned before the first decision; None starts cold.
        skills: what policies are said to be able to do, as a first guess of their success; None: nothing is said. They look at the first part only.
        parts: lengths of the two parts of a context, such as the encoder's and the task's; empty where it is one whole.

    Raises:
        UsageError: a number out of range.
    """

    signals: Sequence[float]
    shared: Sequence[float] = (0.0,)
    optimism: float = 0.0
    chance: float = 0.0
    mean_optimism: float = 0.0
    mean_chance: float = 0.0
    floor: float = 0.0
    least: float = 0.0
    alarm: float = math.inf
    expected_costs: Mapping[str, float] | None = None
    warm_contexts: ArrayLike | None = None
    skills: Skills | None = None
    parts: Sequence[int] = ()

    def __post_init__(self) -> None:
        for name in ("optimism", "chance", "mean_optimism", "mean_chance"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"{name} must be finite and >= 0, got {value}")
        if not self.alarm > 1.0:
            raise UsageError(f"alarm must be greater than 1, got {self.alarm}")
        for name in ("floor", "least"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{name} must lie in [0, 1], got {getattr(self, name)}")
        if not self.signals or not all(math.isfinite(signal) and signal > 0.0 for signal in self.signals):
            raise UsageError(f"signals must be one or more finite numbers > 0, got {list(self.signals)}")
        if self.parts and (len(self.parts) != 2 or min(self.parts) < 1):
            raise UsageError(f"parts must be two lengths of at least 1, or none, got {list(self.parts)}")
        if not self.shared or not all(math.isfinite(signal) and signal >= 0.0 for signal in self.shared):
            raise UsageError(f"shared must be one or more finite numbers >= 0, got {list(self.shared)}")

    @property
    def numbers(self) -> dict[str, Any]:
        """How it explores and what it considers, as JSON values."""
        lists = {"signals": [float(value) for value in self.signals], "shared": [float(value) for value in self.shared]}
        parts = {"parts": list(self.parts)} if self.parts else {}
        alarm = {"alarm": float(self.alarm)} if math.isfinite(self.alarm) else {}
        weights = {name: float(getattr(self, name)) for name in ("optimism", "chance", "mean_optimism", "mean_chance", "floor")}
        least = {"least": float(self.least)} if self.least else {}
        return {**lists, **weights, **parts, **alarm, **least}


class BayesianSelector(SharedRows, SelectorBase):
    """Regresses reward plus declared cost on features of the context and chooses by mean, uncertainty and chance.

    Model: reward + cost = mean of all + mean of the policy + (shared + own of the policy) . features + noise, all Gaussian
    (`osel_sim.selection.regression`). How much the context matters, to all policies alike and to the differences between them, and how large the
    noise is, is learned from the evidence. Where the context does not help its weights go to nothing, and what remains is a bandit on the
    policies' means. With declared skills every mean is two, one where the policy declares what is asked for and one where it does not.

    Rewards are measured from their centre and in units of their standard deviation, so that their scale and offset change nothing.

    Of a policy's variance one part would be there without any context, that of its mean by as many decisions: `mean`. The rest is the `context`'s.
    A policy's score is its expected reward + mean_optimism * sqrt(mean) + optimism * sqrt(context) + a normal variable of variance
    mean_chance^2 * mean * (1 + FEW * n / (n + 1)^2) + chance^2 * context, n being its decisions, and the highest score is chosen:
    optimism alone is UCB, chance alone Thompson sampling.

    Whenever the number of decisions has grown by a quarter, features are fitted afresh to the contexts seen so far, and the regression is computed
    again on them; in between it is updated decision by decision. Where a context has two parts, features of the first, of both and of the second are
    fitted, and those of the highest evidence kept until the next time. Then, and every `LOOK` decisions between, it is asked whether some policy has
    become better or worse; if the evidence says so, the decisions before are forgotten (see `alarm` in `Prior`).

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        features: fresh ones, of this selector alone.
        prior: what it is told.

    Raises:
        UsageError: contexts of another form.
        UnknownNameError: `expected_costs` lacks a policy.
    """

    off_policy: ClassVar[bool] = True
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, features: Features, prior: Prior) -> None:
        super().__init__(policies, context_dim, seed)
        self._prior, self._skills = prior, prior.skills
        parts = tuple(prior.parts) or (context_dim,)
        if sum(parts) != context_dim:
            raise UsageError(f"parts {list(parts)} do not add up to the length of a context, {context_dim}")
        if self._skills is not None and self._skills.dimension != parts[0]:
            raise UsageError(f"the examples of skills have length {self._skills.dimension}, contexts {parts[0]}")
        costs = prior.expected_costs
        self._costs_declared = None if costs is None else {name: float(cost) for name, cost in costs.items()}
        self._costs = np.array([self._cost(name) for name in self.policies])
        self._sketch, self._first = Sketch(context_dim, parts), parts[0]
        self._warm, self._warm_digest = warm_table(prior.warm_contexts, context_dim, self._sketch)
        end = self._sketch.parts[0]
        seen = (slice(None, end), slice(None), slice(end, None)) if prior.parts else ()
        self._views: list[Features] = [Part(deepcopy(features), columns) for columns in seen] or [features]
        self._view = 0
        self._generator = np.random.default_rng(seed)
        self._guess = np.zeros(1) if self._skills is None else np.array([DECLARED, NOT_DECLARED])
        self._contexts: list[NDArray[np.float32]] = []
        self._heads: list[Array] = []
        self._chosen: list[int] = []
        self._targets: list[float] = []
        self._counts = np.zeros(len(self.policies), np.int64)
        self._known, self._next_fit = 0, 1
        self._seen: tuple[Context, NDArray[np.float32], Array] | None = None
        self._transformed: tuple[NDArray[np.float32], Array] | None = None
        self._centre, self._deviation, self._signal = 0.0, DEVIATION, 0.0
        self._regression: SharedRegression
        self._fit(0)

    @property
    def settings(self) -> dict[str, Any]:
        """What every selector of this kind has; subclasses add theirs."""
        told = {"expected_costs": self._costs_declared, "warm_contexts": self._warm_digest}
        return {**self._prior.numbers, **told, "skills": None if self._skills is None else self._skills.digest}

    @property
    def signal(self) -> float:
        """How much the context matters to the differences between policies by the evidence so far: variance relative to the noise."""
        self._catch_up()
        return self._signal

    @property
    def _features(self) -> Features:
        return self._views[self._view]

    def _select(self, context: Context) -> Choice:
        self._catch_up()
        prior, rows = self._prior, self._rows(context)
        means, variances = self._regression.predict(rows, self.columns)
        of_mean = np.minimum(variances, 1.0 / (self._counts + 1.0 / MEAN))
        of_context = variances - of_mean
        unit = self._deviation * math.sqrt(self._regression.noise)
        hope = unit * (prior.mean_optimism * np.sqrt(of_mean) + prior.optimism * np.sqrt(of_context))
        scores = self._deviation * (means + rows[:, : len(self._guess)] @ self._guess) - self._costs + hope - self._charged
        few = 1.0 + FEW * self._counts / (self._counts + 1.0) ** 2
        chance = prior.mean_chance**2 * few * of_mean + prior.chance**2 * of_context
        propensities = probability_of_best(scores[self.columns], (unit * np.sqrt(chance))[self.columns])
        random = max(prior.least, min(0.5, prior.floor / math.sqrt(len(self._chosen) + 1)))
        propensities = (1.0 - random) * propensities + random / len(propensities)
        index = int(self._generator.choice(len(self.policies), p=propensities))
        return Choice(self.policies[index], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _expected(self, context: Context) -> Array:
        self._catch_up()
        rows = self._rows(context)
        means, _ = self._regression.predict(rows)
        return np.asarray(self._deviation * (means + rows[:, : len(self._guess)] @ self._guess) - self._costs, np.float64)

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        sketched, heads = self._see(context)
        index = self.known.index(choice.policy)
        self._contexts.append(sketched)
        self._heads.append(heads[index].copy())
        self._chosen.append(index)
        self._counts[index] += 1
        self._targets.append(float(reward + self._costs[index]))
        self._note()

    def _catch_up(self) -> None:
        """Learn from what came since the last choice. Of several fits that are due only the last is computed, as nothing is left of those before: a
        warm start with thousands of outcomes is quick."""
        while self._next_fit <= (count := len(self._targets)):
            due = 0
            while self._next_fit <= count:
                due, self._next_fit = self._next_fit, max(self._next_fit + 1, math.ceil(self._next_fit * GROWTH))
            self._fit(due)
        for at in range(self._known, count):
            row = np.concatenate([self._heads[at], self._transform(self._contexts[at])[0]])
            target = self._standard(self._targets[at]) - float(self._heads[at] @ self._guess)
            self._regression.update(self._chosen[at], row, target)
        every = max(LOOK, 1 << (count // LOOK).bit_length() >> 1)  # a power of two of about a thirtieth of all
        if count > self._known and count % every == 0:
            self._look(count)
        self._known = len(self._targets)

    def _look(self, count: int) -> None:
        """Forget what was before a change that showed itself since the last fit."""
        if change := self._change(np.array(self._contexts, np.float64), np.array(self._chosen), self._standard(np.array(self._targets))):
            self._forget(count, change)

    def _forget(self, count: int, change: int) -> None:
        """Forget the first `change` of `count` decisions, and fit what is left."""
        for seen in (self._contexts, self._heads, self._chosen, self._targets):
            del seen[:change]
        self._counts = np.bincount(self._chosen, minlength=len(self._costs))
        self._next_fit = max(count - change + 1, math.ceil((count - change) * GROWTH))
        self._fit(count - change)

    def _fit(self, count: int) -> None:
        """Scale, features, evidence and regression from the first so many decisions; from the prior alone at first."""
        contexts = np.array(self._contexts[:count], np.float64).reshape(-1, self._sketch.dim)
        targets, chosen = np.array(self._targets[:count]), np.array(self._chosen[:count], np.int64)
        self._measure(chosen, targets)
        targets = self._standard(targets)
        found = []
        for view in range(len(self._views)):
            self._view = view
            self._fit_features(np.concatenate([self._warm, contexts]), contexts, chosen, targets)
            found.append(self._regress(contexts, chosen, targets))
        self._view = int(np.argmax([evidence for evidence, _, _ in found]))
        _, self._signal, self._regression = found[self._view]
        if change := self._change(contexts, chosen, targets):
            self._forget(count, change)
            return
        self._known, self._transformed = count, None

    def _change(self, contexts: Array, chosen: NDArray[np.int64], targets: Array) -> int:
        """How many of the decisions to forget: those before policies became better or worse than the contexts explain; 0 where nothing changed."""
        if not math.isfinite(self._prior.alarm) or len(chosen) < PIECES:
            return 0
        heads = np.array(self._heads[: len(targets)], np.float64)
        rows = np.concatenate([heads, self._features.transform(contexts)], axis=1)
        left = targets - heads @ self._guess - (rows * self._regression.weights[chosen]).sum(axis=1)
        return change_point(left, chosen, len(self._counts), self._regression.noise, self._prior.alarm)

    def _regress(self, contexts: Array, chosen: NDArray[np.int64], targets: Array) -> tuple[float, float, SharedRegression]:
        """Evidence for the features that there are now, how much they matter by it, and the regression on them."""
        heads = np.array(self._heads[: len(targets)], np.float64).reshape(-1, len(self._guess))
        rows = np.concatenate([heads, self._features.transform(contexts)], axis=1)
        moments = Moments.of(rows, chosen, targets - heads @ self._guess, len(self._costs))
        own = (NOTHING, *(float(signal) for signal in self._prior.signals)) if self._features.dim and len(targets) > 1 else (NOTHING,)
        shared = [max(NOTHING, float(signal)) for signal in self._prior.shared] if len(own) > 1 else [NOTHING]
        found = [regression for signal in own for regression in fit(moments, self._scale(signal), [self._scale(common) for common in shared])]
        most = max(regression.evidence for regression in found)
        weights = np.exp(np.array([regression.evidence for regression in found]) - most)
        evidence = most + math.log(weights.mean())
        weights = (weights / weights.sum()).reshape(len(own), len(shared))
        signal = float(weights.sum(axis=1) @ np.array(own))
        [regression] = fit(moments, self._scale(signal), [self._scale(float(weights.sum(axis=0) @ np.array(shared)))])
        return evidence, signal, regression

    def _fit_features(self, contexts: Array, own: Array, chosen: NDArray[np.int64], targets: Array) -> None:
        """Fit `features` to contexts, warm ones included; `own` are those decided on, `targets` (n,) what came of them, standardised."""
        if len(contexts):
            self._features.fit(contexts)

    def _measure(self, chosen: NDArray[np.int64], targets: Array) -> None:
        """Where rewards + costs lie and how far they spread. Until two of them differ the deviation is a guess, of which no choice depends."""
        if not len(targets):
            return
        # The mean over policies, not decisions: how good the most chosen one is says little of those hardly tried.
        counts, sums = (np.bincount(chosen, weights, len(self._costs)) for weights in (None, targets))
        self._centre = float(((sums + targets.mean()) / (counts + 1))[counts > 0].mean())
        deviation = math.sqrt(float(((targets - self._centre) ** 2).mean()))
        if deviation > 1e-9 * abs(self._centre):
            self._deviation = deviation

    def _standard(self, targets: Any) -> Any:
        return (targets - self._centre) / self._deviation

    def _scale(self, signal: float) -> Array:
        """Prior variances of a mean, or two, and of the features' weights."""
        return np.concatenate([np.full(len(self._guess), MEAN), np.full(self._features.dim, signal)])

    def _rows(self, context: Context) -> Array:
        """What the regression sees of a context, (P, 1 + dim): a constant for the mean, and the features.

        With skills (P, 2 + dim): how far a policy declares what is asked for, and how far not, instead of the constant.
        """
        sketched, heads = self._see(context)
        features = self._transform(sketched)
        return np.concatenate([heads, np.broadcast_to(features, (len(heads), features.shape[1]))], axis=1)

    def _see(self, context: Context) -> tuple[NDArray[np.float32], Array]:
        """A context's sketch, and the constants of its rows. `update` mostly asks for what `select` asked for before."""
        if self._seen is None or not np.array_equal(self._seen[0], context):
            share = np.ones((len(self._costs), 1)) if self._skills is None else self._skills.share(context[: self._first], self.known)[:, None]
            heads = share if self._skills is None else np.concatenate([share, 1.0 - share], axis=1)
            self._seen = context.copy(), np.array(self._sketch(context)), heads
        return self._seen[1:]

    def _transform(self, sketched: NDArray[np.float32]) -> Array:
        """Features of a context, (1, dim)."""
        if self._transformed is None or self._transformed[0] is not sketched:
            self._transformed = sketched, self._features.transform(sketched[None].astype(np.float64))
        return self._transformed[1]

    def _cost(self, policy: str) -> float:
        if self._costs_declared is None:
            return 0.0
        if policy not in self._costs_declared:
            raise UnknownNameError("policy", policy, self._costs_declared, "the expected costs of this selector")
        if not math.isfinite(self._costs_declared[policy]):
            raise UsageError(f"the expected cost of {policy!r} must be finite, got {self._costs_declared[policy]}")
        return self._costs_declared[policy]

    def tell(self, told: Mapping[str, Any]) -> None:
        """Take over `expected_costs` and `skills`. What was seen keeps what was believed when it was seen."""
        self._catch_up()
        costs, skills = told.get("expected_costs") or {}, told.get("skills")
        if self._costs_declared is not None:
            self._costs_declared |= {name: float(cost) for name, cost in costs.items()}
        if skills is not None and skills.dimension != self._first:
            raise UsageError(f"the examples of skills have length {skills.dimension}, contexts {self._first}")
        if skills is not None and self._skills is None:  # until now every policy was one that declares nothing
            self._guess, self._heads = np.array([DECLARED, NOT_DECLARED]), [np.array([UNKNOWN, 1.0 - UNKNOWN]) for _ in self._heads]
            self._fit(len(self._targets))
        self._skills, self._seen = skills or self._skills, None

    def _add_policy(self, name: str) -> None:
        if name in self.known:
            return
        self._catch_up()
        self._costs = np.append(self._costs, self._cost(name))
        self._counts = np.append(self._counts, 0)
        self._seen = None
        self._fit(len(self._targets))

    def _state(self) -> State:
        self._catch_up()
        return {
            "contexts": np.array(self._contexts, np.float32).reshape(-1, self._sketch.dim),
            "heads": np.array(self._heads, np.float64).reshape(-1, len(self._guess)),
            "chosen": np.array(self._chosen, np.int64),
            "targets": np.array(self._targets, np.float64),
            **({"view": self._view} if self._prior.parts else {}),
            "model": [self._centre, self._deviation, self._signal, self._next_fit],
            "random": self._generator.bit_generator.state,
            **self._fresh_state(),
            **{f"regression.{key}": value for key, value in self._regression.state().items()},
            **{f"features.{key}": value for key, value in self._features.state().items()},
        }

    def _load(self, state: State) -> None:
        self._contexts, self._heads = list(state["contexts"].copy()), list(state["heads"].copy())
        self._chosen, self._targets = state["chosen"].tolist(), state["targets"].tolist()
        self._counts = np.bincount(state["chosen"], minlength=len(self._costs))
        self._centre, self._deviation, self._signal, self._next_fit = state["model"]
        self._generator.bit_generator.state = state["random"]
        self._regression = SharedRegression(**{key: copy(value) for key, value in part_of(state, "regression.").items()})
        self._view = state.get("view", 0)
        self._features.load(part_of(state, "features."))
        self._known, self._seen, self._transformed = len(self._targets), None, None
        self._load_fresh(state)
