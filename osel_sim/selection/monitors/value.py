"""A monitor that learns what going on and handing over come to, and takes what is best by probability."""

from collections.abc import Sequence
from typing import ClassVar, override

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.monitor import Candidate, DecisionPoint, Picture, Turn, Watched
from osel_sim.selection.monitors.base import MonitorBase, number
from osel_sim.selection.monitors.features import SIGNALS, signals
from osel_sim.selection.regression import Moments, SharedRegression, fit
from osel_sim.selection.scaling import LAST, RunningComponents
from osel_sim.statistics.best import probability_of_best

Array = NDArray[np.float64]

COMPONENTS = 8
"""Of the picture."""
WIDTH = 1 + SIGNALS + COMPONENTS
"""Features of a decision point: 1, the signals, the picture."""
DEVIATION = 0.5
"""Standard deviation of rewards to expect before any two have differed: that of a success with probability 1/2."""
MEAN, OWN, SHARED = 1.0, 0.1, 0.25
"""Prior variances relative to the noise's: of a mean, of weights of features that one turn has for itself, and of those that all have in common."""
CONVINCED = 0.95
"""Probability of another policy to be best from which on nothing is left to chance over several decision points."""


class ValueMonitor(MonitorBase):
    """Bayesian linear regression of the reward-to-go, one for each turn (driver -> who drives on) with a part in common, on features of the point.

    It draws who drives on with each policy's probability to be best (Thompson sampling, with those probabilities as exact propensities). An episode
    has many decision points, and a coin thrown at each would almost always hand over at the first of them. So as long as it is not `CONVINCED` it
    spreads the chance of handing over evenly over the points that are still to come, as far as it can tell their number from those that were.

    The reward-to-go is that of what followed, handoffs at later points included. It learns from every episode it watched, and as well from those that
    another one did, such as the moments of a log.

    Args:
        candidates, picture_dim, seed: see `MonitorBase`.
        most: handoffs in an episode at most, >= 1.

    Raises:
        UsageError: `most` is no such number.
    """

    off_policy: ClassVar[bool] = True

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int, most: str = "1") -> None:
        super().__init__(candidates, picture_dim, seed)
        self._most = int(number(most, "monitor value: MOST", 1, whole=True))
        self._left, self._seen = self._most, 0  # handoffs left, decision points seen in this episode
        self._components = RunningComponents(picture_dim, COMPONENTS)
        self._seen_points: list[tuple[Picture, Array, int, float]] = []  # kept as long as the components may still change
        self._sums = _Sums(len(self.policies) ** 2)
        self._model: SharedRegression | None = None
        self._level, self._scale = 0.0, 1.0

    @override
    def reset(self, instruction: str, driver: str, seed: tuple[int, ...]) -> None:
        super().reset(instruction, driver, seed)
        self._left, self._seen = self._most, 0

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        row = self._row(point.look.picture(), signals(point))
        self._seen += 1
        if not self._left or len(self.policies) == 1:
            return Turn(point.driver, "", {point.driver: 1.0})
        means, deviations = self._predict(point.driver, row)
        chances = self._spread(probability_of_best(means, deviations), point)
        column = int(self.chance.choice(len(self.policies), p=chances))
        policy = self.policies[column]
        self._left -= policy != point.driver
        stay = self.policies.index(point.driver)
        why = "" if column == stay else f"expected to come to {means[column]:.3f}, going on to {means[stay]:.3f}"
        return Turn(policy, why, dict(zip(self.policies, chances.tolist(), strict=True)))

    @override
    def learn(self, watched: Watched) -> None:
        for point, turn, to_go in zip(watched.points, watched.turns, watched.to_go, strict=True):
            fits, seen = self._components.fits, (point.look.picture(), signals(point), self._turn(point.driver, turn.policy), to_go)
            self._components.add(seen[0])
            if self._sums.count < LAST:
                self._seen_points.append(seen)
            if self._components.fits > fits:
                self._sums = _Sums(len(self.policies) ** 2)
                for picture, signal, column, target in self._seen_points:
                    self._sums.add(self._row(picture, signal), column, target)
            else:
                self._sums.add(self._row(*seen[:2]), *seen[2:])
        self._model = None  # fitted when it is next needed

    def expected(self, point: DecisionPoint) -> dict[str, float]:
        """What it expects to come of each policy driving on, as reward-to-go."""
        means, _ = self._predict(point.driver, self._row(point.look.picture(), signals(point)))
        return dict(zip(self.policies, means.tolist(), strict=True))

    def _turn(self, driver: str, policy: str) -> int:
        return self.policies.index(driver) * len(self.policies) + self.policies.index(policy)

    def _row(self, picture: Picture, signal: Array) -> Array:
        """Features of a decision point (WIDTH,)."""
        return np.concatenate([[1.0], signal, self._components.transform(picture).astype(np.float64)])

    def _predict(self, driver: str, row: Array) -> tuple[Array, Array]:
        """Means and standard deviations (P,) of the reward-to-go of each policy driving on."""
        model = self._fitted()
        turns = [self._turn(driver, policy) for policy in self.policies]
        # Only this driver's turns: what variances hold is told apart from the best of them.
        own = SharedRegression(
            model.prior, model.means[turns], model.covariances[turns], model.shared_covariance, model.information, model.noise, model.evidence
        )
        means, variances = own.predict(np.broadcast_to(row, (len(turns), len(row))))
        return self._level + self._scale * means, self._scale * np.sqrt(variances * model.noise)

    def _fitted(self) -> SharedRegression:
        if self._model is None:
            prior, shared = np.full(WIDTH, OWN), np.full(WIDTH, SHARED)
            prior[0] = shared[0] = MEAN
            moments, self._level, self._scale = self._sums.standardised()
            (self._model,) = fit(moments, prior, [shared])
        return self._model

    def _spread(self, chances: Array, point: DecisionPoint) -> Array:
        """Chances (P,) of this decision point, so that over all that are to come another policy's are about what they were."""
        stay = self.policies.index(point.driver)
        another = 1.0 - chances[stay]
        if another >= CONVINCED or another <= 0.0:
            return chances
        to_come = max(1.0, self._seen * (1.0 - point.time_used) / max(point.time_used, 1e-3))
        now = 1.0 - (1.0 - another) ** (1.0 / to_come)
        spread = chances * (now / another)
        spread[stay] = 1.0 - now
        return np.asarray(spread / spread.sum(), np.float64)


class _Sums:
    """All that the regression needs to know of the decision points so far, T turns."""

    def __init__(self, turns: int) -> None:
        self.count = 0
        self._products, self._vectors = np.zeros((turns, WIDTH, WIDTH)), np.zeros((turns, WIDTH))
        self._total = self._squares = 0.0

    def add(self, row: Array, turn: int, target: float) -> None:
        """One more, with what came of that turn."""
        self.count += 1
        self._products[turn] += np.outer(row, row)
        self._vectors[turn] += row * target
        self._total += target
        self._squares += target * target

    def standardised(self) -> tuple[Moments, float, float]:
        """The moments of the targets less their mean, in units of their deviation; and both."""
        level = self._total / self.count if self.count else 0.0
        around = max(self._squares - self.count * level * level, 0.0)
        scale = float(np.sqrt(around / self.count)) if around > 1e-12 else DEVIATION
        vectors = (self._vectors - level * self._products[:, :, 0]) / scale  # the first feature is 1
        return Moments(self._products.copy(), vectors, around / scale**2, self.count), level, scale
