"""Names of encoders. Imports nothing heavy: `--list` shows them."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core.content import root
from osel_sim.core.registry import Registry

if TYPE_CHECKING:  # imports numpy
    from osel_sim.interface.encoder import Encoder

DEFAULT_ENCODER = "osel_small"
TASK = "task"
"""What stands for the name of the task where parts of a context are named."""
CONFIG = "open_clip_config.json"
PLUGINS: "Registry[Callable[[], Encoder]]" = Registry("encoder", "osel_sim.encoders", {})
"""Encoders of other packages."""

ABOUT = {"osel_small": "trained on pick_place; the default", "osel_suite": "trained on all tasks: for choosing among several"}
"""What the encoders that come with the package know."""
FORMS = {
    "MODEL:TAG": "an open_clip model with weights that are fetched once, such as ViT-L-14:openai",
    "MODEL:FILE": "an open_clip model with weights at hand (.safetensors)",
    "FOLDER": "an open_clip folder, such as osel_sim.train --encoder writes",
    "sentence:MODEL": "a sentence-transformers model, which looks at no images (extra text)",
    "tfidf": "words of the log's own texts, for osel_sim.ingest only",
    "auto": "whichever of those at hand predicts rewards, by the evidence (run, replay and ingest)",
}
"""What else `--encoder` takes."""


def embedded_encoders() -> dict[str, Path]:
    """Name -> folder of the encoders that come with the package, no download needed."""
    return {config.parent.name: config.parent for config in sorted((root() / "assets" / "encoders").glob(f"*/{CONFIG}"))}
