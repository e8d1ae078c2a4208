"""One instance with one policy, looked at closely: what it saw, what it did, how it ended (`python -m osel_sim.doctor --policy FILE`)."""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from osel_sim.core import content
from osel_sim.core.errors import UsageError
from osel_sim.core.files import finite, write_json
from osel_sim.episodes.loop import Driver, Frame, Subscriber, run_episode
from osel_sim.formats import library
from osel_sim.formats.conventions import STATE_FRAMES, Conventions
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Call, Caller, Privileged
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.outcome import Outcome
from osel_sim.interface.policy import Observation
from osel_sim.interface.suite import Task
from osel_sim.policy.history import History, split
from osel_sim.policy.mapping import image_of, state_of, state_size, wanted_parts

OTHER_INSTRUCTION = "leave everything as it is"
SATURATED, STILL, TINY, FAR = 0.999, 1e-4, 0.02, 8.0
FLAT_IMAGE = 4.0
"""Standard deviation (of 255) below which an image shows nothing."""
LIBERO_IMAGES = (
    {"observation/image", "observation/wrist_image"},  # openpi's examples/libero
    {"observation.images.image", "observation.images.image2"},  # LeRobot's datasets
)
PROBLEM, NOTE = "problem", "note"


@dataclass
class Report:
    """What was found.

    Attributes:
        instance, instruction: what was tried.
        inputs: name of each input as the policy knows it -> what it was at the first call, in words.
        pictures: files with what each camera showed at the first, a middle and the last call.
        calls, chunk: how often it was asked, and how many actions its answers held.
        actions: axis -> lowest, mean, highest, standard deviation and share at the limit, of all actions answered.
        outcome: how it ended.
        findings: (`problem` or `note`, in words).
    """

    policy: str
    instance: str
    instruction: str
    inputs: dict[str, str] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)
    calls: int = 0
    chunk: tuple[int, int] = (0, 0)
    actions: dict[str, dict[str, float]] = field(default_factory=dict)
    outcome: dict[str, Any] = field(default_factory=dict)
    findings: list[tuple[str, str]] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong with how the policy is connected; it may fail the task all the same."""
        return all(kind != PROBLEM for kind, _ in self.findings)


class Watched:
    """A caller that remembers what went through it."""

    def __init__(self, caller: Caller) -> None:
        self._caller = caller
        self.seen: list[tuple[Observation, Call]] = []

    def bind(self, env: Any) -> None:
        """Show the world to a caller that wants to see it."""
        if isinstance(self._caller, Privileged):
            self._caller.bind(env)

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """As the caller."""
        self._caller.reset(instruction, seed)

    def call(self, observation: Observation) -> Call:
        """As the caller."""
        answer = self._caller.call(observation)
        self.seen.append((observation, answer))
        return answer

    def close(self) -> None:
        """As the caller."""
        self._caller.close()


class _OtherInstruction(Subscriber):
    """Asks once, before the episode, what the policy would do if it were told something else."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self.answer: Call | None = None

    @override
    def on_start(self, frame: Frame) -> None:
        spec, caller = self._driver.spec, self._driver.caller
        if not spec.is_privileged:
            caller.reset(OTHER_INSTRUCTION, (0,))
            self.answer = caller.call(
                {**History(spec.history).with_present(frame.env.observe(spec.cameras, spec.image_size)), "task": OTHER_INSTRUCTION}
            )


def find_policy(policy: str, folder: Path | None) -> tuple[PolicySpec, Path | None]:
    """A policy by name, or by its file; and the folder in which its fallback is looked for.

    Raises:
        UsageError: there is none.
        ContentError: its file is wrong.
    """
    from osel_sim.formats.policy_file import load_policy_file

    if not policy.endswith(".toml"):
        return library.load_policy(policy, folder), folder
    file = Path(policy)
    if not file.is_file():
        raise UsageError(f"{policy}: there is no such policy file")
    return load_policy_file(file.resolve()), file.resolve().parent


