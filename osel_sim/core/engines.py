"""Functions run elsewhere: by submitit, on Slurm or as processes of this machine, or by Ray. They queue, place and watch; here is what they share."""

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from osel_sim.core.errors import MissingPackageError, SettingError

Cluster = Literal["slurm", "ray", "local"]

HOURS = 12
"""Time that a Slurm job asks for where nothing is said (timeout_min); submitit's own default is five minutes."""


class Job(Protocol):
    """A function under way."""

    def done(self) -> bool:
        """Whether it has ended, however it did."""
        ...

    def result(self) -> Any:
        """What it returned; only when it has ended.

        Raises:
            JobError: it was killed, or raised.
        """
        ...


class Engine(Protocol):
    """What runs functions elsewhere.

    Attributes:
        at_once: at most so many jobs should be given to it at a time; None where it queues itself.
    """

    at_once: int | None

    def submit(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Sequence[Job]:
        """Run an importable function once for each argument."""
        ...

    def close(self) -> None:
        """Cancel what is still under way."""
        ...


class JobError(Exception):
    """A job was killed, or raised; in one line."""


def options_of(words: Iterable[str]) -> dict[str, Any]:
    """`KEY=VALUE` each, as a mapping; numbers, true and false as what they are.

    Raises:
        SettingError: one has another form.
    """
    found: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key.isidentifier():
            raise SettingError("cluster_option", f"must be KEY=VALUE, such as timeout_min=60; got {word!r}")
        try:
            found[key] = json.loads(value)
        except ValueError:
            found[key] = value
    return found


def make_engine(cluster: Cluster, folder: Path, cores: int, options: Mapping[str, Any]) -> Engine:
    """Connect to a cluster.

    Args:
        folder: where the engine may keep what it needs; seen by all machines.
        cores: of a job.
        options: of a job, as the engine calls them.

    Raises:
        MissingPackageError: the engine is not installed.
        SettingError: it does not know an option, or there is no such cluster here.
    """
    return _Ray(cores, options) if cluster == "ray" else _Submitit(cluster, folder, cores, options)


class _Submitit:
    def __init__(self, cluster: Literal["slurm", "local"], folder: Path, cores: int, options: Mapping[str, Any]) -> None:
        try:
            import submitit
        except ModuleNotFoundError as error:
            raise MissingPackageError(f"--cluster {cluster}", error.name or "submitit", "pip install 'osel-sim[slurm]'") from None
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
        except Exception as error:  # RuntimeError of Slurm's executor: no srun on this machine
            raise SettingError("cluster", f"{cluster} cannot be used here: {_line(error)}") from None
        try:
            self._executor.update_parameters(**{"name": "osel_sim", "cpus_per_task": cores, "timeout_min": 60 * HOURS} | dict(options))
        except Exception as error:  # NameError of submitit, TypeError, ValueError
            raise SettingError("cluster_option", f"submitit refuses it: {_line(error)}") from None
        # Slurm queues; processes of this machine would all start at once.
        self.at_once: int | None = None if cluster == "slurm" else max(1, (os.cpu_count() or 1) // cores)
        self._jobs: list[_SubmititJob] = []

    def submit(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Sequence[Job]:
        with self._executor.batch():  # of several, Slurm makes one job array
            jobs = [self._executor.submit(function, argument) for argument in arguments]
        self._jobs = [job for job in self._jobs if not job.done()] + [_SubmititJob(job) for job in jobs]
        return self._jobs[-len(jobs) :]

    def close(self) -> None:
        for job in self._jobs:
            job.cancel()


class _SubmititJob:
    def __init__(self, job: Any) -> None:
        self._job = job

    def done(self) -> bool:
        return bool(self._job.done())

    def result(self) -> Any:
        try:
            return self._job.result()
        except Exception as error:  # submitit's own, or what the function raised
            raise JobError(f"{_line(error)}; {self._job.paths.stderr}") from None

    def cancel(self) -> None:
        if not self.done():
            with contextlib.suppress(Exception):  # it has ended meanwhile, or Slurm no longer knows it
                self._job.cancel()


class _Ray:
    def __init__(self, cores: int, options: Mapping[str, Any]) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ModuleNotFoundError as error:
            raise MissingPackageError("--cluster ray", error.name or "ray", "pip install 'osel-sim[ray]'") from None
        self._ray, self._own, self._references = ray, not ray.is_initialized(), list[Any]()
        self.at_once: int | None = None
        self._options = {"num_cpus": cores, "max_retries": 0} | dict(options)
        try:
            ray.remote(**self._options)(_line)  # refuses what it does not know
        except Exception as error:
            raise SettingError("cluster_option", f"Ray refuses it: {_line(error)}") from None
        if self._own:
            try:
                ray.init(log_to_driver=False, logging_level="warning")  # joins the cluster of RAY_ADDRESS or of this machine, else begins one here
            except Exception as error:
                raise SettingError("cluster", f"ray cannot be used here: {_line(error)}") from None

    def submit(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Sequence[Job]:
        remote = self._ray.remote(**self._options)(function)
        jobs = [_RayJob(self._ray, remote.remote(argument)) for argument in arguments]
        self._references += [job.reference for job in jobs]
        return jobs

    def close(self) -> None:
        for reference in self._ray.wait(self._references, num_returns=len(self._references), timeout=0)[1] if self._references else []:
            self._ray.cancel(reference, force=True)
        if self._own:
            self._ray.shutdown()


class _RayJob:
    def __init__(self, ray: Any, reference: Any) -> None:
        self._ray, self.reference = ray, reference

    def done(self) -> bool:
        return bool(self._ray.wait([self.reference], timeout=0)[0])

    def result(self) -> Any:
        try:
            return self._ray.get(self.reference)
        except Exception as error:  # RayError, or what the function raised
            raise JobError(_line(error)) from None


def _line(error: Exception) -> str:
    """The last line of an error that is a traceback, else its first."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if any("Traceback" in line for line in lines) else lines[0]
