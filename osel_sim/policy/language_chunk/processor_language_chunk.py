"""The processor pipelines of the language-conditioned chunk policy: tokens, rotation, image size, normalisation."""

from typing import Any

from osel_sim.policy.language_chunk.configuration_language_chunk import LanguageChunkConfig
from osel_sim.policy.processing import Pipelines, make_pipelines


def make_language_chunk_pre_post_processors(config: LanguageChunkConfig, dataset_stats: dict[str, dict[str, Any]] | None = None) -> Pipelines:
    """Pre- and postprocessor, found by LeRobot's factory by this name.

    Args:
        dataset_stats: LeRobot statistics; only the state's mean and standard deviation are used.
    """
    return make_pipelines(config, dataset_stats)
