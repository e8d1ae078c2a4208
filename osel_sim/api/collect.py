"""Demonstrations of the scripted expert as LeRobotDatasets."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from osel_sim.api.settings import CONTENT, INSTANCES, MAIN, OTHER, Count, Folder, Levels, Names, Settings, settings
from osel_sim.core.errors import SettingError, UsageError

if TYPE_CHECKING:
    from osel_sim.interface.suite import Task


@settings
class CollectConfig(Settings):
    """Record the scripted expert, disturbed now and then, into a LeRobotDataset."""

    task: Annotated[Names, MAIN] = ()
    """tasks to demonstrate: names, tag:TAG, or all; several get a folder each in --out"""
    episodes: Annotated[Count | None, MAIN] = None
    """training instances to demonstrate (seeds 0 to N-1)"""
    out: Annotated[Path | None, MAIN] = None
    """folder of the dataset"""
    resume: Annotated[bool, MAIN] = False
    """go on with --out: finished shards are kept"""
    workers: Annotated[Count, MAIN] = os.cpu_count() or 1
    """processes (default: one a core)"""
    image_size: Annotated[Count, MAIN] = 96
    """pixels, square"""
    camera: Annotated[Names, OTHER] = ()
    """cameras to record, of tasks of other suites; may be repeated (default: the first two that the environment has)"""
    every: Annotated[Count, OTHER] = 1
    """look at every so many control steps only, of tasks of other suites, which may run at 80 Hz: the actions between are kept"""
    level: Annotated[Levels, INSTANCES] = (0,)
    """how hard scenes are perturbed, 0 to 3; several take turns"""
    axis: Annotated[Names, INSTANCES] = ()
    """AXIS=LEVEL: one axis at a level of its own, such as camera=2; repeatable"""
    robot: Annotated[str | None, INSTANCES] = None
    """robot that does it, such as UR5e (default: the one the task file names, else Panda)"""
    tasks: Annotated[Folder | None, CONTENT] = None
    """folder with task files of your own"""


@dataclass(frozen=True)
class CollectResult:
    """What came of collecting.

    Attributes:
        datasets: a folder a task.
        collected: what was done for each this time, in words.
    """

    datasets: tuple[Path, ...]
    collected: tuple[str, ...]


def collect(config: CollectConfig | None = None, /, **values: Any) -> CollectResult:
    """Record the scripted expert, disturbed now and then, into a LeRobotDataset a task.

    Args:
        config: settings as one object; `values` change some of them.
        values: settings by name, as `CollectConfig` has them.

    Raises:
        OselError: whatever is wrong with the settings or what is in the folder already; the message says what.
    """
    from osel_sim.core.holding import held
    from osel_sim.formats.levels import parse_axes, resolve
    from osel_sim.formats.run_config import robots_said
    from osel_sim.interface.instance import OURS
    from osel_sim.suites.registry import known_axes, select_task_files, select_tasks
    from osel_sim.training import collection

    config = CollectConfig.of(**values) if config is None else config.changed(**values)
    if config.episodes is None or config.out is None:
        raise SettingError("out" if config.out is None else "episodes", "is missing")
    chosen = select_tasks(config.task, config.tasks, config.robot)
    if any(task.suite.spec.name != OURS for task in chosen):
        return _collect_suites(config, chosen, parse_axes(config.axis, known_axes(chosen)))
    if config.camera:
        raise SettingError("camera", "is for other suites; ours are recorded with agentview and wrist")
    if config.every > 1:
        raise SettingError("every", "is for other suites; ours are recorded at each of their 20 control steps a second")
    tasks = select_task_files(config.task, config.tasks, config.robot)
    axes = parse_axes(config.axis)
    outs = [config.out] if len(tasks) == 1 else [config.out / task.name for task in tasks]
    for task, out in zip(tasks, outs, strict=True):
        if (out.exists() or collection.shards_folder(out).exists()) and not config.resume:
            raise UsageError(f"{out} is there already: give --resume to go on with it, or another --out")
        for level in config.level:
            resolve(level, axes, task.axes, task.name)  # refuses an unknown level or axis before anything is written
    done = []
    for task, out in zip(tasks, outs, strict=True):
        kind = {"task": task.name, "task_version": task.version, "levels": list(config.level), "axes": axes, "image_size": config.image_size}
        kind |= {"robot": None, **robots_said([task])}
        collection.check_settings(collection.shards_folder(out), kind)
        if collection.seeds(out) == config.episodes:
            done.append(f"{out} is complete")  # and stays as it is: training tells datasets apart by when their files were written, too
            continue
        with held(collection.shards_folder(out)):
            done.append(collection.collect(task, out, config.episodes, config.level, axes, config.image_size, config.workers))
    return CollectResult(tuple(outs), tuple(done))


def _collect_suites(config: CollectConfig, tasks: "list[Task]", axes: dict[str, int]) -> CollectResult:
    """The same of tasks of other suites."""
    from osel_sim.core.holding import held
    from osel_sim.training import collection
    from osel_sim.training.suite_demonstrations import SuiteShard, check_expert

    if config.episodes is None or config.out is None:
        raise SettingError("out" if config.out is None else "episodes", "is missing")
    outs = [config.out] if len(tasks) == 1 else [config.out / task.name.replace(":", "-").replace("/", "-") for task in tasks]
    cameras = [check_expert(task, config.camera) for task in tasks]
    for task, out in zip(tasks, outs, strict=True):
        if (out.exists() or collection.shards_folder(out).exists()) and not config.resume:
            raise UsageError(f"{out} is there already: give --resume to go on with it, or another --out")
        for level in config.level:
            task.instance(0, level, "train", axes)  # refuses an unknown level or axis before anything is written
    done = []
    for task, out, seen in zip(tasks, outs, cameras, strict=True):
        kind: dict[str, object] = {"task": task.name, "task_version": task.info.digest, "levels": list(config.level), "axes": axes}
        kind |= {"every": config.every}
        collection.check_settings(collection.shards_folder(out), kind | {"image_size": config.image_size, "cameras": list(seen)})
        if collection.seeds(out) == config.episodes:
            done.append(f"{out} is complete")
            continue
        with held(collection.shards_folder(out)):
            shard = SuiteShard(task, out, 0, 0, config.image_size, config.level, axes, seen, config.every)
            done.append(collection.collect_suite(task, out, config.episodes, shard, config.workers))
    return CollectResult(tuple(outs), tuple(done))
