"""PPO over a logged stream, without SB3's loop: the same algorithm, draws and settings, several times quicker.

`PPOSelector` runs SB3's own code decision by decision. A replay knows the whole stream of contexts beforehand, and PPO's weights only change once a
rollout: so a rollout's choices are made together, and the training step is compiled (`osel_sim.selection.ppo.kernel`). Initial weights and the random
draws of the choices are SB3's, from the same seed. Sums are formed in another order, so weights agree to rounding, not to the bit; a choice differs
where a draw falls within that rounding of the border between two policies, and from there on the two go separate ways, each as good as the other.
"""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.compiling import announced

if TYPE_CHECKING:
    from osel_sim.selection.ppo.sb3 import PPOSelector


LINE = 16
"""Numbers in a cache line of 64 bytes."""


@functools.cache
def prepare() -> None:
    """Compile what training takes, or load it from numba's cache, before anything waits for it."""
    from osel_sim.selection.ppo.kernel import GROUP, forward, log_softmax, train

    sizes, batch = np.array([1, 2, 2], np.int64), GROUP
    actor, critic = ((*(_aligned((10,)) for _ in range(3)), sizes) for _ in range(2))
    layers = (2, batch, 2)
    work = [_aligned(shape) for _ in range(2) for shape in ((2, *layers), (2, *layers), layers)]
    contexts, numbers, actions = _aligned((batch, 1)), np.zeros(batch, np.float32), np.zeros(batch, np.int64)
    with announced("the training of ppo"):
        forward(actor[0], actor[3], contexts, work[0], False)
        log_softmax(work[0][0, -1], np.zeros((batch, 2)))
        room, settings = _aligned((LINE,)), (1e-3, 1.0, 0.2, 0.0, 0.5, 0.5, -1.0, 0.0)
        train(actor, critic, np.zeros(1, np.int64), contexts, actions, numbers, numbers, numbers, contexts, (*work, room), settings)


def supports(selector: "PPOSelector") -> bool:
    """Whether these settings are covered: one mini-batch an epoch, an unclipped value loss and normalised advantages (as by default)."""
    settings = selector.all_settings
    return (
        settings["batch_size"] >= settings["n_steps"]
        and settings["clip_range_vf"] is None
        and settings["normalize_advantage"]
        and settings["gamma"] == 0.0
        and len(settings["layers"]) > 0
    )


