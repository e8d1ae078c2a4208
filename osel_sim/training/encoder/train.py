"""Training of the embedded encoder: `python -m osel_sim.train --encoder osel_small --data DIR`."""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim import cli
from osel_sim.context.encoder import DEFAULT_ENCODER, WEIGHTS
from osel_sim.core.errors import CheckpointError, UnknownNameError, UsageError
from osel_sim.core.torch_settings import computes_bfloat16
from osel_sim.formats.levels import LEVELS
from osel_sim.formats.library import select_tasks

STATE = "training_state.pt"
REPORT = "training.json"
SAVE_SECONDS = 60.0
EXAMPLES = """examples:
  python -m osel_sim.train --encoder osel_small --data data/scenes
  python -m osel_sim.train --encoder osel_small --data data/scenes --task all --level 0 1 2 --steps 3000 --out runs/train/osel_small
"""


@dataclass(frozen=True)
class Settings:
    """How to train.

    Attributes:
        tasks: whose scenes are seen; with several, steps take turns.
        levels: of the scenes, in turn.
        steps: gradient steps; the learning rate falls to zero over them.
        scenes, test_scenes: how many instances of each task's train and test split are rendered.
        views, texts: views and captions a batch.
        rate: peak learning rate of AdamW.
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Train an encoder from the command line, measure it, and write its open_clip folder."""
    defaults = Settings()
    parser = cli.Parser("train", "Train the context encoder on rendered scenes and their instructions, and measure it on unseen ones.", EXAMPLES)
    parser.add_argument(
        "--encoder", metavar="NAME", nargs="?", const=DEFAULT_ENCODER, required=True, help=f"architecture: {DEFAULT_ENCODER}, the only one so far"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="rendered scenes are kept here, and rendered if missing")
    parser.add_argument("--out", type=Path, metavar="DIR", help="the checkpoint's folder (default: DATA/<encoder>); load it with --encoder DIR")
    parser.add_argument("--task", nargs="+", default=list(defaults.tasks), help="names, tag:TAG, or all (default: pick_place)")
    parser.add_argument("--level", nargs="+", type=int, choices=LEVELS, default=[0], help="levels of the scenes, in turn (default: 0)")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, default=defaults.steps, help="gradient steps (default: %(default)s)")
    length.add_argument("--minutes", type=float, help="as many steps as fit, timed on the first ones")
    parser.add_argument("--scenes", type=int, default=defaults.scenes, help="training scenes of each task (default: %(default)s)")
    parser.add_argument("--test-scenes", type=int, default=defaults.test_scenes, help="test scenes of each task to measure on (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--device", default="", help="torch device (default: cuda if there, else cpu)")
    parser.add_argument("--resume", action="store_true", help="go on from the last saved state in the checkpoint's folder, to --steps")
    options = parser.parse_args(arguments)
    if options.encoder != DEFAULT_ENCODER:
        raise UnknownNameError("encoder to train", options.encoder, [DEFAULT_ENCODER])
    for name in ("steps", "scenes", "test_scenes"):
        if getattr(options, name) < 1:
            raise UsageError(f"--{name.replace('_', '-')} must be 1 or more, got {getattr(options, name)}")
    if options.minutes is not None and not options.minutes > 0:
        raise UsageError(f"--minutes must be more than 0, got {options.minutes}")
    tasks = tuple(task.name for task in select_tasks(options.task))
    settings = Settings(tasks, tuple(options.level), options.steps, options.seed, options.scenes, options.test_scenes)
    report = train(settings, options.data, options.out or options.data / options.encoder, options.minutes, options.device, options.resume)
    print(json.dumps(report["measured"], indent=2))
    return 0


