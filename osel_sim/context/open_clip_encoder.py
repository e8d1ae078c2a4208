"""open_clip models as encoders: image and text embeddings, concatenated."""

import gzip
import logging
import textwrap
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.names import CONFIG, DEFAULT_ENCODER, PLUGINS, embedded_encoders
from osel_sim.core.errors import CheckpointError, UnknownNameError, UsageError, nearest
from osel_sim.core.files import file_digest, read_json
from osel_sim.core.hub import offline_if_unreachable, why_silent
from osel_sim.core.trust import ForeignCodeError, no_foreign_code, what_failed
from osel_sim.interface.encoder import Context, Image

WEIGHTS = "open_clip_model.safetensors"
VOCABULARY = "bpe_vocabulary.txt.gz"
MAX_VOCABULARY = 16 << 20  # bytes, inflated; CLIP's own has 3 MB


def load_open_clip(name: str, device: str = "cpu") -> "OpenClipEncoder":
    """Load an embedded encoder, an open_clip folder, `hf-hub:ORGANISATION/REPOSITORY`, `MODEL:TAG` or `MODEL:FILE`.

    Raises:
        UnknownNameError: no such encoder, model or tag; names the nearest.
        CheckpointError: weights cannot be downloaded, read, do not fit the model, or ask for code.
    """
    embedded = embedded_encoders()
    if name in embedded:
        return OpenClipEncoder.from_folder(embedded[name], name, device)
    if (Path(name) / CONFIG).is_file():
        return OpenClipEncoder.from_folder(Path(name), name, device)
    import open_clip

    model, separator, weights = name.partition(":")
    models: list[str] = open_clip.list_models()
    if model == "hf-hub" and weights:
        return OpenClipEncoder(name, name, *_create(name, name, device))
    if model not in models:
        raise _unknown_model(model, [*embedded, *PLUGINS], models)
    tags: list[str] = open_clip.list_pretrained_tags_by_model(model)
    if not separator or not weights:
        raise UsageError(f"encoder {name!r} needs weights: {model}:TAG with one of {', '.join(tags) or 'no known tags'}, or {model}:/path/to/weights")
    identity = name
    options: dict[str, Any] = {}
    if weights in tags:
        # OpenAI's weights want QuickGELU; open_clip only warns when the model's config says otherwise, and embeds badly.
        options["force_quick_gelu"] = bool(open_clip.get_pretrained_cfg(model, weights).get("quick_gelu", False)) or "quickgelu" in model
    elif Path(weights).is_file() and Path(weights).suffix != ".safetensors":
        raise CheckpointError(
            f"encoder {name!r}: {weights} is no .safetensors file, and weights in other files can hold code: "
            "read them where you trust them, and save them by safetensors.torch.save_file"
        )
    elif Path(weights).is_file():
        identity = f"{model}@{digest(Path(weights))}"
    elif "/" in weights or Path(weights).suffix:
        raise CheckpointError(f"encoder {name!r}: no such file: {weights}")
    else:
        raise UnknownNameError(f"pretrained weights of {model}", weights, tags, f"or {model}:/path/to/weights.safetensors")
    return OpenClipEncoder(name, identity, *_create(model, name, device, pretrained=weights, **options))


