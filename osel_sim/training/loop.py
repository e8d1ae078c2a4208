"""The training loop: batches in, averaged weights out."""

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm  # type: ignore[import-untyped]

from osel_sim.core.torch_settings import computes_bfloat16
from osel_sim.training.recipe import Optimisation
from osel_sim.training.state import load_state, save_state

SPEED_STEPS = 12  # measured to turn minutes into steps; the first two are not counted


@dataclass
class Progress:
    """What a run has come to; kept with the state."""

    step: int = 0
    seconds: float = 0.0
    losses: dict[str, float] = field(default_factory=dict)


class Trainer:
    """Trains a LeRobot policy on batches given by step; the exponential moving average of its weights is the result."""

    def __init__(
        self,
        policy: nn.Module,
        batch_of: Callable[[int], dict[str, Tensor]],
        settings: Optimisation,
        device: str,
        folder: Path,
        fingerprint: str,
        seed: int = 0,
    ) -> None:
        self.policy, self._batch_of, self._settings = policy, batch_of, settings
        self._device, self._folder, self._fingerprint, self._seed = device, folder, fingerprint, seed
        self._bfloat16 = computes_bfloat16(device)
        self.steps = settings.steps
        self.progress = Progress()
        decayed = [parameter for parameter in policy.parameters() if parameter.ndim > 1]
        others = [parameter for parameter in policy.parameters() if parameter.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self._optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)
        self.average = {name: value.detach().clone() for name, value in policy.state_dict().items()}

    def resume(self) -> bool:
        """Continue from the folder's state, if there is one.

        Raises:
            DataError: the state is damaged, or belongs to other data, another seed or recipe.
        """
        state = load_state(self._folder)
        if state is None:
            return False
        if state["fingerprint"] != self._fingerprint:
            from osel_sim.core.errors import DataError

            raise DataError(f"{self._folder}: was trained with other data, seed or recipe; give those, or another --out")
        self.policy.load_state_dict(state["policy"])
        self._optimiser.load_state_dict(state["optimiser"])
        self.average = {name: value.to(self._device) for name, value in state["average"].items()}
        self.steps = state["steps"]
        self.progress = Progress(state["step"], state["seconds"], state["losses"])
        return True

    def save(self) -> None:
        """Keep everything an exact continuation needs."""
        state = {
            "fingerprint": self._fingerprint,
            "policy": self.policy.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "average": self.average,
            "steps": self.steps,
            "step": self.progress.step,
            "seconds": self.progress.seconds,
            "losses": self.progress.losses,
        }
        save_state(self._folder, state)

    def steps_in(self, minutes: float) -> int:
        """How many steps fit, by timing a few on copies of nothing: gradients are computed and thrown away, no weight changes."""
        start = 0.0
        for index in range(SPEED_STEPS):
            if index == 2:
                start = time.perf_counter()
            loss, _ = self._loss(self._batch_of(index))
            torch.autograd.backward(loss)
            self._optimiser.zero_grad()
        a_step = (time.perf_counter() - start) / (SPEED_STEPS - 2)
        return max(int(minutes * 60 / a_step), 1)

    def run(self, every: dict[int, Callable[[int], None]], *, save_every: int, label: str, until: int | None = None) -> None:
        """Train from `progress.step` to `steps`.

        Args:
            every: number of steps -> what to call after so many, with the step; also called after the last.
            save_every: steps between two saved states.
            until: stop here instead, with the state saved and the schedule that of `steps`.
        """
        last = min(self.steps, until or self.steps)
        self.policy.train()
        with tqdm(total=self.steps, initial=self.progress.step, desc=label, unit="step", mininterval=1.0) as bar:
            for step, batch in self._prefetched(self.progress.step, last):
                begin = time.perf_counter()
                report = self._step(step, batch)
                for name, value in report.items():
                    self.progress.losses[name] = 0.98 * self.progress.losses.get(name, value) + 0.02 * value
                self.progress.step = step + 1
                self.progress.seconds += time.perf_counter() - begin
                bar.update()
                bar.set_postfix({name: f"{value:.4f}" for name, value in self.progress.losses.items()}, refresh=False)
                if (step + 1) % save_every == 0 or step + 1 == last:
                    self.save()
                for interval, call in every.items():
                    if (step + 1) % interval == 0 or step + 1 == self.steps:
                        call(step + 1)
                        self.policy.train()

    def _prefetched(self, first: int, last: int) -> Iterator[tuple[int, dict[str, Tensor]]]:
        """Batches in order, the next one assembled in a thread while this one is learned."""
        with ThreadPoolExecutor(1) as pool:
            coming = pool.submit(self._batch_of, first) if first < last else None
            for step in range(first, last):
                if coming is None:
                    return
                batch = coming.result()
                coming = pool.submit(self._batch_of, step + 1) if step + 1 < last else None
                yield step, batch

    def _loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        moved = {name: value.to(self._device, non_blocking=True) if isinstance(value, Tensor) else value for name, value in batch.items()}
        with torch.autocast(self._device, torch.bfloat16, enabled=self._bfloat16):
            loss, report = self.policy(moved)
        return loss, report

    def _step(self, step: int, batch: dict[str, Tensor]) -> dict[str, float]:
        for group in self._optimiser.param_groups:
            group["lr"] = self._settings.learning_rate * self._rate(step)
        torch.manual_seed(self._seed * 1_000_003 + step)  # noise that a policy draws: of the step, so that a resumed run draws the same
        loss, report = self._loss(batch)
        torch.autograd.backward(loss)
        if self._settings.gradient_clip > 0:
            nn.utils.clip_grad_norm_(self.policy.parameters(), self._settings.gradient_clip)
        self._optimiser.step()
        self._optimiser.zero_grad()
        decay = min(self._settings.ema_decay, (1 + step) / (10 + step))
        current = self.policy.state_dict()
        names = [name for name, value in current.items() if value.is_floating_point()]
        torch._foreach_lerp_([self.average[name] for name in names], [current[name] for name in names], 1 - decay)
        return report

    def _rate(self, step: int) -> float:
        """Share of the full learning rate: linear warm-up, then a cosine down to a hundredth."""
        warmup = min(self._settings.warmup_steps, self.steps // 10 + 1)
        if step < warmup:
            return (step + 1) / warmup
        done = (step - warmup) / max(self.steps - warmup, 1)
        return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done))
