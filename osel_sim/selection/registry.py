"""Selectors by name. Listing them imports none: torch and stable-baselines3 come in with the selector that needs them."""

import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.core.registry import Registry

if TYPE_CHECKING:  # imports numpy
    from osel_sim.interface.selector import Selector

ENTRY_POINTS = "osel_sim.selectors"
"""Entry-point group in which other packages offer selectors: `name = "module:Class"`."""

BUILT_IN = {
    "auto": "osel_sim.selection.kernel_ucb:KernelUCBSelector",
    "epsilon_greedy": "osel_sim.selection.epsilon_greedy:EpsilonGreedySelector",
    "fixed": "osel_sim.selection.fixed:FixedSelector",
    "kernel_ucb": "osel_sim.selection.kernel_ucb:KernelUCBSelector",
    "lints": "osel_sim.selection.linear_bandits:LinTSSelector",
    "linucb": "osel_sim.selection.linear_bandits:LinUCBSelector",
    "linucb_discounted": "osel_sim.selection.discounted:DiscountedLinUCBSelector",
    "neural_linear": "osel_sim.selection.neural_linear:NeuralLinearSelector",
    "ppo": "osel_sim.selection.ppo.sb3:PPOSelector",
    "ppo_tuned": "osel_sim.selection.ppo.tuned:TunedPPOSelector",
    "random": "osel_sim.selection.uniform:UniformSelector",
    "thompson": "osel_sim.selection.thompson:ThompsonSelector",
    "thompson_window": "osel_sim.selection.thompson_window:WindowThompsonSelector",
    "ucb1": "osel_sim.selection.ucb1:UCB1Selector",
    "vw_regcb": "osel_sim.selection.vowpal:RegCBSelector",
    "vw_squarecb": "osel_sim.selection.vowpal:SquareCBSelector",
}

RECOMMENDED = "auto"
"""The selector that we recommend. The default of a live run is the paper's PPO."""
RECOMMENDATION = f"The selector we recommend is {RECOMMENDED} (--selector {RECOMMENDED}), which learns from far fewer decisions than the paper's ppo"

ABOUT = {
    "auto": "kernel UCB: contextual as far as the rewards speak for it; the one we recommend",
    "epsilon_greedy": "the paper's: best mean so far, exploring less and less",
    "fixed": "fixed:POLICY, always the same one",
    "kernel_ucb": "another name of auto",
    "lints": "Thompson sampling on a linear model of the context",
    "linucb": "highest upper bound of a linear model of the context",
    "linucb_discounted": "linucb that forgets at an even pace, for policies that change",
    "neural_linear": "Thompson sampling on the hidden layer of a small network",
    "ppo": "the paper's, of stable-baselines3: contextual, and slow to learn; the default of run",
    "ppo_tuned": "ppo with leading components of the context and a larger learning rate",
    "random": "every policy equally often",
    "thompson": "Thompson sampling on mean rewards, without context",
    "thompson_window": "thompson on the last decisions alone, for policies that change",
    "ucb1": "highest upper bound of the mean rewards, without context",
    "vw_regcb": "Vowpal Wabbit's RegCB (extra vw)",
    "vw_squarecb": "Vowpal Wabbit's SquareCB (extra vw)",
}
"""A line about each of our own."""

SELECTORS = Registry[Any]("selector", ENTRY_POINTS, BUILT_IN)


def selector_locations() -> dict[str, str]:
    """Name -> `module:Class` of every selector, installed plugins included; a plugin cannot replace a built-in one."""
    return SELECTORS.locations()


def is_recommended(name: str) -> bool:
    """Whether that is the selector that we recommend, by whichever of its names."""
    return BUILT_IN.get(name) == BUILT_IN[RECOMMENDED]


def make_selector(name: str, policies: Sequence[str], context_dim: int, seed: int, **settings: Any) -> "Selector":
    """Build a selector.

    Args:
        name: as `selector_locations` lists it, or `fixed:POLICY` for always that policy.
        policies: names to choose from.
        context_dim: length of a context.
        seed: of everything random in it.
        settings: hyper-parameters of that selector, by keyword.

    Raises:
        UnknownNameError: no such selector, or `fixed:POLICY` of a policy that is not among `policies`.
        UsageError: settings this selector does not have.
    """
    kind, colon, policy = name.partition(":")
    if kind not in SELECTORS or (colon and kind != "fixed"):
        raise UnknownNameError("selector", name, SELECTORS, "fixed:POLICY for always the same one")
    if kind == "fixed":
        if colon:
            settings = {**settings, "policy": policy}
        elif "policy" not in settings:
            raise UsageError(f"selector 'fixed' needs a policy, such as {f'fixed:{policies[0]}' if policies else 'fixed:POLICY'!r}")
    factory = SELECTORS.load(kind)
    known = _settings(factory)
    for setting in settings:
        if setting not in known:
            raise UnknownNameError(f"setting of selector {kind!r}", setting, known)
    return cast("Selector", factory(policies, context_dim, seed, **settings))


def setting_names(name: str) -> list[str]:
    """Names of the hyper-parameters that a selector takes by keyword.

    Raises:
        UnknownNameError: no such selector.
    """
    return _settings(_load(name))


def wanted_of(name: str, known: Mapping[str, Any]) -> dict[str, Any]:
    """What of the settings that are known a selector takes.

    Raises:
        UnknownNameError: no such selector.
    """
    takes = setting_names(name)
    return {key: value for key, value in known.items() if key in takes}


def learns_off_policy(name: str) -> bool:
    """Whether a selector may be shown outcomes of choices that it did not make (`SelectorBase.off_policy`).

    Raises:
        UnknownNameError: no such selector.
    """
    return bool(getattr(_load(name), "off_policy", False))


def can_share(name: str) -> bool:
    """Whether robots can exchange what such a selector learns (`osel_sim.interface.selector.Shares`).

    Raises:
        UnknownNameError: no such selector.
    """
    return all(hasattr(_load(name), method) for method in ("begin", "share", "absorb"))


def check_can_share(names: Iterable[str]) -> None:
    """Refuse selectors that cannot share.

    Raises:
        UsageError: naming the first of them, and our own that can.
    """
    for name in names:
        if not can_share(name):
            those = ", ".join(own for own in BUILT_IN if not own.startswith("vw_") and can_share(own))
            raise UsageError(f"selector {name!r} has nothing that robots could exchange; those that do: {those}")


def _load(name: str) -> Any:
    return SELECTORS.load(name.partition(":")[0])


def _settings(factory: Any) -> list[str]:
    return [parameter.name for parameter in inspect.signature(factory).parameters.values() if parameter.kind is parameter.KEYWORD_ONLY]
