"""How much an encoder understands of unseen scenes: retrieval both ways, neighbours of contexts, and what linear probes read from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.encoder import encode_many
from osel_sim.context.open_clip_encoder import OpenClipEncoder
from osel_sim.formats.task_file import TaskSpec
from osel_sim.formats.terms import KINDS
from osel_sim.training.encoder.captions import NAMINGS, PLACES, Captions
from osel_sim.training.encoder.scenes import Scenes

Embeddings = NDArray[np.float32]

CANDIDATES = 6
"""Retrieval picks the right one of that many, where there are as many: chance is 1/6."""
NEIGHBOURS = 10
PROBED = 50
"""Linear probes need so many contexts."""


def measure_all(encoder: OpenClipEncoder, tasks: Sequence[TaskSpec], scenes: Sequence[Scenes]) -> dict[str, Any]:
    """`measure_task` of one task; of several that of each under `tasks`, and under `task`, over all scenes, how well contexts tell tasks apart."""
    if len(tasks) == 1:
        return measure_task(encoder, tasks[0], scenes[0])
    pictured = [([image], text) for one in scenes for image, text in zip(one.images, one.instructions.tolist(), strict=True)]
    contexts = encode_many(encoder, pictured)
    labels = np.repeat([task.name for task in tasks], [len(one) for one in scenes])
    result: dict[str, Any] = {"neighbours": {"agree": neighbour_agreement(contexts, labels), "chance": chance(labels)}}
    if len(contexts) >= PROBED:
        result["probe"] = _probe(contexts, labels)
    return {"task": _rounded(result), "tasks": {task.name: measure_task(encoder, task, one) for task, one in zip(tasks, scenes, strict=True)}}


def measure_task(encoder: OpenClipEncoder, task: TaskSpec, scenes: Scenes, seed: int = 0) -> dict[str, Any]:
    """Everything `training.json` says about an encoder; all numbers but `place_r2` are fractions in [0, 1].

    - `image_to_instruction`: its own instruction among 5 that name, in the same words, an object that is not there (chance 1/6);
    - `instruction_to_image`: its own picture among 5 without the named object (chance 1/6); both split into trained and held-out phrasings;
    - `cutout_to_name`: the right name for a cut-out around one thing, among all names of its kind;
    - `place`: whether the named object is on the left, in the middle or on the right (chance 1/3);
    - `neighbours`: how many of a context's 10 nearest agree with it in object, container, phrasing; `chance` beside each;
    - `probes`: accuracy of a linear classifier on the context, 5-fold; `place_r2`: of ridge regression from the picture to where things are.

    What makes no sense for a task is left out: retrieval where all things are always there, names where there is one thing of a kind.
    """
    rng = np.random.default_rng(seed)
    images = np.stack([encoder.embed_image(image) for image in scenes.images])
    texts = np.stack([encoder.embed_text(text) for text in scenes.instructions.tolist()])
    held_out = np.char.startswith(scenes.phrasings, "held_out")
    contexts = np.concatenate([images, texts], axis=1)
    labels = {name: values for name, values in context_labels(task, scenes).items() if len(np.unique(values)) > 1}
    result: dict[str, Any] = {"scenes": len(scenes)}
    names_object = next(iter(task.roles.values())) == "object"
    if names_object and np.isnan(scenes.pixels[..., 0]).any():
        to_text, to_image = _retrieve(encoder, task, scenes, images, texts, rng)
        result |= {"image_to_instruction": _split(to_text, held_out), "instruction_to_image": _split(to_image, held_out)}
    kinds = [kind for kind in KINDS if len(task.of_kind(kind)) > 1]
    result |= {
        "cutout_to_name": {kind: _name_cutouts(encoder, task, scenes, kind) for kind in kinds},
        "neighbours": {name: {"agree": neighbour_agreement(contexts, values), "chance": chance(values)} for name, values in labels.items()},
    }
    if (place := _places(encoder, task, scenes, images)) is not None:
        result["place"] = place
    if len(scenes) >= PROBED:
        result["probes"] = {name: _probe(contexts, values) for name, values in labels.items()}
        result["place_r2"] = _place_r2(images, scenes)
    rounded: dict[str, Any] = _rounded(result)
    return rounded


def context_labels(task: TaskSpec, scenes: Scenes) -> dict[str, NDArray[Any]]:
    """What a context may cluster by, each (N,)."""
    objects = [entity.kind == "object" for entity in task.entities]
    there = ~np.isnan(scenes.pixels[:, objects, 0])  # (N, objects); no column in a task without objects
    return {"object": scenes.targets, "container": scenes.containers, "phrasing": scenes.phrasings, "objects_there": there.sum(axis=1)}


def neighbour_agreement(contexts: Embeddings, labels: NDArray[Any], neighbours: int = NEIGHBOURS) -> float:
    """Mean fraction of each context's nearest others (Euclidean) that carry its label."""
    from sklearn.neighbors import NearestNeighbors

    count = min(neighbours, len(contexts) - 1)
    nearest = NearestNeighbors(n_neighbors=count + 1).fit(contexts).kneighbors(contexts, return_distance=False)
    own = np.arange(len(contexts))[:, None]
    return float(np.mean([np.mean(labels[row[row != me][:count]] == labels[me]) for row, me in zip(nearest, own[:, 0], strict=True)]))


