"""Bayesian linear regression of each policy's reward on features of the context, and choosing by it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.core.files import content_digest
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.features import Array, Features, Sketch
from osel_sim.selection.skills import DECLARED, NOT_DECLARED, Skills
from osel_sim.statistics.best import probability_of_best

INTERCEPT = 0.5
"""Prior variance of a policy's mean reward, in units of the noise. Strong: no context is needed to find the best single policy."""

NOISE, NOISE_WEIGHT = 0.2, 4.0
"""Prior guess of the noise's variance (a success of probability 0.3 to 0.7 has 0.2) and how many decisions that guess is worth."""

CENTRE = 0.5
"""Prior guess of a policy's reward + cost, worth one decision: as many successes as failures."""

GROWTH = 1.25
"""Features and evidence are computed afresh whenever there are this many times as many decisions."""

WARM = 2000
"""Of more warm contexts than these, evenly spaced ones are taken."""


@dataclass(frozen=True)
class Prior:
    """What a `BayesianSelector` is told before its first decision, and how it explores.

    Attributes:
        signals: candidates for the prior variance of w relative to the noise, > 0.
        optimism, chance: weights of the two ways to explore, >= 0.
        expected_costs: policy -> what of its reward is known beforehand, alpha_time * time + alpha_price * price, so that only success must be
            learned (`episodes.expected_costs` computes them from policy files). May name policies to be added later. None: learned with the rest.
        warm_contexts: (n, context_dim) contexts without outcomes, from which features are learned before the first decision; None starts cold.
        skills: what policies are said to be able to do, as a first guess of their success; None: nothing is said.

    Raises:
        UsageError: a number out of range.
    """

    signals: Sequence[float]
    optimism: float = 0.0
    chance: float = 0.0
    expected_costs: Mapping[str, float] | None = None
    warm_contexts: ArrayLike | None = None
    skills: Skills | None = None

    def __post_init__(self) -> None:
        for name, value in (("optimism", self.optimism), ("chance", self.chance)):
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"{name} must be finite and >= 0, got {value}")
        if not self.signals or not all(math.isfinite(signal) and signal > 0.0 for signal in self.signals):
            raise UsageError(f"signals must be one or more finite numbers > 0, got {list(self.signals)}")


