"""`run.json`: everything a live run or a recording depends on, and what it ran with.

The configuration and the GL backend must be equal when a run is resumed. Versions may differ, with a warning: what follows then need not be the bytes
that an uninterrupted run would have written.
"""

import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

from osel_sim.core import content
from osel_sim.core.errors import DataError, UsageError
from osel_sim.core.files import digest, is_partial, read_json, write_json
from osel_sim.core.holding import LOCK
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import TEXTS
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.interface.suite import Task

SCHEMA_VERSION = 1
RUN = "run.json"
UNSAID = ("robot", "context", "encoders", "until_decided", "monitor", "moments", "budget", "fleet", "shard")
"""Keys of a configuration that are left out where they say what is usual; they are compared all the same."""
LIBRARIES = ("gymnasium", "lerobot", "mujoco", "numba", "numpy", "open_clip_torch", "osel-sim", "robosuite", "stable_baselines3", "torch")


def read_run(folder: Path) -> dict[str, Any]:
    """What a run's or a recording's `run.json` holds: `configuration` and `environment` are objects.

    Raises:
        DataError: it is missing, of another version or of another form.
    """
    file = folder / RUN
    data = read_json(file)
    version = data.get("schema_version")
    if version != SCHEMA_VERSION or isinstance(version, bool):
        raise DataError(f"{file}: schema_version must be {SCHEMA_VERSION}, got {quoted(version)}")
    for key in ("configuration", "environment"):
        if not isinstance(data.setdefault(key, {}), dict):
            raise DataError(f"{file}: {key} must be an object, got {quoted(data[key])}")
    for key, name in (("configuration", "content"), ("environment", "versions"), ("environment", "suites")):
        if not TEXTS.fits(data[key].get(name) or {}):
            raise DataError(f"{file}: {key}.{name} must be {TEXTS.wanted}, got {quoted(data[key][name])}")
    return data


def environment(gl: str, root: Path, packages: Iterable[str] = ()) -> dict[str, Any]:
    """What a run ran with.

    Args:
        gl: the OpenGL backend in use.
        root: folder whose git revision counts.
        packages: more distributions whose versions count, besides those that every run needs.
    """
    versions = {"python": platform.python_version()}
    for name in (*LIBRARIES, *packages):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {"gl": gl, "versions": versions, "git": git_revision(root), "machine": platform.machine(), "system": platform.system()}


def git_revision(root: Path) -> str | None:
    """Commit of a checkout, with `+changes` if tracked files differ from it; None outside of one."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        revision = git("rev-parse", "HEAD")
        return revision + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def content_digests(tasks: Iterable[Task], policies: Iterable[PolicySpec]) -> dict[str, str]:
    """What the files that a run depends on hold: the tasks', the policies', and their checkpoints' where those lie on this machine."""
    digests = {f"task {task.name}": task.info.digest for task in tasks}
    for spec in policies:
        # A Python object has no file; its class is all that can be said of it.
        digests[f"policy {spec.name}"] = digest(spec.file) if spec.file.is_file() else str(spec.file)
        checkpoint = content.resolve_checkpoint(spec.checkpoint) if spec.checkpoint else None
        if isinstance(checkpoint, Path):
            digests[f"checkpoint {spec.name}"] = digest(checkpoint)
    return digests


class HasRobot(Protocol):
    """A task, and who does it."""

    @property
    def name(self) -> str:
        """Name of the task."""
        ...

    @property
    def robot(self) -> str:
        """Name of the robot; empty where the suite has but one."""
        ...


def robots_said(tasks: Iterable[HasRobot]) -> dict[str, Any]:
    """`robot` of a configuration: the one that does all tasks, or the robot of each; nothing where that is the usual one."""
    robots = {task.name: task.robot for task in tasks}
    names = set(robots.values())
    return {"robot": robots if len(names) > 1 else names.pop()} if names - {DEFAULT_ROBOT, ""} else {}


