"""What can truly be said of a picture: facts seen in it, and captions that claim some of them.

One picture of the table fits every instruction whose object and container are on it, so pairing each picture with its own instruction alone would
teach little. Here every caption of a batch is judged against every picture (or cut-out) of it: true, false, or cannot be told.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.formats.task_file import TaskSpec
from osel_sim.formats.terms import ATTRIBUTE, KINDS

EDGE = 0.04
"""A thing whose middle is nearer than this to the edge of a view (fraction of its side) is neither surely in it nor surely out."""

PLACES = {
    "on the left": (0, -np.inf, 0.40),
    "in the middle": (0, 0.44, 0.56),
    "on the right": (0, 0.60, np.inf),
    "at the far left": (0, -np.inf, 0.22),
    "at the far right": (0, 0.78, np.inf),
    "at the back": (1, -np.inf, 0.42),
    "at the front": (1, 0.58, np.inf),
}
"""Words for a place in a view: axis (0 is x, 1 is y downwards) and the interval they mean."""
BLUR = 0.02
"""Nearer than this to an interval's end it cannot be told."""

NUMBERS = ("one object", "two objects", "three objects", "four objects")
NAMINGS = ("{}", "a {}", "a photo of a {}", "there is a {} on the table", "this is the {}")
PLACINGS = ("the {} is {}", "a {} {}", "there is a {} {} of the table", "{} {}")
COUNTINGS = ("{} on the table", "there are {}", "a table with {}", "{}")


@dataclass(frozen=True)
class Caption:
    """A sentence, the facts (indices) it claims, and whether it is an instruction."""

    text: str
    claims: tuple[int, ...]
    is_instruction: bool = False


class Captions:
    """Facts and captions of one task.

    Facts, in order: each entity is in view (E); each entity is at each place (E x 7, entity first); the number of objects in view is 1 ... 4.
    """

    def __init__(self, task: TaskSpec) -> None:
        self.task = task
        self._of_kind = {kind: [index for index, entity in enumerate(task.entities) if entity.kind == kind] for kind in KINDS}
        self._properties = [role for role, kind in task.roles.items() if kind == ATTRIBUTE]
        self._fixtures = [index for index, entity in enumerate(task.entities) if entity.kind != "object"]
        self.count = len(task.entities) * (1 + len(PLACES)) + len(NUMBERS)

    def facts(self, pixels: NDArray[np.float32]) -> NDArray[np.int8]:
        """Facts (N, F) of views: 1 true, -1 false, 0 cannot be told. `pixels` (N, E, 2) as in `Scenes`, relative to the view."""
        outside = np.nan_to_num(np.maximum(-pixels, pixels - 1.0).max(axis=2), nan=np.inf)  # how far out of view; negative inside
        present = np.where(outside < -EDGE, 1, np.where(outside > EDGE, -1, 0)).astype(np.int8)
        places = np.stack([self._within(pixels[..., axis], low, high) for axis, low, high in PLACES.values()], axis=2)
        places = np.where(present[..., None] == 1, places, present[..., None])  # what is not there is nowhere
        seen = present[:, self._of_kind["object"]]
        numbers = np.arange(1, len(NUMBERS) + 1)[None]
        exact = np.where((seen == 1).sum(axis=1, keepdims=True) == numbers, 1, -1)
        counts = np.where((seen == 0).any(axis=1, keepdims=True), 0, exact)
        return np.concatenate([present, places.reshape(len(pixels), -1), counts], axis=1).astype(np.int8)

    @staticmethod
    def _within(value: NDArray[np.float32], low: float, high: float) -> NDArray[np.int8]:
        margin = np.nan_to_num(np.minimum(value - low, high - value), nan=-np.inf)
        return np.where(margin > BLUR, 1, np.where(margin < -BLUR, -1, 0)).astype(np.int8)

    def instruction(self, roles: Mapping[str, int], template: str, rng: np.random.Generator) -> Caption:
        """An instruction; it claims that what fills its roles (role -> entity) is in view. Roles that are properties claim nothing."""
        names = {role: self._name(entity, rng) for role, entity in roles.items()}
        properties = {role: _pick(self.task.attributes[_pick(list(self.task.attributes), rng)], rng) for role in self._properties}
        return Caption(template.format(**names, **properties), tuple(roles.values()), is_instruction=True)

    def draw(self, facts: NDArray[np.int8], count: int, rng: np.random.Generator, words: Sequence[str]) -> list[Caption]:
        """Captions for a batch of views with `facts` (N, F); about half the things they speak of are taken from what is in some view.

        Args:
            words: any words; now and then they take the place of words that name nothing, so that unheard phrasings are understood.
        """
        return [self._one(facts[rng.integers(len(facts))], rng, words) for _ in range(count)]

    def _one(self, seen: NDArray[np.int8], rng: np.random.Generator, words: Sequence[str]) -> Caption:
        kind = rng.random()
        if kind < 0.4:
            roles: dict[str, int] = {}
            for role, wanted in self.task.roles.items():
                if role not in self._properties:
                    roles[role] = self._entity([index for index in self._of_kind[wanted] if index not in roles.values()], seen, rng)
            return self.instruction(roles, _vary(_pick(self.task.train, rng), rng, words), rng)
        objects = self._of_kind["object"]
        loose = bool(objects) and (rng.random() < 0.7 or not self._fixtures)
        entity = self._entity(objects if loose else self._fixtures, seen, rng)
        if kind < 0.5:
            return Caption(_pick(NAMINGS, rng).format(self._name(entity, rng)), (entity,))
        if kind < 0.9 or not objects:
            first = len(self.task.entities) + entity * len(PLACES)
            true = [place for place in range(len(PLACES)) if seen[first + place] == 1]
            place = _pick(true if true and rng.random() < 0.5 else range(len(PLACES)), rng)
            return Caption(_pick(PLACINGS, rng).format(self._name(entity, rng), list(PLACES)[place]), (first + place,))
        number = _pick(range(len(NUMBERS)), rng)
        return Caption(_pick(COUNTINGS, rng).format(NUMBERS[number]), (self.count - len(NUMBERS) + number,))

    def _entity(self, choice: list[int], seen: NDArray[np.int8], rng: np.random.Generator) -> int:
        there = [index for index in choice if seen[index] == 1]
        return _pick(there if there and rng.random() < 0.5 else choice, rng)

    def _name(self, entity: int, rng: np.random.Generator) -> str:
        return _pick(self.task.entities[entity].names, rng)


def truth(facts: NDArray[np.int8], captions: list[Caption]) -> NDArray[np.int8]:
    """(N, M): 1 where every claim of caption m is true of view n, -1 where one is false, 0 where it cannot be told."""
    return np.stack([facts[:, list(caption.claims)].min(axis=1) for caption in captions], axis=1)


def _vary(template: str, rng: np.random.Generator, words: Sequence[str]) -> str:
    """Sometimes drop, replace or add words that name nothing."""
    if rng.random() < 0.4:
        return template
    varied: list[str] = []
    for word in template.split():
        chance = rng.random()
        if "{" in word or chance > 0.3:
            varied.append(word)
        elif chance < 0.15:
            varied.append(_pick(words, rng))
        if rng.random() < 0.1:
            varied.append(_pick(words, rng))
    return " ".join(varied)


def _pick[T](items: Sequence[T], rng: np.random.Generator) -> T:
    return items[int(rng.integers(len(items)))]