class OpenClipEncoder:
    """Image embedding (the mean, if there are several) and text embedding of an open_clip model, each of length one, concatenated."""

    def __init__(self, name: str, identity: str, model: Any, tokenizer: Any) -> None:
        from open_clip.transform import PreprocessCfg, image_transform_v2

        self.name, self.identity = name, identity
        self.model, self.tokenizer = model, tokenizer
        self.device = next(model.parameters()).device
        self._preprocess = image_transform_v2(PreprocessCfg(**model.visual.preprocess_cfg), is_train=False)
        size = model.visual.image_size
        self.image_size = int(size[0] if isinstance(size, tuple | list) else size)
        self.dimension = 2 * len(self.embed_text("x"))

    @classmethod
    def from_folder(cls, folder: Path, name: str, device: str = "cpu") -> "OpenClipEncoder":
        """Load an open_clip folder: `open_clip_config.json`, safetensors, and where present its own vocabulary."""
        weights, vocabulary = folder / WEIGHTS, folder / VOCABULARY
        if not weights.is_file():
            raise CheckpointError(f"encoder {name!r}: {weights} is missing")
        own = None
        if vocabulary.is_file():
            _check_vocabulary(vocabulary)
            own = str(vocabulary)
        return cls(name, f"{folder.name}@{digest(weights)}", *_create(f"local-dir:{folder}", name, device, own))

    def encode(self, images: Sequence[Image], instruction: str) -> Context:
        """Context (d,) float32: image embedding (d/2,), then text embedding (d/2,), each of length one."""
        return np.concatenate([self.embed_images(images), self.embed_text(instruction)]).astype(np.float32)

    def embed_images(self, images: Sequence[Image]) -> NDArray[np.float32]:
        """Mean embedding (d/2,) of one or more images, of length one."""
        if not images:
            raise UsageError("a context needs at least one image")
        mean: NDArray[np.float32] = np.mean([self.embed_image(image) for image in images], axis=0)
        return mean / max(float(np.linalg.norm(mean)), 1e-12)

    def embed_image(self, image: Image) -> NDArray[np.float32]:
        """Embedding (d/2,) of length one of a uint8 (H, W, 3) RGB image."""
        import torch
        from PIL import Image as PillowImage

        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise UsageError(f"an image must be uint8 (H, W, 3), got {image.dtype} {image.shape}")
        with torch.inference_mode():
            pixels = self._preprocess(PillowImage.fromarray(image))[None].to(self.device)
            embedding: NDArray[np.float32] = self.model.encode_image(pixels, normalize=True)[0].float().cpu().numpy()
        return embedding

    def embed_text(self, text: str) -> NDArray[np.float32]:
        """Embedding (d/2,) of length one."""
        embedding: NDArray[np.float32] = self.embed_texts([text])[0]
        return embedding

    def embed_texts(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Embeddings (n, d/2) of length one, in one batch."""
        import torch

        with torch.inference_mode():
            tokens = self.tokenizer(list(texts)).to(self.device)
            embeddings: NDArray[np.float32] = self.model.encode_text(tokens, normalize=True).float().cpu().numpy()
        return embeddings


def _create(model: str, name: str, device: str, vocabulary: str | None = None, **options: Any) -> tuple[Any, Any]:
    """An open_clip model with its weights in evaluation mode, and its tokenizer; whatever goes wrong inside open_clip becomes one line."""
    import open_clip

    own = {} if vocabulary is None else {"bpe_path": vocabulary}
    may_ask = _may_ask_the_hub(model, options)
    try:
        with _quiet(), offline_if_unreachable() if may_ask else nullcontext(), no_foreign_code():
            loaded = open_clip.create_model(model, device=device, require_pretrained=True, weights_only=True, **options).eval()
            return loaded, open_clip.get_tokenizer(model, **own)
    except Exception as error:  # open_clip raises RuntimeError, KeyError, OSError, SafetensorError ... for what a user may get wrong
        failed = what_failed(error)
        if isinstance(failed, ForeignCodeError):
            raise ForeignCodeError(f"encoder {name!r}: {failed}") from None
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CheckpointError(
            f"encoder {name!r}: {textwrap.shorten(reason, 220, placeholder=' ...')}{why_silent() if may_ask else ''}; "
            f"without network, pass weights you have as MODEL:/path/to/weights.safetensors, or use the embedded {DEFAULT_ENCODER!r}"
        ) from None


def _may_ask_the_hub(model: str, options: Mapping[str, Any]) -> bool:
    """Whether anything of a model may have to come from the hub: its weights, or the text model and tokenizer that its configuration names."""
    import open_clip

    kind, _, folder = model.rpartition(":")
    if kind == "local-dir":
        config = read_json(Path(folder) / CONFIG).get("model_cfg")
    elif kind or not Path(str(options.get("pretrained"))).is_file():
        return True
    else:
        config = open_clip.get_model_config(model)
    parts = config.values() if isinstance(config, dict) else ()
    return any(str(key).startswith("hf_") and value for part in parts if isinstance(part, dict) for key, value in part.items())


def _check_vocabulary(file: Path) -> None:
    """Refuse what open_clip would inflate without a bound."""
    try:
        with gzip.open(file) as handle:
            size = len(handle.read(MAX_VOCABULARY + 1))
    except (OSError, EOFError, zlib.error) as error:
        raise CheckpointError(f"{file}: cannot be read ({error})") from None
    if size > MAX_VOCABULARY:
        raise CheckpointError(f"{file}: holds more than {MAX_VOCABULARY} bytes")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without open_clip's warnings and log lines."""
    disabled = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


def _unknown_model(name: str, embedded: Sequence[str], models: Sequence[str]) -> UnknownNameError:
    """Open_clip knows some 150 models: list the embedded encoders and the models nearest to what was asked."""
    near = nearest(name, [*embedded, *models], 5)
    return UnknownNameError("encoder", name, {*embedded, *near}, "and MODEL:TAG of open_clip.list_pretrained()")


def digest(file: Path) -> str:
    """The beginning of a file's SHA-256, for identities."""
    return file_digest(file)[:12]
