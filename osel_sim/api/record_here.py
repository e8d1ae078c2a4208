"""A recording in worker processes of this machine: every policy on the same instances, or a shard of them."""

import logging
import time
from collections.abc import Mapping, Set
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from osel_sim.api.record_moments import as_begun as moments_as_begun
from osel_sim.api.record_moments import check_moments, cuts_of, in_blocks, said_of
from osel_sim.api.record_settings import RecordConfig
from osel_sim.api.results import RecordResult
from osel_sim.api.until_decided import baseline_then, concluded, instances_of, said, stopping
from osel_sim.core.errors import DataError, SettingError
from osel_sim.core.trust import trusting
from osel_sim.formats.merged_policy import with_parts

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.analysis.until_decided import UntilDecided
    from osel_sim.episodes.recording import Recording
    from osel_sim.episodes.workers import Plan

logger = logging.getLogger(__name__)

_FIXED = {"task": "tasks", "level": "levels", "axis": "axes"} | {name: name for name in ("instances", "start_seed", "action_noise", "split")}
"""Setting -> key in run.json of what a recording keeps from its beginning to its end."""


def record_here(config: RecordConfig) -> RecordResult:
    """Record what is asked for in worker processes of this machine.

    Raises:
        OselError: as `osel_sim.record`.
    """
    from osel_sim.analysis.log import read_outcomes

    given = config.given
    if config.resume and not config.task and config.out is not None:
        config = _as_begun(config, given)
    folder = config.out
    if folder is None:
        raise SettingError("out", "is missing: give the folder to write to")
    _check_stopping(config)
    baseline = None if config.baseline is None else read_outcomes(config.baseline)
    if baseline is not None and not config.task:
        config = _of_the_same_instances(config, baseline)
    with trusting(config.trust):
        return _record(config, folder, baseline, "encoder" in given)


def _check_stopping(config: RecordConfig) -> None:
    """Refuse settings that only go with `--until-decided`; a run.json has all settings, as they are by default."""
    for name in ("margin", "baseline", "baseline_policy"):
        if getattr(config, name) != getattr(RecordConfig, name) and not config.until_decided:
            raise SettingError(name, "is for a recording until it is decided; add --until-decided, or leave it out")
    if config.shard is not None and config.until_decided:
        raise SettingError("shard", "does not go with --until-decided: a shard does not know what the others find")
    if config.shard is not None and config.moments is not None:
        raise SettingError("shard", "does not go with --moments yet: tables of moments are not merged")
    if config.baseline_policy is not None and config.baseline is None:
        raise SettingError("baseline_policy", "is a policy of --baseline; give that log, too")


def _record(config: RecordConfig, folder: Path, baseline: "LoggedOutcomes | None", encoder_given: bool) -> RecordResult:
    from osel_sim.core.holding import held, taken
    from osel_sim.formats.rollout_log import ROLLOUTS
    from osel_sim.formats.run_config import RUN, check_run_folder, read_run
    from osel_sim.formats.shards import SHARDS
    from osel_sim.remote.policy import check_servers

    plan = plan_of(config)
    check_moments(plan)
    configuration = configuration_of(config, plan)  # refuses an unknown level or axis before anything loads
    before = read_run(folder) if config.resume and (folder / RUN).exists() else None
    stop = None
    if config.until_decided:
        configuration |= said(plan, config.margin, baseline, config.baseline_policy, before and before["configuration"])
        stop = stopping(plan, configuration, baseline, folder)
    known = configuration if before is None else _as_it_began(configuration, before["configuration"])
    check_run_folder(folder, known, config.resume)
    if before is None:
        check_servers(plan.everyone, plan.tasks[0].specification)
    with held(folder) if before is not None else taken(folder, (SHARDS, ROLLOUTS)):
        result = _record_into(folder, config, plan, configuration, known, before, encoder_given, stop)
    return result if stop is None else concluded(result, plan, configuration, baseline)


