"""The regression of several policies at once is the one that all its weights together would give."""

import numpy as np
import pytest

from osel_sim.selection.regression import Moments, fit

POLICIES, WIDTH = 3, 4
OWN, SHARED = np.array([1.0, 0.3, 0.3, 0.3]), np.array([0.5, 0.8, 0.8, 0.8])


def observations(count: int):
    generator = np.random.default_rng(count)
    chosen = generator.integers(POLICIES - 1, size=count)  # the last policy is never tried
    return generator.normal(size=(count, WIDTH)), chosen, generator.normal(size=count)


def in_full(rows, chosen, targets):
    """Prior covariance of all weights (shared, own of every policy), posterior mean and covariance, and the covariance of the targets."""
    prior = np.diag(np.concatenate([SHARED, *[OWN] * POLICIES]))
    wide = np.zeros((len(rows), (POLICIES + 1) * WIDTH))
    wide[:, :WIDTH] = rows
    for number, policy in enumerate(chosen):
        wide[number, (policy + 1) * WIDTH : (policy + 2) * WIDTH] = rows[number]
    covariance = np.linalg.inv(np.linalg.inv(prior) + wide.T @ wide)
    return covariance @ wide.T @ targets, covariance, np.eye(len(rows)) + wide @ prior @ wide.T


@pytest.mark.parametrize("updated", [0, 7])
def test_posterior_is_that_of_all_weights_together(updated):
    rows, chosen, targets = observations(40)
    begun = len(rows) - updated
    [regression] = fit(Moments.of(rows[:begun], chosen[:begun], targets[:begun], POLICIES), OWN, [SHARED])
    for row, policy, target in zip(rows[begun:], chosen[begun:], targets[begun:], strict=True):
        regression.update(policy, row, target)
    mean, covariance, _ = in_full(rows, chosen, targets)
    asked = np.random.default_rng(0).normal(size=(POLICIES, WIDTH))
    wide = np.zeros((POLICIES, len(mean)))
    for policy, row in enumerate(asked):
        wide[policy, :WIDTH] = wide[policy, (policy + 1) * WIDTH : (policy + 2) * WIDTH] = row
    means, variances = regression.predict(asked)
    assert means == pytest.approx(wide @ mean)
    best = int(means.argmax())
    for other in {0, 1, 2} - {best}:
        difference = wide[best] - wide[other]
        assert variances[best] + variances[other] == pytest.approx(difference @ covariance @ difference)


def test_evidence_differs_by_that_of_the_targets():
    """Up to a constant it is the log density of a multivariate t distribution with as many degrees of freedom as the noise's guess weighs."""
    rows, chosen, targets = observations(30)
    moments = Moments.of(rows, chosen, targets, POLICIES)
    found = [regression.evidence for regression in fit(moments, OWN, [SHARED, np.full(WIDTH, 1e-9)])]
    expected = []
    for shared in (SHARED, np.zeros(WIDTH)):
        covariance = np.eye(len(rows)) + (rows * shared) @ rows.T + (chosen[:, None] == chosen) * ((rows * OWN) @ rows.T)
        explained = targets @ np.linalg.solve(covariance, targets)
        expected.append(-0.5 * np.linalg.slogdet(covariance)[1] - 0.5 * (len(rows) + 4) * np.log((4 + explained) / (len(rows) + 4)))
    assert found == pytest.approx(expected, abs=1e-6)
