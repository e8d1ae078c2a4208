"""What a selector sees of an instance: its image(s) and instruction as one vector of fixed length. Encoders by name."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.names import DEFAULT_ENCODER, PLUGINS, embedded_encoders
from osel_sim.context.open_clip_encoder import OpenClipEncoder, load_open_clip
from osel_sim.context.text_encoders import SENTENCE, TFIDF, TextOnly, load_text_encoder
from osel_sim.core.errors import UsageError
from osel_sim.interface.encoder import Encoder, Image


def load_encoder(name: str = DEFAULT_ENCODER, device: str = "cpu") -> Encoder:
    """Load an encoder.

    Args:
        name: an embedded one (`osel_small`, `osel_suite`); `MODEL:TAG` for any open_clip model and pretrained tag (`ViT-L-14:openai`), fetched once;
            `MODEL:/path/to/weights.safetensors` for weights at hand; an open_clip folder (config and weights);
            `hf-hub:ORGANISATION/REPOSITORY`; `sentence:MODEL` for a sentence-transformers model, which looks at no images (a folder or a name of the
            model hub, such as `sentence:all-MiniLM-L6-v2`); `IMAGES+sentence:MODEL` for images by one and text by the other; or a name of the
            entry-point group `osel_sim.encoders` (a callable without arguments).
        device: torch device. On another than `cpu` results may differ in the last bits.

    Raises:
        UnknownNameError: no such encoder, model or tag; names the nearest.
        CheckpointError: weights cannot be downloaded, read, do not fit the model, or ask for code.
    """
    if name in PLUGINS and name not in embedded_encoders():
        return PLUGINS.load(name)()
    if "sentence:" in name or name.endswith("tfidf"):
        return load_text_encoder(name, device)
    return load_open_clip(name, device)


def load_log_encoder(name: str, texts: Sequence[str], with_images: bool, device: str = "cpu") -> Encoder:
    """Load an encoder for a log: of an open_clip encoder only the text half where there are no images.

    Raises:
        UsageError: an encoder of images for a log without any; otherwise as `load_encoder`.
    """
    if name.endswith(TFIDF) or SENTENCE in name:
        if "+" in name and not with_images and (name.endswith(f"+{TFIDF}") or f"+{SENTENCE}" in name):
            raise UsageError(f"encoder {name!r} wants images, and there are none; name the part after the + alone")
        return load_text_encoder(name, device, texts)
    encoder = load_encoder(name, device)
    return TextOnly(encoder) if isinstance(encoder, OpenClipEncoder) and not with_images else encoder


def encode_many(encoder: Encoder, instances: Sequence[tuple[Sequence[Image], str]]) -> NDArray[np.float32]:
    """Contexts (N, d) of (images, instruction) pairs.

    One after another on purpose: in a batch the last bits of a result would depend on its neighbours, and a resumed run on where it was cut.
    """
    contexts = [encoder.encode(images, instruction) for images, instruction in instances]
    return np.stack(contexts) if contexts else np.zeros((0, encoder.dimension), np.float32)
