"""The hub that weights may come from: what is not there has to fail soon, also where there is no network."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    """Within, the hub's client takes what its local cache has if the hub does not answer, instead of half a minute of retries for every file."""
    import httpx
    from huggingface_hub import constants

    offline = constants.HF_HUB_OFFLINE
    try:
        if not offline:
            try:
                httpx.head(constants.ENDPOINT, timeout=SECONDS)
            except httpx.HTTPError:
                constants.HF_HUB_OFFLINE = True
        yield
    finally:
        constants.HF_HUB_OFFLINE = offline
