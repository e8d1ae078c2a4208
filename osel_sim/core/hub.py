"""The hub that weights may come from: what is not there has to fail soon, also where there is no network."""

from collections.abc import Iterator
from contextlib import contextmanager

SECONDS = 3.0


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
