"""Which of several encoders it is, and why: of a log, or of a live run that goes on with it."""

from collections.abc import Mapping
from dataclasses import dataclass

AUTO = "auto"
"""What stands for the choice among encoders."""

CHOOSING_HALF = "instances of the choosing half"


@dataclass(frozen=True)
class EncoderChoice:
    """Which encoder it is, and why.

    Attributes:
        encoder: identity of the one chosen.
        instances: how many it was chosen on.
        gains: identity -> reward that a router on its contexts has over the best single policy, and the standard error; the usual one first.
    """

    encoder: str
    instances: int
    gains: Mapping[str, tuple[float, float]]

    @property
    def usual(self) -> str:
        """Identity of the one that it is unless another is ahead."""
        return next(iter(self.gains))

    def words(self, of: str) -> str:
        """In one sentence.

        Args:
            of: what it was chosen on.
        """
        if len(self.gains) < 2:
            return f"encoder {self.encoder}: the only one to choose from"
        said = ", ".join(f"{name} {gain:+.4f} ± {error:.4f}" for name, (gain, error) in self.gains.items())
        stays = self.encoder == self.usual
        why = "none is ahead of it by more than the error" if stays else f"ahead of {self.usual} by more than the error"
        return f"encoder {self.encoder}, {why}: over the best single policy a router gains on {self.instances} {of} {said}"

    def __str__(self) -> str:
        """In one sentence, of a log."""
        return self.words(CHOOSING_HALF)
