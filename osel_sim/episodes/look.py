"""What a monitor may look at more closely at a decision point, made when it is asked for."""

from collections.abc import Callable

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.episodes.view import view
from osel_sim.interface.encoder import Encoder
from osel_sim.interface.environment import Environment, Image
from osel_sim.interface.monitor import Picture, Told

PICTURE_SIZE = 64
"""Pixels of the image of which `change` is told where there is no encoder."""


class LiveLook:
    """What may be looked at more closely at a decision point of an episode that goes on; a `Look`.

    Args:
        before: image at the decision point before, if somebody looked at it.
        ask: another policy, as `Look.difference`.

    Attributes:
        image: if somebody looked at it.
        busy: it is the simulator or a policy that is at work, not the monitor.
    """

    def __init__(self, env: Environment, instruction: str, encoder: Encoder | None, before: Image | None, ask: Callable[[str], float | None]) -> None:
        self._env, self._instruction, self._encoder, self._before, self._ask = env, instruction, encoder, before, ask
        self.image: Image | None = None
        self.busy = False
        self._picture: Picture | None = None
        self._changes: tuple[float | None, ...] = ()
        self._differences: dict[str, float | None] = {}

    def picture(self) -> Picture:
        """As `Look.picture`.

        Raises:
            UsageError: there is no encoder.
        """
        if self._encoder is None:
            raise UsageError("this episode has no encoder, so there are no pictures of its decision points")
        if self._picture is None:
            self._picture = self._encoder.encode([self._seen()], self._instruction)
        return self._picture

    def change(self) -> float | None:
        """As `Look.change`."""
        if not self._changes:
            now, before = self._seen(), self._before
            apart = None if before is None else float(np.mean(np.abs(now.astype(np.float64) - before)) / 255.0)
            self._changes = (apart,)
        return self._changes[0]

    def difference(self, policy: str) -> float | None:
        """As `Look.difference`."""
        if policy not in self._differences:
            self.busy = True
            self._differences[policy] = self._ask(policy)
            self.busy = False
        return self._differences[policy]

    def told(self) -> Told:
        """What was looked at."""
        return Told(self._picture, self._changes, dict(self._differences))

    def _seen(self) -> Image:
        if self.image is None:
            self.busy = True
            self.image = self._image()
            self.busy = False
        return self.image

    def _image(self) -> Image:
        if self._encoder is not None:
            return view(self._env, self._encoder)[0]
        return self._env.image(self._env.specification.context_camera, PICTURE_SIZE, PICTURE_SIZE, "fast")
