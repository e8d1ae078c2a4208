"""Kinds of policies by name, imported only when one is made.

A kind is a function `load(spec) -> make_session`: it loads what is heavy (weights) once and returns a cheap factory of policies, each with its
own state, which may share the weights. Others add a kind through the entry-point group `osel_sim.policies` (`kind = "module:load"`).
"""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.formats.policy_file import PRIVILEGED, PolicySpec
from osel_sim.interface.policy import Policy

MakeSession = Callable[[], Policy]
Loader = Callable[[PolicySpec], MakeSession]

GROUP = "osel_sim.policies"
BUILT_IN = {"lerobot": "osel_sim.policy.lerobot_policy:load"}
SERVERS = ("openpi",)  # kinds that only exist as somebody's server, reached by `url` of the policy file


def kinds() -> list[str]:
    """All kinds a policy file may name."""
    return sorted({*BUILT_IN, *SERVERS, *PRIVILEGED, *_plugins()})


def load_policy(spec: PolicySpec) -> MakeSession:
    """Load the weights of `spec` and return the factory of its sessions.

    Raises:
        UnknownNameError: no such kind.
        UsageError: the kind cannot be loaded here.
        CheckpointError: from the kind's own loader.
    """
    return _loader(spec)(spec)


def make_policy(spec: PolicySpec) -> Policy:
    """One policy of `spec`, weights included. Use `load_policy` where several sessions share them."""
    return load_policy(spec)()


def _loader(spec: PolicySpec) -> Loader:
    if spec.kind in SERVERS:
        raise UsageError(f"{spec.file}: kind: {spec.kind!r} is a server of its own and cannot be loaded here; give its address as url in [remote]")
    if spec.is_privileged:
        raise UsageError(f"{spec.file}: kind: {spec.kind!r} sees the simulator's state and only drives in an episode: it cannot be served")
    plugin = EntryPoint(spec.kind, BUILT_IN[spec.kind], GROUP) if spec.kind in BUILT_IN else _plugins().get(spec.kind)
    if plugin is None:
        raise UnknownNameError("policy kind", spec.kind, kinds(), str(spec.file))
    try:
        loader: Loader = plugin.load()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"{spec.file}: kind {spec.kind!r}: cannot import {plugin.value} ({error})") from error
    return loader


def _plugins() -> dict[str, EntryPoint]:
    return {plugin.name: plugin for plugin in entry_points(group=GROUP)}