def _record_into(
    folder: Path,
    config: RecordConfig,
    plan: "Plan",
    configuration: dict[str, Any],
    known: dict[str, Any],
    before: dict[str, Any] | None,
    encoder_given: bool,
    stop: "UntilDecided | None",
) -> RecordResult:
    """Record what is missing into a folder that this process holds.

    Args:
        configuration: as it is asked for now; `known`: as it would have been at the beginning.
        before: the folder's `run.json`, None for a new one.
        stop: says when it has enough.
    """
    from osel_sim.context.encoder import load_encoder
    from osel_sim.core.files import write_json
    from osel_sim.episodes.declared_skills import declare
    from osel_sim.episodes.recording import Recording
    from osel_sim.formats.run_config import RUN, start_or_resume
    from osel_sim.suites.ran_with import ran_with

    encoder = load_encoder(plan.encoder)
    skills = declare(plan.policies, encoder, plan.tasks, config.tasks)
    configuration["encoder"] = encoder.identity
    # An encoder that was given is added; the one that was there must not have changed.
    known["encoder"] = before["configuration"].get("encoder") if before and encoder_given else encoder.identity
    for warning in start_or_resume(folder, known, ran_with(plan.tasks), config.resume, config.to_json()):
        logger.warning(warning)
    recording = Recording(folder, plan, encoder.identity, skills)
    _keep_what_decides(recording, stop)
    if recording.complete:
        logger.info("%s is complete", folder)
        return RecordResult(folder)
    if before is not None:
        write_json(folder / RUN, before | {"settings": config.to_json(), "configuration": configuration})
    try:
        done, seconds = _record_missing(recording, config.workers, stop) if recording.missing() else (0, 0.0)
    except BaseException:
        if not recording.grew and before is not None:  # nothing came of it, such as for want of a checkpoint: the folder is as it was
            write_json(folder / RUN, before)
        raise
    recording.finish(configuration)
    if lost := recording.lost:
        logger.warning(
            "%d episodes were lost, the first of them of %s, policy %s (%s); --resume --out %s records them again",
            *(len(lost), lost[0].instance, lost[0].policy, lost[0].error, folder),
        )
    return RecordResult(folder, done, seconds)


def plan_of(config: RecordConfig) -> "Plan":
    """What the settings ask for.

    Raises:
        OselError: there is no such task, policy, level or axis, or a policy does not fit.
    """
    from osel_sim.context.names import DEFAULT_ENCODER
    from osel_sim.episodes.drivers import choose_policies, with_fallbacks
    from osel_sim.episodes.shard import Shard
    from osel_sim.episodes.workers import Plan
    from osel_sim.formats.levels import parse_axes
    from osel_sim.suites.registry import common_specification, known_axes, select_tasks

    tasks = select_tasks(config.task, config.tasks, config.robot)
    policies = choose_policies(config.policies, common_specification(tasks), config.policies_dir)
    return Plan(
        tasks=tuple(tasks),
        policies=tuple(policies),
        everyone=tuple(with_fallbacks(policies, config.policies_dir)),
        seeds=range(config.start_seed, config.start_seed + config.instances),
        levels=tuple(config.level),
        split=config.split,
        encoder=config.encoder or DEFAULT_ENCODER,
        repeats=config.repeats or 1,
        repeat_every=config.repeat_every or 1,
        axes=parse_axes(config.axis, known_axes(tasks)),
        action_noise=config.action_noise,
        cuts=cuts_of(config),
        shard=None if config.shard is None else Shard.parse(config.shard),
    )


def configuration_of(config: RecordConfig, plan: "Plan") -> dict[str, Any]:
    """Everything the rollout log depends on but the encoder, content of files included."""
    from osel_sim.formats.run_config import content_digests, robots_said

    return {
        "tasks": [task.name for task in plan.tasks],
        "policies": [spec.name for spec in plan.policies],
        **robots_said(plan.tasks),
        "instances": config.instances,
        "start_seed": config.start_seed,
        "repeats": plan.repeats,
        "repeat_every": plan.repeat_every,
        "levels": list(config.level),
        "axes": plan.perturbed,
        "action_noise": config.action_noise,
        "split": config.split,
        "content": content_digests(plan.tasks, plan.everyone),
        **said_of(plan.cuts),
        **({} if plan.shard is None else {"shard": str(plan.shard)}),
    }


def _as_begun(config: RecordConfig, given: Set[str]) -> RecordConfig:
    """The settings that a recording began with; policies, repeats and an encoder that were given come in addition."""
    from osel_sim.formats.run_config import RUN, check_run_folder, read_run
    from osel_sim.interface.robot import DEFAULT_ROBOT

    folder = cast(Path, config.out)
    check_run_folder(folder, {}, resume=True)
    run = read_run(folder)
    began = run["configuration"]
    try:
        values = _instances_as(began)
        values["shard"] = began.get("shard")
        if config.shard not in (None, values["shard"]):
            raise SettingError("shard", f"{config.shard}, but {folder / RUN} is of {values['shard'] or 'all instances'}; give another --out")
        for name in given & set(_FIXED):
            own = getattr(config, name)
            if (list(own) if isinstance(own, tuple) else own) != began[_FIXED[name]]:
                words = " ".join(map(str, own)) if isinstance(own, tuple) else own
                raise SettingError(name, f"{words}, but {folder / RUN} began with {began[_FIXED[name]]}; leave it out, or give another --out")
        robot = values["robot"]
        if config.robot not in (None, robot or DEFAULT_ROBOT):
            raise SettingError(
                "robot", f"{config.robot}, but {folder / RUN} began with {robot or DEFAULT_ROBOT}; leave it out, or give another --out"
            )
        values["policies"] = tuple(dict.fromkeys([*began["policies"], *(config.policies or ())]))
        values["encoder"] = config.encoder or began["encoder"].partition("@")[0]
        values |= {name: getattr(config, name) or began[name] for name in ("repeats", "repeat_every")}
        values |= moments_as_begun(config, given, began, folder / RUN)
        if "until_decided" in began:
            values |= {"until_decided": True, "baseline": config.baseline or baseline_then(run.get("settings"), folder)}
            values |= {"baseline_policy": began["until_decided"].get("baseline_policy"), "margin": began["until_decided"]["margin"]}
            if "margin" in given and config.margin != values["margin"]:
                raise SettingError("margin", f"{config.margin}, but {folder / RUN} began with {values['margin']}; leave it out")
    except KeyError as missing:
        raise DataError(f"{folder / RUN}: not of a recording by this version, it has no {missing}; give all flags it was made with") from None
    except (TypeError, AttributeError) as error:
        raise DataError(f"{folder / RUN}: configuration does not have the promised form ({error})") from None
    return config.changed(**values)


