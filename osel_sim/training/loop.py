"""The training loop of policies and encoders: batches in, weights (or their moving average) out."""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from osel_sim.core.errors import CheckpointError, DataError, DivergedError
from osel_sim.core.progress import progress
from osel_sim.core.torch_settings import computes_bfloat16
from osel_sim.training.state import (
    FILE,
    STATE_FILE,
    optimiser_arrays,
    read_training_state,
    restore_optimiser,
    restore_weights,
    weight_arrays,
)

SPEED_STEPS = 12  # measured to turn minutes into steps; the first two are not counted
SHORT = 40
"""Values of an identity that take more characters than this are not shown in messages."""


@dataclass(frozen=True)
class Problem:
    """What is trained, and how.

    Attributes:
        module: its weights are trained, saved and averaged.
        batch_of: the batch of a step. A function of the step alone, so that a resumed run sees what an uninterrupted one would have seen; it is
            called in a thread, one step ahead.
        loss_of: the loss of a batch (a scalar tensor) and the numbers to report. Computed in bfloat16 where the device does.
        optimiser: of the module's parameters; its groups have their peak learning rates.
        rate: share of the peak at a step of so many, `rate(step, steps)`.
        clipped: the gradients of these parameters are clipped to a common norm of `clip`, if that is more than 0.
        ema_decay: of the exponential moving average of the weights; None: none is kept.
        seed: of the noise that the module draws.
    """

    module: nn.Module
    batch_of: Callable[[int], Any]
    loss_of: Callable[[Any], tuple[Tensor, Mapping[str, float]]]
    optimiser: torch.optim.Optimizer
    rate: Callable[[int, int], float]
    clipped: Sequence[nn.Parameter]
    clip: float
    ema_decay: float | None = None
    seed: int = 0


@dataclass
class Progress:
    """What a run has come to; kept with the state."""

    step: int = 0
    seconds: float = 0.0
    losses: dict[str, float] = field(default_factory=dict)


