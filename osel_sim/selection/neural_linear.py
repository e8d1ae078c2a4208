"""Neural-linear Thompson sampling: a small network learns the features, Bayesian regression on them the rewards (Riquelme et al. 2018)."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError
from osel_sim.core.torch_settings import threads
from osel_sim.interface.selector import State
from osel_sim.selection.bayesian import BayesianSelector, Prior
from osel_sim.selection.features import Array, Components

STEPS, RATE, DECAY = 150, 0.02, 1e-3
"""Of the network's training: steps on all decisions at once, AdamW's learning rate and weight decay."""


class NeuralLinearSelector(BayesianSelector):
    """Thompson sampling on the hidden layer of a network that predicts every policy's reward from the whitened context.

    It seldom stays with a worse policy (1 of 80 seeds of four problems without context, `benchmarks/selection.py`), as it chooses by chance.

    Robots share their decisions, 4 * min(D, 256) + 24 bytes each for contexts of D numbers (`osel_sim.selection.shared_rows.Rows`), from which each
    trains the same network and the same head; weights are not sent.

    The network is trained from scratch whenever the features are fitted, on all decisions so far; it sees the reward of the chosen policy only.

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        components: principal components of the contexts seen, whitened: the network's input.
        hidden: units of the hidden layer.
        chance, signals, expected_costs, warm_contexts: see `Prior`.

    Raises:
        UsageError: a number out of range, or contexts of another form.
        UnknownNameError: `expected_costs` lacks a policy.
    """

    name: ClassVar[str] = "neural_linear"

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        components: int = 24,
        hidden: int = 32,
        chance: float = 0.5,
        signals: Sequence[float] = (0.05, 0.2, 0.8),
        expected_costs: Mapping[str, float] | None = None,
        warm_contexts: ArrayLike | None = None,
    ) -> None:
        if components < 1 or hidden < 1:
            raise UsageError(f"components and hidden must be at least 1, got {components} and {hidden}")
        self._own = {"components": components, "hidden": hidden}
        self._hidden = HiddenLayer(components, hidden)
        prior = Prior(signals, chance=chance, mean_chance=1.0, expected_costs=expected_costs, warm_contexts=warm_contexts)
        super().__init__(policies, context_dim, seed, self._hidden, prior)

    @property
    def settings(self) -> dict[str, Any]:
        """Those of `BayesianSelector`, and the sizes of the network."""
        return {**super().settings, **self._own}

    def _fit_features(self, contexts: Array, own: Array, chosen: NDArray[np.int64], targets: Array) -> None:
        super()._fit_features(contexts, own, chosen, targets)
        if len(own):
            self._hidden.train(own, chosen, targets, len(self._costs))


class HiddenLayer:
    """Features of a network of one hidden layer; untrained, a random one.

    Args:
        components: of the context, whitened, at most.
        hidden: units.
    """

    def __init__(self, components: int, hidden: int) -> None:
        self._space = Components(components, whitening=1.0)
        self.dim = hidden
        self._weights, self._scale = np.zeros((1, hidden)), 1.0

    def fit(self, contexts: Array) -> None:
        """Components of the contexts, and random weights on them."""
        self._space.fit(contexts)
        generator = np.random.default_rng(0)
        inputs = self._inputs(contexts)
        self._weights = generator.normal(size=(inputs.shape[1], self.dim)) * np.sqrt(2.0)
        self._set_scale(inputs)

    def train(self, contexts: Array, chosen: NDArray[np.int64], targets: Array, policies: int) -> None:
        """Least squares on the chosen policy's reward, by AdamW.

        Args:
            contexts: (n, sketched dim). chosen: (n,) columns. targets: (n,) rewards + costs, standardised. policies: number of outputs.
        """
        import torch
        from torch.optim.adamw import adamw

        inputs = self._inputs(contexts)
        seen, columns, centred = (torch.from_numpy(values) for values in (inputs, chosen[:, None], (targets - targets.mean())[:, None]))
        weights = [torch.from_numpy(self._weights.copy()), torch.zeros(self.dim, policies, dtype=torch.float64)]
        means, squares = ([torch.zeros_like(matrix) for matrix in weights] for _ in range(2))
        counts = [torch.zeros(()) for _ in weights]
        settings: dict[str, Any] = {"lr": RATE, "weight_decay": DECAY, "beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "amsgrad": False, "maximize": False}
        # The gradients of two layers are quickly written down: autograd would take several times as long to find them.
        with threads(1), torch.no_grad():  # a matrix product's last bits depend on how many threads share it
            for _ in range(STEPS):
                hidden = torch.relu(seen @ weights[0])
                outputs = hidden @ weights[1]
                errors = (outputs.gather(1, columns) - centred) * (1.0 / len(centred))
                deltas = torch.zeros_like(outputs).scatter_(1, columns, errors)
                gradients = [seen.T @ ((deltas @ weights[1].T) * (hidden > 0)), hidden.T @ deltas]
                adamw(weights, gradients, means, squares, [], counts, fused=True, **settings)
        self._weights = weights[0].numpy()
        self._set_scale(inputs)

    def transform(self, contexts: Array) -> Array:
        """(n, sketched dim) -> (n, hidden), with a mean squared length of 1 where it was fitted."""
        if not self._space.dim:
            return np.zeros((len(contexts), self.dim))
        return np.asarray(np.maximum(self._inputs(contexts) @ self._weights, 0.0) * self._scale)

    def state(self) -> State:
        """Components and weights."""
        return {**self._space.state(), "weights": self._weights.copy(), "scale": self._scale}

    def load(self, state: State) -> None:
        """Take over what `state` gave."""
        self._space.load(state)
        self._weights, self._scale = state["weights"].copy(), state["scale"]

    def _inputs(self, contexts: Array) -> Array:
        return np.concatenate([self._space.transform(contexts), np.ones((len(contexts), 1))], axis=1)

    def _set_scale(self, inputs: Array) -> None:
        lengths = (np.maximum(inputs @ self._weights, 0.0) ** 2).sum(axis=1)
        self._scale = float(1.0 / np.sqrt(max(lengths.mean(), 1e-12)))