def check_policy(spec: PolicySpec, task: Task, seed: int, level: int, out: Path, policies: Path | None = None) -> Report:
    """Let a policy act on one test instance, without its fallback, and look at everything that went in and out.

    Args:
        out: folder for pictures and `report.json`.
        policies: folder of the user's own policy files.

    Raises:
        OselError: the policy does not load, its file is wrong, or its server cannot be reached.
    """
    from osel_sim.episodes.drivers import Drivers

    instance, environment = task.instance(seed, level), task.specification
    report = Report(spec.name, instance.key, instance.instruction)
    with Drivers([spec], environment) as drivers:
        watched = Watched(drivers[spec.name].caller)
        env = task.open()
        try:
            env.load(instance)
            other = _OtherInstruction(drivers[spec.name])
            outcome = run_episode(env, instance, Driver(spec, watched), subscribers=[other])
        finally:
            env.close()
    out.mkdir(parents=True, exist_ok=True)
    report.calls = len(watched.seen)
    report.outcome = {key: value for key, value in asdict(outcome).items() if key != "monitored"}
    if watched.seen:
        seen = [split(observation)[-1] for observation, _ in watched.seen]
        _inputs(report, spec, environment, seen[0])
        report.pictures = _pictures(spec, seen, out)
    _actions(report, environment.action, [call.actions for _, call in watched.seen if call.actions is not None], other.answer)
    _end(report, outcome)
    write_json(out / "report.json", finite(asdict(report)))
    return report


def _inputs(report: Report, spec: PolicySpec, environment: EnvironmentSpec, first: Observation) -> None:
    for camera in spec.cameras:
        image = image_of(first, camera, spec.mapping)
        size = " x ".join(map(str, image.shape[:2]))
        report.inputs[spec.mapping.key(camera)] = f"camera {camera}, {size} pixels, brightness {image.mean():.0f} of 255, contrast {image.std():.0f}"
        if image.std() < FLAT_IMAGE:
            report.findings.append((PROBLEM, f"the image of {camera} is of one colour"))
    for key in spec.mapping.blank:
        report.inputs[key] = "black"
    if spec.mapping.state and environment.state:
        state, parts = state_of(first, spec.mapping, environment), ", ".join(wanted_parts(spec.mapping, environment))
        report.inputs[spec.mapping.state] = f"{parts}: {np.array2string(state, precision=3, suppress_small=True)}"
        report.findings += [(NOTE, text) for text in _far_off(spec, environment, first)]
    report.findings += [(NOTE, text) for text in _as_libero(spec.mapping)]
    report.inputs[spec.mapping.prompt] = repr(report.instruction)


def _far_off(spec: PolicySpec, environment: EnvironmentSpec, first: Observation) -> list[str]:
    """Numbers of the state that are far from all that a local checkpoint was trained on."""
    statistics = _trained_on(spec)
    if statistics is None or len(statistics[0]) != state_size(spec.mapping, environment):
        return []
    mean, spread = statistics

    def away(mapping: Conventions) -> NDArray[np.float64]:
        return np.abs(state_of(first, mapping, environment) - mean) / np.maximum(spread, 1e-6)

    deviations = away(spec.mapping)
    worst = int(deviations.argmax())
    if deviations[worst] <= FAR:
        return []
    state = state_of(first, spec.mapping, environment)
    text = (
        f"number {worst} of the state, {state[worst]:.3f}, is {deviations[worst]:.0f} standard deviations from the mean {mean[worst]:.3f} "
        "of what the checkpoint was trained on: do [mapping] state_parts and the robot's starting pose agree with it?"
    )
    other = next(frame for frame in STATE_FRAMES if frame != spec.mapping.state_frame)
    if "axis_angle" in environment.state and (nearer := away(replace(spec.mapping, state_frame=other)).max()) < deviations[worst] / 2:
        text += f' With state_frame = "{other}" no number would be further away than {nearer:.0f}.'
    return [text]


