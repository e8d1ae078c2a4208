"""The selector that the suite recommends, `auto`."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from numpy.typing import ArrayLike

from osel_sim.core.errors import UsageError
from osel_sim.selection.bayesian import BayesianSelector, Prior
from osel_sim.selection.features import Landmarks
from osel_sim.selection.skills import Skills


class KernelUCBSelector(BayesianSelector):
    """Gaussian-process regression of every policy's success on the context, with what matters learned from the evidence.

    Contexts that lie together share what was learned of a policy, those apart do not, so regions of any shape can be told apart, and the selector
    begins as a bandit without context and becomes a contextual one as far as the rewards speak for it (see `BayesianSelector`). Where they
    never do it is a bandit on the policies' means, and ends with the best single policy. Declared costs spare it learning time and price,
    declared skills trying everything everywhere; it works without, and with no context seen before.

    What a policy does in one context is explored by optimism, which wastes least where there are many contexts; what it does on the whole by optimism
    and chance together. Optimism alone never returns to a policy whose first tries were bad luck; chance alone tries worse policies longer. Where the
    evidence says that a policy became better or worse, what was before is forgotten. Settings were chosen on made-up problems like those of
    `benchmarks/selection.py`, drawn from other seeds, and on the choosing half of `assets/logs/suite`.

    Robots share their decisions: 4 * min(D, 256) + 24 bytes each for contexts of D numbers, 8 more with skills
    (`osel_sim.selection.shared_rows.Rows`). Features, and how far each kind of them is believed, follow from those on every robot alike.

    Args:
        policies, context_dim, seed: see `SelectorBase`.
        expected_costs: policy -> declared alpha_time * time + alpha_price * price, as `episodes.expected_costs` gives; None learns them too.
        skills: which policies declare what, as `episodes.declared_skills` gives it; a first guess, overruled by outcomes. None: nothing is known.
        warm_contexts: (n, context_dim) contexts without outcomes to learn components and landmarks from; None starts cold.
        parts: lengths of the encoder's part of a context and of what is appended to it; which of them are used, the evidence says. Empty: one whole.
        components, whitening, width, landmarks: of the features, see `osel_sim.selection.features.Landmarks`.
        signals, shared, optimism, mean_optimism, chance, mean_chance, floor, least, alarm: see `Prior`.

    Raises:
        UsageError: a number out of range, or contexts (those of the skills, too) of another form.
        UnknownNameError: `expected_costs` lacks a policy.
    """

    name: ClassVar[str] = "kernel_ucb"

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        expected_costs: Mapping[str, float] | None = None,
        skills: Skills | None = None,
        warm_contexts: ArrayLike | None = None,
        parts: Sequence[int] = (),
        components: int = 32,
        whitening: float = 0.25,
        width: float = 0.7,
        landmarks: int = 64,
        signals: Sequence[float] = (0.05, 0.3, 1.2),
        shared: Sequence[float] = (0.0, 0.5),
        optimism: float = 1.0,
        mean_optimism: float = 1.0,
        chance: float = 0.1,
        mean_chance: float = 0.4,
        floor: float = 0.1,
        least: float = 0.0,
        alarm: float = 1e3,
    ) -> None:
        if components < 1 or landmarks < 1 or not width > 0.0:
            raise UsageError(f"components and landmarks must be at least 1 and width positive, got {components}, {landmarks}, {width}")
        self._own = {"components": components, "whitening": whitening, "width": width, "landmarks": landmarks}
        prior = Prior(
            signals,
            shared,
            optimism=optimism,
            mean_optimism=mean_optimism,
            chance=chance,
            mean_chance=mean_chance,
            floor=floor,
            least=least,
            alarm=alarm,
            expected_costs=expected_costs,
            warm_contexts=warm_contexts,
            skills=skills,
            parts=parts,
        )
        super().__init__(policies, context_dim, seed, Landmarks(components, whitening, width, landmarks), prior)

    @property
    def settings(self) -> dict[str, Any]:
        """Those of `BayesianSelector`, and those of the features."""
        return {**super().settings, **self._own}
