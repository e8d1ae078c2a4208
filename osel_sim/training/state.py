"""Training state on disk: weights, their average and the optimiser's moments as tensors, progress as JSON, in one safetensors file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from osel_sim.core.errors import CheckpointError, DataError
from osel_sim.core.tensor_file import Arrays, TensorFile

STATE_FILE = "training.state"
"""Safetensors under another ending: a checkpoint folder's `*.safetensors` are its weights."""

PICKLED = "training_state.pt"
"""What earlier versions wrote: a pickle, which is not read."""

FILE = TensorFile("training state", "osel_sim.training_state.v1")


def read_training_state(folder: Path) -> tuple[Arrays, dict[str, Any]] | None:
    """Arrays and values of the last state, or None where there is none.

    Raises:
        CheckpointError: only a state of an earlier version is there.
        DataError: the file is damaged or holds something else.
    """
    file = folder / STATE_FILE
    if file.is_file():
        return FILE.read(file)
    if (folder / PICKLED).is_file():
        raise CheckpointError(
            f"{folder / PICKLED}: is the state of an earlier version, a pickle, which is no longer read; remove it to start over "
            "(a policy's weights so far can be begun with: --init and another --out)"
        )
    return None


def weight_arrays(part: str, weights: Mapping[str, Tensor]) -> Arrays:
    """Weights by flat names, `part.name`."""
    return {f"{part}.{name}": value.detach().cpu().numpy() for name, value in weights.items()}


def restore_weights(part: str, weights: Mapping[str, Tensor], arrays: Arrays) -> None:
    """Copy the arrays of `weight_arrays` into tensors, in place, so that they keep their device and memory layout.

    Raises:
        DataError: the arrays are of other names or shapes.
    """
    own = {name.removeprefix(f"{part}."): value for name, value in arrays.items() if name.startswith(f"{part}.")}
    if {name: tuple(value.shape) for name, value in own.items()} != {name: tuple(value.shape) for name, value in weights.items()}:
        raise DataError(f"the training state's {part} has other tensors than what is trained; remove it to start over")
    with torch.no_grad():
        for name, value in weights.items():
            value.copy_(torch.from_numpy(own[name]))


def optimiser_arrays(optimiser: torch.optim.Optimizer) -> Arrays:
    """What the optimiser keeps of each parameter, `optimiser.NUMBER.KEY`. Its settings are not state: the recipe gives them."""
    kept: dict[int, dict[str, Tensor]] = optimiser.state_dict()["state"]
    return {f"optimiser.{number}.{key}": value.detach().cpu().numpy() for number, own in kept.items() for key, value in own.items()}


def restore_optimiser(optimiser: torch.optim.Optimizer, arrays: Arrays) -> None:
    """Give the optimiser what `optimiser_arrays` kept.

    Raises:
        DataError: the arrays belong to other parameters.
    """
    parameters: list[nn.Parameter] = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    kept: dict[int, dict[str, Tensor]] = {}
    for name, array in arrays.items():
        part, number, key = [*name.split(".", 2), "", ""][:3]
        if part in ("weights", "average"):
            continue
        value = torch.from_numpy(array)
        own = parameters[int(number)] if number.isdecimal() and int(number) < len(parameters) else None
        if part != "optimiser" or own is None or (value.ndim and value.shape != own.shape):
            raise DataError("the training state's optimiser belongs to other parameters; remove it to start over")
        if value.ndim:
            # In the parameter's memory layout: fused steps go through the memory of both in the same order.
            value = torch.empty_like(own, requires_grad=False).copy_(value)
        kept.setdefault(int(number), {})[key] = value
    optimiser.load_state_dict({**optimiser.state_dict(), "state": kept})
