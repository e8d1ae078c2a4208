"""Bayesian linear regression for several policies at once: what they have in common, and what is each one's own."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import State

Array = NDArray[np.float64]

NOISE_WEIGHT = 4.0
"""How many observations the prior guess of the noise's variance, 1, is worth."""


@dataclass(frozen=True)
class Moments:
    """All that a regression needs to know of its observations.

    Attributes:
        products: (P, K, K), of each policy the sum over its rows of row x row.
        vectors: (P, K), of each policy the sum of row * target.
        squares: sum of all squared targets.
        count: number of observations.
    """

    products: Array
    vectors: Array
    squares: float
    count: int

    @classmethod
    def of(cls, rows: Array, chosen: NDArray[np.int64], targets: Array, policies: int) -> "Moments":
        """Of n observations: rows (n, K), columns of the policies (n,), targets (n,)."""
        products, vectors = np.zeros((policies, rows.shape[1], rows.shape[1])), np.zeros((policies, rows.shape[1]))
        for policy in np.unique(chosen):
            own = rows[chosen == policy]
            products[policy], vectors[policy] = own.T @ own, own.T @ targets[chosen == policy]
        return cls(products, vectors, float(targets @ targets), len(targets))


@dataclass
class SharedRegression:
    """target = row . (shared + own of the policy) + noise, all Gaussian; variances and covariances are relative to the noise's variance.

    Some contexts are hard for every policy. Were each policy regressed by itself, one that is seldom chosen would seem good wherever the usual one
    was seen to fail. With a part in common a failure speaks against both, and what remains to be told apart is their difference.

    The shared weights are the only tie between the policies: given them, each policy's own are independent of the others'. So the posterior needs
    matrices (K, K) only, one a policy and one for the shared weights (block elimination), and an observation changes two of them by a rank of one.

    Attributes:
        prior: (K,) prior variances of a policy's own weights, > 0.
        means: (P, K) of the own weights, were the shared ones 0.
        covariances: (P, K, K) of the own weights, given the shared ones.
        shared_covariance: (K, K) of the shared weights.
        information: (K,) what it is multiplied with to be their mean.
        noise: variance of the noise.
        evidence: log probability of the targets, the noise integrated out (inverse gamma prior), less what does not depend on the prior variances.
    """

    prior: Array
    means: Array
    covariances: Array
    shared_covariance: Array
    information: Array
    noise: float
    evidence: float

    def predict(self, rows: Array, columns: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """Means (P,) of what the policies come to, and variances (P,), given each one's row (P, K).

        What policies have in common does not tell them apart. So a variance is that of a policy's own part, and of how far its shared part differs
        from the shared part of the policy of the highest mean: between that one and any other, variances add up to that of their difference.

        Args:
            columns: policies that may be chosen, among which the highest mean is looked for; None: all.
        """
        gains = (self.covariances @ rows[:, :, None])[:, :, 0]
        pulls = gains / self.prior  # how much of the shared weights is left in a policy's mean once its own have followed
        means = (rows * self.means).sum(axis=1) + pulls @ (self.shared_covariance @ self.information)
        apart = pulls - pulls[means.argmax() if columns is None else columns[means[columns].argmax()]]
        variances = (gains * rows).sum(axis=1) + ((apart @ self.shared_covariance) * apart).sum(axis=1)
        return means, np.maximum(variances, 1e-12)

    @property
    def weights(self) -> Array:
        """Means (P, K) of shared and own weights together."""
        return np.asarray(self.means + self.covariances @ ((self.shared_covariance @ self.information) / self.prior), np.float64)

    def update(self, policy: int, row: Array, target: float) -> None:
        """Take one more observation into account (Sherman and Morrison); the noise and the evidence stay as they are."""
        gain = self.covariances[policy] @ row
        variance, pull = 1.0 + float(gain @ row), gain / self.prior
        surprise = (target - float(self.means[policy] @ row)) / variance
        self.means[policy] += gain * surprise
        self.covariances[policy] -= np.outer(gain, gain / variance)
        self.information += pull * surprise
        gain = self.shared_covariance @ pull
        self.shared_covariance -= np.outer(gain, gain / (variance + float(gain @ pull)))

    def state(self) -> State:
        """Arrays and values, copied."""
        return asdict(self)


def fit(moments: Moments, prior: Array, shared: Sequence[Array]) -> list[SharedRegression]:
    """A regression for each of some prior variances of the shared weights. They share arrays: `update` one of them only.

    Args:
        moments: of the observations.
        prior: (K,) prior variances of the own weights, > 0.
        shared: of the shared weights, (K,) each, > 0.
    """
    width = moments.vectors.shape[1]
    covariances = np.broadcast_to(np.diag(prior), moments.products.shape).copy()
    used = np.flatnonzero(np.einsum("pkk->p", moments.products) > 0.0)
    roots = np.sqrt(prior)
    scaled = np.eye(width) + roots[:, None] * moments.products[used] * roots
    log_determinant = _log_determinants(scaled)
    covariances[used] = roots[:, None] * np.linalg.inv(scaled) * roots
    means = (covariances @ moments.vectors[:, :, None])[:, :, 0]
    information = (means / prior).sum(axis=0)
    # What the observations tell of the shared weights, the own ones having followed: prior^-1 - prior^-1 covariance prior^-1 a policy.
    told = len(used) * np.diag(1.0 / prior) - covariances[used].sum(axis=0) / prior[:, None] / prior
    unexplained = moments.squares - float((moments.vectors * means).sum())
    count = NOISE_WEIGHT + moments.count
    found = []
    for variances in shared:
        roots = np.sqrt(variances)
        scaled = np.eye(width) + roots[:, None] * told * roots
        covariance = roots[:, None] * np.linalg.inv(scaled) * roots
        noise = (NOISE_WEIGHT + max(unexplained - float(information @ covariance @ information), 0.0)) / count
        evidence = -0.5 * (log_determinant + _log_determinants(scaled)) - 0.5 * count * math.log(noise)
        found.append(SharedRegression(prior, means, covariances, covariance, information, noise, evidence))
    return found


def _log_determinants(matrices: Array) -> float:
    """Of all of them together; they are symmetric and positive definite."""
    return float(2.0 * np.log(np.diagonal(np.linalg.cholesky(matrices), axis1=-2, axis2=-1)).sum())
