"""Text to numbers without a vocabulary file: words and their character trigrams, hashed by CRC-32.

CRC-32 is the same on every machine and Python, unlike `hash`. Trigrams let a word never seen share something with its relatives
("lemon", "lemons"); the idea is fastText's (Bojanowski et al., 2017, "Enriching Word Vectors with Subword Information").
"""

import re
import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

PADDING, START = 0, 1
RESERVED = 2  # ids below are not hashes
PIECES = 8  # ids a word: itself and up to seven trigrams

_WORD = re.compile(r"[a-z0-9]+")


def words_of(text: str) -> list[str]:
    """Lower-case words of letters and digits, punctuation dropped."""
    return _WORD.findall(text.lower())


@lru_cache(maxsize=65536)
def _pieces(word: str, vocabulary: int) -> tuple[int, ...]:
    marked = f"<{word}>"
    parts = [marked] + [marked[index : index + 3] for index in range(len(marked) - 2)]
    ids = [RESERVED + zlib.crc32(part.encode()) % (vocabulary - RESERVED) for part in parts[:PIECES]]
    return tuple(ids + [PADDING] * (PIECES - len(ids)))


def tokenise(texts: Sequence[str], vocabulary: int, length: int) -> NDArray[np.int64]:
    """Ids of each text's words, (texts, length, PIECES); row 0 is a start token, so that an empty text has one too.

    Words beyond `length - 1` are cut off, unused places hold `PADDING`.
    """
    tokens = np.full((len(texts), length, PIECES), PADDING, np.int64)
    tokens[:, 0, 0] = START
    for row, text in enumerate(texts):
        for column, word in enumerate(words_of(text)[: length - 1], start=1):
            tokens[row, column] = _pieces(word, vocabulary)
    return tokens


def embed(text: str, dimension: int) -> NDArray[np.float32]:
    """A fixed embedding of a text, (dimension,) of unit length: every piece of every word votes for one signed place (feature hashing).

    It has no parameters to train, so LeRobot's own ACT reads an instruction through its `observation.environment_state`.
    """
    vector = np.zeros(dimension, np.float32)
    for word in words_of(text):
        marked = f"<{word}>"
        for part in [marked] + [marked[index : index + 3] for index in range(len(marked) - 2)]:
            code = zlib.crc32(part.encode())
            vector[(code >> 1) % dimension] += 1.0 if code & 1 else -1.0
    norm = float(np.linalg.norm(vector))
    return vector / np.float32(norm) if norm else vector
