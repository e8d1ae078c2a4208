"""Result files of several policies as one long table: the episodes that all of them ran."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from osel_sim.core.errors import DataError, SettingError
from osel_sim.core.files import file_digest
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.records import Record, listed
from osel_sim.ingestion.result_files import LEROBOT, Episode, ResultFile, read_result_file

COLUMNS = frozenset(("policy", "task", "instruction", "episode", "success", "error"))
"""Columns that every row of the table has."""


@dataclass(frozen=True)
class Paired:
    """Episodes that all policies ran.

    Attributes:
        records: a row for each episode and policy, with `COLUMNS` and what all evaluators measured.
        files: policy -> its file, in the order in which they were given.
        measured: columns that every row without an error has beside `COLUMNS`, such as `steps`.
        note: which pairing was found, in words.
        doubts: what speaks against it, each in words.
    """

    records: list[Record]
    files: dict[str, Path]
    measured: frozenset[str]
    note: str
    doubts: tuple[str, ...]


def read_results(given: Sequence[str]) -> Paired:
    """Read result files and pair their episodes by task and seed, or by task and number where files do not say the seeds.

    Args:
        given: POLICY=FILE, two or more.

    Raises:
        SettingError: there are fewer, or one is of another form.
        DataError: a file is wrong, two are the same, their seeds differ, or no episode is in all of them.
    """
    files = [read_result_file(policy, file) for policy, file in _named(given).items()]
    digests: dict[str, ResultFile] = {}
    for result in files:
        other = digests.setdefault(file_digest(result.file), result)
        if other is not result:
            raise DataError(f"{result.file}: is the same file as {other.file}; one is needed for each policy")
    files = _short_names(files)
    doubts = [doubt for result in files for doubt in result.doubts]
    key, how = _identity(files, doubts)
    tables = [_by_key(result, key) for result in files]
    common = [identity for identity in tables[0] if all(identity in table for table in tables)]
    _say_what_is_left_out(files, tables, doubts)
    if not common:
        raise DataError(f"no episode is in all of the files, {how}: " + "; ".join(f"{result.file} has {_tasks(result)}" for result in files))
    ran = [values for table in tables for identity in common if (values := table[identity].values)["error"] is None]
    measured = frozenset.intersection(*map(frozenset, ran)) - COLUMNS if ran else frozenset()
    records: list[Record] = []
    for identity in common:
        for result, table in zip(files, tables, strict=True):
            episode = table[identity]
            own = {"policy": result.policy, "task": episode.task, "instruction": _instruction(episode.task), "episode": f"{identity[1]:06d}"}
            records.append(replace(episode, values={**dict.fromkeys(measured), **episode.values, **own}))
    tasks = len({task for task, _ in common})
    note = f"paired {how}: {len(common)} episodes of {tasks} task{'s' * (tasks > 1)} that all {len(files)} policies ran"
    return Paired(records, {result.policy: result.file for result in files}, measured, note, tuple(doubts))


def _named(given: Sequence[str]) -> dict[str, Path]:
    """Policy -> file."""
    files: dict[str, Path] = {}
    for item in given:
        policy, equals, file = item.partition("=")
        if not (policy and equals and file):
            raise SettingError("results", f"must be POLICY=FILE, got {item!r}")
        if policy in files:
            raise SettingError("results", f"policy {policy!r} is named twice")
        files[policy] = Path(file)
    if len(files) < 2:
        raise SettingError("results", f"needs the files of two policies or more, got {len(files)}")
    return files


def _instruction(task: str) -> str:
    """What stands for the instruction, which the files do not have. Of a single word text encoders can make nothing."""
    words = task.replace("_", " ")
    return words if " " in words else f"the task {words}"


def _short_names(files: list[ResultFile]) -> list[ResultFile]:
    """The same, with LeRobot's tasks called by their group alone where every group has but the task 0."""
    tasks = {episode.task for result in files if result.evaluator == LEROBOT for episode in result.episodes}
    if not all(task.endswith("/0") for task in tasks):
        return files
    return [
        replace(result, episodes=tuple(replace(episode, task=episode.task.removesuffix("/0")) for episode in result.episodes))
        if result.evaluator == LEROBOT
        else result
        for result in files
    ]


def _identity(files: Sequence[ResultFile], doubts: list[str]) -> "tuple[Callable[[Episode], tuple[str, int]], str]":
    """What tells that two policies' episodes are the same instance, and that in words."""
    episodes = [episode for result in files for episode in result.episodes]
    if all(episode.seed is not None for episode in episodes):
        return lambda episode: (episode.task, episode.seed or 0), "by task and seed"
    seeds: Mapping[int | None, ResultFile] = {result.seed: result for result in reversed(files)}
    known = [seed for seed in seeds if seed is not None]
    if len(known) > 1:
        told = ", ".join(f"{seeds[seed].file} with {seed}" for seed in known)
        raise DataError(f"the files were made with different seeds ({told}): their episodes are not the same instances")
    silent = [result.file for result in files if result.seed is None]
    if not silent:
        return lambda episode: (episode.task, episode.number), f"by task, number of the episode and the run's seed, {known[0]}"
    doubts.append(
        f"no seeds are in {listed(map(str, silent))}: the n-th episodes of a task are taken for the same instance, which they are if all were run "
        "with the same seed (lerobot-eval --seed, 1000 unless told)"
    )
    return lambda episode: (episode.task, episode.number), "by task and number of the episode"


def _by_key(result: ResultFile, key: "Callable[[Episode], tuple[str, int]]") -> dict[tuple[str, int], Episode]:
    table: dict[tuple[str, int], Episode] = {}
    for episode in result.episodes:
        other = table.setdefault(key(episode), episode)
        if other is not episode:
            raise DataError(f"{episode.where}: has the seed {episode.seed} of episode {other.number}")
    return table


def _say_what_is_left_out(files: Sequence[ResultFile], tables: Sequence[Mapping[tuple[str, int], Episode]], doubts: list[str]) -> None:
    in_all = set.intersection(*({task for task, _ in table} for table in tables))
    for result, table in zip(files, tables, strict=True):
        own = list(dict.fromkeys(task for task, _ in table if task not in in_all))
        lone: list[Hashable] = [key for key in table if key[0] in in_all and not all(key in other for other in tables)]
        if own:
            doubts.append(f"{result.file}: left out, since not all files have them: task{'s' * (len(own) > 1)} {listed(own)}")
        if lone:
            doubts.append(f"{result.file}: left out, since not all files have them: {len(lone)} of its {len(table)} episodes")


def _tasks(result: ResultFile) -> str:
    """Its tasks with how many episodes, for a message."""
    counts: dict[str, int] = {}
    for episode in result.episodes:
        counts[episode.task] = counts.get(episode.task, 0) + 1
    return listed(f"{quoted(task)} ({count})" for task, count in counts.items())
