"""`run --encoder auto`: which encoders there are to choose from, what the choice does not go with, and who makes it."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.api.run_settings import RunConfig
from osel_sim.core.errors import SettingError
from osel_sim.formats.encoder_choice import AUTO

if TYPE_CHECKING:
    from osel_sim.episodes.changes import PolicyChanges
    from osel_sim.episodes.encoder_trial import EncoderTrial
    from osel_sim.interface.encoder import Encoder
    from osel_sim.interface.selector import Selector

LATER = 1
"""Keeps the random numbers of a selector that takes over apart from those of the one before: they were drawn, and propensities are of fresh ones."""


def candidates() -> list[str]:
    """Names of the encoders that work on this machine as it is and need no log; the usual one first: those that come with the package, those of other
    packages, and those of texts."""
    from osel_sim.context.names import DEFAULT_ENCODER, PLUGINS, embedded_encoders
    from osel_sim.context.text_encoders import TFIDF, text_encoders_at_hand

    texts = [name for name in text_encoders_at_hand() if name != TFIDF]  # tf-idf is fitted on texts that a run has yet to come to
    return list(dict.fromkeys([DEFAULT_ENCODER, *embedded_encoders(), *sorted(PLUGINS.others()), *texts]))


def check_encoder(config: RunConfig) -> None:
    """Refuse what goes with one encoder only.

    Raises:
        SettingError: naming what it is, and what to do instead.
    """
    if config.encoder != AUTO:
        return
    for given, flag, why in (
        (config.warm_start, "--warm-start", "whose contexts are of one encoder: name that one; replay LOG --encoder auto chooses among a log's"),
        (config.monitor, "--monitor", "which looks at pictures by one encoder from the first call on: name the encoder"),
        (config.robots > 1, "--robots", "which share what they learned from contexts of one encoder: name the encoder"),
        (config.budget_cents is not None, "--budget-cents", "whose price of a cent is learned from contexts of one encoder: name the encoder"),
    ):
        if given:
            raise SettingError("encoder", f"{AUTO} does not go with {flag}, {why}")


def encoders_said(config: RunConfig) -> dict[str, Any]:
    """What a run's configuration says of the encoders that it chooses among; nothing where it was told which it is."""
    return {"encoders": candidates()} if config.encoder == AUTO else {}


def load_encoders(config: RunConfig) -> "tuple[Encoder, ...]":
    """The encoders that a run may come to use, the one that it begins with first."""
    from osel_sim.context.encoder import load_encoder
    from osel_sim.context.names import DEFAULT_ENCODER

    names = candidates() if config.encoder == AUTO else [config.encoder or DEFAULT_ENCODER]
    return tuple(map(load_encoder, names))


def encoder_said(config: RunConfig, usual: "Encoder") -> str:
    """Identity of the encoder that `run.json` names: the one that a run which is resumed had come to.

    Raises:
        DataError: what its folder says of that is damaged.
    """
    if config.encoder != AUTO or not config.resume:
        return usual.identity
    from osel_sim.formats.encoder_checks import name_encoder, read_checks

    checks = read_checks(config.folder)
    name_encoder(config.folder, checks)
    return checks[-1].choice.encoder if checks else usual.identity


def make_trial(
    config: RunConfig,
    folder: Path,
    encoders: "tuple[Encoder, ...]",
    make: "Callable[[Encoder, int], tuple[Selector, PolicyChanges]]",
) -> "EncoderTrial | None":
    """Who finds out which encoder a run goes on with; None where it was told.

    Args:
        make: makes a selector for an encoder's contexts, of a seed, and the run's changes as it is told of them.
    """
    if config.encoder != AUTO:
        return None
    from osel_sim.analysis.live_encoder_choice import choose_live
    from osel_sim.episodes.encoder_trial import EncoderTrial
    from osel_sim.selection.fleet import robot_seed

    return EncoderTrial(folder, encoders, choose_live, lambda encoder: make(encoder, robot_seed(config.seed, LATER)))
