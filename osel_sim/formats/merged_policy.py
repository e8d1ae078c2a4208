"""`merge:a+b`: several policies asked as one, by a name that says which. It has no file of its own: all that it needs is in theirs."""

from collections.abc import Callable, Iterable
from pathlib import Path

from pydantic.dataclasses import dataclass

from osel_sim.core.errors import UsageError
from osel_sim.formats.policy_file import PolicySpec, Remote
from osel_sim.formats.toml_types import TABLE

MERGE = "merge"
"""Kind of a merged policy, and how its name begins: `merge:a+b`."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class MergedSpec(PolicySpec):
    """What `merge:a+b` is, made of what its parts are (`merged`).

    Its `price` is nothing: every call says what its parts cost (`osel_sim.interface.call.Call.paid`).

    Attributes:
        parts: policies that are asked, two or more, in the order in which they are named.
    """

    parts: tuple[PolicySpec, ...]

    @property
    def is_privileged(self) -> bool:
        """Whether one of them sees what no robot could."""
        return any(part.is_privileged for part in self.parts)


def is_merge(name: str) -> bool:
    """Whether a policy's name is that of a merge."""
    return name.startswith(f"{MERGE}:")


def part_names(name: str) -> list[str]:
    """Names of the policies that are merged.

    Raises:
        UsageError: fewer than two, one named twice, or one that is a merge itself.
    """
    names = name.removeprefix(f"{MERGE}:").split("+")
    if len(names) < 2 or not all(names) or len(set(names)) < len(names) or any(map(is_merge, names)):
        raise UsageError(f"policy {name!r}: a merge names two or more different policies, such as 'merge:local_small+remote_large'")
    return names


def parts_of(spec: PolicySpec) -> tuple[PolicySpec, ...]:
    """The policies that are merged; of any other policy, itself."""
    return spec.parts if isinstance(spec, MergedSpec) else (spec,)


def with_parts(names: Iterable[str]) -> set[str]:
    """Names of policies, and of those that merges among them are made of."""
    names = set(names)
    return names.union(*(part_names(name) for name in names if is_merge(name)))


def merged(name: str, load: Callable[[str], PolicySpec]) -> MergedSpec:
    """The merge of this name.

    It sees what any of its parts sees, and is asked again when the first of them wants to be. It finishes its chunk while it waits where all parts
    that are behind a network do, and falls back where a part does, once no part has an answer.

    Args:
        load: finds one of its parts.

    Raises:
        UsageError: the name is wrong, or two parts want several successive images of different sizes, of which only one size can be kept.
        UnknownNameError: no such part.
    """
    parts = tuple(load(part) for part in part_names(name))
    remotes = [part.remote for part in parts if part.remote is not None]
    looking_back = sorted({part.image_size for part in parts if part.history > 1})
    if len(looking_back) > 1:
        sizes = " and ".join(map(str, looking_back))
        raise UsageError(f"policy {name!r}: its parts want successive images of {sizes} pixels; those that look back must agree on image_size")
    fallback = next((remote.fallback for remote in remotes if remote.fallback is not None), None)
    mode = "async" if remotes and all(remote.mode == "async" for remote in remotes) else "blocking"
    return MergedSpec(
        name=name,
        title=f"{' and '.join(part.name for part in parts)}, merged",
        kind=MERGE,
        execute=min(part.execute for part in parts),
        inference_seconds=max(part.inference_seconds for part in parts),
        cameras=tuple(dict.fromkeys(camera for part in parts for camera in part.cameras)),
        image_size=looking_back[0] if looking_back else parts[0].image_size,
        history=max(part.history for part in parts),
        remote=Remote(mode=mode, deadline=max(remote.deadline for remote in remotes), fallback=fallback) if remotes else None,
        file=Path(name),
        parts=parts,
    )
