"""Policies made ready to drive: local ones loaded, servers of remote ones started, fallbacks found."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self

from osel_sim.core import content
from osel_sim.core.errors import ContentError, OselError, UsageError
from osel_sim.episodes.loop import Driver
from osel_sim.episodes.merged_caller import MergedCaller
from osel_sim.formats import library
from osel_sim.formats.merged_policy import MergedSpec, is_merge, merged, parts_of
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.instance import OURS
from osel_sim.policy.environment_fit import check_environment, misfits
from osel_sim.policy.objects import PolicyObject

logger = logging.getLogger(__name__)


def choose_policies(
    names: Sequence[str] | None, environment: EnvironmentSpec, folder: Path | None = None, objects: Mapping[str, PolicyObject] | None = None
) -> list[PolicySpec]:
    """Policy files by name, or all that fit the environment and see no more than a robot could; the log says which are left out.

    Args:
        environment: what they are to drive.
        folder: the user's own policy files.
        objects: policies that no file describes, by name.

    Raises:
        UnknownNameError: no such policy.
        UsageError: a policy is named twice, or there is none at all.
        ContentError: a file is wrong, or one that is named does not fit the environment.
    """
    if names is None:
        unfit = left_out(environment, folder)
        specs = [library.load_policy(name, folder) for name in content.files("policies", folder) if name not in unfit]
        names = [spec.name for spec in specs if not spec.is_privileged]
        shipped = environment.name == OURS and folder is None  # those of other suites, which nobody asked about
        if unfit and not shipped:
            logger.info("not made for the environment of %s, and left out: %s (naming one says why)", environment.name, ", ".join(unfit))
        if not names and unfit:
            raise UsageError(f"no policy there is drives in the environment of {environment.name}, such as {next(iter(unfit.values()))}")
    wanted = list(names)
    if not wanted:
        raise UsageError("no policies: name at least one after --policies")
    for name in wanted:
        if wanted.count(name) > 1:
            raise UsageError(f"policy {name!r} is named twice after --policies")
    at_hand = objects or {}

    def load(name: str) -> PolicySpec:
        return at_hand[name].spec_for(environment) if name in at_hand else library.load_policy(name, folder)

    found = [merged(name, load) if is_merge(name) else load(name) for name in wanted]
    for spec in found:
        check_environment(spec, environment)
    return found


def left_out(environment: EnvironmentSpec, folder: Path | None = None) -> dict[str, str]:
    """Policies, of those that see no more than a robot could, that do not fit an environment -> why.

    Raises:
        ContentError: a file is wrong.
    """
    found = {}
    for name in content.files("policies", folder):
        spec = library.load_policy(name, folder)
        problem = next(misfits(spec, environment), None)
        if problem is not None and not spec.is_privileged:
            found[name] = f"{spec.file}: {problem[0]}: {problem[1]}"
    return found


def with_fallbacks(specs: Sequence[PolicySpec], folder: Path | None = None) -> list[PolicySpec]:
    """The policies, those that they are made of, and those that they fall back to.

    Raises:
        ContentError: a fallback does not exist or is not local.
    """
    found = {spec.name: spec for spec in specs}
    found |= {part.name: part for spec in specs for part in parts_of(spec) if part.name not in found}
    for spec in list(found.values()):
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
        environment: what they are to drive.
        objects: those of them that no file describes, by name.

    Raises:
        ContentError: a policy's file does not fit the environment.
        CheckpointError: a policy cannot be loaded.
        RemoteError: a server cannot be started or reached.
    """

    def __init__(self, specs: Sequence[PolicySpec], environment: EnvironmentSpec, objects: Mapping[str, PolicyObject] | None = None) -> None:
        from osel_sim.policy.expert import ExpertCaller
        from osel_sim.policy.local import LocalCaller
        from osel_sim.policy.registry import make_policy
        from osel_sim.remote.policy import open_remote

        for spec in specs:
            check_environment(spec, environment)
        merges = [spec for spec in specs if isinstance(spec, MergedSpec)]
        specs = [spec for spec in specs if not isinstance(spec, MergedSpec)]
        remote = [spec for spec in specs if spec.is_remote]
        self._drivers: dict[str, Driver] = {}
        # Servers load their weights in their own processes meanwhile.
        with ThreadPoolExecutor(max(1, len(remote))) as pool:
            opening = [(spec, pool.submit(open_remote, spec, environment)) for spec in remote]
            problem: OselError | None = None
            try:
                for spec in specs:
                    if not spec.is_remote:
                        at_hand = (objects or {}).get(spec.name)
                        policy = None if spec.is_privileged else at_hand.policy if at_hand else make_policy(spec, environment)
                        caller = ExpertCaller(spec) if policy is None else LocalCaller(policy, spec, environment)
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
        self._merged = [MergedCaller(spec, [self._drivers[part.name] for part in spec.parts], environment.action) for spec in merges]
        self._drivers |= {spec.name: Driver(spec, caller) for spec, caller in zip(merges, self._merged, strict=True)}

    def trust(self, propensities: Mapping[str, float]) -> None:
        """Let merges follow, where their parts disagree, the one that a selector would rather have chosen (`MergedCaller.trust`)."""
        for caller in self._merged:
            caller.trust(propensities)

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
