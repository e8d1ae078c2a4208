"""Policies made ready to drive: local ones loaded, servers of remote ones started, fallbacks found."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self

from osel_sim.core import content
from osel_sim.core.errors import ContentError, OselError, UsageError
from osel_sim.episodes.loop import Driver
from osel_sim.formats import library
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.policy.objects import PolicyObject


def choose_policies(names: Sequence[str] | None, folder: Path | None = None, objects: Mapping[str, PolicyObject] | None = None) -> list[PolicySpec]:
    """Policy files by name, or all there are that see no more than a robot could.

    Args:
        objects: policies that no file describes, by name.

    Raises:
        UnknownNameError: no such policy.
        UsageError: a policy is named twice, or there is none at all.
        ContentError: a file is wrong.
    """
    if names is None:
        specs = [library.load_policy(name, folder) for name in content.files("policies", folder)]
        names = [spec.name for spec in specs if not spec.is_privileged]
    wanted = list(names)
    if not wanted:
        raise UsageError("no policies: name at least one after --policies")
    for name in wanted:
        if wanted.count(name) > 1:
            raise UsageError(f"policy {name!r} is named twice after --policies")
    at_hand = objects or {}
    return [at_hand[name].spec if name in at_hand else library.load_policy(name, folder) for name in wanted]


def with_fallbacks(specs: Sequence[PolicySpec], folder: Path | None = None) -> list[PolicySpec]:
    """The policies and those that they fall back to.

    Raises:
        ContentError: a fallback does not exist or is not local.
    """
    found = {spec.name: spec for spec in specs}
    for spec in specs:
        name = spec.remote.fallback if spec.remote else None
        if name is None:
            continue
        try:
            fallback = found.get(name) or library.load_policy(name, folder)
        except UsageError as error:
            raise ContentError(spec.file, "remote.fallback", str(error)) from None
        if fallback.is_remote:
            raise ContentError(spec.file, "remote.fallback", f"must be a local policy, {name!r} is remote")
        found[name] = fallback
    return list(found.values())


class Drivers:
    """Policies by name, ready to drive. Close it: that stops the servers.

    Args:
        specs: the policies and their fallbacks (`with_fallbacks`).
        objects: those of them that no file describes, by name.

    Raises:
        CheckpointError: a policy cannot be loaded.
        RemoteError: a server cannot be started or reached.
    """

    def __init__(self, specs: Sequence[PolicySpec], objects: Mapping[str, PolicyObject] | None = None) -> None:
        from osel_sim.policy.local import LocalCaller
        from osel_sim.policy.registry import make_policy
        from osel_sim.remote.policy import open_remote
        from osel_sim.sim.expert_caller import ExpertCaller

        remote = [spec for spec in specs if spec.is_remote]
        self._drivers: dict[str, Driver] = {}
        # Servers load their weights in their own processes meanwhile.
        with ThreadPoolExecutor(max(1, len(remote))) as pool:
            opening = [(spec, pool.submit(open_remote, spec)) for spec in remote]
            problem: OselError | None = None
            try:
                for spec in specs:
                    if not spec.is_remote:
                        at_hand = (objects or {}).get(spec.name)
                        policy = None if spec.is_privileged else at_hand.policy if at_hand else make_policy(spec)
                        caller = ExpertCaller(spec) if policy is None else LocalCaller(policy, spec)
                        self._drivers[spec.name] = Driver(spec, caller)
            except OselError as error:
                problem = error
            for spec, future in opening:
                try:
                    self._drivers[spec.name] = Driver(spec, future.result())
                except OselError as error:
                    problem = problem or error
        if problem is not None:
            self.close()
            raise problem

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getitem__(self, name: str) -> Driver:
        return self._drivers[name]

    def fallback(self, name: str) -> Driver | None:
        """Who takes over when `name` cannot go on."""
        remote = self._drivers[name].spec.remote
        return self._drivers[remote.fallback] if remote and remote.fallback else None

    def close(self) -> None:
        """Let go of all policies."""
        for driver in self._drivers.values():
            driver.caller.close()
        self._drivers.clear()
