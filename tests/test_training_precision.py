"""Training computes in a precision that the machine has convolutions for."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile

from osel_sim.core.torch_settings import computes_bfloat16
from osel_sim.training.loop import Problem, Trainer, warm_up_then_cosine


class Convolution(nn.Module):
    """Says what it computed in."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, 8, 3)
        self.seen: list[torch.dtype] = []

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        found = self.layer(batch["image"])
        self.seen.append(found.dtype)
        return found.float().square().mean(), {}


def test_no_step_falls_back_on_the_slow_convolution(tmp_path: Path) -> None:
    model = Convolution()
    images = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-3)
    problem = Problem(model, lambda step: {"image": images}, model, optimiser, warm_up_then_cosine(1), tuple(model.parameters()), 1.0)
    trainer = Trainer(problem, 2, "cpu", tmp_path, {"seed": 0})
    with profile(activities=[ProfilerActivity.CPU], acc_events=True) as profiled:
        trainer.run({}, save_every=2, label="convolution")
    ran = {event.key for event in profiled.key_averages()}
    assert {name for name in ran if "convolution" in name} and not {name for name in ran if "slow_conv" in name}
    assert model.seen == [torch.bfloat16 if computes_bfloat16("cpu") else torch.float32] * 2
