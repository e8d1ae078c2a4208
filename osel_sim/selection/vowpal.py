"""Contextual bandits of Vowpal Wabbit, through its own Python package: SquareCB and RegCB.

An optional extra: `pip install 'osel-sim[vw]'`.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.scaling import RunningComponents

COMPONENTS = 32
"""Dimensions that the linear models see."""


class VowpalSelector(SelectorBase):
    """A learner with `--cb_explore_adf`: a linear model of the reward for each pair of dimension and policy, and an exploration rule on top.

    The dimensions are the leading components of the contexts so far. Rewards are passed as costs, their negatives.

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        learning_rate: of Vowpal Wabbit's adaptive, normalised gradient steps, > 0 (its default).
        exploration: further command line flags of the exploration rule.

    Raises:
        UsageError: the package is not installed, or a number out of range.
    """

    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, learning_rate: float, exploration: str) -> None:
        super().__init__(policies, context_dim, seed)
        if not learning_rate > 0.0:
            raise UsageError(f"learning_rate must be positive, got {learning_rate}")
        self.learning_rate = float(learning_rate)
        self._flags = f"--quiet --cb_explore_adf --cb_type mtr -q ca -b 18 -l {learning_rate} --random_seed {seed % 2**31} {exploration}"
        self._generator = np.random.default_rng(seed)
        self._scale = RunningComponents(context_dim, COMPONENTS)
        self._workspace = _workspace(self._flags)

    @property
    def settings(self) -> dict[str, Any]:
        """The learning rate; subclasses add theirs."""
        return {"learning_rate": self.learning_rate}

    def _select(self, context: Context) -> Choice:
        self._scale.add(context)
        found = np.array(self._workspace.predict(self._example(context)), np.float64)
        propensities = np.maximum(found, 0.0) / np.maximum(found, 0.0).sum()
        index = self._generator.choice(len(self.policies), p=propensities)
        return Choice(self.policies[index], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _recall(self, context: Context, choice: Choice) -> Choice:
        self._scale.add(context)
        return choice

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        label = f"0:{-reward!r}:{choice.propensities[choice.policy]!r} "
        self._workspace.learn(self._example(context, self.known.index(choice.policy), label))

    def _example(self, context: Context, chosen: int = -1, label: str = "") -> list[str]:
        """The context and one line a policy in Vowpal Wabbit's text format; the chosen one carries cost and probability."""
        features = " ".join(f"{index}:{value:.6g}" for index, value in enumerate(self._scale.transform(context).tolist()) if value)
        # Policies are numbered: a name may contain what has a meaning in this format.
        columns = self.columns.tolist()
        lines = columns if chosen < 0 or chosen in columns else [*columns, chosen]
        return [f"shared |c {features} one:1", *(f"{label if index == chosen else ''}|a p{index}" for index in lines)]

    def _state(self) -> State:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "model"
            self._workspace.save(str(file))
            model = np.frombuffer(file.read_bytes(), np.uint8).copy()
        return {"model": model, "random": self._generator.bit_generator.state, **self._scale.state()}

    def _load(self, state: State) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "model"
            file.write_bytes(state["model"].tobytes())
            self._workspace = _workspace(f"--quiet -i {file}")
        self._generator.bit_generator.state = state["random"]
        self._scale.load(state)


class SquareCBSelector(VowpalSelector):
    """SquareCB (Foster and Rakhlin, 2020): a policy's probability falls with the gap between its estimated reward and the best one's.

    Args:
        policies, context_dim, seed, learning_rate: see `VowpalSelector`.
        gamma_scale: how sharply, > 0; larger explores less (Vowpal Wabbit's default).
    """

    name: ClassVar[str] = "vw_squarecb"

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, *, learning_rate: float = 0.5, gamma_scale: float = 10.0) -> None:
        if not gamma_scale > 0.0:
            raise UsageError(f"gamma_scale must be positive, got {gamma_scale}")
        self.gamma_scale = float(gamma_scale)
        super().__init__(policies, context_dim, seed, learning_rate, f"--squarecb --gamma_scale {gamma_scale}")

    @property
    def settings(self) -> dict[str, Any]:
        """Learning rate and gamma's scale."""
        return {**super().settings, "gamma_scale": self.gamma_scale}


class RegCBSelector(VowpalSelector):
    """Optimistic RegCB (Foster et al., 2018): the policy whose reward could be the highest by any model that still fits what was seen.

    Args:
        policies, context_dim, seed, learning_rate: see `VowpalSelector`.
        lowest, highest: rewards lie between these.
        mellowness: how badly a model may fit and still count, > 0; larger explores more (Vowpal Wabbit's default).
    """

    name: ClassVar[str] = "vw_regcb"

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        learning_rate: float = 0.5,
        lowest: float = -1.0,
        highest: float = 1.0,
        mellowness: float = 0.1,
    ) -> None:
        if not lowest < highest:
            raise UsageError(f"lowest must be below highest, got {lowest} and {highest}")
        if not mellowness > 0.0:
            raise UsageError(f"mellowness must be positive, got {mellowness}")
        self.lowest, self.highest, self.mellowness = float(lowest), float(highest), float(mellowness)
        flags = f"--regcb --regcbopt --mellowness {mellowness} --cb_min_cost {-highest} --cb_max_cost {-lowest}"
        super().__init__(policies, context_dim, seed, learning_rate, flags)

    @property
    def settings(self) -> dict[str, Any]:
        """Learning rate, range of the rewards, mellowness."""
        return {**super().settings, "lowest": self.lowest, "highest": self.highest, "mellowness": self.mellowness}


def available() -> bool:
    """Whether the package is installed."""
    from importlib.util import find_spec

    return find_spec("vowpalwabbit") is not None


def _workspace(flags: str) -> Any:
    try:
        from vowpalwabbit import Workspace
    except ImportError:
        raise UsageError("this selector needs the package vowpalwabbit: pip install 'osel-sim[vw]'") from None
    return Workspace(flags)