class Trainer:
    """Trains a `Problem`.

    Args:
        steps: how many in all.
        device: of torch.
        folder: where the state is kept.
        identity: what must be the same to continue, as plain data: settings, seed, digests of the data.
    """

    def __init__(self, problem: Problem, steps: int, device: str, folder: Path, identity: Mapping[str, Any]) -> None:
        self._problem, self.steps, self._device, self._folder = problem, steps, device, folder
        self._identity = json.loads(json.dumps(identity))
        self._bfloat16 = computes_bfloat16(device)
        self.progress = Progress()
        self._peaks = [group["lr"] for group in problem.optimiser.param_groups]
        state = problem.module.state_dict() if problem.ema_decay is not None else {}
        self.average = {name: value.detach().clone() for name, value in state.items()}

    def resume(self) -> bool:
        """Continue from the folder's state, if there is one.

        Raises:
            CheckpointError: the state belongs to other data, another seed or recipe, or is one of an earlier version.
            DataError: it is damaged.
        """
        found = read_training_state(self._folder)
        if found is None:
            return False
        arrays, values = found
        file = self._folder / STATE_FILE
        try:
            self._check_identity(file, values["identity"])
            restore_weights("weights", self._problem.module.state_dict(), arrays)
            restore_weights("average", self.average, arrays)
            restore_optimiser(self._problem.optimiser, arrays)
            self.steps = int(values["steps"])
            self.progress = Progress(int(values["step"]), float(values["seconds"]), dict(values["losses"]))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DataError(f"{file}: is no training state of this version ({type(error).__name__}: {error}); remove it to start over") from None
        return True

    def save(self) -> None:
        """Keep everything an exact continuation needs."""
        self._folder.mkdir(parents=True, exist_ok=True)
        weights = weight_arrays("weights", self._problem.module.state_dict()) | weight_arrays("average", self.average)
        progress = {"step": self.progress.step, "seconds": self.progress.seconds, "losses": list(self.progress.losses.items())}
        values = {"identity": self._identity, "steps": self.steps, **progress}
        FILE.write(self._folder / STATE_FILE, weights | optimiser_arrays(self._problem.optimiser), values)

    def steps_in(self, minutes: float) -> int:
        """How many steps fit, by timing a few whose gradients are thrown away: nothing that is trained changes."""
        start = 0.0
        buffers = [(buffer, buffer.clone()) for buffer in self._problem.module.buffers()]  # running means of normalisation layers
        for index in range(SPEED_STEPS):
            if index == 2:
                start = time.perf_counter()
            loss, _ = self._loss(self._problem.batch_of(index))
            torch.autograd.backward(loss)
            self._problem.optimiser.zero_grad()
        a_step = (time.perf_counter() - start) / (SPEED_STEPS - 2)
        for buffer, before in buffers:
            buffer.copy_(before)
        return max(int(minutes * 60 / a_step), 1)

    def run(self, every: dict[int, Callable[[int], None]], *, save_every: int, label: str, until: int | None = None) -> None:
        """Train from `progress.step` to `steps`.

        Args:
            every: number of steps -> what to call after so many, with the step; also called after the last.
            save_every: steps between two saved states.
            until: stop here instead, with the state saved and the schedule that of `steps`.

        Raises:
            DivergedError: loss or gradient is not finite. Weights and average stay as the last good step left them, and are saved.
        """
        last = min(self.steps, until or self.steps)
        self._problem.module.train()
        with progress(self.steps, "step", label, initial=self.progress.step) as bar:
            for step, batch in self._prefetched(self.progress.step, last):
                begin = time.perf_counter()
                try:
                    report = self._step(step, batch)
                except DivergedError:
                    self.save()
                    raise
                for name, value in report.items():
                    self.progress.losses[name] = 0.98 * self.progress.losses.get(name, value) + 0.02 * value
                self.progress.step = step + 1
                self.progress.seconds += time.perf_counter() - begin
                bar.update()
                bar.note(", ".join(f"{name}={value:.4f}" for name, value in self.progress.losses.items()))
                if (step + 1) % save_every == 0 or step + 1 == last:
                    self.save()
                for interval, call in every.items():
                    if (step + 1) % interval == 0 or step + 1 == self.steps:
                        call(step + 1)
                        self._problem.module.train()

    def _prefetched(self, first: int, last: int) -> Iterator[tuple[int, Any]]:
        """Batches in order, the next one assembled in a thread while this one is learned."""
        with ThreadPoolExecutor(1) as pool:
            coming = pool.submit(self._problem.batch_of, first) if first < last else None
            for step in range(first, last):
                if coming is None:
                    return
                batch = coming.result()
                coming = pool.submit(self._problem.batch_of, step + 1) if step + 1 < last else None
                yield step, batch

    def _loss(self, batch: Any) -> tuple[Tensor, Mapping[str, float]]:
        with torch.autocast(self._device.partition(":")[0], torch.bfloat16, enabled=self._bfloat16):
            return self._problem.loss_of(batch)

    def _step(self, step: int, batch: Any) -> Mapping[str, float]:
        problem = self._problem
        for group, peak in zip(problem.optimiser.param_groups, self._peaks, strict=True):
            group["lr"] = peak * problem.rate(step, self.steps)
        torch.manual_seed(problem.seed * 1_000_003 + step)  # noise that a policy draws: of the step, so that a resumed run draws the same
        buffers = [(buffer, buffer.clone()) for buffer in problem.module.buffers()]
        loss, report = self._loss(batch)
        torch.autograd.backward(loss)
        norm = nn.utils.clip_grad_norm_(problem.clipped, problem.clip if problem.clip > 0 else math.inf)
        if not math.isfinite(loss.item()) or not math.isfinite(norm.item()):
            for buffer, before in buffers:
                buffer.copy_(before)
            problem.optimiser.zero_grad()
            numbers = ", ".join(f"{name} {value:g}" for name, value in report.items())
            raise DivergedError(
                f"step {step + 1} of {self.steps}: {numbers}, size of the gradient {norm.item():g}: training cannot go on from what is no finite "
                f"number; {self._folder} keeps the weights of step {step}. Look for damage in the data, or take a lower learning rate and begin anew"
            )
        problem.optimiser.step()
        problem.optimiser.zero_grad()
        if problem.ema_decay is not None:
            decay = min(problem.ema_decay, (1 + step) / (10 + step))
            current = problem.module.state_dict()
            names = [name for name, value in current.items() if value.is_floating_point()]
            torch._foreach_lerp_([self.average[name] for name in names], [current[name] for name in names], 1 - decay)
        return report

    def _check_identity(self, file: Path, saved: Mapping[str, Any]) -> None:
        different = {key: saved.get(key) for key, value in self._identity.items() if saved.get(key) != value}
        if different:
            was = ", ".join(f"{key} {value!r}" if len(repr(value)) <= SHORT else f"another {key}" for key, value in different.items())
            raise CheckpointError(f"{file}: was trained with {was}; give the same, or another --out")


def warm_up_then_cosine(warmup_steps: int) -> Callable[[int, int], float]:
    """A linear warm-up over so many steps (a tenth of all at most), then a cosine down to a hundredth of the peak."""

    def rate(step: int, steps: int) -> float:
        warmup = min(warmup_steps, steps // 10 + 1)
        if step < warmup:
            return (step + 1) / warmup
        done = (step - warmup) / max(steps - warmup, 1)
        return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done))

    return rate
