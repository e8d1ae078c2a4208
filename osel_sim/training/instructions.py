"""Instructions about a scene in training: another phrasing, other things named, words left out or made up."""

import re

import numpy as np
from numpy.typing import NDArray

from osel_sim.training.annotations import ATTRIBUTE, Annotations
from osel_sim.training.recipe import Augmentation

FIELD = re.compile(r"\{(\w+)\}")
LETTERS = np.array(list("abcdefghijklmnopqrstuvwxyz"))


class Instructions:
    """Draws instructions from a dataset's training phrasings."""

    def __init__(self, annotations: Annotations, augmentation: Augmentation) -> None:
        self._nameable, self._roles = annotations.nameable, annotations.roles
        self._phrasings = [text.split() for text in annotations.phrasings]
        self._augmentation = augmentation
        kinds = np.array([thing.kind for thing in annotations.nameable])
        self._of_kind = {kind: kinds == kind for kind in {*annotations.roles.values()}}
        self._attributes = len(annotations.attributes)
        self._common = sorted({word for words in self._phrasings for word in words if not FIELD.search(word)})
        self._ordered = len(set(annotations.roles.values())) < len(annotations.roles)

    def phrase(self, target: NDArray[np.int64], random: np.random.Generator) -> str:
        """A random training phrasing whose roles are filled by the things of these indices (roles,), each under a random one of its names."""
        choices = [self._nameable[index].names if index >= 0 else ("",) for index in target]
        names = {role: known[random.integers(len(known))] for role, known in zip(self._roles, choices, strict=True)}
        words = [self._word(word, names, random) for word in self._phrasings[random.integers(len(self._phrasings))]]
        # What is off draws no number, so that recipes without it train to the weights they always did.
        if self._augmentation.shuffle_words and not self._ordered and random.random() < self._augmentation.shuffle_words:
            random.shuffle(words)
        if self._augmentation.insert_words:
            for _ in range(random.integers(self._augmentation.insert_words + 1)):
                words.insert(random.integers(len(words) + 1), self._other_word(random))
        return " ".join(words)

    def pair(self, present: NDArray[np.bool_], random: np.random.Generator) -> NDArray[np.int64]:
        """What else an instruction about this scene could name: random things, no thing twice, for all roles (roles,); -1 where there is none."""
        free = np.concatenate([present, np.ones(self._attributes, bool)])
        chosen = np.full(len(self._roles), -1, np.int64)
        for position, kind in enumerate(self._roles.values()):
            there = np.flatnonzero(self._of_kind[kind] & free)
            if len(there):
                chosen[position] = there[random.integers(len(there))]
                free[chosen[position]] = kind == ATTRIBUTE
        return chosen

    def _word(self, word: str, names: dict[str, str], random: np.random.Generator) -> str:
        if FIELD.search(word):
            return FIELD.sub(lambda field: names.get(field[1], field[0]), word)
        draw = random.random()
        if draw < self._augmentation.drop_word:
            return ""
        if draw < self._augmentation.drop_word + self._augmentation.noise_word:
            return _made_up(random)
        return word

    def _other_word(self, random: np.random.Generator) -> str:
        """One of the phrasings' words, none of a name, or a made-up one."""
        known = self._common and random.random() < 0.5
        return self._common[random.integers(len(self._common))] if known else _made_up(random)


def _made_up(random: np.random.Generator) -> str:
    return "".join(LETTERS[random.integers(len(LETTERS), size=random.integers(2, 9))])
