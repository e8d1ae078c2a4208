"""Policies that are Python objects at hand, such as one defined in a notebook, beside those that a file describes."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from osel_sim.core.errors import UsageError
from osel_sim.formats.policy_file import PolicySpec, Price
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Policy

OBJECT = "object"
"""Kind of a policy that no file describes."""


@dataclass(frozen=True)
class PolicyObject:
    """A policy at hand with what a policy file would say of it. It runs in this process, as a local policy.

    Attributes:
        spec: of kind `object`; its `file` names the object's class.
        policy: what drives: `reset(instruction)` and `act(observation)`.
    """

    spec: PolicySpec
    policy: Policy

    def spec_for(self, environment: EnvironmentSpec) -> PolicySpec:
        """What a policy file would say of it, with all cameras of an environment where it names none."""
        return self.spec if self.spec.cameras else replace(self.spec, cameras=environment.cameras)


def as_policy(
    policy: Policy,
    name: str | None = None,
    *,
    cameras: Sequence[str] | None = None,
    image_size: int = 96,
    history: int = 1,
    execute: int = 1000,
    inference_seconds: float = 0.0,
    price_per_action: float = 0.0,
) -> PolicyObject:
    """Say what a policy file would say of a policy object.

    Args:
        policy: an object with `reset(instruction)` and `act(observation)`, which returns actions (T, D) float32.
        name: what it is called; None: its class's name in small letters.
        cameras, image_size: what it is shown (square, pixels); None: all cameras that there are.
        history: how many successive observations it is shown at a call, the newest last.
        execute: actions of each chunk that are executed before it is asked again; at most the chunk's length.
        inference_seconds: declared time of one inference on the virtual clock.
        price_per_action: cents for each executed action.

    Raises:
        UsageError: the object lacks a method, or a number is out of range.
    """
    for method in ("reset", "act"):
        if not callable(getattr(policy, method, None)):
            raise UsageError(f"policy {type(policy).__name__!r} has no method {method!r}; a policy has reset(instruction) and act(observation)")
    if not (
        16 <= image_size <= 1024 and 1 <= history <= 16 and 1 <= execute <= 1000 and 0 <= inference_seconds <= 3600 and 0 <= price_per_action <= 1e6
    ):
        ranges = (
            "image_size in [16, 1024], history in [1, 16], execute in [1, 1000], inference_seconds in [0, 3600] and price_per_action in [0, 1000000]"
        )
        raise UsageError(f"a policy's numbers must lie in these ranges, as in a policy file: {ranges}")
    kind = type(policy)
    name = name or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.__name__).lower()
    spec = PolicySpec(
        name=name,
        title=f"{kind.__name__} (a Python object)",
        kind=OBJECT,
        checkpoint="",
        cameras=tuple(cameras or ()),
        image_size=image_size,
        history=history,
        execute=execute,
        inference_seconds=inference_seconds,
        remote=None,
        price=Price(per_action=price_per_action),
        file=Path(f"{kind.__module__}.{kind.__qualname__}"),
    )
    return PolicyObject(spec, policy)


def split_objects(policies: Iterable[object] | None) -> tuple[list[str] | None, dict[str, PolicyObject]]:
    """Names of all policies in their order, and the objects among them by name.

    Args:
        policies: names of policy files, `PolicyObject`s, or bare objects, which are taken as `as_policy` does.

    Raises:
        UsageError: two have the same name, or an object is no policy.
    """
    if policies is None:
        return None, {}
    names: list[str] = []
    objects: dict[str, PolicyObject] = {}
    for item in [policies] if isinstance(policies, str) else policies:
        if not isinstance(item, str):
            found = item if isinstance(item, PolicyObject) else as_policy(item)  # type: ignore[arg-type]
            objects[found.spec.name] = found
        names.append(item if isinstance(item, str) else found.spec.name)
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"policy {name!r} is named twice")
    return names, objects
