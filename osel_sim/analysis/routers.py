"""Supervised routers: whom to choose for an instance, learned from the outcomes of all policies on other instances.

A selector sees one outcome an instance. These see all, which no robot pays for; they are a measure of what contexts and labels tell at all.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import Rows, best_of_group
from osel_sim.analysis.log import Array, LoggedOutcomes

Router = Callable[[Rows, Rows], NDArray[np.int64]]
"""Of the instances `by`, not empty, and `on`: columns of the policies to choose for the latter, learned from the outcomes of the former."""

SINGLE = "one policy for all"

GROUPINGS = ("task", "target", "container", "phrasing", "robot")
"""Attributes of an instance that any combination of may make groups."""

TEXT = "instruction"
"""Instances of the same text are a group as well."""

BY_TEXT = f"groups by {TEXT}"
"""The router that goes by them."""

SHRINK = 4.0
"""A group's mean rewards count as if so many more instances of the group had the mean of all: a small group says little."""

COMPONENTS = 32
"""Leading principal components of the contexts that models see. Of six real tables none was routed worse by 32 than by all 128 or 256."""

MOST_LABELS = 100
"""An attribute of more labels than that is left to groups."""

FEWEST = 40
"""Instances that a model needs: of fewer it learns nothing that groups do not say."""

MOST = 4_000
"""Instances that a model learns from: more cost time and tell little."""

NEIGHBOURS = (20, 60)

MODELS = ("ridge regression", *(f"{count} nearest neighbours" for count in NEIGHBOURS), "extremely randomised trees")
"""Names of the routers that are regressions of rewards on contexts and labels."""


def routers(log: LoggedOutcomes, means: Array) -> dict[str, Router]:
    """All there are, by name; those that know least come first.

    Args:
        means: (N, P) mean rewards.
    """
    labels = {name: log.labels(name) for name in (*GROUPINGS, TEXT)}
    varying = [name for name in GROUPINGS if len(set(labels[name])) > 1]
    groupings = [names for size in range(len(varying) + 1) for names in combinations(varying, size)]
    if 1 < len(set(labels[TEXT])) < len(log):
        groupings.append((TEXT,))
    found = {f"groups by {' and '.join(names)}" if names else SINGLE: _by_groups(means, [labels[name] for name in names]) for names in groupings}
    features = _features(log.contexts, [labels[name] for name in varying])
    return found | {name: _by_model(make, features, means) for name, make in _models().items()}


def context_routers(contexts: NDArray[np.float32], means: Array) -> dict[str, Router]:
    """Those that look at contexts (N, D) alone."""
    features = _features(contexts, [])
    return {name: _by_model(make, features, means) for name, make in _models().items()}


def _by_groups(means: Array, labels: Sequence[Sequence[str]]) -> Router:
    groups = group_numbers(labels, len(means))
    return lambda by, on: best_of_group(means, groups, by, on, SHRINK)


def group_numbers(labels: Sequence[Sequence[str]], count: int) -> NDArray[np.int64]:
    """Number of each instance's group, (N,), from one list of labels an attribute."""
    if not labels:
        return np.zeros(count, np.int64)
    numbers: dict[tuple[str, ...], int] = {}
    return np.array([numbers.setdefault(row, len(numbers)) for row in zip(*labels, strict=True)], np.int64)


def _by_model(make: Callable[[int], Any], features: Array, means: Array) -> Router:
    def choose(by: Rows, on: Rows) -> NDArray[np.int64]:
        rows = _thinned(np.flatnonzero(by))
        if len(rows) < FEWEST or not on.any():
            return np.full(int(on.sum()), means[by].mean(axis=0).argmax(), np.int64)
        predicted = make(len(rows)).fit(features[rows], means[rows]).predict(features[on])
        return np.asarray(predicted.reshape(len(predicted), -1).argmax(axis=1), np.int64)

    return choose


def _thinned(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `MOST` of them, evenly spread: a log may be sorted by task."""
    return rows if len(rows) <= MOST else rows[np.linspace(0, len(rows) - 1, MOST).astype(np.int64)]


def _features(contexts: NDArray[np.float32], labels: Sequence[Sequence[str]]) -> Array:
    """What models see of every instance: its context's leading components, and for each attribute a one at its label, on the same scale.

    Components are found on the contexts of all instances; outcomes have no part in them.
    """
    from sklearn.decomposition import PCA

    values = np.asarray(contexts, np.float64)
    values = values - values.mean(axis=0)
    scale = float(np.sqrt((values**2).sum(axis=1).mean()))
    values = values / scale if scale > 0.0 else values[:, :1]
    if min(values.shape) > COMPONENTS:
        model = PCA(COMPONENTS, svd_solver="randomized", random_state=0).fit(values[_thinned(np.arange(len(values)))])
        values = model.transform(values)
    columns = [np.eye(groups.max() + 1)[groups] for groups in (group_numbers([own], len(values)) for own in labels) if groups.max() < MOST_LABELS]
    return np.concatenate([values, *columns], axis=1)


def _models() -> dict[str, Callable[[int], Any]]:
    """Regressions of the rewards of all policies at once, for so many instances: a linear one, local means, and trees."""
    from sklearn.ensemble import ExtraTreesRegressor
    from sklearn.linear_model import RidgeCV
    from sklearn.neighbors import KNeighborsRegressor

    def neighbours(count: int) -> Callable[[int], Any]:
        return lambda rows: KNeighborsRegressor(min(count, rows // 2), algorithm="brute")

    made = (
        lambda _: RidgeCV(np.logspace(-3.0, 4.0, 15)),
        *(neighbours(count) for count in NEIGHBOURS),
        lambda _: ExtraTreesRegressor(30, min_samples_leaf=10, max_features=0.3, random_state=0),
    )
    return dict(zip(MODELS, made, strict=True))
