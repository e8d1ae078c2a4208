"""Training of the embedded encoder: `python -m osel_sim.train --encoder osel_small --data DIR`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.context.names import DEFAULT_ENCODER
from osel_sim.context.open_clip_encoder import VOCABULARY, WEIGHTS
from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.core.files import atomic, finite, write_json
from osel_sim.formats.levels import LEVELS
from osel_sim.formats.task_file import TaskSpec
from osel_sim.suites.registry import select_task_files

if TYPE_CHECKING:
    from osel_sim.training.encoder.scenes import Scenes
    from osel_sim.training.loop import Trainer

REPORT = "training.json"
SAVE_EVERY = 200
"""Steps between two saved states."""

WARMUP_STEPS = 100


@dataclass(frozen=True)
class EncoderSettings:
    """How to train.

    Attributes:
        tasks: whose scenes are seen, by name; with several, steps take turns.
        levels: of the scenes, in turn.
        steps: gradient steps; the learning rate falls to zero over them.
        scenes, test_scenes: how many instances of each task's train and test split are rendered.
        views, texts: views and captions a batch.
        rate: peak learning rate of AdamW.

    Raises:
        UsageError: a number out of range, or no task or level.
        UnknownNameError: no such level.
    """

    tasks: tuple[str, ...] = ("pick_place",)
    levels: tuple[int, ...] = (0,)
    steps: int = 1600
    seed: int = 0
    scenes: int = 8_000
    test_scenes: int = 600
    views: int = 64
    texts: int = 64
    rate: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("steps", "scenes", "test_scenes", "views", "texts"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if self.seed < 0:
            raise UsageError(f"seed must be 0 or more, got {self.seed}")
        if not 0.0 < self.rate < math.inf:
            raise UsageError(f"rate must be a positive number, got {self.rate}")
        if not self.tasks or not self.levels:
            raise UsageError("give at least one task and one level")
        for level in self.levels:
            if level not in LEVELS:
                raise UnknownNameError("level", str(level), map(str, LEVELS))


def train(settings: EncoderSettings, data: Path, out: Path, minutes: float | None = None, device: str = "", resume: bool = False) -> dict[str, Any]:
    """Train, write the open_clip folder `out`, measure what was written on the test split, and return what `training.json` says.

    Args:
        data: folder where rendered scenes are kept; they are rendered if missing.
        minutes: choose the number of steps so that training takes about so long, instead of `settings.steps`.
        device: of torch; empty: a CUDA GPU where there is one.
        resume: go on from the state in `out`, if there is one, to `settings.steps`.

    Raises:
        UsageError: `out` holds a checkpoint already and `resume` is false, or `minutes` is not positive.
        UnknownNameError: no such task.
        CheckpointError: a training state of other settings, or of an earlier version.
    """
    import open_clip
    import torch

    from osel_sim.context.open_clip_encoder import OpenClipEncoder
    from osel_sim.training.encoder import recipe
    from osel_sim.training.encoder.evaluate import measure_all
    from osel_sim.training.encoder.scenes import cached_scenes
    from osel_sim.training.state import STATE_FILE

    if minutes is not None and not 0.0 < minutes < math.inf:
        raise UsageError(f"minutes must be more than 0, got {minutes}")
    if not resume and (out / WEIGHTS).exists():
        raise UsageError(f"{out} holds a checkpoint already; pass --resume to go on with it, or another --out")
    tasks = select_task_files(settings.tasks)
    scenes = [cached_scenes(data, task, settings.scenes, "train", recipe.IMAGE_SIZE, settings.levels) for task in tasks]
    test = [cached_scenes(data, task, settings.test_scenes, "test", recipe.IMAGE_SIZE, settings.levels) for task in tasks]
    recipe.write_architecture(out)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(settings.seed)
    # channels_last makes bfloat16 convolutions on a CPU half again as fast
    model = open_clip.CLIP(**recipe.MODEL).to(device, memory_format=torch.channels_last)
    trainer = _trainer(settings, model, tasks, scenes, device, out)
    resumed = resume and trainer.resume()
    if minutes is None:
        trainer.steps = settings.steps
    elif not resumed:
        trainer.steps = trainer.steps_in(minutes)
    trainer.run({}, save_every=SAVE_EVERY, label="encoder")
    _save_weights(model, out / WEIGHTS)
    report: dict[str, Any] = {
        "settings": {**vars(settings), "steps": trainer.steps},
        "model_cfg": recipe.MODEL,
        "preprocess_cfg": recipe.PREPROCESS,
        "final_loss": round(trainer.progress.losses.get("loss", math.nan), 4),
        "training_seconds": round(trainer.progress.seconds),
        "device": device,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "open_clip": open_clip.__version__,
        "measured": measure_all(OpenClipEncoder.from_folder(out, DEFAULT_ENCODER), tasks, test),
    }
    write_json(out / REPORT, finite(report))
    (out / STATE_FILE).unlink(missing_ok=True)
    return report


def _trainer(settings: EncoderSettings, model: Any, tasks: list[TaskSpec], scenes: list["Scenes"], device: str, out: Path) -> "Trainer":
    """The model with its readouts, batches and objective."""
    import numpy as np
    import open_clip
    import torch

    from osel_sim.training.encoder import recipe
    from osel_sim.training.encoder.captions import Captions
    from osel_sim.training.loop import Problem, Trainer

    tokenizer = open_clip.get_tokenizer(f"local-dir:{out}", bpe_path=str(out / VOCABULARY))
    objective = recipe.Objective(model, {task.name: len(task.entities) for task in tasks})
    captions, words = [Captions(task) for task in tasks], recipe.filler_words(tokenizer)

    def batch_of(step: int) -> tuple[recipe.Batch, Any]:
        turn, chance = step % len(tasks), np.random.default_rng([settings.seed, step])
        batch = recipe.make_batch(scenes[turn], captions[turn], settings.views, settings.texts, chance, words)
        return batch, tokenizer(batch.texts)

    def loss_of(batch: tuple[recipe.Batch, Any]) -> tuple[Any, dict[str, float]]:
        loss = objective(*batch)
        return loss, {"loss": loss.item()}

    module = torch.nn.ModuleDict({"model": model, "readouts": objective.readouts})
    problem = Problem(
        module=module,
        batch_of=batch_of,
        loss_of=loss_of,
        optimiser=torch.optim.AdamW(module.parameters(), lr=settings.rate, betas=(0.9, 0.98), weight_decay=0.05),
        rate=lambda step, steps: min((step + 1) / WARMUP_STEPS, 0.5 * (1 + math.cos(math.pi * step / steps))),
        clipped=tuple(model.parameters()),
        clip=1.0,
        seed=settings.seed,
    )
    # A longer training may go on from a shorter one; how many test scenes there are is no matter of training.
    identity = {key: value for key, value in vars(settings).items() if key not in ("steps", "test_scenes")}
    return Trainer(problem, settings.steps, device, out, identity)


def _save_weights(model: Any, file: Path) -> None:
    """Write half precision safetensors: a difference far below what the embeddings resolve, at half the size."""
    import torch
    from safetensors.torch import save_file

    state = {name: value.detach().cpu() for name, value in model.state_dict().items()}
    halved = {name: value.half() if value.dtype == torch.float32 else value for name, value in state.items()}
    with atomic(file) as partial:
        save_file({name: value.contiguous() for name, value in halved.items()}, partial)
