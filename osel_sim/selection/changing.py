"""Selectors whose policies come and go, and those that cannot have that."""

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Changes, Selector
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.budget import Budgeted


def changing(selector: Selector, retires: bool) -> Changes:
    """The selector, as one whose policies may come and go.

    Args:
        retires: whether some are to retire; else they only join.

    Raises:
        UsageError: it is none; names the methods that it lacks.
    """
    if isinstance(selector, Budgeted):
        changing(selector.inner, retires)
    name = getattr(selector, "name", type(selector).__name__)
    lacking = [method for method in ("add_policy", "retire_policy") if not callable(getattr(selector, method, None))]
    if lacking or not isinstance(selector, Changes):
        raise UsageError(
            f"selector {name!r} lacks {' and '.join(lacking) or 'policies'}, so its policies cannot come and go "
            "(osel_sim.interface.selector.Changes); begin anew with the policies that there are now"
        )
    if isinstance(selector, SelectorBase) and not selector.retires and retires:
        raise UsageError(f"selector {name!r} cannot retire policies: its class says `retires = True` once it chooses among `columns` only")
    return selector
