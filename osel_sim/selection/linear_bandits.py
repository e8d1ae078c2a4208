"""LinUCB and linear Thompson sampling on whitened principal components of the context."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from numpy.typing import ArrayLike

from osel_sim.core.errors import UsageError
from osel_sim.selection.bayesian import BayesianSelector, Prior
from osel_sim.selection.features import Components


class LinearSelector(BayesianSelector):
    """Each policy's reward is linear in the whitened context; policies are learned one by one, as in the bandits' textbook form.

    Robots share their decisions: 4 * min(D, 256) + 24 bytes each for contexts of D numbers (`osel_sim.selection.shared_rows.Rows`).

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        components: principal components of the contexts seen, each whitened to the same variance.
        prior: what it is told, and how it explores.

    Raises:
        UsageError: a number out of range, or contexts of another form.
        UnknownNameError: `expected_costs` lacks a policy.
    """

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, components: int, prior: Prior) -> None:
        if components < 1:
            raise UsageError(f"components must be at least 1, got {components}")
        self.components = components
        super().__init__(policies, context_dim, seed, Components(components, whitening=1.0), prior)

    @property
    def settings(self) -> dict[str, Any]:
        """Those of `BayesianSelector`, and the number of components."""
        return {**super().settings, "components": self.components}


class LinUCBSelector(LinearSelector):
    """Chooses the policy whose reward is highest at `optimism` deviations above its mean (Li et al. 2010). Arguments: `LinearSelector`, `Prior`.

    As published it can stay with a worse policy for good: where the first tries of the better one were bad luck its bound lies below the other's, and
    no bound of a policy changes while it is not chosen (in `benchmarks/selection.py` 5 of 12 seeds after an unlucky start, 2 of 12 among three
    policies 0.1 apart). `auto` and `lints` choose by chance and come back.
    """

    name: ClassVar[str] = "linucb"

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        components: int = 24,
        optimism: float = 1.0,
        signals: Sequence[float] = (0.05, 0.2, 0.8),
        expected_costs: Mapping[str, float] | None = None,
        warm_contexts: ArrayLike | None = None,
    ) -> None:
        super().__init__(
            policies,
            context_dim,
            seed,
            components,
            Prior(signals, optimism=optimism, mean_optimism=optimism, expected_costs=expected_costs, warm_contexts=warm_contexts),
        )


class LinTSSelector(LinearSelector):
    """Chooses the policy whose reward is highest in a draw from what is believed (Agrawal and Goyal 2013). Arguments: `LinearSelector`, `Prior`.

    `chance` scales the deviation of the draws where it is the context's; that of a policy's mean is drawn from in full. 1 is Thompson sampling
    proper, which explores more than some thousand decisions repay. Without context it stays with a worse policy only where there are too few
    decisions to tell (in `benchmarks/selection.py` 3 of 12 seeds of 16 policies in 400 decisions, as `thompson` does).
    """

    name: ClassVar[str] = "lints"

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        components: int = 24,
        chance: float = 0.5,
        signals: Sequence[float] = (0.05, 0.2, 0.8),
        expected_costs: Mapping[str, float] | None = None,
        warm_contexts: ArrayLike | None = None,
    ) -> None:
        super().__init__(
            policies,
            context_dim,
            seed,
            components,
            Prior(signals, chance=chance, mean_chance=1.0, expected_costs=expected_costs, warm_contexts=warm_contexts),
        )
