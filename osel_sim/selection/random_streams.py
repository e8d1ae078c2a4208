"""Random streams of one torch user that nobody else can disturb."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from osel_sim.interface.selector import State


class RandomStreams:
    """Own states of torch's and numpy's global generators, swapped in while in use.

    stable-baselines3 samples actions from torch's global generator and shuffles mini-batches with numpy's. Other users of those (a policy that
    samples actions between two decisions) would change what it does, and it what they do. Python's `random` and CUDA's generators are never touched.
    """

    def __init__(self, seed: int) -> None:
        import torch

        self.torch = torch.Generator().manual_seed(seed).get_state()
        self.numpy = np.random.RandomState(seed).get_state(legacy=False)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Swap the streams in, and compute on one thread.

        One thread is fast enough on batches this small, and makes the bits independent of how many cores there are: sums split over threads round
        differently.
        """
        import torch

        others_torch, others_numpy, threads = torch.get_rng_state(), np.random.get_state(legacy=False), torch.get_num_threads()
        torch.set_rng_state(self.torch)
        np.random.set_state(self.numpy)
        torch.set_num_threads(1)
        try:
            yield
        finally:
            self.torch, self.numpy = torch.get_rng_state(), np.random.get_state(legacy=False)
            torch.set_rng_state(others_torch)
            np.random.set_state(others_numpy)
            torch.set_num_threads(threads)

    def state(self) -> State:
        """Both streams, as arrays and JSON values."""
        generator = self.numpy
        return {
            "random.torch": self.torch.numpy().copy(),
            "random.numpy.key": generator["state"]["key"].copy(),
            "random.numpy.pos": int(generator["state"]["pos"]),
            "random.numpy.gauss": [int(generator["has_gauss"]), float(generator["gauss"])],
        }

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        import torch

        has_gauss, gauss = state["random.numpy.gauss"]
        self.torch = torch.from_numpy(state["random.torch"].copy())
        self.numpy = {
            "bit_generator": "MT19937",
            "state": {"key": state["random.numpy.key"].copy(), "pos": state["random.numpy.pos"]},
            "has_gauss": has_gauss,
            "gauss": gauss,
        }