def _instances_as(began: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a recording on the same instances; raises KeyError or TypeError where its configuration has another form."""
    robot = began.get("robot")
    values = {name: began[key] for name, key in _FIXED.items()}
    values["axis"] = tuple(part for axes in began["axes"] for part in axes.split(","))
    return values | {"robot": robot if isinstance(robot, str) else None}


def _of_the_same_instances(config: RecordConfig, baseline: "LoggedOutcomes") -> RecordConfig:
    """The settings with the instances of a baseline's log, and its repeats; those that were given stay."""
    try:
        values = _instances_as(baseline.metadata) | {name: baseline.metadata[name] for name in ("repeats", "repeat_every")}
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"--baseline {baseline.source} does not say how its instances were drawn ({error}): it is from elsewhere or of an earlier version; "
            "give --task and the other flags it was recorded with"
        ) from None
    values |= instances_of(baseline)
    return config.changed(**{name: value for name, value in values.items() if name not in config.given})


def _as_it_began(configuration: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration as it would have been without the policies and the repeats that a recording is given later on.

    Args:
        before: what the recording began with.
    """
    known = dict(configuration)
    policies, content_then = before.get("policies", []), before.get("content", {})
    added = with_parts(configuration["policies"]) - set(policies)
    if added and set(policies) < set(configuration["policies"]):
        digests = {key: value for key, value in configuration["content"].items() if key in content_then or key.partition(" ")[2] not in added}
        known |= {"policies": policies, "content": digests}
    repeats, every = before.get("repeats", 1), before.get("repeat_every", 1)
    if "until_decided" in configuration:
        return known  # more repeats would have decided otherwise
    # More of them: every episode there was is still asked for.
    if configuration["repeats"] >= repeats and (repeats == 1 or every % configuration["repeat_every"] == 0):
        known |= {"repeats": repeats, "repeat_every": every}
    return known


def _keep_what_decides(recording: "Recording", stop: "UntilDecided | None") -> bool:
    """Want no more than what it took to decide, if that is there. Returns whether it is."""
    if stop is None or not stop.look(recording.rows):
        return False
    recording.keep_to(cast("frozenset[str]", stop.kept))
    return True


def _record_missing(recording: "Recording", workers: int, stop: "UntilDecided | None") -> tuple[int, float]:
    """Record what is not there yet, with a progress bar, and add it. Returns how many episodes, and the seconds they took."""
    from osel_sim.core.progress import progress
    from osel_sim.episodes.workers import record as record_episodes
    from osel_sim.interface.outcome import credited

    plan, missing = recording.plan, recording.missing()
    if stop is not None:
        missing = {key: missing[key] for key in stop.order if key in missing}
    if plan.cuts is not None:
        missing = {key: missing[key] for key in in_blocks(missing, plan)}
    total, left = sum(len(plan.episodes(instance)) for instance in plan.instances), sum(map(len, missing.values()))
    unit = "episode" if left else "context"
    logger.info("starting %d workers: they load the encoder%s ...", workers, ", policies and servers" if left else "")
    start = time.perf_counter()
    done, successes = 0, 0.0
    wanted = plan if left else replace(plan, everyone=())  # contexts alone need no policy
    with (
        progress(total if left else len(missing), unit, initial=total - left if left else 0) as bar,
        closing(record_episodes(wanted, missing, workers, bar.begin)) as events,
    ):
        for recorded in events:
            if recorded is None:
                bar.update()
                continue
            rows = recording.add(recorded)
            decided = _keep_what_decides(recording, stop)
            if not left:
                bar.update()
                continue
            done += len(rows)
            successes += sum(credited(row, "success") for row in rows)
            bar.note(f"success {100 * successes / done:.0f}%, {3600 * done / (time.perf_counter() - start):.0f} episodes/h")
            if decided and not recording.missing():
                break  # what workers have made beyond is not part of the log
    return done, time.perf_counter() - start
