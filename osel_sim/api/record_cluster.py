"""A recording whose shards are recorded elsewhere, and put together here.

What is done is told from the shards' folders alone, never from the engine: a shard that is complete is not sent again, whoever recorded it, and one
that another process is busy with is waited for.
"""

import logging
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from osel_sim.api.record_here import plan_of, record_here
from osel_sim.api.record_settings import RecordConfig
from osel_sim.api.results import RecordResult
from osel_sim.core.engines import Engine, Job, JobError, make_engine, options_of
from osel_sim.core.errors import DataError, OselError, SettingError, UsageError, WorkerError
from osel_sim.core.files import read_json, write_json
from osel_sim.core.holding import held, is_held, taken
from osel_sim.core.progress import progress
from osel_sim.core.trust import trusting
from osel_sim.episodes.merging import PARTS, merge, read_part
from osel_sim.episodes.shard import Shard
from osel_sim.formats.rollout_log import ROLLOUTS
from osel_sim.formats.run_config import RUN, check_writable
from osel_sim.formats.toml_types import quoted

logger = logging.getLogger(__name__)

SETTINGS = "cluster.json"
"""In the folder of the shards: what was asked for."""
JOBS = "jobs"
"""Beside it: what the engine keeps of its jobs, such as their output."""
SCHEMA_VERSION = 1
POLL_SECONDS = 0.5
"""Between two looks at the jobs: submitit itself only looks for the files of their results, and nobody tells of jobs of an earlier session."""
_ITS_OWN = {"out", "resume", "workers", "trust", "cluster", "retries", "at_once", "cluster_option"}
"""Settings that may be others when it goes on."""
_OF_THE_WHOLE = {"out", "resume", "cluster", "shards", "retries", "at_once", "cluster_option"}
"""Settings that the recording of one shard is not given."""
_ADDED = {"policies", "encoder", "repeats", "repeat_every"}
"""Settings that a recording may be given later on, as `record --resume` has it."""


def is_for_cluster(config: RecordConfig) -> bool:
    """Whether shards are to be recorded elsewhere: as it is asked for, or as it was when it began and not all are put together yet.

    Raises:
        SettingError: a setting that only goes with `--cluster`.
    """
    if config.cluster is not None:
        return True
    going_on = config.resume and config.out is not None and (config.out / PARTS / SETTINGS).exists() and not (config.out / ROLLOUTS).exists()
    for name in ("shards", "retries", "at_once", "cluster_option"):
        if not going_on and getattr(config, name) != getattr(RecordConfig, name):
            raise SettingError(name, "is for a recording on a cluster; add --cluster slurm, ray or local, or leave it out")
    return going_on


def record_on_cluster(config: RecordConfig) -> RecordResult:
    """Send the shards that are not there, wait for them, and put all together.

    Raises:
        WorkerError: shards failed, and failed again as often as they were sent.
        OselError: as `osel_sim.record` and `osel_sim.merge`.
    """
    if config.out is None:
        raise SettingError("out", "is missing: give the folder to write to")
    if config.shard is not None:
        raise SettingError("shard", "does not go with --cluster, which records every shard")
    if config.until_decided:
        raise SettingError("until_decided", "does not go with --cluster: it looks at all episodes as they come")
    if config.moments is not None:
        raise SettingError("moments", "does not go with --cluster yet: tables of moments are not merged")
    out, parts = config.out, config.out / PARTS
    check_writable(out)
    config = _going_on(config, parts / SETTINGS) if config.resume else _new(config, out)
    shards = [_Part.of(config, number) for number in range(1, (config.shards or 0) + 1)]
    start, recorded = time.perf_counter(), 0
    with taken(out, (RUN, ROLLOUTS, f"{PARTS}/{SETTINGS}")):
        parts.mkdir(exist_ok=True)
        with held(parts):
            if waiting := [part for part in shards if not part.complete(config)]:
                recorded = _record_all(waiting, shards, config, parts)
            merge([part.folder for part in shards], out)
    return RecordResult(out, recorded, time.perf_counter() - start)


