"""An Octo-style policy as a LeRobot plugin of type `octo_chunk`: a transformer with readout tokens and a flow-matching action head.

Importing this package registers it. File and class names follow LeRobot's convention for plugins, as those of `language_chunk` do.
"""

from osel_sim.policy.octo_chunk.configuration_octo_chunk import OctoChunkConfig
from osel_sim.policy.octo_chunk.modeling_octo_chunk import OctoChunkPolicy
from osel_sim.policy.octo_chunk.processor_octo_chunk import make_octo_chunk_pre_post_processors

__all__ = ["OctoChunkConfig", "OctoChunkPolicy", "make_octo_chunk_pre_post_processors"]
