"""Finds tasks/, policies/ and assets/: in a checkout or an editable install beside the package, in a wheel inside it.

`importlib.resources` alone misses them in an editable install, because they lie outside the package there.
"""

from pathlib import Path

from osel_sim.core.errors import UnknownNameError, UsageError

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


def resolve_checkpoint(checkpoint: str) -> Path | str:
    """A checkpoint as a policy file names it: an existing folder (absolute, or relative to the content root), else a hub name as it is."""
    folder = Path(checkpoint)
    if not folder.is_absolute():
        folder = root() / folder
    return folder if folder.exists() else checkpoint