def _new(config: RecordConfig, out: Path) -> RecordConfig:
    """The settings of a new recording, with the names of its policies, so that none comes in that is found only later."""
    if (out / RUN).exists() or (out / PARTS / SETTINGS).exists():
        raise UsageError(f"--out {out} is in use; add --resume to go on with what is in it, or give another folder")
    if config.shards is None:
        raise SettingError("shards", "is missing: say into how many parts the recording is to be divided")
    with trusting(config.trust):
        plan = plan_of(config)
        if config.shards > (count := len(plan.tasks) * len(plan.seeds)):
            raise SettingError("shards", f"{config.shards}, but there are {count} instances, and no shard may be empty")
        _ = replace(plan, shard=Shard(1, config.shards)).perturbed  # refuses an unknown level or axis here, not in every job
    return config.changed(policies=tuple(spec.name for spec in plan.policies))


def _going_on(config: RecordConfig, file: Path) -> RecordConfig:
    """The settings that it began with; policies, repeats and an encoder that were given come in addition."""
    if not file.exists():
        raise UsageError(f"--resume: there is no recording on a cluster in {config.out}; leave --resume out to begin one, or --cluster to go on here")
    data = read_json(file)
    if data.get("schema_version") != SCHEMA_VERSION or not isinstance(data.get("settings"), dict):
        raise DataError(f"{file}: schema_version must be {SCHEMA_VERSION} and settings an object, got {quoted(data.get('schema_version'))}")
    try:
        began = RecordConfig.of(**data["settings"])
    except UsageError as error:
        raise DataError(f"{file}: {error}") from None
    for name in config.given - _ITS_OWN - _ADDED:
        if getattr(config, name) != getattr(began, name):
            raise SettingError(name, f"{getattr(config, name)}, but {file} began with {getattr(began, name)}; leave it out, or give another --out")
    values = {name: getattr(config, name) for name in config.given & (_ITS_OWN | _ADDED)} | {"resume": False}
    values["policies"] = tuple(dict.fromkeys([*(began.policies or ()), *(config.policies or ())]))
    config = began.changed(**values)
    with trusting(config.trust):
        plan_of(config)
    return config


@dataclass(frozen=True, eq=False)
class _Part:
    """A shard to be recorded elsewhere: where it lies, and the settings that it is recorded with."""

    shard: Shard
    folder: Path
    settings: Mapping[str, Any]

    @classmethod
    def of(cls, config: RecordConfig, number: int) -> "_Part":
        """The shard of this number; paths are absolute, since a job may run in another folder."""
        shard = Shard(number, config.shards or 0)
        folder = (config.out or Path()).absolute() / PARTS / f"{number:0{len(str(shard.of))}d}"
        usual = RecordConfig.of().to_json()
        own = {name: value for name, value in config.to_json().items() if value != usual[name] and name not in _OF_THE_WHOLE}
        paths = {name: str(Path(own[name]).absolute()) for name in ("tasks", "policies_dir") if name in own}
        return cls(shard, folder, own | paths | {"shard": str(shard), "out": str(folder)})

    def missing(self, config: RecordConfig) -> str | None:
        """Why it has to be recorded; None where everything is there that is asked for, be it without outcome."""
        try:
            told = read_part(self.folder).run["configuration"]
        except DataError as error:
            return str(error)
        if set(config.policies or ()) - set(told["policies"]):
            return "policies were added"
        if any(getattr(config, name) not in (None, told[name]) for name in ("repeats", "repeat_every")):
            return "repeats were added"
        if config.encoder is not None and config.encoder != told["encoder"].partition("@")[0]:
            return "an encoder was added"
        return None

    def complete(self, config: RecordConfig) -> bool:
        """Whether every episode that is asked for has its outcome."""
        return self.missing(config) is None and not read_part(self.folder).lost


