"""Kinds of policies by name, imported only when one is made.

A kind is a function `load(spec, environment) -> make_session`, or `load(spec)` where it does not matter what it drives: it loads what is heavy
(weights) once and returns a cheap factory of policies, each with its own state, which may share the weights. Others add a kind through the
entry-point group `osel_sim.policies`: `NAME = "module:load"`.
"""

import inspect
from collections.abc import Callable
from typing import Any

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.core.registry import Registry
from osel_sim.formats.merged_policy import MERGE
from osel_sim.formats.policy_file import PRIVILEGED, SERVERS, PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Policy
from osel_sim.policy.environment_fit import check_environment

MakeSession = Callable[[], Policy]
Loader = Callable[[PolicySpec, EnvironmentSpec], MakeSession]

LOADERS = Registry[Loader]("policy kind", "osel_sim.policies", {"lerobot": "osel_sim.policy.lerobot_policy:load"})


def kinds() -> list[str]:
    """All kinds a policy file may name."""
    return sorted({*LOADERS, *SERVERS, *PRIVILEGED})


def session_factory(spec: PolicySpec, environment: EnvironmentSpec) -> MakeSession:
    """Load the weights of `spec` and return the factory of its sessions.

    Args:
        environment: what it will drive.

    Raises:
        ContentError: its file does not fit the environment.
        UnknownNameError: no such kind.
        UsageError: the kind cannot be loaded here.
        CheckpointError: from the kind's own loader.
    """
    check_environment(spec, environment)
    loader = _loader(spec)
    try:
        inspect.signature(loader).bind(spec, environment)
    except TypeError:
        return _without_environment(loader, spec)
    return loader(spec, environment)


def _without_environment(loader: Any, spec: PolicySpec) -> MakeSession:
    """Call a loader that is not interested in what it drives."""
    try:
        inspect.signature(loader).bind(spec)
    except TypeError:
        raise UsageError(f"{spec.file}: kind {spec.kind!r}: its entry point must be a function load(spec, environment)") from None
    session: MakeSession = loader(spec)
    return session


def make_policy(spec: PolicySpec, environment: EnvironmentSpec) -> Policy:
    """One policy of `spec`, weights included. Use `session_factory` where several sessions share them."""
    return session_factory(spec, environment)()


def _loader(spec: PolicySpec) -> Loader:
    if spec.kind in SERVERS:
        raise UsageError(f"{spec.file}: kind: {spec.kind!r} is a server of its own and cannot be loaded here; give its address as url in [remote]")
    if spec.kind == MERGE:
        raise UsageError(f"policy {spec.name!r} is asked in an episode only: load or serve its policies one by one")
    if spec.is_privileged:
        raise UsageError(f"{spec.file}: kind: {spec.kind!r} sees the simulator's state and only drives in an episode: it cannot be served")
    if spec.kind not in LOADERS:
        raise UnknownNameError("policy kind", spec.kind, kinds(), str(spec.file))
    try:
        return LOADERS.load(spec.kind)
    except UsageError as error:
        raise UsageError(f"{spec.file}: {error}") from error
