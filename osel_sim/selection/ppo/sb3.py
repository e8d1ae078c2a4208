"""stable-baselines3's PPO with the paper's settings, driven decision by decision."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.random_streams import RandomStreams

if TYPE_CHECKING:
    import torch
    from stable_baselines3 import PPO

Weights = NDArray[np.float32]

ROLLOUT = ("observations", "actions", "rewards", "values", "log_probs", "episode_starts")
"""Arrays of SB3's rollout buffer that hold decisions; returns and advantages are computed from them when it is full."""

Activation = Literal["tanh", "gelu"]

ENDED = np.ones(1, np.float32)
"""Every decision is an episode of its own, so each begins one and each ends one."""


class PPOSelector(SelectorBase):
    """Proximal policy optimisation over contexts, the paper's selector.

    Networks, sampling, rollout buffer and training step are SB3's own; only the loop of `learn()`, which calls an environment, is replaced by
    `select` and `update`. On the same stream the weights end up equal to those of `learn()`, bit for bit. Policies are drawn from the network's
    categorical distribution, whose probabilities are the propensities. Defaults are the paper's (appendix "Hyperparameters") and else SB3's.

    Robots share by averaging weights (McMahan et al. 2017, FedAvg): all begin with the first one's and exchange 4 bytes a weight, whatever was
    decided: 8.5 MB with the paper's layers on contexts of 768 numbers. Adam's moments, and decisions that are not yet trained on, stay where they
    are. Unlike what others add up, mean weights are no more than near those that one learner of everything would have.

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        learning_rate: of Adam, > 0.
        n_steps: decisions between two training steps, >= 2.
        batch_size: decisions in a mini-batch, >= 2. SB3's default of 64 exceeds the paper's n_steps; SB3 then uses the whole rollout, as 5 does here.
        n_epochs: passes over the rollout in a training step, unless `target_kl` ends it sooner.
        gamma: discount. Decisions are episodes of one step, so nothing is left to discount.
        gae_lambda: of generalised advantage estimation; without effect for the same reason.
        clip_range: of the probability ratio.
        clip_range_vf: of the change of the value estimate; None does not clip it.
        normalize_advantage: to zero mean and unit deviation in each mini-batch.
        ent_coef: weight of the entropy bonus, which keeps it exploring.
        vf_coef: weight of the value loss.
        max_grad_norm: gradients are clipped to this norm.
        target_kl: a training step ends when the policy has moved 1.5 times this far; None never ends it.
        layers: hidden layers of the policy network and of the value network, which share nothing.
        activation: between layers: `tanh`, SB3's default, or `gelu`, as in the code of the paper's authors (`benchmarks/paper_figure5.py`).

    Raises:
        UsageError: a number out of range.
        UnknownNameError: no such activation.
    """

    name: ClassVar[str] = "ppo"
    retires: ClassVar[bool] = True

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        learning_rate: float = 1e-4,
        n_steps: int = 5,
        batch_size: int = 5,
        n_epochs: int = 10,
        gamma: float = 0.0,
        gae_lambda: float = 0.95,
        clip_range: float = 0.2,
        clip_range_vf: float | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.01,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        target_kl: float | None = 0.003,
        layers: Sequence[int] = (768, 512, 128, 64, 16),
        activation: Activation = "tanh",
    ) -> None:
        import torch

        super().__init__(policies, context_dim, seed)
        # Normalising the advantage of a single decision divides by nothing (SB3 issue 440).
        for setting, value, least in (
            ("n_steps", n_steps, 2),
            ("batch_size", batch_size, 2),
            ("n_epochs", n_epochs, 1),
            *(("layers", n, 1) for n in layers),
        ):
            if value < least:
                raise UsageError(f"{setting} must be at least {least}, got {value}")
        if not learning_rate > 0.0:
            raise UsageError(f"learning_rate must be positive, got {learning_rate}")
        if activation not in get_args(Activation):
            raise UnknownNameError("activation", activation, get_args(Activation))
        self._settings: dict[str, Any] = {
            "learning_rate": learning_rate,
            "n_steps": n_steps,
            "batch_size": batch_size,
            "n_epochs": n_epochs,
            "gamma": gamma,
            "gae_lambda": gae_lambda,
            "clip_range": clip_range,
            "clip_range_vf": clip_range_vf,
            "normalize_advantage": normalize_advantage,
            "ent_coef": ent_coef,
            "vf_coef": vf_coef,
            "max_grad_norm": max_grad_norm,
            "target_kl": target_kl,
            "layers": list(layers),
            "activation": activation,
        }
        self._random = RandomStreams(seed)
        # Contexts are copied here: torch aligns its own memory, numpy does not, and the matrix library may round by alignment.
        self._input = torch.empty((1, self._network_dim), dtype=torch.float32)
        self._algorithm = self._build(self.policies)

    @property
    def settings(self) -> dict[str, Any]:
        """Hyper-parameters, as the constructor takes them."""
        return self._settings

    @property
    def all_settings(self) -> dict[str, Any]:
        """All of PPO's hyper-parameters, those that a subclass fixes included."""
        return self._settings

    @property
    def algorithm(self) -> "PPO":
        """SB3's algorithm object: its networks, optimiser and counters, for inspection."""
        return self._algorithm

    def network_inputs(self, contexts: NDArray[np.float32]) -> NDArray[np.float32]:
        """What the network would see of a whole stream of contexts (T, context_dim), from the present state on, which does not change."""
        return contexts

    @property
    def _network_dim(self) -> int:
        """Length of what the network sees of a context."""
        return self.context_dim

    @property
    def random_streams(self) -> RandomStreams:
        """Of the choices and of SB3's shuffling."""
        return self._random

    def _build(self, policies: Sequence[str]) -> "PPO":
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger

        from osel_sim.selection.environment import SelectionEnv, table_rounds

        # SB3 reads the two spaces from an environment; this one is never stepped.
        spaces = SelectionEnv(table_rounds(np.zeros((1, self._network_dim)), np.zeros((1, len(policies)))), policies, self._network_dim)
        arguments = {key: value for key, value in self._settings.items() if key not in ("layers", "activation")}
        between = torch.nn.GELU if self._settings["activation"] == "gelu" else torch.nn.Tanh
        network = {"net_arch": list(self._settings["layers"]), "activation_fn": between}
        with self._random.in_use():
            algorithm = PPO("MlpPolicy", spaces, policy_kwargs=network, device="cpu", **arguments)
        algorithm.set_logger(Logger(None, []))
        return algorithm

    def _select(self, context: Context) -> Choice:
        import torch

        network = self._algorithm.policy
        self._input.numpy()[0] = context
        with self._random.in_use(), torch.no_grad():
            action, value, log_probability = network(self._input)
        distribution = cast("torch.distributions.Categorical", network.action_dist.distribution)
        probabilities = distribution.probs[0].double()
        # float32 probabilities sum to 1 only to seven digits.
        propensities = dict(zip(self.policies, (probabilities / probabilities.sum()).tolist(), strict=True))
        return Choice(self.policies[int(action)], propensities, {"value": value.item(), "log_probability": log_probability.item()})

    def _recall(self, context: Context, choice: Choice) -> Choice:
        """With this network's value and log probability, so that it is trained on as an own decision: with the other selector's probability PPO would
        stop at once where the two differ by more than `target_kl`."""
        import torch

        self._input.numpy()[0] = context
        with self._random.in_use(), torch.no_grad():
            action = torch.tensor([self.policies.index(choice.policy)])
            value, log_probability, _ = self._algorithm.policy.evaluate_actions(self._input, action)
        return Choice(choice.policy, choice.propensities, {"value": value.item(), "log_probability": log_probability.item()})

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        import torch

        if choice.propensities.keys() != set(self.policies):
            return  # chosen before policies came or went: see _add_policy
        if not {"value", "log_probability"} <= choice.details.keys():
            raise UsageError("PPO learns from its own choices only: pass the Choice that select() returned")
        rollout = self._algorithm.rollout_buffer
        rollout.add(
            context,
            np.array([self.policies.index(choice.policy)]),
            np.array([reward]),
            ENDED,
            torch.tensor([choice.details["value"]]),
            torch.tensor([choice.details["log_probability"]]),
        )
        self._algorithm.num_timesteps += 1
        if rollout.full:
            # The value of what follows an ended episode is multiplied by zero: SB3 computes it, here it is left out.
            rollout.compute_returns_and_advantage(torch.zeros(1), ENDED)
            with self._random.in_use():
                self._algorithm.train()
            rollout.reset()

    def begin(self, first: State | None) -> State:
        """Take over the first robot's weights; returns its own, as `share` does."""
        if first is not None:
            self._move(lambda key, value: np.asarray(first[key], np.float32))
        return self.share()

    def share(self) -> State:
        """The weights of both networks, float32, by SB3's names."""
        return {key: value.numpy().copy() for key, value in self._algorithm.policy.state_dict().items()}

    def absorb(self, messages: Sequence[State], own: int) -> None:
        """Move by as much as the mean of all robots' weights lay apart from its own when they were shared: with no delay, to that mean."""

        def moved(key: str, value: Weights) -> Weights:
            mean = np.mean([message[key] for message in messages], axis=0, dtype=np.float64)
            return np.asarray(mean + (value.astype(np.float64) - messages[own][key]), np.float32)

        self._move(moved)

    def _move(self, moved: Callable[[str, Weights], Weights]) -> None:
        """Give the networks other weights, made of their names and what they are."""
        import torch

        network = self._algorithm.policy
        network.load_state_dict({key: torch.from_numpy(moved(key, value.numpy()).copy()) for key, value in network.state_dict().items()})

    def _state(self) -> State:
        algorithm = self._algorithm
        state = {f"network.{key}": value.numpy().copy() for key, value in algorithm.policy.state_dict().items()}
        for index, moments in algorithm.policy.optimizer.state_dict()["state"].items():
            state.update({f"optimizer.{index}.{key}": value.numpy().copy() for key, value in moments.items()})
        state.update({f"rollout.{key}": getattr(algorithm.rollout_buffer, key).copy() for key in ROLLOUT})
        counters = {"rollout_size": algorithm.rollout_buffer.pos, "decisions": algorithm.num_timesteps, "updates": algorithm._n_updates}
        return {**state, **counters, **self._random.state()}

    def _load(self, state: State) -> None:
        import torch

        algorithm = self._algorithm
        algorithm.policy.load_state_dict({key: torch.tensor(state[f"network.{key}"]) for key in algorithm.policy.state_dict()})
        optimizer = algorithm.policy.optimizer
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in state.items():
            if key.startswith("optimizer."):
                _, index, moment = key.split(".")
                moments.setdefault(int(index), {})[moment] = torch.tensor(value)
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
        algorithm.rollout_buffer.reset()
        for key in ROLLOUT:
            getattr(algorithm.rollout_buffer, key)[:] = state[f"rollout.{key}"]
        algorithm.rollout_buffer.pos = state["rollout_size"]
        algorithm.num_timesteps, algorithm._n_updates = state["decisions"], state["updates"]
        self._random.load(state)

    def _add_policy(self, name: str) -> None:
        """Give the output layer one more row, the mean of the others.

        The new policy's logit is then the mean of the old ones': it is tried now and then where the choice was clear, often where it was open, and
        the odds among the old policies do not change. Decisions not yet trained on are dropped, because their probabilities are of the old layer:
        up to n_steps - 1, and those in flight. A policy that comes back is a new one: its row would be of features that have moved on since.
        """
        self._rebuild((*self.policies, name), lambda rows: np.concatenate([rows, rows.mean(axis=0, keepdims=True)]))

    def _retire_policy(self, name: str) -> None:
        """Take its row out of the output layer: the odds among the others do not change. Decisions not yet trained on are dropped."""
        index = self.policies.index(name)
        self._rebuild(tuple(policy for policy in self.policies if policy != name), lambda rows: np.delete(rows, index, axis=0))

    def _rebuild(self, policies: tuple[str, ...], change: Callable[[NDArray[Any]], NDArray[Any]]) -> None:
        """Build the network for other policies, with `change` made to the rows of the output layer and of Adam's moments of it."""
        state = self._state()
        outputs = [index for index, (key, _) in enumerate(self._algorithm.policy.named_parameters()) if key.startswith("action_net.")]
        for key, value in state.items():
            if key.startswith(("network.action_net.", *(f"optimizer.{index}.exp_avg" for index in outputs))):
                state[key] = change(value)
        state["rollout_size"] = 0
        self._algorithm = self._build(policies)
        self._load(state)
