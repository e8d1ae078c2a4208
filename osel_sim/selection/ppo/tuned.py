"""PPO with settings that learn from hundreds of decisions rather than tens of thousands."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.ppo.sb3 import PPOSelector
from osel_sim.selection.scaling import SEEN, TURN, RunningComponents


class TunedPPOSelector(PPOSelector):
    """stable-baselines3's PPO as in `PPOSelector`, on leading components, with one small layer, longer rollouts and a larger learning rate.

    The paper's settings see contexts as the encoder gives them and take steps so small that hundreds of decisions change little. Here the network
    sees the leading principal components of the contexts so far, half whitened. The numbers were chosen on synthetic streams and on the choosing
    half of `assets/logs/suite`.

    Robots share their weights as `PPOSelector` does, and see contexts through the first robot's components, which are sent beside them: 4 bytes a
    weight, and 8 * (min(D, 256) + components) * (components + 1) at most for contexts of D numbers; some 70 kB. Until the first exchange each has
    components of its own: where that comes after many training steps, what they learned before is blurred.

    It may stay with a worse policy for good, as PPO may: a softmax that has become sure of an action hardly draws another, the clipped objective
    takes small steps back, and nothing in the published form makes it try (6 of 80 seeds of four problems without context,
    `benchmarks/selection.py`).

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        components: how many, >= 1.
        Others: see `PPOSelector`; a rollout is one mini-batch.
    """

    name: ClassVar[str] = "ppo_tuned"

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        components: int = 24,
        learning_rate: float = 4e-3,
        n_steps: int = 32,
        n_epochs: int = 5,
        clip_range: float = 0.4,
        ent_coef: float = 0.003,
        vf_coef: float = 0.5,
        max_grad_norm: float = 2.0,
        target_kl: float | None = None,
        layers: Sequence[int] = (64,),
    ) -> None:
        if components < 1:
            raise UsageError(f"components must be at least 1, got {components}")
        self._scale = RunningComponents(context_dim, components)
        super().__init__(
            policies,
            context_dim,
            seed,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=n_steps,
            n_epochs=n_epochs,
            clip_range=clip_range,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            target_kl=target_kl,
            layers=layers,
        )

    @property
    def settings(self) -> dict[str, Any]:
        """Hyper-parameters, as the constructor takes them."""
        fixed = ("activation", "batch_size", "gamma", "gae_lambda", "clip_range_vf", "normalize_advantage")
        return {"components": self._scale.dim, **{key: value for key, value in super().settings.items() if key not in fixed}}

    @property
    def _network_dim(self) -> int:
        return self._scale.dim

    def network_inputs(self, contexts: NDArray[np.float32]) -> NDArray[np.float32]:
        """The stream as the network would see it."""
        return self._scale.stream(contexts)

    def share(self) -> State:
        """The weights, and how contexts become the components that they are weights of."""
        return {**super().share(), **{key: value for key, value in self._scale.state().items() if key != SEEN}}

    def absorb(self, messages: Sequence[State], own: int) -> None:
        """Move towards the mean weights as `PPOSelector` does, and see contexts as the first robot does: only then do weights mean the same."""
        super().absorb(messages, own)
        fitted = next((message for message in messages if len(message[TURN])), None)
        if fitted is not None:
            self._scale.load({**fitted, SEEN: self._scale.state()[SEEN]})

    def _recall(self, context: Context, choice: Choice) -> Choice:
        self._scale.add(context)
        return super()._recall(self._scale.transform(context), choice)

    def _select(self, context: Context) -> Choice:
        self._scale.add(context)
        return super()._select(self._scale.transform(context))

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        # Transformed by what is known now: the same as in select() unless other choices were made in between.
        super()._update(self._scale.transform(context), choice, reward)

    def _state(self) -> State:
        return {**super()._state(), **self._scale.state()}

    def _load(self, state: State) -> None:
        super()._load(state)
        self._scale.load(state)