def check_run_folder(folder: Path, configuration: dict[str, Any], resume: bool) -> None:
    """Refuse an output folder that cannot be used, before anything heavy is loaded.

    Args:
        configuration: as far as it is known; keys that it lacks are not compared.

    Raises:
        UsageError: the folder is in use and `resume` is off, there is nothing to resume, or the configuration differs.
        DataError: its `run.json` cannot be read.
    """
    file = folder / RUN
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is a file; give a folder")
    if not file.exists():
        if resume:
            raise UsageError(f"--resume: there is no run in {folder}; leave --resume out to begin one, or give the folder with --out")
        check_writable(folder)
        if folder.exists() and any(not is_partial(item) and item.name != LOCK for item in folder.iterdir()):
            raise UsageError(f"--out {folder} is not empty and holds no {RUN}; give a new folder")
        return
    if not resume:
        raise UsageError(f"--out {folder} is in use; add --resume to go on with what is in it, or give another folder")
    was = read_run(folder)["configuration"]
    now = {**dict.fromkeys(UNSAID), **configuration} if configuration else {}
    _compare(file, {key: was.get(key) for key in now}, json.loads(json.dumps(now)))


def check_writable(folder: Path) -> None:
    """Whether a folder can be written into, or made.

    Raises:
        UsageError: it cannot.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise UsageError(f"--out {folder} cannot be written: {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UsageError(f"--out {folder} cannot be written: no permission to write into {there}")


def start_or_resume(
    folder: Path, configuration: dict[str, Any], ran_with: dict[str, Any], resume: bool, settings: dict[str, Any] | None = None
) -> list[str]:
    """Write `run.json` into an output folder that this process holds, or check that what is in it is the same run.

    Args:
        configuration: what came of the settings: names, digests, everything that results depend on; must be equal on resuming.
        ran_with: what `environment` says.
        settings: of the command, as they were given; `--config run.json` takes them from there.

    Returns:
        warnings: what is different in the environment of a resumed run.

    Raises:
        UsageError: as `check_run_folder`, or the folder cannot be written, or the GL backend differs.
        DataError: its `run.json` cannot be read.
    """
    check_run_folder(folder, configuration, resume)
    file = folder / RUN
    if not resume:
        try:
            given = {} if settings is None else {"settings": settings}
            write_json(file, {"schema_version": SCHEMA_VERSION, **given, "configuration": configuration, "environment": ran_with})
        except OSError as error:
            raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None
        return []
    was = read_run(folder)["environment"]
    if was.get("gl") != ran_with["gl"]:
        raise UsageError(f"{file}: it began with the GL backend {was.get('gl')!r}, now it is {ran_with['gl']!r}; set MUJOCO_GL={was.get('gl')}")
    return [
        f"{key} was {_flat(was).get(key)!r} at the beginning, now it is {value!r}"
        for key, value in _flat(ran_with).items()
        if _flat(was).get(key) != value
    ]


def note_growth(folder: Path, episodes: int) -> None:
    """Write down that a run is to have more decisions than it began with.

    Raises:
        DataError: its `run.json` cannot be read.
    """
    run = read_run(folder)
    settings = {"settings": run["settings"] | {"episodes": episodes}} if isinstance(run.get("settings"), dict) else {}
    write_json(folder / RUN, run | settings | {"configuration": run["configuration"] | {"episodes": episodes}})


def _compare(file: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    for key, was, now in differences(old, new):
        raise UsageError(f"{file}: {key} was {was!r} at the beginning, now it is {now!r}; resume with the same, or give another --out")


def differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Each key, nested ones joined with dots, whose value differs, with both values; None where there is none."""
    was, now = _flat(old), _flat(new)
    for key in [*now, *(key for key in was if key not in now)]:
        if was.get(key) != now.get(key):
            yield key, was.get(key), now.get(key)


def _flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested keys joined with dots, so that a difference can be named."""
    result: dict[str, Any] = {}
    for key, value in data.items():
        result.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return result
