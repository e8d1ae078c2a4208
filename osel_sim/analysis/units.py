"""What was drawn independently in a log: its units. Intervals ask what other units would have given."""

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import LoggedInstance, LoggedOutcomes
from osel_sim.interface.robot import DEFAULT_ROBOT


def units_of(log: LoggedOutcomes) -> NDArray[np.int64]:
    """Number of each instance's unit, (N,), from 0 on.

    Instances of one scene are one unit, however they are phrased or perturbed: the same task, split, seed and robot, where a log was recorded here.
    Elsewhere instances of the same text are one: 60 questions of which each stands in ten rows are 60. Where all have the same text, or none, it
    tells nothing apart, and each instance is a unit.
    """
    texts = {_text(instance) for instance in log.instances}
    numbers: dict[tuple[object, ...], int] = {}
    return np.array([numbers.setdefault(_name(instance, len(texts) > 1), len(numbers)) for instance in log.instances], np.int64)


def _name(instance: LoggedInstance, by_text: bool) -> tuple[object, ...]:
    if instance.seed is not None and instance.key.startswith(f"{instance.task}/{instance.split}/"):
        return "scene", instance.task, instance.split, instance.seed, instance.robot or DEFAULT_ROBOT
    text = _text(instance)
    return ("text", text) if by_text and text else ("instance", instance.key)


def _text(instance: LoggedInstance) -> str:
    return " ".join((instance.instruction or "").casefold().split())