class FastPPO:
    """One replay of PPO.

    Args:
        selector: a fresh PPO selector that `supports` accepts: its settings, initial weights and random streams are used; it is not changed but for
            the streams.
    """

    def __init__(self, selector: "PPOSelector") -> None:
        settings = selector.all_settings
        self._streams = selector.random_streams
        self._n_steps = int(settings["n_steps"])
        target_kl = settings["target_kl"]
        names = ("learning_rate", "n_epochs", "clip_range", "ent_coef", "vf_coef", "max_grad_norm")
        self._gelu = settings["activation"] == "gelu"
        self._settings = (*(float(settings[name]) for name in names), -1.0 if target_kl is None else float(target_kl), float(self._gelu))
        state = {key: value.numpy() for key, value in selector.algorithm.policy.state_dict().items()}
        self.actor = _tower(state, "policy_net", "action_net")
        self.critic = _tower(state, "value_net", "value_net")
        self.steps = np.zeros(1, np.int64)

    def change_outputs(self, rows: NDArray[np.float32]) -> None:
        """Make each row of the output layer, and of Adam's moments of it, a weighted sum of the rows that there are, as `PPOSelector.add_policy` and
        `retire_policy` do.

        Args:
            rows: (policies then, policies now), the weights.
        """
        *parts, sizes = self.actor
        inputs, outputs = int(sizes[-2]), int(sizes[-1])
        kept = len(parts[0]) - outputs * (inputs + 1)
        made = []
        for part in parts:
            weight, bias = part[kept : kept + outputs * inputs].reshape(outputs, inputs), part[-outputs:]
            made.append(np.concatenate([part[:kept], (rows @ weight).ravel(), rows @ bias]))
        self.actor = (*_side_by_side(made), np.array([*sizes[:-1], len(rows)], np.int64))

    def run(self, contexts: NDArray[np.float32], rewards: NDArray[np.float64]) -> NDArray[np.int16]:
        """Go through a stream.

        Args:
            contexts: (T, dim), as the network is to see them.
            rewards: (T, P); only those of the choices are looked at.

        Returns:
            columns chosen, (T,).
        """
        prepare()
        with self._streams.in_use():
            return self._run(contexts, rewards)

    def _run(self, contexts: NDArray[np.float32], rewards: NDArray[np.float64]) -> NDArray[np.int16]:
        from osel_sim.selection.ppo.kernel import GROUP, forward, log_softmax, train

        total, policies, size = len(contexts), rewards.shape[1], self._n_steps
        batch = -(-size // GROUP) * GROUP
        chosen = np.zeros(total, np.int16)
        widest = int(max(self.actor[3][1:]))

        def buffers(tower: "Tower") -> list[NDArray[np.float32]]:
            shape = (len(tower[3]) - 1, batch, widest)
            return [_aligned((2, *shape)), _aligned((2, *shape)), _aligned(shape)]

        actor, critic = buffers(self.actor), buffers(self.critic)
        inputs, following = _aligned((batch, contexts.shape[1])), _aligned((batch, contexts.shape[1]))
        following[: min(size, total)] = contexts[:size]
        room = _aligned((max(widest, contexts.shape[1]),))
        ready = False
        for start in range(0, total, size):
            inputs, following = following, inputs
            count = min(size, total - start)
            if not ready:
                forward(self.actor[0], self.actor[3], inputs, actor[0], self._gelu)
                forward(self.critic[0], self.critic[3], inputs, critic[0], self._gelu)
            log_probabilities = np.empty((count, policies))
            log_softmax(actor[0][0, -1], log_probabilities)
            actions = _draw(log_probabilities)
            chosen[start : start + count] = actions
            if count < size:
                break
            rows = np.arange(size)
            received = rewards[start + rows, actions].astype(np.float32)
            values = critic[0][0, -1, :size, 0].copy()
            advantages = received - values
            returns = advantages + values
            normalised = (advantages - advantages.mean()) / (advantages.std(ddof=1) + np.float32(1e-8))
            coming = contexts[start + size : start + 2 * size]
            following[: len(coming)] = coming  # at the end, rows of before remain below: they are passed through, and not looked at
            old = log_probabilities[rows, actions].astype(np.float32)
            which = train(
                self.actor, self.critic, self.steps, inputs, actions, old, normalised, returns, following, (*actor, *critic, room), self._settings
            )
            ready = which >= 0
            if which == 1:
                actor[0], actor[1] = actor[1], actor[0]
                critic[0], critic[1] = critic[1], critic[0]
        return chosen


def _draw(log_probabilities: NDArray[np.float64]) -> NDArray[np.int64]:
    """One policy a row, by the call that SB3's categorical distribution makes, so that the same stream gives the same draws."""
    import torch

    probabilities = torch.from_numpy(np.exp(log_probabilities).astype(np.float32))
    return torch.cat([torch.multinomial(row[None], 1, True) for row in probabilities]).reshape(-1).numpy()


Tower = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]
"""Weights, Adam's two moments, sizes: see `ppo_kernel`."""


def _tower(state: dict[str, NDArray[np.float32]], hidden: str, output: str) -> Tower:
    numbers = sorted({int(key.split(".")[2]) for key in state if key.startswith(f"mlp_extractor.{hidden}.")})
    names = [*(f"mlp_extractor.{hidden}.{number}" for number in numbers), output]
    matrices = [state[f"{name}.weight"] for name in names]
    flat = np.concatenate([part.ravel() for name in names for part in (state[f"{name}.weight"], state[f"{name}.bias"])]).astype(np.float32)
    sizes = np.array([matrices[0].shape[1], *(len(matrix) for matrix in matrices)], np.int64)
    nothing = np.zeros_like(flat)
    return (*_side_by_side([flat, nothing, nothing]), sizes)


def _side_by_side(parts: Sequence[NDArray[np.float32]]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Three arrays of one length, together, because numpy asks for large pages where an array has 4 MB or more."""
    weights, first, second = (row[: len(parts[0])] for row in _aligned((3, -(-len(parts[0]) // LINE) * LINE)))
    weights[:], first[:], second[:] = parts
    return weights, first, second


def _aligned(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Zeros that begin at a multiple of 64 bytes: reads across two cache lines cost a quarter of the time otherwise."""
    count = int(np.prod(shape))
    raw = np.zeros(count + LINE, np.float32)
    start = -(raw.ctypes.data // raw.itemsize) % LINE
    return raw[start : start + count].reshape(shape)
