"""Python environments of suites of others: what each is made of, where it lies, whether it is there.

A suite's simulator has pins of its own, which seldom fit ours. `pins/NAME.in` says what it needs, `pins/NAME.txt` is the whole closure of that with
exact versions. `install` makes an environment of it in the user's cache folder; the suite's environments then run there, in a host process
(`osel_sim.suites.hosted`). Where what `NAME.in` asks for is installed beside us in fitting versions, they run in this process.
"""

import functools
import importlib.metadata
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from osel_sim.core.caches import prepare
from osel_sim.core.errors import MissingPackageError, UnknownNameError, UsageError
from osel_sim.core.files import content_digest
from osel_sim.core.holding import held

PINS = Path(__file__).resolve().parent / "pins"
READY = ".ready"
COMMAND = "python -m osel_sim.suites install"
TAIL = 5
"""Lines of uv's complaint that are told."""


@dataclass(frozen=True)
class SuiteEnvironment:
    """The Python environment of one suite.

    Attributes:
        name: of the suite, or of the part of one that has pins of its own.
    """

    name: str

    @property
    def folder(self) -> Path:
        """Where it lies, or would: another one for every set of pins and version of Python."""
        version = ".".join(map(str, sys.version_info[:2]))
        return prepare() / "osel_sim" / "suites" / f"{self.name}-{content_digest(version + self._pins.read_text(encoding='utf-8'))[:12]}"

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self._env / "bin" / "python"

    @property
    def packages(self) -> Path:
        """The folder of its packages."""
        return self._env / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"

    @property
    def installed(self) -> bool:
        """Whether it has been made."""
        return (self.folder / READY).is_file() and self.python.exists()

    @property
    def here(self) -> bool:
        """Whether this process can do without it: all that the suite needs is installed here in versions that fit."""
        return not self.misfits()

    @property
    def command(self) -> str:
        """The command that makes it."""
        return f"{COMMAND} {self.name}"

    def misfits(self) -> list[str]:
        """What this process lacks of what the suite needs: `metaworld==3.0.0 (not installed)`."""
        return list(_misfits(self.name, tuple(sys.path)))

    def require(self, suite: str) -> None:
        """See to it that the suite can run.

        Raises:
            MissingPackageError: it can neither run here nor has its environment been made; names a package and the command.
        """
        if not self.installed and not self.here:
            raise MissingPackageError(f"suite {suite!r}", self.misfits()[0].partition(" ")[0], self.command)

    def versions(self, packages: Iterable[str]) -> dict[str, str]:
        """Versions of packages as the suite runs with them; those that are not there are left out."""
        path = [str(self.packages)] if not self.here else sys.path
        wanted = {_canonical(package): package for package in packages}
        found = importlib.metadata.distributions(path=path)
        there = {_canonical(one.metadata["Name"]): one.version for one in found if _canonical(one.metadata["Name"]) in wanted}
        return {package: there[name] for name, package in wanted.items() if name in there}

    def install(self) -> Path:
        """Make it, unless it is there. Takes a minute or two, and reaches for nothing but the package registry that uv is set up with.

        Returns:
            its folder.

        Raises:
            MissingPackageError: uv is not installed.
            UsageError: uv fails; says how, or another process is at it.
        """
        if self.installed:
            return self.folder
        self.folder.mkdir(parents=True, exist_ok=True)
        with held(self.folder):
            if not self.installed:
                self._make(find_uv())
        return self.folder

    def _make(self, uv: str) -> None:
        shutil.rmtree(self._env, ignore_errors=True)  # what an interrupted attempt left
        _run(uv, "venv", "--quiet", "--no-project", "--python", sys.executable, str(self._env))
        _run(uv, "pip", "install", "--quiet", "--python", str(self.python), "--no-deps", "--requirements", str(self._pins))
        (self.folder / READY).touch()

    @property
    def _env(self) -> Path:
        return self.folder / "env"  # uv holds a lock of its own in it, called as ours is

    @property
    def _pins(self) -> Path:
        return PINS / f"{self.name}.txt"


def names() -> list[str]:
    """Names of the environments there are lists for."""
    return sorted(file.stem for file in PINS.glob("*.in"))


def environment(name: str) -> SuiteEnvironment:
    """The environment of that name.

    Raises:
        UnknownNameError: there is none.
    """
    if name not in names():
        raise UnknownNameError("suite with an environment of its own", name, names(), "python -m osel_sim.suites list")
    return SuiteEnvironment(name)


def find_uv() -> str:
    """The uv to install with: the one beside this Python, else the shell's.

    Raises:
        MissingPackageError: there is none.
    """
    beside = Path(sys.executable).parent / "uv"
    found = str(beside) if beside.exists() else shutil.which("uv")
    if found is None:
        raise MissingPackageError("making a suite's environment", "uv", f"{sys.executable} -m pip install uv")
    return found


def _run(*command: str) -> None:
    # A folder that a shell has activated is none of uv's business here.
    clean = {key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, env=clean, check=False)
    if done.returncode:
        lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise UsageError(f"uv {' '.join(command[1:3])} failed: {' | '.join(lines[-TAIL:])}")


@functools.lru_cache
def _misfits(name: str, path: tuple[str, ...]) -> tuple[str, ...]:
    from packaging.requirements import Requirement

    found = []
    for line in (PINS / f"{name}.in").read_text(encoding="utf-8").splitlines():
        words = line.partition("#")[0].strip()
        if not words:
            continue
        requirement = Requirement(words)
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{requirement.name} (not installed)")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            found.append(f"{requirement.name} {version} (needs {requirement.specifier})")
    return tuple(found)


def _canonical(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")
