"""Whether this Python can run the package, which one can, and how it is called from here.

Read by Pythons that are too old for the rest of the package as well, which say so instead of failing: hence no syntax newer than Python 3.6, and
nothing imported but the standard library.
"""

import importlib.util
import os
import sys

VERSIONS = ((3, 12), (3, 13))
FIRST = ("cyclopts", "packaging", "pydantic", "rich")
"""Packages that every command needs before it can say anything. `doctor` tells of all others."""
ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
"""The checkout, where the package runs from one."""


def problem() -> str:
    """Why this Python cannot run the package, and which can; empty where it can."""
    if sys.version_info[:2] not in VERSIONS:
        known = " or ".join(".".join(map(str, version)) for version in VERSIONS)
        return f"osel_sim needs Python {known}, and {_described()} runs it; {remedy()}"
    missing = [name for name in FIRST if importlib.util.find_spec(name) is None]
    return lacking(*missing) if missing else ""


def lacking(*packages: str) -> str:
    """What to say where this Python has not got some packages."""
    names = ", ".join(repr(name) for name in packages)
    return f"{_described()} does not have the package{'s' if len(packages) > 1 else ''} {names}; {remedy()}"


def remedy() -> str:
    """Which Python to use, or how to get what this one lacks."""
    own = os.path.join(ROOT, ".venv", "bin", "python")
    if not os.path.isfile(os.path.join(ROOT, "Makefile")):
        return f"get it by: {sys.executable} -m pip install osel-sim"
    if os.path.isfile(own) and os.path.dirname(own) != os.path.dirname(sys.executable):
        return f"use {_from_here(own)}"
    return f"`make environment` in {ROOT} sets up {_from_here(own)} with all it needs"


def called() -> str:
    """How this Python is called from here: `python` where a shell finds it by that name, else its path."""
    import shutil

    found = shutil.which("python")
    if found is not None and os.path.dirname(os.path.abspath(found)) == os.path.dirname(os.path.abspath(sys.executable)):
        return "python"
    return _from_here(sys.executable)


def check() -> None:
    """End the process, with one line on standard error, where this Python cannot run the package."""
    found = problem()
    if found:
        sys.stderr.write(f"error: {found}\n")
        sys.exit(2)


def _described() -> str:
    return f"{sys.executable} (Python {'.'.join(map(str, sys.version_info[:3]))})"


def _from_here(file: str) -> str:
    """The path from the working folder where it lies below that, else the whole path."""
    here = os.path.abspath(os.curdir) + os.sep
    return file[len(here) :] if file.startswith(here) else file
