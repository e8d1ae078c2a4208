"""One stream of a log, shown to a selector that keeps to a budget."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import Selector
from osel_sim.selection.budget import Budget, Budgeted


@dataclass(frozen=True)
class Within:
    """A budget, and what every policy would cost in each decision of a stream, (T, P) cents."""

    budget: Budget
    prices: NDArray[np.float64]

    def play(self, selector: Selector, contexts: NDArray[np.float32], rewards: NDArray[np.float64], seed: int) -> NDArray[np.int16]:
        """Show the stream to the selector. Returns the columns chosen, (T,); -1 from where the budget pays for nothing.

        Args:
            contexts: (T, D). rewards: (T, P).
        """
        kept = Budgeted(selector, self.budget, contexts.shape[1], seed)
        column = {policy: index for index, policy in enumerate(kept.policies)}
        chosen = np.full(len(contexts), -1, np.int16)
        for decision, context in enumerate(contexts):
            if not kept.affordable:
                break
            choice = kept.select(context)
            chosen[decision] = at = column[choice.policy]
            kept.pay(choice.policy, float(self.prices[decision, at]))
            kept.update(context, choice, float(rewards[decision, at]))
        return chosen