def record_part(settings: Mapping[str, Any]) -> tuple[int, str | None]:
    """Record a shard, or go on with it: what a job does.

    Returns:
        how many episodes, and why not all that there are; None if they are all there.
    """
    from osel_sim.core.caches import prepare

    prepare()
    begun = (Path(settings["out"]) / RUN).exists()
    try:
        return record_here(RecordConfig.of(**{**settings, "resume": begun})).recorded, None
    except OselError as error:
        return 0, str(error)


def _record_all(waiting: list[_Part], shards: list[_Part], config: RecordConfig, folder: Path) -> int:
    """Have shards recorded, and return how many episodes that took."""
    cluster = config.cluster or "local"
    engine = make_engine(cluster, folder / JOBS, config.workers, options_of(config.cluster_option))
    write_json(folder / SETTINGS, {"schema_version": SCHEMA_VERSION, "settings": config.to_json()})
    logger.info("sending %d of %d shards to %s ...", len(waiting), len(shards), cluster)
    sending = _Sending(engine, config, deque(waiting))
    try:
        with progress(len(shards), "shard", initial=len(shards) - len(waiting)) as bar:
            bar.begin()
            while sending.busy:
                done = sending.step()
                bar.note(f"{len(sending.running)} under way, {sending.sent_again} sent again")
                bar.update(done)
                if not done:
                    time.sleep(POLL_SECONDS)
    finally:
        engine.close()
    if sending.failed:
        part, reason = next(iter(sending.failed.items()))
        raise WorkerError(
            f"{len(sending.failed)} of {len(shards)} shards failed, {part.shard} the first ({reason}); what they wrote is in {folder / JOBS}; "
            f"record --resume --out {config.out} sends them again, and no others"
        )
    return sending.recorded


class _Sending:
    """Shards that are sent, and sent again where they fail.

    Attributes:
        running: those under way.
        failed: those that failed as often as they were sent, and why.
        recorded, sent_again: episodes, and shards.
    """

    def __init__(self, engine: Engine, config: RecordConfig, waiting: deque[_Part]) -> None:
        self._engine, self._config, self._waiting = engine, config, waiting
        self._at_once = config.at_once or engine.at_once or len(waiting)
        self._left = {part: config.retries for part in waiting}
        self.running: dict[_Part, Job] = {}
        self.failed: dict[_Part, str] = {}
        self.recorded = self.sent_again = 0

    @property
    def busy(self) -> bool:
        return bool(self._waiting or self.running)

    def step(self) -> int:
        """Send what there is room for, and see what has ended. Returns how many shards are complete that were not."""
        batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), self._at_once - len(self.running)))]
        elsewhere = [part for part in batch if is_held(part.folder)]
        self.running |= {part: _Elsewhere(part.folder) for part in elsewhere}
        send = [part for part in batch if part not in elsewhere]
        if send:
            self.running |= dict(zip(send, self._engine.submit(record_part, [part.settings for part in send]), strict=True))
        return sum(self._ended(part) for part in [part for part, job in self.running.items() if job.done()])

    def _ended(self, part: _Part) -> bool:
        """Whether a shard whose job has ended is complete; if not, it is sent again."""
        try:
            recorded, reason = self.running.pop(part).result()
        except JobError as error:
            recorded, reason = 0, str(error)
        self.recorded += recorded
        if part.complete(self._config):
            return True
        if is_held(part.folder):  # an earlier job of it goes on: of a session that was killed
            self._waiting.append(part)
            return False
        missing = part.missing(self._config)
        reason = reason or missing or "episodes were lost with their worker processes"
        if self._left[part]:
            self._left[part] -= 1
            self.sent_again += 1
            logger.warning("shard %s failed: %s; it is sent again", part.shard, reason)
            self._waiting.append(part)
            return False
        logger.warning("shard %s failed: %s; that was the last of %d times it is sent", part.shard, reason, self._config.retries + 1)
        if missing is not None:
            self.failed[part] = reason
        return missing is None


class _Elsewhere:
    """A shard that another process is busy with, such as a job of a session that was killed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def done(self) -> bool:
        return not is_held(self._folder)

    def result(self) -> tuple[int, str | None]:
        return 0, None
