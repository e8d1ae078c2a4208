"""Several sessions of a policy asked together, where it can be, else one after another."""

import logging
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from osel_sim.interface.policy import Actions, Batched, Observation, Policy
from osel_sim.policy.local import check_form

logger = logging.getLogger(__name__)

TOLERANCE = 1e-5
"""How far a number of an answer may be from what the session alone answers: sums over a batch are taken in another order."""
_CALLS = 2


def act_together(sessions: Sequence[Policy], observations: Sequence[Observation]) -> list[Actions | Exception]:
    """The next chunk of each session, or what it raised."""
    kind = type(sessions[0])
    if len(sessions) > 1 and issubclass(kind, Batched) and all(type(session) is kind for session in sessions):
        try:
            return list(kind.act_batch(cast("Sequence[Batched]", sessions), observations))
        except Exception as error:  # one's own, which the others must not suffer from: asked alone, it shows whose
            logger.info("asked one by one after all: %s: %s", type(error).__name__, error)
    return [_alone(session, observation) for session, observation in zip(sessions, observations, strict=True)]


def why_not_together(make_session: Callable[[], Policy], observations: Sequence[Observation], dimension: int) -> str:
    """Why sessions of a policy must be asked one by one; empty where together they answer what each answers alone, to `TOLERANCE`.

    Args:
        observations: two or more that differ; tried together, and all but the last.
        dimension: of an action.
    """
    kind = type(make_session())
    if not issubclass(kind, Batched):
        return f"{kind.__name__} has no act_batch"
    worst = 0.0
    for count in {2, len(observations)}:
        alone, together = ([make_session() for _ in range(count)] for _ in range(2))
        for session, observation in zip([*alone, *together], [*observations[:count], *observations[:count]], strict=True):
            session.reset(observation["task"])
        for _ in range(_CALLS):  # a second time: random numbers differ from call to call
            expected = [check_form(session.act(observation), dimension) for session, observation in zip(alone, observations, strict=False)]
            try:
                answers = list(kind.act_batch(cast("Sequence[Batched]", together), observations[:count]))
                found = [check_form(answer, dimension) for answer in answers]
            except Exception as error:
                return f"act_batch fails ({type(error).__name__}: {error})"
            if [answer.shape for answer in found] != [answer.shape for answer in expected]:
                return "act_batch answers in another form than act"
            worst = max(worst, *(float(np.abs(one - other).max()) for one, other in zip(found, expected, strict=True)))
    return f"act_batch answers {worst:.2g} away from act" if worst > TOLERANCE else ""


def _alone(session: Policy, observation: Observation) -> Actions | Exception:
    try:
        return session.act(observation)
    except Exception as error:
        return error
