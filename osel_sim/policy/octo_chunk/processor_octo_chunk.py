"""The processor pipelines of the Octo-style policy: tokens, rotation, image size, normalisation."""

from typing import Any

from osel_sim.policy.octo_chunk.configuration_octo_chunk import OctoChunkConfig
from osel_sim.policy.processing import Pipelines, make_pipelines


def make_octo_chunk_pre_post_processors(config: OctoChunkConfig, dataset_stats: dict[str, dict[str, Any]] | None = None) -> Pipelines:
    """Pre- and postprocessor, found by LeRobot's factory by this name.

    Args:
        dataset_stats: LeRobot statistics; mean and standard deviation of state and action are used.
    """
    return make_pipelines(config, dataset_stats)
