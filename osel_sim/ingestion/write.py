"""An ingested log on disk: contexts first, resumable; then `ingest.json` and the log itself, at once."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from osel_sim.context.appended import Appended
from osel_sim.core.errors import UsageError
from osel_sim.core.files import content_digest, is_partial, read_json, write_json
from osel_sim.formats.rollout_log import ROLLOUTS, Row, read_rollouts, write_rollouts
from osel_sim.interface.encoder import Encoder, Image, TextEncoder

if TYPE_CHECKING:
    from osel_sim.context.cache import ContextCache

BATCH = 32
"""Texts that are encoded at once."""
INGEST = "ingest.json"
AUTOSAVE = 500


@dataclass(frozen=True)
class IngestedInstance:
    """What an instance's context is made from.

    Attributes:
        digest: of all that its images depend on; where it or the text differs, so may the context.
        images: loads them, uint8 (H, W, 3) RGB.
    """

    key: str
    text: str
    digest: str
    images: Callable[[], Sequence[Image]]


def check_out(folder: Path, instances: Iterable[IngestedInstance]) -> str:
    """Refuse an output folder that holds something else, before anything heavy is loaded.

    Returns:
        a digest of the instances, for `write_log`.

    Raises:
        UsageError: the folder is in use, by a log or by the contexts of other instances.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is a file; give a folder")
    inputs = content_digest(json.dumps([(item.key, item.text, item.digest) for item in instances], ensure_ascii=False))
    file = folder / INGEST
    if file.exists():
        if read_json(file).get("instances") != inputs:
            raise UsageError(f"--out {folder} holds the contexts of other instances, or of other files; give another folder")
    elif folder.exists() and any(not is_partial(item) for item in folder.iterdir()):
        raise UsageError(f"--out {folder} is not empty and holds no {INGEST}; give a new folder")
    return inputs


def write_log(
    folder: Path,
    inputs: str,
    rows: list[Row],
    instances: Sequence[IngestedInstance],
    load_encoder: Callable[[], Encoder],
    metadata: dict[str, Any],
    appended: Appended | None = None,
) -> str:
    """Encode what is not encoded yet, with a progress bar, and write the log. An interrupted one goes on where it was.

    A log that is there already stays, if it is the same: then only contexts of another encoder are added.

    Args:
        inputs: from `check_out`.
        metadata: of the log; the encoder is added.
        appended: to the context of each instance, in a second set of contexts, which the log then names as its own.

    Returns:
        the encoder's identity, with what is appended.

    Raises:
        UsageError: another log is there.
    """
    from osel_sim.context.cache import ContextCache
    from osel_sim.core.progress import progress

    there = (folder / ROLLOUTS).exists()
    if there and read_rollouts(folder)[0] != rows:
        raise UsageError(f"--out {folder} holds a log with other outcomes; give another folder")
    encoder = load_encoder()
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / INGEST, {"instances": inputs})
    cache = ContextCache(folder, autosave=AUTOSAVE)
    missing = {item.key for item in instances if cache.get(encoder.identity, item.key) is None}
    try:
        with progress(len(instances), "context", initial=len(instances) - len(missing), quiet=not missing) as bar:
            for batch in _batches(instances, encoder):
                if missing.isdisjoint(item.key for item in batch):
                    continue
                _encode(batch, encoder, cache)
                bar.update(len(missing.intersection(item.key for item in batch)))
        identity = encoder.identity
        if appended is not None:
            table = cache.table(identity, [item.key for item in instances])
            identity += appended.name
            for item, context in zip(instances, np.concatenate([table, appended.parts], axis=1), strict=True):
                if cache.get(identity, item.key) is None:
                    cache.put(identity, item.key, context)
    finally:
        cache.save()
    if not there:
        write_rollouts(folder, rows, {**metadata, "encoder": identity})
    return identity


def _encode(batch: Sequence[IngestedInstance], encoder: Encoder, cache: "ContextCache") -> None:
    """Put the contexts of a batch into the cache."""
    if isinstance(encoder, TextEncoder):
        texts = list(dict.fromkeys(item.text for item in batch))
        contexts = dict(zip(texts, encoder.encode_texts(texts), strict=True))
        for item in batch:
            cache.put(encoder.identity, item.key, contexts[item.text])
    else:
        for item in batch:
            cache.encode(encoder, item.key, item.images, item.text)


def name_encoder(folder: Path, identity: str) -> None:
    """Make an encoder the log's own, whose contexts are taken where none is named."""
    rows, metadata = read_rollouts(folder)
    if metadata["encoder"] != identity:
        write_rollouts(folder, rows, {**metadata, "encoder": identity})


def _batches(instances: Sequence[IngestedInstance], encoder: Encoder) -> list[list[IngestedInstance]]:
    """What is encoded at once: the instances of some texts of about one length, else one instance after another.

    The last bits of a context depend on its neighbours in the batch. So batches are the same wherever an encoding was interrupted, and instances of
    one text are in one batch.
    """
    if not isinstance(encoder, TextEncoder):
        return [[item] for item in instances]
    of_text: dict[str, list[IngestedInstance]] = {}
    for item in instances:
        of_text.setdefault(item.text, []).append(item)
    texts = sorted(of_text, key=lambda text: (len(text), text))
    return [[item for text in texts[start : start + BATCH] for item in of_text[text]] for start in range(0, len(texts), BATCH)]