def train(settings: Settings, data: Path, out: Path, minutes: float | None = None, device: str = "", resume: bool = False) -> dict[str, Any]:
    """Train, write the open_clip folder `out`, measure what was written on the test split, and return what `training.json` says.

    Raises:
        UsageError: `out` holds a checkpoint or a training state already and `resume` is false.
        CheckpointError: a training state of other settings.
    """
    import numpy as np
    import open_clip
    import torch
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from osel_sim.context.encoder import VOCABULARY, OpenClipEncoder
    from osel_sim.training.encoder import recipe
    from osel_sim.training.encoder.captions import Captions
    from osel_sim.training.encoder.evaluate import measure_all
    from osel_sim.training.encoder.scenes import cached_scenes

    if not resume and (out / WEIGHTS).exists():
        raise UsageError(f"{out} holds a checkpoint already; pass --resume to go on with it, or another --out")
    tasks = select_tasks(settings.tasks)
    scenes = [cached_scenes(data, task, settings.scenes, "train", recipe.IMAGE_SIZE, settings.levels) for task in tasks]
    test = [cached_scenes(data, task, settings.test_scenes, "test", recipe.IMAGE_SIZE, settings.levels) for task in tasks]
    recipe.write_architecture(out)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    bfloat16 = computes_bfloat16(device)
    torch.manual_seed(settings.seed)
    # channels_last makes bfloat16 convolutions on a CPU half again as fast
    model = open_clip.CLIP(**recipe.MODEL).to(device, memory_format=torch.channels_last)
    tokenizer = open_clip.get_tokenizer(f"local-dir:{out}", bpe_path=str(out / VOCABULARY))
    objective = recipe.Objective(model, {task.name: len(task.entities) for task in tasks})
    optimizer = torch.optim.AdamW([*model.parameters(), *objective.readouts.parameters()], lr=settings.rate, betas=(0.9, 0.98), weight_decay=0.05)
    captions, words = [Captions(task) for task in tasks], recipe.filler_words(tokenizer)
    step, steps, seconds, saved, smooth = 0, settings.steps, 0.0, time.monotonic(), 0.0
    if resume and (out / STATE).exists():
        step, planned, seconds = _load_state(out / STATE, settings, objective, optimizer)
        steps, minutes = (planned if minutes is not None else settings.steps), None

    columns = (TextColumn("training"), BarColumn(), MofNCompleteColumn(), TextColumn("loss {task.fields[loss]:.3f}"), TimeRemainingColumn())
    with Progress(*columns) as progress:
        bar = progress.add_task("", total=steps, completed=step, loss=0.0)
        model.train()
        while step < steps:
            begin = time.monotonic()
            for group in optimizer.param_groups:
                group["lr"] = settings.rate * min((step + 1) / 100, 0.5 * (1 + math.cos(math.pi * step / steps)))
            # Each step has its own generator, so that a resumed training sees what an uninterrupted one would have seen.
            turn, chance = step % len(tasks), np.random.default_rng([settings.seed, step])
            batch = recipe.make_batch(scenes[turn], captions[turn], settings.views, settings.texts, chance, words)
            with torch.autocast(device.partition(":")[0], torch.bfloat16, enabled=bfloat16):
                loss = objective(batch, tokenizer(batch.texts))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            step += 1
            seconds += time.monotonic() - begin
            if minutes is not None and step == 30:
                steps, minutes = max(step, int(minutes * 60 / (seconds / step))), None
            smooth = loss.item() if not smooth else 0.98 * smooth + 0.02 * loss.item()
            progress.update(bar, total=steps, completed=step, loss=smooth)
            if time.monotonic() - saved > SAVE_SECONDS:
                _save_state(out / STATE, settings, objective, optimizer, step, steps, seconds)
                saved = time.monotonic()
    _save_weights(model, out / WEIGHTS)
    report = {
        "settings": {**vars(settings), "steps": steps},
        "model_cfg": recipe.MODEL,
        "preprocess_cfg": recipe.PREPROCESS,
        "final_loss": round(smooth, 4),
        "training_seconds": round(seconds),
        "device": device,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "open_clip": open_clip.__version__,
        "measured": measure_all(OpenClipEncoder.from_folder(out, DEFAULT_ENCODER), tasks, test),
    }
    (out / REPORT).write_text(json.dumps(report, indent=2) + "\n")
    (out / STATE).unlink(missing_ok=True)
    return report


def _save_weights(model: Any, file: Path) -> None:
    """Write half precision safetensors: a difference far below what the embeddings resolve, at half the size."""
    import torch
    from safetensors.torch import save_file

    state = {name: value.detach().cpu() for name, value in model.state_dict().items()}
    halved = {name: value.half() if value.dtype == torch.float32 else value for name, value in state.items()}
    temporary = file.with_suffix(".tmp")
    save_file({name: value.contiguous() for name, value in halved.items()}, temporary)
    temporary.replace(file)


def _save_state(file: Path, settings: Settings, objective: Any, optimizer: Any, step: int, steps: int, seconds: float) -> None:
    import torch

    temporary = file.with_suffix(".tmp")
    weights = {"model": objective.model.state_dict(), "readouts": objective.readouts.state_dict()}
    state = {**weights, "optimizer": optimizer.state_dict(), "step": step, "steps": steps, "seconds": seconds}
    torch.save({**state, "settings": vars(settings)}, temporary)
    temporary.replace(file)


def _load_state(file: Path, settings: Settings, objective: Any, optimizer: Any) -> tuple[int, int, float]:
    import torch

    state = torch.load(file, map_location="cpu", weights_only=True)
    differing = [key for key, value in vars(settings).items() if state["settings"].get(key) != value and key not in ("steps", "test_scenes")]
    if differing:
        was = ", ".join(f"{key} {state['settings'].get(key)!r}" for key in differing)
        raise CheckpointError(f"{file} was trained with {was}; resume with the same")
    objective.model.load_state_dict(state["model"])
    objective.readouts.load_state_dict(state["readouts"])
    optimizer.load_state_dict(state["optimizer"])
    return int(state["step"]), int(state["steps"]), float(state["seconds"])
