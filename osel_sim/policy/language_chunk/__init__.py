"""A small language-conditioned policy as a LeRobot plugin of type `language_chunk`; importing this package registers it.

The file and class names follow LeRobot's convention for plugins (`configuration_*`, `modeling_*`, `processor_*`), by which its factory
finds the policy class and the processors of a registered configuration.
"""

from osel_sim.policy.language_chunk.configuration_language_chunk import LanguageChunkConfig
from osel_sim.policy.language_chunk.modeling_language_chunk import LanguageChunkPolicy
from osel_sim.policy.language_chunk.processor_language_chunk import make_language_chunk_pre_post_processors

__all__ = ["LanguageChunkConfig", "LanguageChunkPolicy", "make_language_chunk_pre_post_processors"]
