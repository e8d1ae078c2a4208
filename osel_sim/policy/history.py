"""Several successive observations in one, for policies that look at more than the present.

Their arrays are stacked: images (n, H, W, 3) and state (n, S), the newest last. At the beginning of an episode, where there are fewer, the first is
repeated.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from osel_sim.interface.policy import Observation


class History:
    """The last observations of an episode.

    Args:
        length: how many a policy is shown, the present one included.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._past: deque[Observation] = deque(maxlen=length - 1)

    def remember(self, observation: Observation) -> None:
        """Keep what was to be seen before a control step."""
        self._past.append(observation)

    def with_present(self, observation: Observation) -> Observation:
        """What the policy is shown now."""
        if self.length == 1:
            return observation
        known = [*self._past, observation]
        return stacked([known[0]] * (self.length - len(known)) + known)


def stacked(observations: Sequence[Observation]) -> Observation:
    """Successive observations as one; what is no array is that of the last."""
    last = observations[-1]
    return {key: np.stack([one[key] for one in observations]) if isinstance(value, np.ndarray) else value for key, value in last.items()}


def split(observation: Observation) -> list[Observation]:
    """The observations that one consists of: itself, where it is no stack."""
    single = {"observation.state": 1}
    lengths = {len(value) for key, value in observation.items() if isinstance(value, np.ndarray) and value.ndim > single.get(key, 3)}
    if not lengths:
        return [observation]
    return [{key: value[index] if isinstance(value, np.ndarray) else value for key, value in observation.items()} for index in range(min(lengths))]
