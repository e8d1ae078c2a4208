"""A rollout log replayed to two selectors, of which one is one's own, and its learning curve."""

import osel_sim as osel
from osel_sim.interface.selector import Choice


class RecentBest:
    def __init__(self, policies, context_dim, seed):
        self.policies, self.mean = tuple(policies), {}

    def select(self, context):
        best = max(self.policies, key=lambda policy: self.mean.get(policy, 1.0))  # a policy never tried counts as perfect
        return Choice(best, {policy: float(policy == best) for policy in self.policies})

    def update(self, context, choice, reward):
        self.mean[choice.policy] = 0.9 * self.mean.get(choice.policy, reward) + 0.1 * reward


result = osel.replay("assets/logs/pick_place", selectors=["auto", RecentBest], seeds=3, no_frontier=True, out="runs/own_selector", overwrite=True)
result.curve.save("runs/own_selector/curve.svg")
