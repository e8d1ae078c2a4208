"""A live run that finds out which encoder to go on with: its first decisions are encoded by all of them.

The selector is shown the contexts of the usual one. After some decisions it is asked which encoder tells about rewards. Where that is another, a new
selector takes over, and is told all decisions so far again, with the other encoder's contexts: policies, propensities and rewards as they were.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError
from osel_sim.episodes.changes import PolicyChanges
from osel_sim.formats.encoder_checks import CHECKS, EncoderCheck, read_checks, write_checks
from osel_sim.formats.encoder_choice import EncoderChoice
from osel_sim.formats.journal import Decision
from osel_sim.interface.encoder import Context, Encoder
from osel_sim.interface.selector import Choice, Selector
from osel_sim.selection.recalling import recalled

logger = logging.getLogger(__name__)

ASKED_AFTER = (60, 120, 240, 480)
"""Decisions after which it is asked, until another encoder than the usual one is taken. Later ones are not encoded by the others any more."""


class Judge(Protocol):
    """Says which encoder tells most about rewards (`osel_sim.analysis.live_encoder_choice.choose_live`)."""

    def __call__(self, decisions: Sequence[Decision], policies: Sequence[str], contexts: Mapping[str, NDArray[np.float32]]) -> EncoderChoice:
        """Of decisions so far, the policies there are now, and contexts (T, D) by identity, the usual encoder's first."""
        ...


class EncoderTrial:
    """The choice among encoders in a live run.

    Args:
        folder: of the run; what was found in it by an earlier process is not asked again.
        encoders: the usual one first.
        judge: says which of them it is.
        make: a selector for contexts of an encoder that has seen nothing yet, with random numbers of its own, and the run's changes of policies as it
            is told of them.
        asked_after: decisions after which it is asked.

    Raises:
        DataError: what the folder says of earlier choices is damaged.
    """

    def __init__(
        self,
        folder: Path,
        encoders: Sequence[Encoder],
        judge: Judge,
        make: Callable[[Encoder], tuple[Selector, PolicyChanges]],
        asked_after: Sequence[int] = ASKED_AFTER,
    ) -> None:
        self._folder, self._encoders, self._judge, self.make, self._asked_after = folder, tuple(encoders), judge, make, tuple(asked_after)
        self._noted = {check.before: check for check in read_checks(folder)}
        self.checks: list[EncoderCheck] = []

    @property
    def tried(self) -> Sequence[Encoder]:
        """Those that the next decision's instance is to be encoded by besides the usual one; none once it is settled."""
        return () if self.checks and self.checks[-1].final else self._encoders[1:]

    @property
    def words(self) -> str:
        """What it has come to so far, as a sentence without its full stop."""
        if self.checks:
            return self.checks[-1].words
        return f"encoder {self._encoders[0].identity}: which one predicts rewards is asked after {self._asked_after[0]} decisions"

    def due(self, count: int) -> bool:
        """Whether it is to be asked after so many decisions."""
        return bool(self.tried) and count in self._asked_after

    def ask(self, decisions: Sequence[Decision], policies: Sequence[str], contexts: Callable[[Encoder], NDArray[np.float32]]) -> Encoder:
        """The encoder to go on with.

        Args:
            decisions: all so far; as many as it is to be asked after.
            policies: that there are now.
            contexts: (T, D) of all so far, by an encoder.

        Raises:
            DataError: an earlier process took one that is not there.
        """
        before = len(decisions)
        if (check := self._noted.get(before)) is None:
            choice = self._judge(decisions, policies, {encoder.identity: contexts(encoder) for encoder in self._encoders})
            check = EncoderCheck(before, choice, choice.encoder != choice.usual or before >= self._asked_after[-1])
            write_checks(self._folder, [*self.checks, check])
            logger.info("%s", check.words)
        self.checks.append(check)
        return self._encoder(check)

    def _encoder(self, check: EncoderCheck) -> Encoder:
        known = {encoder.identity: encoder for encoder in self._encoders}
        if check.choice.encoder not in known:
            raise DataError(
                f"{self._folder / CHECKS}: from decision {check.before} on the encoder is {check.choice.encoder!r}, which is none of "
                f"{', '.join(known)}: it has other weights by now, or is not installed"
            )
        return known[check.choice.encoder]


def tell_again(
    selector: Selector,
    changes: PolicyChanges,
    decisions: Sequence[Decision],
    contexts: Sequence[Context],
    learn: Callable[[Context, Choice, Decision], None],
) -> None:
    """Let a selector that has seen nothing yet live through decisions that another one made, policies that joined and left included.

    Args:
        contexts: of the decisions, as the selector is to be shown them.
        learn: lets it learn from one.
    """
    for decision, context in zip(decisions, contexts, strict=True):
        changes.apply(selector, decision.index)
        learn(context, recalled(selector, context, decision.policy, decision.propensities), decision)
