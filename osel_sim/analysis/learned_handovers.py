"""A monitor learned from every way on: what each handover would gain over going on, regressed on what is to be seen at the moment.

A monitor that runs live sees one way on of each moment. This one sees all, which only snapshots can show; it is a measure of what pictures and
signals tell at all, as supervised routers are for the choice at the start. Each moment's ways on share everything before it, so that their
differences are what it learns from: the luck of the beginning drops out.

Which regression, and how much a handover must promise, is decided inside the half it learns from: of five folds of its instances each is decided on
by the other four. It hands nothing over unless that was ahead there by more than a standard error.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import Rows
from osel_sim.analysis.handovers import driving_on, first_turns, reward_of
from osel_sim.analysis.log import Array, mean_over_repeats
from osel_sim.analysis.moment_log import MomentLog, rewards_of
from osel_sim.selection.reward import RewardWeights

COMPONENTS = 24
"""Leading principal components of the pictures that it looks at."""
FOLDS = 5
FEWEST = 30
"""Moments that a regression needs."""
PROMISES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2)
"""Gains in reward that a handover may have to promise, to be tried."""

Model = Callable[[], Any]


@dataclass(frozen=True)
class Chosen:
    """What was decided inside the learning half, of one first policy.

    Attributes:
        model: name of the regression; empty where nothing is handed over.
        promise: what a handover must promise.
        gain, error: in reward over going on, on the folds that it did not learn from, and its standard error.
    """

    model: str
    promise: float
    gain: float
    error: float


def features_of(log: MomentLog, by: Rows, look: bool = True, signals: bool = True) -> Array:
    """What is known of each moment, (moments seen, F): components of the picture, signals, and calls so far.

    Args:
        by: (N,) instances by whose moments components and scales are found.
        look, signals: whether pictures and signals are among it.
    """
    from sklearn.decomposition import PCA

    rows = np.unique(log.seen_at[by][log.there[by]])
    pictures, told = np.asarray(log.seen.pictures, np.float64), np.nan_to_num(log.seen.signals)
    calls = np.zeros((len(told), 1))
    for at, call in enumerate(log.calls):
        calls[log.seen_at[..., at][log.there[..., at]], 0] = call
    columns = [calls / max(log.calls)]
    if signals:
        scale = told[rows].std(axis=0)
        columns.append((told - told[rows].mean(axis=0)) / np.where(scale > 0.0, scale, 1.0))
    if look:
        model = PCA(min(COMPONENTS, len(rows) - 1, pictures.shape[1]), svd_solver="full").fit(pictures[rows])
        found = model.transform(pictures)
        columns.append(found / max(float(found[rows].std()), 1e-12))
    return np.concatenate(columns, axis=1)


def learned_turns(
    log: MomentLog, weights: RewardWeights, by: Rows, on: Rows, look: bool = True, signals: bool = True
) -> tuple[NDArray[np.int64], dict[str, Chosen]]:
    """What it says at each decision point, learned from the instances `by`.

    Args:
        by, on: (N,) bool, without an instance in common.
        look, signals: what it may look at.

    Returns:
        turns: (N, P, R, M), as `osel_sim.analysis.handovers.first_turns` takes them: of the instances `on`, and of those `by` what was said of
            each fold by the others. The rest drives on.
        chosen: first policy -> what was decided.
    """
    features, gains = features_of(log, by, look, signals), gains_of(log, weights)
    turns = driving_on(log)
    chosen = {}
    for first, name in enumerate(log.policies):
        found, inside = _choose(log, weights, gains, features, by, first)
        chosen[name] = found
        if found.model:
            predicted = _predict(log, _models()[found.model], gains, features, by, on, first)
            turns[on, first] = _turns(predicted, first, found.promise)
            turns[by, first] = inside[by]
    return turns, chosen


def gains_of(log: MomentLog, weights: RewardWeights) -> Array:
    """What each way on gains in reward over the first policy's going on, (N, P, R, M, P)."""
    rewards, first = log.rewards(weights), np.arange(len(log.policies))
    going_on = rewards[:, first, :, :, first].transpose(1, 0, 2, 3)
    return np.asarray(rewards - going_on[..., None], np.float64)


def _choose(log: MomentLog, weights: RewardWeights, gains: Array, features: Array, by: Rows, first: int) -> tuple[Chosen, NDArray[np.int64]]:
    """Regression and promise of one first policy, by what they come to on folds that were not learned from; and what they say there, (N, R, M)."""
    rows = np.flatnonzero(by)
    fold = np.random.default_rng(0).permutation(len(rows)) % FOLDS
    best, said = Chosen("", 0.0, 0.0, 0.0), driving_on(log)[:, first]
    if log.there[rows, first].sum() < FEWEST:
        return best, said
    alone = mean_over_repeats(rewards_of(log.alone, weights))[rows, first]
    for name, make in _models().items():
        predicted = np.full((*log.there[:, first].shape, len(log.policies)), -np.inf)
        for number in range(FOLDS):
            inside, outside = np.zeros(len(log), bool), np.zeros(len(log), bool)
            inside[rows[fold != number]], outside[rows[fold == number]] = True, True
            predicted[outside] = _predict(log, make, gains, features, inside, outside, first)
        for promise in PROMISES:
            turns = driving_on(log)
            turns[:, first] = _turns(predicted, first, promise)
            then = mean_over_repeats(reward_of(log, first_turns(log, turns), weights))[rows, first]
            apart = (then - alone)[np.isfinite(then - alone)]
            gain, error = float(apart.mean()), float(apart.std(ddof=1) / np.sqrt(len(apart)))
            if gain > max(best.gain, error):
                best, said = Chosen(name, promise, gain, error), turns[:, first]
    return best, said


def _predict(log: MomentLog, make: Model, gains: Array, features: Array, by: Rows, on: Rows, first: int) -> Array:
    """Gain promised by each way on, (number of `on`, R, M, P); minus infinity where there is no moment, or of the driver itself."""
    others = [column for column in range(len(log.policies)) if column != first]
    there = log.there[:, first]
    learn = there & by[:, None, None] & np.isfinite(gains[:, first][..., others]).all(axis=3)
    result = np.full((*there.shape, len(log.policies)), -np.inf)
    if learn.sum() >= FEWEST:
        wanted = gains[:, first][learn][:, others]
        model = make().fit(features[log.seen_at[:, first][learn]], wanted if len(others) > 1 else wanted[:, 0])
        asked = there & on[:, None, None]
        if asked.any():
            found = np.asarray(model.predict(features[log.seen_at[:, first][asked]])).reshape(-1, len(others))
            for number, column in enumerate(others):
                result[asked, column] = found[:, number]
    return result[on]


def _turns(predicted: Array, first: int, promise: float) -> NDArray[np.int64]:
    """Whom to let drive on, (n, R, M): the way on that promises most, where that is enough."""
    best = predicted.argmax(axis=3)
    return np.where(predicted.max(axis=3) > promise, best, first)


def _models() -> dict[str, Model]:
    from sklearn.ensemble import ExtraTreesRegressor
    from sklearn.linear_model import RidgeCV

    return {
        "ridge regression": lambda: RidgeCV(np.logspace(0.0, 4.0, 9)),
        "extremely randomised trees": lambda: ExtraTreesRegressor(30, min_samples_leaf=8, max_features=0.4, random_state=0),
    }
