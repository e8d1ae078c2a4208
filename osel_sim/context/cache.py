"""Contexts on disk: `contexts.npz` beside a journal or rollout log, keyed by encoder and instance."""

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from osel_sim.core.arrays import read_arrays
from osel_sim.core.errors import DataError, UsageError
from osel_sim.core.files import atomic
from osel_sim.interface.encoder import Context, Encoder, Image

logger = logging.getLogger(__name__)

FILE = "contexts.npz"
_DIGEST = re.compile(r"@[^+#]*|#\w+")
"""What an identity has besides names: digests, and which part of a context it is."""
EXAMPLE = "skill:"
"""How the keys of examples of skills begin; an instance's begins with the name of its task."""


class ContextCache:
    """Contexts of any number of encoders in one `contexts.npz`.

    The file holds for each encoder `<identity>|instances` (N,) unicode, sorted, and `<identity>|contexts` (N, d) float32. It is replaced
    whole and atomically, so a reader or a killed run always finds a complete one, and the same contents are the same bytes.
    One process writes; workers hand it their contexts. Examples of skills lie among the instances, as `skill:NAME:NUMBER`.

    Args:
        folder: where `contexts.npz` lies or will lie.
        autosave: write the file whenever that many new contexts came in, and a twentieth of those that are there (0: only on `save`).
        mend: begin anew, with a warning, where the file that is there is damaged: for those who can make the contexts again.

    Raises:
        DataError: the file that is there cannot be read or has another form.
    """

    def __init__(self, folder: Path, autosave: int = 100, mend: bool = False) -> None:
        self.file = folder / FILE
        self._autosave, self._unsaved = autosave, 0
        self._contexts: dict[str, dict[str, Context]] = {}
        try:
            self._contexts = _read(self.file) if self.file.exists() else {}
        except DataError as error:
            if not mend:
                raise
            logger.warning("%s; its contexts are made again", error)

    def encoders(self) -> list[str]:
        """Identities of the encoders that have contexts here."""
        return sorted(self._contexts)

    def items(self, encoder: str) -> Iterator[tuple[str, Context]]:
        """Key and context of everything that an encoder, given by its identity, has here; examples of skills among it."""
        return iter(self._contexts.get(encoder, {}).items())

    def get(self, encoder: str, instance: str) -> Context | None:
        """The context (d,) of an instance, or None. `encoder` is an identity, or a name where only one identity here has it."""
        return self._contexts.get(self.identity(encoder), {}).get(instance)

    def table(self, encoder: str, instances: Sequence[str]) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        """Contexts (N, d) of these instances, in their order.

        Raises:
            DataError: an encoder or instance has no context here.
        """
        known = self._contexts.get(self.identity(encoder))
        if known is None:
            raise DataError(f"{self.file}: no contexts of encoder {encoder!r}, only of: {', '.join(self.encoders()) or 'none'}")
        missing = [instance for instance in instances if instance not in known]
        if missing:
            raise DataError(f"{self.file}: encoder {encoder!r} has no context of {len(missing)} instances, the first of them {missing[0]!r}")
        return np.stack([known[instance] for instance in instances])

    def examples(self, encoder: str, skill: str) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        """Contexts (n, d) of the examples of a skill, in order; (0, 0) if there are none."""
        known, found = self._contexts.get(self.identity(encoder), {}), list[Context]()
        while _example(skill, len(found)) in known:
            found.append(known[_example(skill, len(found))])
        return np.stack(found) if found else np.zeros((0, 0), np.float32)

    def skills(self, encoder: str) -> list[str]:
        """Names of the skills that have examples here, sorted."""
        known = self._contexts.get(self.identity(encoder), {})
        return sorted({key.removeprefix(EXAMPLE).rpartition(":")[0] for key in known if key.startswith(EXAMPLE)})

    def put_examples(self, encoder: str, skill: str, contexts: Sequence[Context]) -> None:
        """Set the examples of a skill."""
        for row in range(len(self.examples(encoder, skill))):
            del self._contexts[encoder][_example(skill, row)]
        for row, context in enumerate(contexts):
            self.put(encoder, _example(skill, row), context)

    def put(self, encoder: str, instance: str, context: Context) -> None:
        """Add a context; `encoder` is an identity."""
        if context.dtype != np.float32 or context.ndim != 1 or not np.isfinite(context).all():
            raise UsageError(f"a context must be finite float32 (d,), got {context.dtype} {context.shape}")
        known = self._contexts.setdefault(encoder, {})
        if known and len(next(iter(known.values()))) != len(context):
            raise UsageError(f"contexts of encoder {encoder!r} have length {len(next(iter(known.values())))}, got {len(context)}")
        known[instance] = context
        self._unsaved += 1
        if self._autosave and self._unsaved >= max(self._autosave, len(known) // 20):
            self.save()

    def encode(self, encoder: Encoder, instance: str, images: Callable[[], Sequence[Image]], instruction: str) -> Context:
        """The context from here, else encoded now and kept. `images` is called only if needed, so nothing is rendered for a known instance."""
        context = self.get(encoder.identity, instance)
        if context is None:
            context = encoder.encode(images(), instruction)
            self.put(encoder.identity, instance, context)
        return context

    def save(self) -> None:
        """Write the file if something new came in."""
        if not self._unsaved:
            return
        arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {}
        for encoder, known in sorted(self._contexts.items()):
            instances = sorted(known)
            arrays[f"{encoder}|instances"] = np.array(instances, dtype=np.str_)
            arrays[f"{encoder}|contexts"] = np.stack([known[instance] for instance in instances])
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with atomic(self.file, sync=True) as partial, partial.open("wb") as handle:
            np.savez(handle, allow_pickle=False, **arrays)
        self._unsaved = 0

    def identity(self, encoder: str) -> str:
        """The identity that is here of an encoder by its name, such as `tfidf`, `tfidf+task`; an unknown name stays as it is.

        Raises:
            DataError: several identities have that name.
        """
        if encoder in self._contexts:
            return encoder
        matches = [identity for identity in self._contexts if _DIGEST.sub("", identity) == encoder]
        matches = matches or [identity for identity in self._contexts if identity.partition("@")[0] == encoder]
        if len(matches) > 1:
            raise DataError(f"{self.file}: several versions of encoder {encoder!r}: {', '.join(sorted(matches))}; name one of them")
        return matches[0] if matches else encoder


def _example(skill: str, row: int) -> str:
    return f"{EXAMPLE}{skill}:{row}"


def _read(file: Path) -> dict[str, dict[str, Context]]:
    contexts: dict[str, dict[str, Context]] = {}
    arrays = read_arrays(file, "contexts")
    encoders = {key.rpartition("|")[0] for key in arrays}
    if arrays.keys() != {f"{encoder}|{part}" for encoder in encoders for part in ("instances", "contexts")}:
        raise DataError(f"{file}: not a file of contexts (each encoder has instances and contexts, it has {', '.join(sorted(arrays))[:200]})")
    for encoder in sorted(encoders):
        instances, table = arrays[f"{encoder}|instances"], arrays[f"{encoder}|contexts"]
        if instances.dtype.kind != "U" or table.dtype != np.float32 or table.ndim != 2 or instances.shape != table.shape[:1]:
            raise DataError(f"{file}: {encoder}: expected (N,) unicode and (N, d) float32, got {instances.dtype} and {table.dtype} {table.shape}")
        wrong = instances[~np.isfinite(table).all(axis=1)].tolist()
        if wrong or not table.shape[1]:
            raise DataError(f"{file}: {encoder}: the context of {', '.join(wrong[:3]) or 'every instance'} is not all finite numbers")
        if len(np.unique(instances)) < len(instances):
            raise DataError(f"{file}: {encoder}: an instance has two contexts")
        contexts[encoder] = {str(instance): row for instance, row in zip(instances, table, strict=True)}
    return contexts
