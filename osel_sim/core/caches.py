"""One folder for all caches where the user's own cannot be written: read-only containers, users without a home or a name.

Compiled code (numba, torch), light meshes, fonts (matplotlib) and models of the hub each have a variable that says where they are kept. Without it
most want `~/.cache`, and what they do where that cannot be written differs from one to the next. What stands in the environment already stays.
"""

import functools
import getpass
import logging
import os
import stat
import tempfile
from pathlib import Path

from osel_sim.core.errors import UsageError

logger = logging.getLogger(__name__)

_VARIABLES = {
    "XDG_CACHE_HOME": "",
    "NUMBA_CACHE_DIR": "numba",
    "TORCHINDUCTOR_CACHE_DIR": "torchinductor",
    "TRITON_CACHE_DIR": "triton",
    "MPLCONFIGDIR": "matplotlib",
}
_DOWNLOADS = {"HF_HOME": "huggingface", "TORCH_HOME": "torch"}
"""What was downloaded is read from `~/.cache` also where nothing can be added to it."""


def folder() -> Path | None:
    """Where the user's caches are: `$XDG_CACHE_HOME`, or `~/.cache`; None for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # neither HOME nor an entry among the users
        return None


@functools.cache
def prepare() -> Path:
    """See to it that every cache has a folder that can be written: the user's own, else one among the temporary files.

    Libraries and child processes are told through the environment, before torch, numba or robosuite are imported: they look only once.

    Returns:
        the folder.

    Raises:
        UsageError: not even temporary files can be written; or NUMBA_CACHE_DIR, which numba insists on, cannot.
    """
    own, compiled = folder(), os.environ.get("NUMBA_CACHE_DIR")
    if compiled and not _usable(Path(compiled)):
        raise UsageError(f"NUMBA_CACHE_DIR={compiled} cannot be written, and compiled code is kept there: name another folder, or unset it")
    try:
        temporary = Path(tempfile.gettempdir())
    except OSError as error:
        raise UsageError(f"no folder for temporary files can be written ({error.strerror or error}): name one in TMPDIR") from None
    if _name() is None:
        os.environ["USER"] = f"uid{os.getuid()}"  # torch asks for one, to name its folder
    if own is not None and _usable(own):
        return own
    base = _temporary(temporary)
    logger.info("caches: %s cannot be written, they are kept in %s (XDG_CACHE_HOME names another folder)", own or "the home folder", base)
    for name, part in _DOWNLOADS.items():
        if own is not None and (own / part).is_dir():
            os.environ.setdefault(name, str(own / part))
    for name, part in _VARIABLES.items():
        if name == "XDG_CACHE_HOME" or not os.environ.get(name):
            os.environ[name] = str(base / part)
    if own is None:
        os.environ.setdefault("HOME", str(base))
    return base


def _temporary(place: Path) -> Path:
    """A folder that outlives this process and that nobody else can write: compiled code is run as it lies there."""
    base = place / f"osel_sim-{os.getuid()}"
    base.mkdir(mode=0o700, exist_ok=True)
    found = base.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022 and _usable(base):
        return base
    return Path(tempfile.mkdtemp(prefix="osel_sim-"))


def _usable(folder: Path) -> bool:
    """Whether a folder is there, or can be made, and be written into: tried, since permissions do not tell all."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _name() -> str | None:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the first until Python 3.12
        return None
