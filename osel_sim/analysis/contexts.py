"""Contexts laid out in the plane, with what could explain how they lie."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array, LoggedOutcomes
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.best import best_of_each

MOST_POINTS = 1_200


@dataclass(frozen=True)
class Layout:
    """Some instances in the plane.

    Attributes:
        rows: (M,) which instances.
        places: (M, 2).
        labels: for each aspect (task, object, container, phrasing, best policy) the label (M,) of every one; only aspects that differ.
    """

    rows: NDArray[np.int64]
    places: Array
    labels: dict[str, tuple[str, ...]]


def lay_out(log: LoggedOutcomes, weights: RewardWeights, seed: int = 0, most: int = MOST_POINTS) -> Layout | None:
    """t-SNE of the contexts, or of `most` of them drawn at random; None for too few to lay out."""
    rows = np.sort(np.random.default_rng(seed).permutation(len(log))[:most])
    if len(rows) < 20:
        return None
    from sklearn.manifold import TSNE

    part = log.take(rows)
    places = TSNE(perplexity=min(30.0, len(rows) / 4), init="pca", random_state=seed).fit_transform(part.contexts)
    aspects = {
        "task": part.labels("task"),
        "robot": part.labels("robot"),
        "object": part.labels("target"),
        "container": part.labels("container"),
        "phrasing": tuple(wording(label) for label in part.labels("phrasing")),
        "best policy": best_policies(part, weights),
    }
    return Layout(rows, places.astype(np.float64), {name: labels for name, labels in aspects.items() if len(set(labels)) > 1})


def best_policies(log: LoggedOutcomes, weights: RewardWeights) -> tuple[str, ...]:
    """The policy with the highest mean reward on each instance, `several` where it is shared, `unknown` where one has no outcome."""
    found = []
    for best in best_of_each(log.mean_rewards(weights)):
        columns = np.flatnonzero(best)
        found.append(log.policies[columns[0]] if len(columns) == 1 else "several" if len(columns) else "unknown")
    return tuple(found)


def wording(phrasing: str) -> str:
    """`train-5` -> `train`, `held_out-2` -> `held out`: the kind of wording, without its number."""
    return (phrasing.rpartition("-")[0] or phrasing).replace("_", " ")
