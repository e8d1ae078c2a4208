"""The hub that weights may come from: what is not there fails soon, also without network, and says which variable stands in the way."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from osel_sim.core.proxies import settings

SECONDS = 3.0
_WANTED = ("*.json", "*.safetensors", "*.txt", "*.model", "*.jinja")
"""What is downloaded of a model: no code and no pickle."""
_LEFT_OUT = ("checkpoints/*", "training_state/*", "*/training_state/*", "onnx/*", "openvino/*")


def download(repository: str) -> Path:
    """The folder with one revision of a model's data files, from the hub or the local cache of it.

    Raises:
        Exception: of the hub's client; there are many.
    """
    from huggingface_hub import snapshot_download

    return Path(snapshot_download(repository, allow_patterns=list(_WANTED), ignore_patterns=list(_LEFT_OUT)))


@contextmanager
def offline_if_unreachable() -> Iterator[None]:
    """Within, the hub's client takes what its local cache has if the hub does not answer, instead of half a minute of retries for every file.

    For what may come from the hub only: an HTTP client cannot even be made where the environment names a proxy or a certificate that it cannot use.
    """
    from huggingface_hub import constants

    offline = constants.HF_HUB_OFFLINE
    try:
        constants.HF_HUB_OFFLINE = offline or _unreachable() is not None
        yield
    finally:
        constants.HF_HUB_OFFLINE = offline


def why_silent() -> str:
    """What to add to the message where something of the hub cannot be had: why it does not answer, and what the environment says about the way to it.

    Empty if it does answer.
    """
    problem = _unreachable()
    if problem is None:
        return ""
    said = settings()
    return f"; the hub cannot be reached ({problem}" + (f"; the environment sets {', '.join(said)}" if said else "") + ")"


def _unreachable() -> str | None:
    """Why the hub does not answer, or None if it does, or nobody may ask it."""
    import httpx
    from huggingface_hub import constants

    if os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "ON", "YES", "TRUE"):
        return f"HF_HUB_OFFLINE={os.environ['HF_HUB_OFFLINE']}"
    try:
        httpx.head(constants.ENDPOINT, timeout=SECONDS)
    except Exception as error:  # no network; or no client, for want of a package, a certificate, or sense in a proxy's address: each has its own
        return " ".join(str(error).split()) or type(error).__name__
    return None
