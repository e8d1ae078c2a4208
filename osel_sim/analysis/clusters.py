"""Section IV of the paper on a log: clusters in the context, the optimal action of each, and what context is worth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import Rows, best_of_group, cross_fit
from osel_sim.analysis.estimate import Estimate, mean_of
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.outcomes import OutcomeRates, rates_of
from osel_sim.core.errors import DataError
from osel_sim.selection.reward import RewardWeights, counted_time

MOST_CLUSTERS = 40
FEWEST_MEMBERS = 8  # a cluster of fewer on average says nothing about its policies
_COMPONENTS = 24
_SAMPLE = 2_000


@dataclass(frozen=True)
class Clustering:
    """Clusters in the context.

    Attributes:
        labels: (N,) cluster of each instance, 0 the largest.
        silhouettes: mean silhouette of each number of clusters tried; the highest was taken.
    """

    labels: NDArray[np.int64]
    silhouettes: dict[int, float]

    @property
    def count(self) -> int:
        """How many clusters there are."""
        return int(self.labels.max()) + 1


@dataclass(frozen=True)
class Cluster:
    """One cluster, as the paper describes it.

    Attributes:
        share: proportion of the instances, rho^i.
        about: what most of its instances are about, where the log knows.
        rates: outcome rates p^i.
        rewards: mean reward of each policy on it (the plain expectation).
        best: the policy with the highest.
        paper_local, paper_remote: the two sides of the paper's equation 5.
        paper_remote_best: the paper's optimal action is the remote one.
    """

    number: int
    instances: int
    share: float
    about: str
    rates: OutcomeRates
    rewards: dict[str, float]
    best: str
    paper_local: float
    paper_remote: float
    paper_remote_best: bool


@dataclass(frozen=True)
class Inequality:
    """Contextual against non-contextual converged reward (paper, equations 3 and 7).

    Attributes:
        contextual, non_contextual: best policy of each cluster, and best policy of all, chosen and scored on the same instances: never below zero
            apart, because the larger of several means is optimistic.
        held_out: their difference where one half of the instances chooses and the other half scores, and the other way round.
        paper_contextual, paper_non_contextual: by the paper's formula.
    """

    contextual: float
    non_contextual: float
    held_out: Estimate | None
    paper_contextual: float
    paper_non_contextual: float

    @property
    def size(self) -> float:
        """Contextual minus non-contextual."""
        return self.contextual - self.non_contextual


def find_clusters(contexts: NDArray[np.float32], seed: int = 0, most: int = MOST_CLUSTERS) -> Clustering:
    """k-means on the leading principal components, with the number of clusters that has the highest silhouette.

    Args:
        contexts: (N, D).
        seed: of k-means and of the instances the silhouette is taken on.
        most: clusters at most.

    Raises:
        DataError: too few instances for two clusters.
    """
    distinct = len(np.unique(contexts, axis=0))
    limit = min(most, len(contexts) // FEWEST_MEMBERS, distinct - 1)
    if limit < 2:
        raise DataError(f"{len(contexts)} instances, {distinct} of them with a context of their own, are too few for clusters of {FEWEST_MEMBERS}")
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA
    from sklearn.metrics import silhouette_score

    components = PCA(min(_COMPONENTS, *contexts.shape), random_state=seed).fit_transform(np.asarray(contexts, np.float64))
    sample = np.random.default_rng(seed).permutation(len(contexts))[:_SAMPLE]
    best, scores = np.zeros(len(contexts), np.int64), dict[int, float]()
    for count in _counts(limit):
        labels = KMeans(count, n_init=3, random_state=seed).fit_predict(components)
        scores[count] = float(silhouette_score(components[sample], labels[sample])) if len(np.unique(labels[sample])) > 1 else -1.0
        if scores[count] == max(scores.values()):
            best = labels
    order = np.argsort(-np.bincount(best), kind="stable")
    return Clustering(np.argsort(order)[best].astype(np.int64), scores)


def describe(log: LoggedOutcomes, clustering: Clustering, weights: RewardWeights, remote: NDArray[np.bool_]) -> list[Cluster]:
    """Each cluster with its outcome rates, its policies' mean rewards and its optimal action.

    Only instances on which every policy has an outcome count: the means of a cluster's policies are then over the same instances.
    """
    rewards, complete = log.mean_rewards(weights), complete_rows(log, weights)
    clusters = []
    for number in range(clustering.count):
        rows = (clustering.labels == number) & complete
        if not rows.any():
            continue
        means = rewards[rows].mean(axis=0)
        rates = rates_of(f"cluster {number + 1}", log.success[rows], remote)
        paper_local, paper_remote = paper_sides(log.take(rows), weights, remote)
        clusters.append(
            Cluster(
                number + 1,
                int(rows.sum()),
                float(rows.sum() / complete.sum()),
                _about(log, rows),
                rates,
                dict(zip(log.policies, means.tolist(), strict=True)),
                log.policies[int(means.argmax())],
                paper_local,
                paper_remote,
                paper_local < paper_remote,
            )
        )
    return clusters


def inequality(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, remote: NDArray[np.bool_]) -> Inequality:
    """How much the best policy of each cluster is above the best policy of all.

    Args:
        labels: (N,) cluster of each instance.
    """
    complete = complete_rows(log, weights)
    rewards, own = log.mean_rewards(weights)[complete], labels[complete]
    by_cluster = [(float((own == number).mean()), rewards[own == number].mean(axis=0).max()) for number in np.unique(own)]
    part = log.take(complete)
    paper = [(float((own == number).mean()), max(paper_sides(part.take(own == number), weights, remote))) for number in np.unique(own)]
    return Inequality(
        float(sum(share * value for share, value in by_cluster)),
        float(rewards.mean(axis=0).max()),
        _held_out(rewards, own, part.first_half()),
        float(sum(share * value for share, value in paper)),
        float(max(paper_sides(part, weights, remote))),
    )


def paper_sides(log: LoggedOutcomes, weights: RewardWeights, remote: NDArray[np.bool_]) -> tuple[float, float]:
    """The paper's local side, 1 - p_FS, and remote side, p_FS - alpha_time tau - alpha_price p.

    tau and p are the means of the remote policy; of several, of the one with the highest reward on each instance, as the paper merges them.
    """
    only_remote = rates_of("", log.success, remote).only_remote.value
    penalties = _penalty(log, weights)[:, remote]
    rewards = log.mean_rewards(weights)[:, remote]
    merged = np.take_along_axis(penalties, rewards.argmax(axis=1)[:, None], axis=1)[:, 0]
    return 1.0 - only_remote, only_remote - float(merged.mean())


def complete_rows(log: LoggedOutcomes, weights: RewardWeights) -> NDArray[np.bool_]:
    """Which instances (N,) have a reward of every policy.

    Raises:
        DataError: none has.
    """
    complete = np.isfinite(log.mean_rewards(weights)).all(axis=1)
    if not complete.any():
        raise DataError(f"{log.source}: no instance has an outcome of every policy")
    return complete


def _penalty(log: LoggedOutcomes, weights: RewardWeights) -> Array:
    """alpha_time tau + alpha_price p, mean over the repeats, (N, P)."""
    return mean_over_repeats(score_of(log, weights)) - log.mean_rewards(weights)


def _held_out(rewards: Array, labels: NDArray[np.int64], first: NDArray[np.bool_]) -> Estimate | None:
    """Mean over all instances of (policy its cluster would take) - (policy all would take), each chosen on the half the instance is not in."""
    if first.all() or not first.any():
        return None

    def difference(by: Rows, on: Rows) -> Array:
        return np.asarray(rewards[on, best_of_group(rewards, labels, by, on)] - rewards[on, rewards[by].mean(axis=0).argmax()], np.float64)

    return mean_of(cross_fit(first, difference))


def _about(log: LoggedOutcomes, rows: NDArray[np.bool_]) -> str:
    """`milk (98%), bowl (51%)`: the commonest task, target and container, where half of the cluster share it, and more than of all instances."""
    parts = []
    for attribute in ("task", "target", "container"):
        labels = np.array(log.labels(attribute))
        values, counts = np.unique(labels[rows], return_counts=True)
        commonest, share = values[counts.argmax()], counts.max() / rows.sum()
        if commonest and share >= 0.5 and share > 1.2 * (labels == commonest).mean():
            parts.append(f"{str(commonest).replace('_', ' ')} ({100 * share:.0f}%)")
    return ", ".join(parts) or "mixed"


def _counts(limit: int) -> Sequence[int]:
    """Numbers of clusters to try: all up to 12, then every third."""
    return [*range(2, min(limit, 12) + 1), *range(15, limit + 1, 3)]


def score_of(log: LoggedOutcomes, weights: RewardWeights) -> Array:
    """What the reward counts as S, (N, P, R): success, or the share of subgoals."""
    score: Array = getattr(log, weights.success)
    return score


def time_of(log: LoggedOutcomes, weights: RewardWeights) -> Array:
    """The time the reward counts, (N, P), mean over the repeats: steps, or log10 of the seconds; 0 where the log has none."""
    values = counted_time(weights, log.steps, log.seconds)
    return mean_over_repeats(values if np.isfinite(values).any() else np.zeros_like(values))
