"""A training recipe: the sizes of a policy and how it is trained; one TOML file in policies/training/ for each policy trained here."""

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from osel_sim.core import content
from osel_sim.core.errors import UnknownNameError
from osel_sim.formats.validate import Table

_CHUNK = {"chunk_size": (1, 200), "image_size": (16, 512)}
_PERCEPTION = {
    "stem_channels": (4, 512),
    "channels": (8, 1024),
    "trunk_layers": (0, 16),
    "query_dim": (4, 1024),
    "queries": (1, 16),
    "vocabulary": (64, 1_000_000),
    "text_length": (4, 256),
    "text_dim": (8, 1024),
    "text_layers": (0, 12),
}
_HEAD = {"hidden": (16, 8192), "hidden_layers": (0, 32)}
MODELS: dict[str, dict[str, tuple[int, int]]] = {
    "language_chunk": {**_CHUNK, **_PERCEPTION, **_HEAD, "keypoints": (1, 512)},
    "octo_chunk": {
        **_CHUNK,
        **_PERCEPTION,
        **_HEAD,
        "patch": (1, 64),
        "width": (16, 4096),
        "layers": (1, 48),
        "attention_heads": (1, 64),
        "readouts": (1, 64),
        "integration_steps": (1, 100),
        "flow_samples": (1, 64),
    },
    "act": {
        **_CHUNK,
        **_PERCEPTION,
        "keypoints": (1, 512),
        "dim_model": (16, 4096),
        "n_heads": (1, 64),
        "dim_feedforward": (16, 16384),
        "n_encoder_layers": (1, 48),
        "n_decoder_layers": (1, 48),
    },
}
"""Types of models, and for each the sizes a recipe may set: key -> (lowest, highest). Defaults are those of the type's configuration
(ACT's perception: of PerceptionConfig)."""


@dataclass(frozen=True)
class Optimisation:
    """AdamW with warm-up, cosine decay, gradient clipping and an exponential moving average (EMA) of the weights, which is what is saved.

    ACT's own loss counts all numbers of an action alike: `gripper_weight` is the others'.
    """

    steps: int = 8000
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    warmup_steps: int = 200
    gradient_clip: float = 1.0
    ema_decay: float = 0.998
    gripper_weight: float = 0.5
    grounding_weight: float = 0.5
    grounding_pairs: int = 1


@dataclass(frozen=True)
class Augmentation:
    """Random changes of each training sample.

    Attributes:
        shift: images move by up to so many pixels each way, all cameras of a sample alike.
        brightness, contrast, colour: spread of the added brightness, of the common gain and of each channel's own gain (images in [0, 1]).
        state_noise: standard deviation added to the normalised state.
        state_dropout: share of samples whose whole state is hidden (set to its mean).
        rephrase: share of samples whose instruction is replaced by another training phrasing of the same targets.
        drop_word, noise_word: share of a phrasing's words (never of a name) left out, or replaced by a made-up word, so that words never
            seen in training are no reason to fail.
        insert_words: up to so many words, made up or of the dataset's phrasings, are put in between those of a phrasing. Without them nothing
            is learned about places in a text beyond the longest phrasing, and long instructions fail whatever they say.
        shuffle_words: share of phrasings whose words come in random order, where the things named are of different kinds; where they are of
            one kind, order is meaning.

    The changes of words are those of Wei & Zou (2019), "EDA: Easy Data Augmentation", without its thesaurus.
    """

    shift: int = 4
    brightness: float = 0.1
    contrast: float = 0.15
    colour: float = 0.05
    state_noise: float = 0.02
    state_dropout: float = 0.0
    rephrase: float = 0.8
    drop_word: float = 0.15
    noise_word: float = 0.15
    insert_words: int = 0
    shuffle_words: float = 0.0


@dataclass(frozen=True)
class Recipe:
    """One recipe, validated.

    Attributes:
        type: a LeRobot policy type, one of `MODELS`.
        model: sizes, keyword arguments of the type's configuration.
        tasks: only datasets of these tasks are used; None: all that are given.
        weights: task -> its share of the samples; tasks that are not named have a weight of 1.
        episodes: only the first so many training episodes of each dataset are used; None: all.
        validation_episodes: held out, the last ones of each dataset.
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
    table = Table.load(file)
    table.integer("version", 1, 1)
    model = table.table("model")
    kind = model.choice("type", tuple(MODELS))
    sizes = {key: model.integer(key, low, high) for key, (low, high) in MODELS[kind].items() if key in model.data}
    model.done()
    data = table.table("data", {})
    episodes = data.integer("episodes", 1, 10_000_000) if "episodes" in data.data else None
    validation = data.integer("validation_episodes", 0, 100_000, 20)
    tasks = data.strings("tasks") if "tasks" in data.data else None
    shares = data.table("weights", {})
    weights = {task: shares.number(task, 0.001, 1000.0) for task in shares.data}
    data.done()
    recipe = Recipe(
        type=kind,
        model=sizes,
        tasks=tasks,
        weights=weights,
        episodes=episodes,
        validation_episodes=validation,
        optimisation=_numbers(table.table("optimisation", {}), Optimisation),
        augmentation=_numbers(table.table("augmentation", {}), Augmentation),
        file=file,
    )
    table.done()
    return recipe


def _numbers[T: (Optimisation, Augmentation)](table: Table, kind: type[T]) -> T:
    """A dataclass of non-negative numbers from a table that may leave any out."""
    values: dict[str, Any] = {}
    for field in fields(kind):
        if isinstance(field.default, int):
            lowest = 1 if field.name in ("steps", "batch_size") else 0
            values[field.name] = table.integer(field.name, lowest, 100_000_000, field.default)
        else:
            values[field.name] = table.number(field.name, 0.0, 1e6, field.default)
    table.done()
    return kind(**values)
