"""What `doctor` looks at: Python, packages, display, machine, tasks, suites, policies and the encoder. Imports nothing that may be missing."""

import importlib.metadata
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from osel_sim.core import content
from osel_sim.core.caches import prepare
from osel_sim.core.errors import ContentError, DataError, DisplayError, UsageError
from osel_sim.core.files import read_json
from osel_sim.core.proxies import settings
from osel_sim.core.shown import shown
from osel_sim.formats.policy_file import PolicySpec, load_policy_file
from osel_sim.formats.task_file import load_task_file
from osel_sim.sim.robots import with_robot
from osel_sim.suites import SUITES

DISTRIBUTION = "osel-sim"
CONFIG = "config.json"
MINIMUM_MEMORY = 4.0
OK, NOTE, MISSING = "ok", "note", "missing"


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    Attributes:
        area: python, packages, display, machine, tasks, suites, policies, encoder.
        name: what was looked at.
        found: what was found, in words.
        state: `ok`, `note` (good to know, nothing is blocked) or `missing` (a run needs it).
        fix: the command or step that puts it right, or empty.
    """

    area: str
    name: str
    found: str
    state: str = OK
    fix: str = ""


def examine(tasks: Path | None = None, policies: Path | None = None) -> list[Check]:
    """All checks, in the order in which they are shown.

    Args:
        tasks: a folder of the user's own task files.
        policies: a folder of the user's own policy files.
    """
    areas: dict[str, Callable[[], Iterator[Check]]] = {
        "python": _python,
        "packages": _packages,
        "display": _display,
        "machine": _machine,
        "tasks": partial(_tasks, tasks),
        "suites": _suites,
        "policies": partial(_policies, policies),
        "encoder": _encoder,
    }
    return [check for area, checks in areas.items() for check in _as_far_as_possible(area, checks)]


def _as_far_as_possible(area: str, checks: Callable[[], Iterator[Check]]) -> Iterator[Check]:
    """The checks of an area; where a package is missing that they themselves need, that."""
    try:
        yield from checks()
    except ModuleNotFoundError as error:
        package = (error.name or str(error)).partition(".")[0]
        yield Check(area, "not looked at", f"for want of the package {package!r}", MISSING, _install(package))


def _python() -> Iterator[Check]:
    yield Check("python", platform.python_implementation(), f"{platform.python_version()} in {sys.prefix}")
    try:
        version = importlib.metadata.version(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        yield Check("python", DISTRIBUTION, "runs from its folder, not installed", MISSING, _install(DISTRIBUTION))
        return
    yield Check("python", DISTRIBUTION, f"{version}, content in {content.root()}")


def _packages() -> Iterator[Check]:
    """Every declared dependency: there, and of a version that fits."""
    from packaging.requirements import Requirement

    try:
        declared = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return
    for requirement in map(Requirement, declared):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            yield Check(
                "packages", requirement.name, f"not installed, {requirement.specifier or 'any version'} needed", MISSING, _install(requirement.name)
            )
            continue
        fits = requirement.specifier.contains(version, prereleases=True)
        state, fix = (OK, "") if fits else (MISSING, _install(f"{requirement.name}{requirement.specifier}"))
        yield Check("packages", requirement.name, version if fits else f"{version}, {requirement.specifier} needed", state, fix)


def _install(requirement: str) -> str:
    """A checkout pins all of its packages; elsewhere pip has to find them."""
    return "make environment" if (content.root() / "Makefile").is_file() else f"pip install '{requirement}'"


def _display() -> Iterator[Check]:
    from osel_sim.sim import gl

    try:
        backend = gl.find_backend()
        how = "found by probing" if backend.how == "probed" else f"from {backend.how}"
        yield Check("display", "OpenGL", f"{backend.name}, {how}, draws with {_renderer()}")
    except DisplayError as error:
        problem, _, advice = str(error).partition(". ")
        yield Check("display", "OpenGL", problem, MISSING, advice)


def _renderer() -> str:
    """What draws: a graphics card's name, or Mesa's software renderer (llvmpipe)."""
    from osel_sim.sim import gl

    context = gl.context(16, 16)
    context.make_current()
    try:
        from OpenGL import GL

        return bytes(GL.glGetString(GL.GL_RENDERER)).decode(errors="replace")
    finally:
        context.free()


def _machine() -> Iterator[Check]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield Check("machine", "cores", str(cores))
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    enough = memory >= MINIMUM_MEMORY
    yield Check("machine", "memory", f"{memory:.1f} GiB", OK if enough else NOTE, "" if enough else f"a run wants {MINIMUM_MEMORY:.0f} GiB")
    yield Check("machine", "free disk space here", f"{shutil.disk_usage(Path.cwd()).free / 2**30:.1f} GiB")
    yield _caches()
    if said := settings():
        yield Check(
            "machine", "proxies", ", ".join(said), NOTE, "nothing local needs the network; NO_PROXY=HOST,... excepts policy servers of your own"
        )
    yield _gpu()


def _caches() -> Check:
    """Where compiled code, light meshes, models and the like are kept."""
    try:
        used = prepare()
    except UsageError as error:
        return Check("machine", "caches", str(error), MISSING, "export TMPDIR=/a/folder/that/can/be/written")
    temporary = used.parent == Path(tempfile.gettempdir())
    note = "the home folder cannot be written: what was compiled is lost with the temporary files; set XDG_CACHE_HOME to keep it"
    return Check("machine", "caches", f"in {used}", NOTE if temporary else OK, note if temporary else "")


def _gpu() -> Check:
    try:
        import torch
    except (ImportError, OSError) as error:
        return Check("machine", "GPU", f"torch cannot be imported ({str(error).splitlines()[0]})", MISSING, _install("torch"))
    if torch.cuda.is_available():
        return Check("machine", "GPU", f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}")
    if shutil.which("nvidia-smi") is not None:
        return Check(
            "machine", "GPU", "there is an NVIDIA driver, but torch does not see a GPU", NOTE, f"a torch built for it (this one: {torch.__version__})"
        )
    return Check("machine", "GPU", "none; nothing needs one, training is quicker with it", NOTE)


def _tasks(folder: Path | None) -> Iterator[Check]:
    found = content.files("tasks", folder)
    if not found:
        yield Check("tasks", "none", f"no task file in {content.root() / 'tasks'}", MISSING, _install(DISTRIBUTION))
    for name, file in found.items():
        try:
            yield Check("tasks", name, with_robot([load_task_file(file)])[0].title)
        except ContentError as error:
            yield Check("tasks", name, str(error), MISSING, f"correct {file.name}")


def _suites() -> Iterator[Check]:
    """Suites of others; nothing of ours needs one."""
    from osel_sim.cli.suites_command import state_words, suite_state
    from osel_sim.interface.instance import OURS

    for name in SUITES:
        if name == OURS:
            continue
        state = suite_state(name)
        about = f"{state['title']}, {len(state['tasks'])} tasks" if state["tasks"] else state["title"]
        missing = [one["command"] for one in state["environments"] if one["state"] == "missing"]
        words = state_words(state) if state["problem"] or missing else f"{about}; {state_words(state)}"
        yield Check("suites", name, words, NOTE if state["problem"] or missing else OK, "; ".join(missing))


def _policies(folder: Path | None) -> Iterator[Check]:
    from osel_sim.interface.specification import specification
    from osel_sim.policy.environment_fit import misfits

    found = content.files("policies", folder)
    if not found:
        yield Check("policies", "none", f"no policy file in {content.root() / 'policies'}", MISSING, _install(DISTRIBUTION))
    for name, file in found.items():
        try:
            spec = load_policy_file(file)
            yield _checkpoint(spec)
            for key, problem in misfits(spec, specification()):
                yield Check("policies", name, f"is for other suites than ours, or wrong: {key}: {problem}", NOTE)
        except ContentError as error:
            yield Check("policies", name, str(error), MISSING, f"correct {file.name}")


def _checkpoint(policy: PolicySpec) -> Check:
    """Whether a policy's checkpoint is on this machine, and whole."""
    if policy.remote is not None and policy.remote.url is not None:
        return Check("policies", policy.name, f"served at {shown(policy.remote.url)} (not tried)", NOTE)
    if not policy.checkpoint:
        return Check("policies", policy.name, f"{policy.kind}, needs no checkpoint")
    place = content.resolve_checkpoint(policy.checkpoint)
    if isinstance(place, Path):
        return _weights("policies", policy.name, place, f"python -m osel_sim.train --policy {policy.name} --data DIR --out {place}")
    if policy.checkpoint.count("/") == 1 and not Path(policy.checkpoint).is_absolute():
        return Check("policies", policy.name, f"hub checkpoint {policy.checkpoint} (not tried)", NOTE)
    train = f"python -m osel_sim.train --policy {policy.name} --data DIR --out {policy.checkpoint}"
    return Check("policies", policy.name, f"checkpoint folder {policy.checkpoint} is missing", MISSING, train)