@dataclass
class _Trials:
    """Choices of one among several: (N,) whether each was right, and how likely a guess was to be."""

    right: NDArray[np.bool_]
    chance: NDArray[np.float64]

    @classmethod
    def of(cls, count: int) -> "_Trials":
        return cls(np.zeros(count, bool), np.ones(count))

    def add(self, index: int, right: float, wrong: NDArray[np.float32]) -> None:
        """Note a trial: similarity of the right one, and of the wrong ones. Where there are none there is no choice, and the trial does not count."""
        self.right[index], self.chance[index] = right > wrong.max(initial=-np.inf), 1 / (1 + len(wrong))


def _retrieve(
    encoder: OpenClipEncoder, task: TaskSpec, scenes: Scenes, images: Embeddings, texts: Embeddings, rng: np.random.Generator
) -> tuple[_Trials, _Trials]:
    """Whether each picture finds its instruction, and each instruction its picture."""
    order = {entity.name: index for index, entity in enumerate(task.entities)}
    objects = [entity for entity in task.entities if entity.kind == "object"]
    there = ~np.isnan(scenes.pixels[..., 0])
    to_text, to_image = _Trials.of(len(scenes)), _Trials.of(len(scenes))
    for index, (target, instruction) in enumerate(zip(scenes.targets.tolist(), scenes.instructions.tolist(), strict=True)):
        named = next(name for name in sorted(task.entity(target).names, key=len, reverse=True) if name in instruction)
        absent = [entity for entity in objects if not there[index, order[entity.name]]]
        others = [absent[choice] for choice in rng.permutation(len(absent))[: CANDIDATES - 1]]
        wrong = [encoder.embed_text(instruction.replace(named, entity.names[rng.integers(len(entity.names))])) for entity in others]
        to_text.add(index, images[index] @ texts[index], np.array([images[index] @ text for text in wrong], np.float32))
        without = np.flatnonzero(~there[:, order[target]])
        chosen = rng.permutation(without)[: CANDIDATES - 1]
        to_image.add(index, images[index] @ texts[index], images[chosen] @ texts[index])
    return to_text, to_image


def _name_cutouts(encoder: OpenClipEncoder, task: TaskSpec, scenes: Scenes, kind: str, side: float = 0.3) -> float:
    """How often a cut-out around a thing is nearest to the name of what is in its middle. Cut-outs may show parts of other things too."""
    choice = [index for index, entity in enumerate(task.entities) if entity.kind == kind]
    names = np.stack([np.mean([encoder.embed_text(form.format(task.entities[index].names[0])) for form in NAMINGS], axis=0) for index in choice])
    size, right = scenes.images.shape[1], []
    for row, (image, pixels) in enumerate(zip(scenes.images, scenes.pixels, strict=True)):
        there = [index for index in choice if not np.isnan(pixels[index, 0])]
        index = there[row % len(there)]
        length = round(side * size)
        left, top = (int(np.clip(round(value * size - length / 2), 0, size - length)) for value in pixels[index])
        embedding = encoder.embed_image(image[top : top + length, left : left + length])
        right.append(choice[int(np.argmax(names @ embedding))] == index)
    return float(np.mean(right))


def _places(encoder: OpenClipEncoder, task: TaskSpec, scenes: Scenes, images: Embeddings) -> float | None:
    """Of scenes in which it can be told: whether the target's place among left, middle and right is found. None: it never can."""
    order = [entity.name for entity in task.entities]
    words = ("on the left", "in the middle", "on the right")
    facts = Captions(task).facts(scenes.pixels)
    texts = {name: np.stack([encoder.embed_text(f"the {task.entity(name).names[0]} is {place}") for place in words]) for name in order}
    right = []
    for index, target in enumerate(scenes.targets.tolist()):
        if target not in order:
            continue  # a property
        first = len(order) + order.index(target) * len(PLACES)
        told = [facts[index, first + list(PLACES).index(place)] for place in words]
        if 1 in told and 0 not in told:
            right.append(int(np.argmax(texts[target] @ images[index])) == told.index(1))
    return float(np.mean(right)) if right else None


def _probe(contexts: Embeddings, labels: NDArray[Any]) -> float:
    from sklearn.linear_model import RidgeClassifier
    from sklearn.model_selection import KFold, cross_val_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    probe = make_pipeline(StandardScaler(), RidgeClassifier(alpha=10.0))
    return float(cross_val_score(probe, contexts, labels, cv=KFold(5, shuffle=True, random_state=0)).mean())


def _place_r2(images: Embeddings, scenes: Scenes) -> float:
    """Mean over entities and both directions on the table of cross-validated R2, from the scenes that have the entity."""
    from sklearn.linear_model import RidgeCV
    from sklearn.model_selection import KFold, cross_val_score

    scores = []
    for entity in range(scenes.positions.shape[1]):
        there = ~np.isnan(scenes.positions[:, entity, 0])
        for axis in range(2):
            if there.sum() >= 50:
                folds = KFold(5, shuffle=True, random_state=0)
                scores.append(cross_val_score(RidgeCV(np.logspace(-3, 2, 6)), images[there], scenes.positions[there, entity, axis], cv=folds).mean())
    return float(np.mean(scores)) if scores else float("nan")


def chance(labels: NDArray[Any]) -> float:
    """Probability that two drawn at random carry the same label."""
    _, counts = np.unique(labels, return_counts=True)
    return float(np.sum((counts / len(labels)) ** 2))


def _split(trials: _Trials, held_out: NDArray[np.bool_]) -> dict[str, float]:
    counted = trials.chance < 1
    groups = {"trained_phrasings": trials.right[counted & ~held_out], "held_out_phrasings": trials.right[counted & held_out]}
    return {name: float(group.mean()) for name, group in groups.items() if len(group)} | {"chance": float(trials.chance[counted].mean())}


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return round(value, 4) if isinstance(value, float) else value