class BayesianSelector(SelectorBase):
    """Regresses reward plus declared cost on features of the context and chooses by mean, uncertainty and chance.

    Model: reward + cost = centre + a_policy + w_policy . features + noise, all Gaussian. How much the context matters (the variance of w) and how
    large the noise is are learned from the evidence. Where the context does not help that variance goes to nothing, and what remains is a bandit on
    the policies' means. With declared skills there are two centres and two a_policy, for what a policy declares and for what it does not.

    A policy's score is mean + deviation * (`optimism` * sqrt(1 + log(1 + n) / 4) + `chance` * standard normal), n being how many decisions told about
    contexts like this one, and the highest score is chosen: optimism alone is UCB, chance alone Thompson sampling. The logarithm makes sure that a
    policy that was unlucky at first is tried again.

    Whenever the number of decisions has grown by a quarter, features are fitted afresh to the contexts seen so far, and the regression is computed
    again on them; in between it is updated decision by decision.

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        features: fresh ones, of this selector alone.
        prior: what it is told.

    Raises:
        UsageError: contexts of another form.
        UnknownNameError: `expected_costs` lacks a policy.
    """

    off_policy: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, features: Features, prior: Prior) -> None:
        super().__init__(policies, context_dim, seed)
        self._skills = prior.skills
        if self._skills is not None and self._skills.dimension != context_dim:
            raise UsageError(f"the examples of skills have length {self._skills.dimension}, contexts {context_dim}")
        costs = prior.expected_costs
        self._costs_declared = None if costs is None else {name: float(cost) for name, cost in costs.items()}
        self._costs = np.array([self._cost(name) for name in self.policies])
        self._signals = [float(signal) for signal in prior.signals]
        self.optimism, self.chance = float(prior.optimism), float(prior.chance)
        self._sketch = Sketch(context_dim)
        self._warm, self._warm_digest = self._check_warm(prior.warm_contexts)
        self._features = features
        self._generator = np.random.default_rng(seed)
        self._contexts: list[NDArray[np.float32]] = []
        self._head_count = 1 if self._skills is None else 2
        self._heads: list[Array] = []
        self._chosen: list[int] = []
        self._targets: list[float] = []
        self._signal, self._noise, self._next_fit = float(np.mean(self._signals)), NOISE, 2
        # Of each policy's intercept(s) and weights, (policies, rows) and (policies, rows, rows); the covariances relative to the noise.
        self._means, self._covariances = np.zeros((0, 0)), np.zeros((0, 0, 0))
        self._fit()

    @property
    def settings(self) -> dict[str, Any]:
        """What every selector of this kind has; subclasses add theirs."""
        return {
            "signals": self._signals,
            "optimism": self.optimism,
            "chance": self.chance,
            "expected_costs": self._costs_declared,
            "warm_contexts": self._warm_digest,
            "skills": None if self._skills is None else self._skills.digest,
        }

    @property
    def signal(self) -> float:
        """How much the context matters by the evidence so far: prior variance of a feature's weight relative to the noise."""
        return self._signal

    def _select(self, context: Context) -> Choice:
        rows = self._rows(context, self._sketch(context))
        variances = np.maximum(((self._covariances @ rows[:, :, None])[:, :, 0] * rows).sum(axis=1), 1e-12)
        deviations = np.sqrt(self._noise * variances)
        # 1 / variance is how many decisions, this policy's, told about contexts like this one.
        optimism = self.optimism * math.sqrt(1.0 + 0.25 * math.log1p((1.0 / variances).sum()))
        scores = (self._means * rows).sum(axis=1) - self._costs + optimism * deviations
        propensities = probability_of_best(scores, self.chance * deviations)
        index = int(self._generator.choice(len(self.policies), p=propensities))
        return Choice(self.policies[index], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        sketched, index = self._sketch(context), self.policies.index(choice.policy)
        row = self._rows(context, sketched)[index]
        target = reward + self._costs[index]
        self._contexts.append(np.array(sketched))
        self._heads.append(row[: self._head_count].copy())
        self._chosen.append(index)
        self._targets.append(float(target))
        if len(self._targets) >= self._next_fit:
            self._fit()
            self._next_fit = math.ceil(len(self._targets) * GROWTH)
            return
        step = self._covariances[index] @ row
        variance = 1.0 + float(step @ row)
        self._means[index] += step * ((target - self._means[index] @ row) / variance)
        self._covariances[index] -= np.outer(step, step / variance)

    def _fit(self) -> None:
        """Features, evidence and regression from all that was seen; from the prior alone at first."""
        contexts = np.array(self._contexts, np.float64).reshape(-1, self._sketch.dim)
        targets, chosen = np.array(self._targets), np.array(self._chosen, np.int64)
        self._fit_features(np.concatenate([self._warm, contexts]), contexts, chosen, targets)
        heads = np.array(self._heads, np.float64).reshape(-1, self._head_count)
        rows = np.concatenate([heads, self._features.transform(contexts)], axis=1)
        if self._skills is None:
            # The mean over policies, not decisions: how good the most chosen one is says little of those hardly tried.
            counts, sums = (np.bincount(chosen, weights, len(self._costs)) for weights in (None, targets))
            prior = np.array([((sums + CENTRE) / (counts + 1)).mean()])
        else:
            prior = np.array([DECLARED, NOT_DECLARED])
        targets = targets - heads @ prior
        parts = [(rows[chosen == policy], targets[chosen == policy]) for policy in range(len(self._costs))]
        moments = np.stack([part.T @ part for part, _ in parts])
        vectors = np.stack([part.T @ target for part, target in parts])
        if len(targets):
            evidence, noises = np.array([self._evidence(moments, vectors, targets, signal) for signal in self._signals]).T
            weights = np.exp(evidence - evidence.max())
            weights /= weights.sum()
            self._signal, self._noise = float(weights @ np.array(self._signals)), float(weights @ noises)
        scale = self._scale(self._signal)
        self._covariances = scale[:, None] * np.linalg.inv(np.eye(len(scale)) + scale[:, None] * moments * scale) * scale
        self._means = (self._covariances @ vectors[..., None])[..., 0]
        self._means[:, : self._head_count] += prior

    def _fit_features(self, contexts: Array, own: Array, chosen: NDArray[np.int64], targets: Array) -> None:
        """Fit `features` to contexts, warm ones included; `own` are those decided on."""
        if len(contexts):
            self._features.fit(contexts)

    def _evidence(self, moments: Array, vectors: Array, targets: Array, signal: float) -> tuple[float, float]:
        """Log probability of all rewards under this signal, the noise integrated out (inverse gamma prior), and the noise's mean."""
        scale, count = self._scale(signal), NOISE_WEIGHT + len(targets)
        factors = np.linalg.cholesky(np.eye(len(scale)) + scale[:, None] * moments * scale)
        explained = sum(
            float((solve_triangular(factor, scale * vector, lower=True, check_finite=False) ** 2).sum())
            for factor, vector in zip(factors, vectors, strict=True)
        )
        noise = (NOISE_WEIGHT * NOISE + max(float(targets @ targets) - explained, 0.0)) / count
        return -float(np.log(np.diagonal(factors, axis1=1, axis2=2)).sum()) - 0.5 * count * math.log(noise), noise

    def _scale(self, signal: float) -> Array:
        """Prior deviations of the intercept and the weights, relative to the noise."""
        return np.sqrt(np.concatenate([np.full(self._head_count, INTERCEPT), np.full(self._features.dim, signal)]))

    def _rows(self, context: Context, sketched: NDArray[np.float32]) -> Array:
        """What the regressions see of a context, (policies, 1 + dim): a constant for the intercept, and the features.

        With skills (policies, 2 + dim): how far a policy declares what is asked for, and how far not, instead of the constant. Each has its own
        intercept, so that a policy which disappoints where it promised much is not thought worse of where it promised little.
        """
        if self._skills is None:
            heads = np.ones((len(self.policies), 1))
        else:
            share = self._skills.share(context, self.policies)
            heads = np.stack([share, 1.0 - share], axis=1)
        features = self._features.transform(sketched[None].astype(np.float64))
        return np.concatenate([heads, np.repeat(features, len(heads), axis=0)], axis=1)

    def _cost(self, policy: str) -> float:
        if self._costs_declared is None:
            return 0.0
        if policy not in self._costs_declared:
            raise UnknownNameError("policy", policy, self._costs_declared, "the expected costs of this selector")
        if not math.isfinite(self._costs_declared[policy]):
            raise UsageError(f"the expected cost of {policy!r} must be finite, got {self._costs_declared[policy]}")
        return self._costs_declared[policy]

    def _check_warm(self, contexts: ArrayLike | None) -> tuple[Array, str | None]:
        if contexts is None:
            return np.zeros((0, self._sketch.dim)), None
        table = np.ascontiguousarray(contexts, np.float32)
        if table.ndim != 2 or table.shape[1] != self.context_dim or not len(table) or not np.isfinite(table).all():
            raise UsageError(f"warm_contexts must be a finite table (n, {self.context_dim}), got shape {table.shape}")
        few = table[np.linspace(0, len(table) - 1, min(WARM, len(table))).astype(np.int64)]
        return self._sketch(few).astype(np.float64), content_digest(table.tobytes())

    def _add_policy(self, name: str) -> None:
        self._costs = np.append(self._costs, self._cost(name))
        self._fit()

    def _state(self) -> State:
        return {
            "contexts": np.array(self._contexts, np.float32).reshape(-1, self._sketch.dim),
            "heads": np.array(self._heads, np.float64).reshape(-1, self._head_count),
            "chosen": np.array(self._chosen, np.int64),
            "targets": np.array(self._targets, np.float64),
            "means": self._means.copy(),
            "covariances": self._covariances.copy(),
            "model": [self._signal, self._noise, self._next_fit],
            "random": self._generator.bit_generator.state,
            **{f"features.{key}": value for key, value in self._features.state().items()},
        }

    def _load(self, state: State) -> None:
        self._contexts, self._heads = list(state["contexts"].copy()), list(state["heads"].copy())
        self._chosen, self._targets = state["chosen"].tolist(), state["targets"].tolist()
        self._means, self._covariances = state["means"].copy(), state["covariances"].copy()
        self._signal, self._noise, self._next_fit = state["model"]
        self._generator.bit_generator.state = state["random"]
        self._features.load({key.removeprefix("features."): value for key, value in state.items() if key.startswith("features.")})