def _encoder() -> Iterator[Check]:
    from osel_sim.context.names import DEFAULT_ENCODER

    folder = content.root() / "assets" / "encoders" / DEFAULT_ENCODER
    train = f"python -m osel_sim.train --encoder --data DIR --out {folder}"
    if folder.is_dir():
        yield _weights("encoder", DEFAULT_ENCODER, folder, train, "open_clip_config.json")
    else:
        yield Check("encoder", DEFAULT_ENCODER, "is missing", MISSING, train)


def _weights(area: str, name: str, folder: Path, fix: str, config: str = CONFIG) -> Check:
    """Whether a folder holds its configuration and at least one complete safetensors file; counts the parameters."""
    from safetensors import SafetensorError, safe_open

    try:
        read_json(folder / config)
    except DataError:
        return Check(area, name, f"{config} in {folder} is missing or no JSON", MISSING, fix)
    # Processors keep their statistics in safetensors files of their own.
    files = sorted(file for file in folder.glob("*.safetensors") if "processor" not in file.name)
    if not files:
        return Check(area, name, f"no safetensors file in {folder}", MISSING, fix)
    parameters = 0
    for file in files:
        try:
            # Opening compares the file's length with what its header says.
            with safe_open(file, framework="numpy") as tensors:
                parameters += sum(_product(tensors.get_slice(key).get_shape()) for key in tensors.keys())  # noqa: SIM118 (not a dictionary)
        except (OSError, SafetensorError) as error:
            return Check(area, name, f"{file} is not a whole safetensors file ({error})", MISSING, fix)
    return Check(area, name, f"checkpoint is whole, {parameters / 1e6:.1f}M parameters")


def _product(shape: list[int]) -> int:
    total = 1
    for size in shape:
        total *= size
    return total
