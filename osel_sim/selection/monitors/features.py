"""What a learning monitor makes of a decision point: its signals as numbers of about like size, and leading components of the picture."""

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.monitor import DecisionPoint

SIGNALS = 6
"""Numbers that `signals` gives."""

LARGEST = 3.0
"""Signals are cut off there: one wild chunk is no reason to believe anything."""


def signals(point: DecisionPoint) -> NDArray[np.float64]:
    """Time used, its square; overlap, movement and change of the image on scales where 1 is much; whether chunks overlapped at all. (SIGNALS,)."""
    change = point.look.change()
    values = [
        point.time_used,
        point.time_used**2,
        0.0 if point.overlap is None else point.overlap / 0.5,
        0.0 if point.moved is None else point.moved / 0.1,
        0.0 if change is None else change / 0.05,
        0.0 if point.overlap is None else 1.0,
    ]
    return np.clip(np.array(values, np.float64), 0.0, LARGEST)
