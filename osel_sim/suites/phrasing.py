"""Which phrasing an instance's instruction has, for suites whose instructions name nothing that is drawn."""

from collections.abc import Sequence

import numpy as np

from osel_sim.core.files import content_digest
from osel_sim.interface.instance import SPLITS


def stream(task: str, seed: int, split: str, *more: int) -> np.random.Generator:
    """Random numbers of one instance: the same arguments give the same ones."""
    return np.random.default_rng([int(content_digest(task)[:8], 16), SPLITS.index(split), seed, *more])


def phrase(
    train: Sequence[str], held_out: Sequence[str], split: str, rng: np.random.Generator, more: float = 0.0, other: np.random.Generator | None = None
) -> tuple[str, str]:
    """Which phrasing, and the instruction. Training and validation instances have training phrasings; half of those of tests have held-out ones.

    Args:
        more: chance that a training phrasing of a test gives way to a held-out one, drawn from `other`.
    """
    new = split == "test" and bool(held_out) and bool(rng.random() < 0.5)
    number = int(rng.integers(len(held_out if new else train)))
    if other is not None and split == "test" and held_out and not new and other.random() < more:
        new, number = True, int(other.integers(len(held_out)))
    return f"{'held_out' if new else 'train'}-{number}", (held_out if new else train)[number]


def words_of(name: str) -> str:
    """An instruction made of a name, where nobody wrote one: `FetchPickAndPlace-v4` -> `fetch pick and place`."""
    base = name.rpartition("/")[2].rpartition(":")[2].partition("-v")[0]
    spaced = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in base)
    return " ".join(spaced.replace("_", " ").replace("-", " ").split()) or name
