"""A training recipe: the sizes of a policy and how it is trained; one TOML file in policies/training/ for each policy trained here."""

from dataclasses import asdict, field, fields
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic.dataclasses import dataclass

from osel_sim.core import content
from osel_sim.core.errors import UnknownNameError
from osel_sim.formats.toml_file import load_toml
from osel_sim.formats.toml_types import TABLE, Texts, Version, at_least, between
from osel_sim.training.model_sizes import ModelSizes

Count = Annotated[int, at_least(0)]
Positive = Annotated[int, at_least(1)]
Amount = Annotated[float, between(0.0, 1e6)]


@dataclass(frozen=True, config=TABLE)
class Optimisation:
    """AdamW with warm-up, cosine decay, gradient clipping and an exponential moving average (EMA) of the weights, which is what is saved."""

    steps: Positive = 8000
    """Optimiser steps."""
    batch_size: Positive = 64
    """Samples a step."""
    learning_rate: Amount = 1e-3
    """Highest learning rate, after the warm-up."""
    weight_decay: Amount = 1e-3
    """AdamW's weight decay."""
    warmup_steps: Count = 200
    """Steps in which the learning rate rises."""
    gradient_clip: Amount = 1.0
    """Largest norm of the gradient."""
    ema_decay: Amount = 0.998
    """Decay of the moving average of the weights."""
    gripper_weight: Amount = 0.5
    """Weight of the gripper in the loss, the six motions having 1; not for ACT, whose own loss counts all numbers of an action alike."""
    grounding_weight: Amount = 0.5
    """Weight of the losses of the positions of the things that an instruction names."""
    grounding_pairs: Count = 1
    """Further pairs of an image and an instruction a sample, for those losses."""


@dataclass(frozen=True, config=TABLE)
class Augmentation:
    """Random changes of each training sample.

    The changes of words are those of Wei & Zou (2019), "EDA: Easy Data Augmentation", without its thesaurus.
    """

    shift: Count = 4
    """Images move by up to so many pixels each way, all cameras of a sample alike."""
    brightness: Amount = 0.1
    """Spread of the added brightness (images in [0, 1])."""
    contrast: Amount = 0.15
    """Spread of the common gain."""
    colour: Amount = 0.05
    """Spread of each channel's own gain."""
    state_noise: Amount = 0.02
    """Standard deviation added to the normalised state."""
    state_dropout: Amount = 0.0
    """Share of samples whose whole state is hidden (set to its mean)."""
    rephrase: Amount = 0.8
    """Share of samples whose instruction is replaced by another training phrasing of the same targets."""
    drop_word: Amount = 0.15
    """Share of a phrasing's words (never of a name) left out."""
    noise_word: Amount = 0.15
    """Share of a phrasing's words replaced by a made-up word, so that words never seen in training are no reason to fail."""
    insert_words: Count = 0
    """Up to so many words, made up or of the dataset's phrasings, are put in between those of a phrasing. Without them nothing is learned about
    places in a text beyond the longest phrasing, and long instructions fail whatever they say."""
    shuffle_words: Amount = 0.0
    """Share of phrasings whose words come in random order, where the things named are of different kinds; where they are of one kind, order is
    meaning."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DataTable:
    """Which demonstrations are used."""

    tasks: Texts | None = None
    """Only datasets of these tasks are used; left out: all that are given."""
    weights: dict[str, Annotated[float, between(0.001, 1000.0)]] = field(default_factory=dict)
    """Task -> its share of the samples; tasks that are not named have a weight of 1."""
    episodes: Annotated[int, between(1, 10_000_000)] | None = None
    """Only the first so many training episodes of each dataset are used; left out: all."""
    validation_episodes: Annotated[int, between(0, 100_000)] = 20
    """Held out, the last ones of each dataset."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class RecipeFile:
    """How a policy is trained: one file in policies/training/."""

    version: Version
    """Of the format."""
    model: ModelSizes
    """The type of model and its sizes; those left out are as the type's configuration has them."""
    data: DataTable = field(default_factory=DataTable)
    """Which demonstrations are used."""
    optimisation: Optimisation = field(default_factory=Optimisation)
    """How the weights are found."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    """Random changes of each training sample."""


@plain_dataclass(frozen=True)
class Recipe:
    """One recipe as `training.json` has it, with the keys of `[data]` among the others and the type beside the sizes.

    Attributes:
        type: a LeRobot policy type.
        model: sizes, keyword arguments of the type's configuration.
        tasks, weights, episodes, validation_episodes: as `DataTable` explains them.
    """

    type: str
    model: dict[str, int]
    tasks: tuple[str, ...] | None
    weights: dict[str, float]
    episodes: int | None
    validation_episodes: int
    optimisation: Optimisation
    augmentation: Augmentation
    file: Path

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for `training.json`."""
        return {**asdict(self), "file": self.file.name}


def find_recipe(policy: str) -> Path:
    """The recipe file of a policy.

    Raises:
        UnknownNameError: there is none.
    """
    folder = content.root() / "policies" / "training"
    known = {file.stem: file for file in sorted(folder.glob("*.toml"))}
    if policy not in known:
        raise UnknownNameError("training recipe", policy, known, "policies/training/; or give one with --recipe FILE")
    return known[policy]


def load_recipe(file: Path) -> Recipe:
    """Read and check a recipe.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    found = load_toml(RecipeFile, file)
    sizes = {size.name: getattr(found.model, size.name) for size in fields(found.model) if size.name != "type"}
    return Recipe(
        type=found.model.type,
        model={name: size for name, size in sizes.items() if size is not None},
        tasks=found.data.tasks,
        weights=found.data.weights,
        episodes=found.data.episodes,
        validation_episodes=found.data.validation_episodes,
        optimisation=found.optimisation,
        augmentation=found.augmentation,
        file=file,
    )
