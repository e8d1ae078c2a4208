"""Random numbers of a batch whose rows come from several sessions: each row gets those that it would get alone."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_IN_PLACE = ("bernoulli_", "exponential_", "normal_", "uniform_")
_DRAW = {*_IN_PLACE, "bernoulli", "normal", "rand", "randint", "randn", "rand_like", "randint_like", "randn_like"}
"""Operations of torch that draw. Any other that does is noticed when a server tries its policy: the answers are not those of each session alone."""


class RowsError(Exception):
    """What is drawn has no row for each session."""


@contextlib.contextmanager
def drawing_by_row(seeds: Sequence[int]) -> Iterator[None]:
    """With torch's random numbers, along the first dimension of what is drawn, those that `torch.manual_seed` of each row gives; put back afterwards.

    Raises:
        RowsError: within the block, something is drawn whose first dimension is not that of the batch.
    """
    devices = [torch.cuda.current_device()] if torch.cuda.is_available() else []
    with torch.random.fork_rng(devices=devices), _Rows(seeds):
        yield


class _Rows(TorchDispatchMode):  # type: ignore[no-untyped-call]
    def __init__(self, seeds: Sequence[int]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._states = [_seeded(seed) for seed in seeds]

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        name = func._schema.name.partition("::")[2]
        if name not in _DRAW:
            return func(*args, **kwargs)
        names = [argument.name for argument in func._schema.arguments]
        drawn = []
        for row in range(len(self._states)):
            own, found = _of_row(row, len(self._states), [*zip(names, args, strict=False), *kwargs.items()])
            if not found:
                raise RowsError(f"{name} draws numbers that are not one row for each of {len(self._states)} sessions")
            self._load(row)
            drawn.append(func(*own[: len(args)], **dict(zip(kwargs, own[len(args) :], strict=True))))
            self._states[row] = _state()
        return args[0] if name in _IN_PLACE else torch.cat(drawn)

    def _load(self, row: int) -> None:
        host, device = self._states[row]
        torch.set_rng_state(host)
        if device is not None:
            torch.cuda.set_rng_state(device)


def _of_row(row: int, rows: int, arguments: Sequence[tuple[str, Any]]) -> tuple[list[Any], bool]:
    """The arguments for one row, and whether any of them has rows."""
    own, found = list[Any](), False
    for name, value in arguments:
        if isinstance(value, Tensor) and value.ndim and value.shape[0] == rows:
            own.append(value[row : row + 1])
            found = True
        elif name == "size" and len(value) and value[0] == rows:
            own.append([1, *value[1:]])
            found = True
        else:
            own.append(value)
    return own, found


State = tuple[Tensor, Tensor | None]


def _seeded(seed: int) -> State:
    torch.manual_seed(seed)
    return _state()


def _state() -> State:
    return torch.get_rng_state(), torch.cuda.get_rng_state() if torch.cuda.is_available() else None