def _trained_on(spec: PolicySpec) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Mean and standard deviation of the states that a local checkpoint was trained on, each (S,)."""
    from safetensors.numpy import load_file

    folder = content.resolve_checkpoint(spec.checkpoint) if spec.checkpoint else None
    for file in sorted(folder.glob("policy_preprocessor*normalizer*.safetensors")) if isinstance(folder, Path) else []:
        statistics = load_file(file)
        mean, spread = (statistics.get(f"observation.state.{key}") for key in ("mean", "std"))
        if mean is not None and spread is not None and mean.ndim == 1 and mean.shape == spread.shape:
            return mean.astype(np.float64), spread.astype(np.float64)
    return None


def _as_libero(mapping: Conventions) -> list[str]:
    """Names of inputs that are LIBERO's, without LIBERO's conventions."""
    keys = {*mapping.images.values()}
    if not any(pair <= keys for pair in LIBERO_IMAGES):
        return []
    lacking = [f'flip = {{ {camera} = "horizontal" }}' for camera in mapping.images if camera not in mapping.flip]
    lacking += ['state_frame = "hand"'] if mapping.state and mapping.state_frame != "hand" else []
    if not lacking:
        return []
    named = ", ".join(sorted(keys))
    return [f"{named} are LIBERO's names, whose images are mirrored and whose state has the hand's orientation: {'; '.join(lacking)}?"]


def _pictures(spec: PolicySpec, observations: list[Observation], out: Path) -> list[str]:
    """Write what the policy was shown of each camera at the first, a middle and the last call."""
    import imageio.v3 as imageio

    files = []
    for index in sorted({0, len(observations) // 2, len(observations) - 1}):
        for camera in spec.cameras:
            file = out / f"call{index:03d}_{camera}.png"
            imageio.imwrite(file, image_of(observations[index], camera, spec.mapping))
            files.append(str(file))
    return files


def _actions(report: Report, spec: ActionSpec, chunks: list[NDArray[np.float32]], other: Call | None) -> None:
    if not chunks:
        return
    lengths = [len(chunk) for chunk in chunks]
    report.chunk = (min(lengths), max(lengths))
    actions = np.concatenate(chunks)
    scaled = (actions - spec.middle) / spec.half_range
    limit = np.abs(scaled) >= SATURATED
    for index, axis in enumerate(spec.names):
        column = actions[:, index]
        report.actions[axis] = {
            "min": float(column.min()),
            "mean": float(column.mean()),
            "max": float(column.max()),
            "std": float(column.std()),
            "at_limit": float(limit[:, index].mean()),
        }
    moves, found = spec.moves, report.findings
    if len(chunks) > 1 and (scaled[:, spec.motions].std(axis=0) < STILL).all():
        found.append((PROBLEM, "all its motions are the same from beginning to end: it does not react to what it sees"))
    elif moves and (np.abs(scaled[:, moves]) < TINY).all():
        hint = ": are they metres a step? then [mapping] scale = [20, 20, 20, 2, 2, 2]" if spec.turns else " of half their range"
        found.append((PROBLEM, f"its motions are all below {TINY}{hint}"))
    if moves and limit[:, moves].mean() > 0.7:
        found.append(
            (PROBLEM, f"{limit[:, moves].mean():.0%} of its motions are at the limit: [mapping] scale or the statistics of its actions are wrong")
        )
    gripper = None if spec.gripper_index is None else actions[:, spec.gripper_index]
    if gripper is not None and ((gripper > 0).all() or (gripper <= 0).all()):
        word = "closed" if (gripper[0] > 0) == (spec.gripper_convention == "closed_positive") else "open"
        found.append((NOTE, f"the gripper is told to be {word} from beginning to end; [mapping] gripper says what its number means"))
    if other is not None and other.actions is not None and np.array_equal(other.actions, chunks[0]):
        found.append((PROBLEM, "another instruction about the same scene gives the very same actions: it does not read the instruction"))


def _end(report: Report, outcome: Outcome) -> None:
    if outcome.error is not None:
        report.findings.append((PROBLEM, f"the episode ended as an error: {outcome.error}"))
    elif not outcome.success:
        report.findings.append((NOTE, f"the task was not done within {outcome.steps} steps; {outcome.subgoals:.0%} of its subgoals were reached"))
