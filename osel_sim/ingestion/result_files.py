"""Result files of other evaluators: `eval_info.json` of LeRobot's `lerobot-eval`, and the aggregates of `vla-eval` (vla-evaluation-harness).

Taken from what their packages write: lerobot 0.6.1 (`scripts/lerobot_eval.py`), vla-eval 0.8.0 (`results/collector.py`, `results/export.py`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.records import Record, listed

LEROBOT, VLA_EVAL = "lerobot-eval", "vla-eval"
_KINDS = {list: "a list", dict: "an object", str: "text", int: "an integer"}


@dataclass(frozen=True)
class Episode(Record):
    """One episode of a result file. Its `number` counts the episodes of its task from 0 on.

    Attributes:
        task: name, with the evaluator's own number where a group has several.
        seed: of this episode; None where the file does not say.
    """

    task: str
    seed: int | None

    @property
    def where(self) -> str:
        """`file, task 'lift', episode 3`."""
        return f"{self.file}, task {quoted(self.task)}, episode {self.number}"


@dataclass(frozen=True)
class ResultFile:
    """What one policy came to.

    Attributes:
        evaluator: `LEROBOT` or `VLA_EVAL`.
        seed: of the whole run; None where the file does not say.
        episodes: at least one; their values are `success`, `error`, and what else the evaluator measured.
        doubts: what speaks against the file, in words.
    """

    policy: str
    file: Path
    evaluator: str
    seed: int | None
    episodes: tuple[Episode, ...]
    doubts: tuple[str, ...] = ()


def read_result_file(policy: str, file: Path) -> ResultFile:
    """Read the result file of a policy.

    Raises:
        DataError: it is of no such evaluator, a key is missing or of a wrong type, or an episode is there twice; names file and place.
    """
    data = read_json(file, "give the file that lerobot-eval or vla-eval wrote")
    if "per_task" in data or "per_episode" in data:
        found = ResultFile(policy, file, LEROBOT, None, tuple(_lerobot(file, data)))
    elif "tasks" in data:
        seed = _get(data, "seed", int, str(file)) if data.get("seed") is not None else None
        doubts = [f"{file}: says that the run was not finished"] if data.get("partial") else []
        found = ResultFile(policy, file, VLA_EVAL, seed, tuple(_vla_eval(file, data)), tuple(doubts))
    else:
        raise DataError(f"{file}: is of neither lerobot-eval (per_task) nor vla-eval (tasks); its keys: {listed(map(str, data)) or 'none'}")
    if not found.episodes:
        raise DataError(f"{file}: has no episodes")
    seen: set[tuple[str, int]] = set()
    for episode in found.episodes:
        if (episode.task, episode.number) in seen:
            raise DataError(f"{episode.where}: is there twice")
        seen.add((episode.task, episode.number))
    return found


def _lerobot(file: Path, data: Mapping[str, Any]) -> Iterator[Episode]:
    """Episodes of `eval_info.json`. Where it evaluated one environment alone, as earlier versions did, it has their seeds."""
    if "per_task" not in data:
        for number, (entry, where) in enumerate(_objects(data, "per_episode", str(file))):
            seed = _get(entry, "seed", int, where) if entry.get("seed") is not None else None
            yield _episode(file, number, "task", seed, {"success": _required(entry, "success", where), **_rewards(entry)})
        return
    for entry, where in _objects(data, "per_task", str(file)):
        task = f"{_get(entry, 'task_group', str, where)}/{_get(entry, 'task_id', int, where)}"
        metrics = _get(entry, "metrics", dict, where)
        successes = _get(metrics, "successes", list, f"{where}, metrics")
        rewards = {key: metrics[key] for key in ("sum_rewards", "max_rewards") if isinstance(metrics.get(key), list)}
        for key, values in rewards.items():
            if len(values) != len(successes):
                raise DataError(f"{where}, metrics: {key} has {len(values)} episodes, successes has {len(successes)}")
        for number, success in enumerate(successes):
            yield _episode(file, number, task, None, {"success": success, **{key[:-1]: values[number] for key, values in rewards.items()}})


def _vla_eval(file: Path, data: Mapping[str, Any]) -> Iterator[Episode]:
    """Episodes of an aggregate: what the benchmark measured, and why an episode could not be run."""
    for entry, where in _objects(data, "tasks", str(file)):
        task = _get(entry, "task", str, where)
        for episode, place in _objects(entry, "episodes", where):
            number = _get(episode, "episode_id", int, place)
            metrics = dict(_get(episode, "metrics", dict, place))
            error = episode.get("failure_reason") or None
            if error is None:
                _required(metrics, "success", f"{place}, metrics")
            measured: dict[str, Any] = {key: episode[key] for key in ("steps", "elapsed_sec") if key in episode}
            yield _episode(file, number, task, None, {**metrics, **measured, "error": error})


def _episode(file: Path, number: int, task: str, seed: int | None, values: Mapping[str, Any]) -> Episode:
    episode = Episode(file, number, None, {"error": None, **values}, task, seed)
    if episode.values.get("success") is None and episode.values["error"] is None:
        raise episode.error("success", "must be true or false, got nothing")
    return episode


def _rewards(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: entry[key] for key in ("sum_reward", "max_reward") if key in entry}


def _objects(data: Mapping[str, Any], key: str, where: str) -> Iterator[tuple[dict[str, Any], str]]:
    """The objects of a list, each with its place."""
    for index, entry in enumerate(_get(data, key, list, where)):
        place = f"{where}, {key}[{index}]"
        if not isinstance(entry, dict):
            raise DataError(f"{place}: must be an object, got {quoted(entry)}")
        yield entry, place


def _get(data: Mapping[str, Any], key: str, kind: type, where: str) -> Any:
    value = _required(data, key, where)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise DataError(f"{where}: {key} must be {_KINDS[kind]}, got {quoted(value)}")
    return value


def _required(data: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in data:
        raise DataError(f"{where}: there is no {key}; its keys: {listed(map(str, data)) or 'none'}")
    return data[key]
