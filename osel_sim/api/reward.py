"""The reward that settings ask for."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from osel_sim.api.settings import RewardSettings

if TYPE_CHECKING:
    from osel_sim.selection.reward import RewardWeights

DEFAULT_PRESET = "oxe"
FLAGS = ("preset", "alpha_time", "alpha_price", "time_unit", "success")
"""Settings that say what the reward is."""


def weights_of(
    config: RewardSettings, metadata: Mapping[str, Any] | None = None, recorded: Mapping[str, Any] | None = None
) -> "tuple[RewardWeights, str | None]":
    """Weights of the reward, and the preset's name where they are a preset's.

    Args:
        metadata: of the log.
        recorded: weights of a live run, which count where no preset is named.
    """
    from osel_sim.selection.reward import PRESETS, RewardWeights, preset

    base = RewardWeights(**recorded) if recorded and config.preset is None else preset(config.preset or DEFAULT_PRESET)
    given = {key: value for key in FLAGS if key != "preset" and (value := getattr(config, key, None)) is not None}
    if measured_by_score(metadata) and base.success == "success" and "success" not in given:
        # The paper's S of Open X-Embodiment is minus the action MSE; success is the score within a tolerance there.
        given["success"] = "score"
    weights = replace(base, **given)
    return weights, next((name for name, known in PRESETS.items() if known == weights), None)


def measured_by_score(metadata: Mapping[str, Any] | None) -> bool:
    """Whether a log was made by `osel_sim.ingest --metric action-mse`."""
    source = (metadata or {}).get("source")
    return isinstance(source, Mapping) and source.get("metric") == "action-mse"
