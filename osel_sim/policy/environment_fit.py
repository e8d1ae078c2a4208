"""Whether a policy file and an environment fit together, said when a policy is chosen for it, before anything heavy is loaded."""

from collections.abc import Iterator

from osel_sim.core.errors import ContentError, did_you_mean
from osel_sim.formats.merged_policy import MERGE, parts_of
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.policy.mapping import has_scale, known_parts


def check_environment(spec: PolicySpec, environment: EnvironmentSpec) -> None:
    """Whether the environment has what a policy file asks for.

    Raises:
        ContentError: naming the file, the key, what the environment has and what the policy wants.
    """
    for part in parts_of(spec) if spec.kind == MERGE else ():
        check_environment(part, environment)
    for key, problem in misfits(spec, environment):
        raise ContentError(spec.file, key, problem)


def misfits(spec: PolicySpec, environment: EnvironmentSpec) -> Iterator[tuple[str, str]]:
    """What does not fit: key of the policy file, and why."""
    has = f"the environment of {environment.name} has"
    if spec.is_privileged and not environment.expert:
        yield "kind", f"{spec.kind!r} drives by what the simulator knows, and {has} no scripted expert"
    for camera in spec.cameras:
        if camera not in environment.cameras:
            cameras = environment.cameras
            yield "observation.cameras", f"unknown camera {camera!r}: {did_you_mean(camera, cameras)}{has} {', '.join(cameras)}"
    mapping, parts, action = spec.mapping, known_parts(environment), environment.action
    for part in mapping.state_parts if mapping.state else ():
        if part not in parts:
            yield "mapping.state_parts", f"unknown part {part!r}: {did_you_mean(part, parts)}{has} {', '.join(parts) or 'no state'}"
    if mapping.state and mapping.state_frame == "hand" and "axis_angle" not in environment.state:
        yield "mapping.state_frame", f"{has} no axis_angle in its state, whose hand's is wanted"
    if mapping.columns and len(mapping.columns) != action.dimension:
        names, given = ", ".join(action.names), list(mapping.columns)
        yield "mapping.columns", f"{has} actions of {action.dimension} numbers ({names}), the policy gives {len(given)}: {given}"
    if has_scale(mapping) and len(mapping.scale) != len(action.motions):
        yield "mapping.scale", f"{has} {len(action.motions)} motions, the policy gives {len(mapping.scale)} factors: {list(mapping.scale)}"
    if mapping.gripper != "closed_positive" and action.gripper is None:
        yield "mapping.gripper", f"{has} no gripper, the policy's is {mapping.gripper!r}"
