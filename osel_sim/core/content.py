"""Finds tasks/, policies/ and assets/: in a checkout or an editable install beside the package, in a wheel inside it.

`importlib.resources` alone misses them in an editable install, because they lie outside the package there.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core.errors import UnknownNameError, UsageError

if TYPE_CHECKING:
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.formats.task_file import TaskSpec

PACKAGE = Path(__file__).resolve().parents[1]


def root() -> Path:
    """The folder that holds tasks/, policies/ and assets/."""
    bundled = PACKAGE / "content"
    return bundled if bundled.is_dir() else PACKAGE.parent


def files(kind: str, extra: Path | None = None) -> dict[str, Path]:
    """Name -> TOML file of every task or policy; `extra` adds a user's folder, whose files win.

    Args:
        kind: `tasks` or `policies`.
    """
    folders = [root() / kind]
    if extra is not None:
        if not extra.is_dir():
            raise UsageError(f"{extra} is not a folder of {kind}")
        folders.append(extra)
    return {file.stem: file for folder in folders for file in sorted(folder.glob("*.toml"))}


def find(kind: str, name: str, extra: Path | None = None) -> Path:
    """The file of one task or policy.

    Raises:
        UnknownNameError: with the nearest known name.
    """
    known = files(kind, extra)
    if name not in known:
        raise UnknownNameError({"tasks": "task", "policies": "policy"}[kind], name, known, "python -m osel_sim.run --list")
    return known[name]


def select_tasks(wanted: Sequence[str], extra: Path | None = None) -> "list[TaskSpec]":
    """Tasks by name, `tag:TAG` or `all`, each once, in the order asked for.

    Raises:
        UsageError: nothing is asked for.
        UnknownNameError: with the nearest known name or tag.
        ContentError: a task file is wrong.
    """
    from osel_sim.formats.task_file import load_task_file

    if not wanted:
        raise UsageError(f"--task is missing; known: {', '.join(files('tasks', extra))}, tag:TAG, all (python -m osel_sim.run --list)")
    chosen: dict[str, TaskSpec] = {}
    for name in wanted:
        kind, colon, tag = name.partition(":")
        if name == "all" or (colon and kind == "tag"):
            everything = [load_task_file(file) for _, file in sorted(files("tasks", extra).items())]
            found = [task for task in everything if name == "all" or tag in task.tags]
            if not found:
                raise UnknownNameError("tag", tag, {tag for task in everything for tag in task.tags}, "python -m osel_sim.run --list")
        else:
            found = [load_task_file(find("tasks", name, extra))]
        chosen |= {task.name: task for task in found}
    return list(chosen.values())


def load_policy(name: str, extra: Path | None = None) -> "PolicySpec":
    """Find and read a policy file.

    Raises:
        UnknownNameError: with the nearest known name.
        ContentError: naming the file, the key and what would be right.
    """
    from osel_sim.formats.policy_file import load_policy_file

    return load_policy_file(find("policies", name, extra))


def resolve_checkpoint(checkpoint: str) -> Path | str:
    """A checkpoint as a policy file names it: an existing folder (absolute, or relative to the content root), else a hub name as it is."""
    folder = Path(checkpoint)
    if not folder.is_absolute():
        folder = root() / folder
    return folder if folder.exists() else checkpoint
