"""Logged bandit data as material for off-policy estimates: a log whose rows are decisions of somebody's own, with the probability of each choice."""

import numpy as np

from osel_sim.analysis.live import LiveLog
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.core.errors import DataError
from osel_sim.formats.rollout_log import PROPENSITIES


def has_choices(log: LoggedOutcomes) -> bool:
    """Whether a log says with which probability the policy of each row was chosen."""
    return PROPENSITIES in log.metadata


def choices_of(log: LoggedOutcomes) -> LiveLog:
    """The decisions of such a log, in the order of its rows.

    Of a decision only the probability of what was chosen is known; the others share the rest alike. The estimates use no more of it than that it is
    not 0: a policy that could not be chosen at all cannot be told from one that was not.

    Raises:
        DataError: there is not one policy with one probability to each instance.
    """
    values = log.metadata[PROPENSITIES]
    ran = np.isfinite(log.success) | log.errors
    valid = isinstance(values, list) and all(isinstance(value, int | float) and 0.0 < value <= 1.0 for value in values)
    if not valid or len(values) != len(log) or ran.shape[2] != 1 or not (ran.sum(axis=(1, 2)) == 1).all():
        raise DataError(f"{log.source}: its metadata must have {PROPENSITIES}, a probability in (0, 1] for each instance, and one policy to each")
    chosen = ran[:, :, 0].argmax(axis=1)
    policies = len(log.policies)
    propensities = np.repeat((1.0 - np.array(values, np.float64))[:, None] / max(policies - 1, 1), policies, axis=1)
    propensities[np.arange(len(log)), chosen] = values
    return LiveLog((), log, chosen.astype(np.int64), propensities, "whoever chose", {}, log)
