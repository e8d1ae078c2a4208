"""Telling a selector of decisions that were made before it was there."""

from collections.abc import Mapping

from osel_sim.interface.selector import Choice, Context, Recalls, Selector


def recalled(selector: Selector, context: Context, policy: str, propensities: Mapping[str, float]) -> Choice:
    """A choice that somebody made, as the selector wants to have it back with `update`."""
    if isinstance(selector, Recalls):
        return selector.recall(context, policy, propensities)
    return Choice(policy, dict(propensities))
