"""One process at a time in an output folder: a lock that says who holds it, and a new folder that is given back if nothing came of it."""

import contextlib
import fcntl
import json
import os
import shutil
import socket
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from osel_sim.core.errors import UsageError

LOCK = ".lock"


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a folder within the block; its `.lock` says who does, and is removed at the end.

    The operating system lets go of the lock when its process ends, however it does: what a killed one leaves of the file blocks nobody. A file system
    that knows no locks is not held.

    Raises:
        UsageError: another process holds it; says which.
    """
    file = folder / LOCK
    with contextlib.ExitStack() as stack:
        try:
            handle = stack.enter_context(_locked(file))
        except BlockingIOError:
            raise UsageError(f"{folder} is in use by {_holder(file)}: wait until it has ended, or give another --out") from None
        except PermissionError:
            raise UsageError(f"{folder} cannot be written: no permission to lock it") from None
        if handle is None:
            yield
            return
        handle.truncate(0)
        since = datetime.now(UTC).isoformat(timespec="seconds")
        handle.write(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "since": since}) + "\n")
        handle.flush()
        stack.callback(file.unlink, missing_ok=True)  # before the lock goes
        yield


def is_held(folder: Path) -> bool:
    """Whether another process holds a folder now."""
    try:
        with (folder / LOCK).open("r+", encoding="utf-8") as handle:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass  # there is none, or none to be had here
    return False


@contextlib.contextmanager
def taken(folder: Path, results: Sequence[str]) -> Iterator[None]:
    """Make a folder, and hold it within the block. If the block raises before there is anything in one of `results`, the folder is as it was.

    Raises:
        UsageError: it cannot be written, or another process holds it.
    """
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None
    with held(folder):
        before = {item.name for item in folder.iterdir()}
        try:
            yield
        except BaseException:
            if not any((folder / name).exists() and (folder / name).stat().st_size for name in results):
                for item in [item for item in folder.iterdir() if item.name not in before]:
                    shutil.rmtree(item, ignore_errors=True) if item.is_dir() else item.unlink(missing_ok=True)
                made_and_empty = made and not any(item.name != LOCK for item in folder.iterdir())
                if made_and_empty:
                    shutil.rmtree(folder, ignore_errors=True)
            raise


@contextlib.contextmanager
def _locked(file: Path) -> Iterator[IO[str] | None]:
    """The file, locked; None where there are no locks. One that its holder has removed meanwhile is not the one that others would lock."""
    while True:
        with file.open("a+", encoding="utf-8") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise
            except OSError:
                yield None
                return
            if file.exists() and os.path.samestat(os.fstat(handle.fileno()), file.stat()):
                yield handle
                return


def _holder(file: Path) -> str:
    try:
        who = json.loads(file.read_text(encoding="utf-8"))
        return f"process {who['pid']} on {who['host']}, since {who['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
