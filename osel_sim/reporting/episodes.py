"""The episodes of a log or a live run as the page's script reads them: columns of numbers, instances once, videos small or linked."""

import base64
import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array, LoggedOutcomes
from osel_sim.formats.journal import Decision
from osel_sim.formats.rollout_log import Row
from osel_sim.interface.outcome import stood_in
from osel_sim.reporting.html_tables import digits_of, shortened
from osel_sim.reporting.page import Episodes
from osel_sim.selection.reward import RewardWeights

MOST_EPISODES = 2_500
"""So many fit into a page of two megabytes."""

MOST_LETTERS, ALL_LETTERS = 600, 300_000
"""Of an instruction, and of all together. A question of an examination can be a page long."""

MOST_VIDEO_BYTES = 6_000_000
"""Videos up to this, all together, are put into the page; the others are linked, and must lie beside it."""

Scenes = Callable[[LoggedOutcomes], Mapping[int, bytes]]
"""Draws how some instances of a log begin: instance -> JPEG."""

_NUMBERS = {"reward": 4, "steps": 0, "seconds": 3, "upload": 3, "inference": 3, "download": 3, "motion": 3, "price": 6}
_GRADED = {"subgoals": 3, "score": 6}
"""Only where they tell more than success."""

_FRAMES = 5
_FRAME_HEIGHT = 168


def no_scenes(log: LoggedOutcomes) -> Mapping[int, bytes]:
    """Draws none."""
    return {}


def list_episodes(
    log: LoggedOutcomes,
    weights: RewardWeights,
    chosen: NDArray[np.int64] | None = None,
    notes: Mapping[tuple[int, int, int], Mapping[str, str | None]] | None = None,
    scenes: Mapping[int, bytes] | None = None,
    videos: Mapping[tuple[int, int], Path] | None = None,
    picks: Mapping[str, Array] | None = None,
    beside: Path = Path(),
) -> Episodes:
    """The episodes of all instances, or of as many instances, spread evenly, as fit.

    Args:
        chosen: (N,) column of the policy a live run chose.
        notes: (instance, policy, repeat) -> `fallback` and `error`.
        scenes: instance -> JPEG of how it begins.
        videos: (instance, policy) -> .mp4.
        picks: selector -> share (N, P) in which it chose each policy for each instance, over the seeds of a replay.
        beside: folder of the page; videos that are not put into it are linked from there.
    """
    rewards = log.rewards(weights)
    ran = np.isfinite(log.success) | log.errors
    kept = _kept(ran, set((scenes or {}).keys()) | {row for row, _ in videos or {}})
    places = [(int(row), int(policy), int(repeat)) for row in kept for policy, repeat in np.argwhere(ran[row])]
    number = {row: index for index, row in enumerate(kept)}
    measures = {"reward": rewards, "seconds": log.seconds, **{name: getattr(log, name) for name in _NUMBERS if name not in ("reward", "seconds")}}
    found = notes or {}
    episodes: dict[str, list[Any]] = {
        "instance": [number[row] for row, _, _ in places],
        "policy": [policy for _, policy, _ in places],
        "repeat": [repeat for _, _, repeat in places],
        "success": [_number(log.success[place], 3) for place in places],
        **{name: [_number(values[place], _NUMBERS[name]) for place in places] for name, values in measures.items()},
        **{name: [_number(getattr(log, name)[place], _GRADED[name]) for place in places] for name in graded(log)},
        "fallback": [found.get(place, {}).get("fallback") for place in places],
        "error": [found.get(place, {}).get("error") or ("ended in error" if log.errors[place] else None) for place in places],
        "video": [f"{row}/{policy}" if (row, policy) in (videos or {}) else None for row, policy, _ in places],
    }
    if chosen is not None:
        episodes["chosen"] = [int(chosen[row] == policy) for row, policy, _ in places]
    episodes = {name: column for name, column in episodes.items() if any(value is not None for value in column)}
    data = {
        "policies": list(log.policies),
        "instances": [_instance(log, row, (scenes or {}).get(row), min(MOST_LETTERS, ALL_LETTERS // max(1, len(kept)))) for row in kept],
        "episodes": episodes,
        "videos": _videos(videos or {}, beside),
        "digits": {
            name: digits_of(value for value in episodes[name] if value is not None) for name in ("seconds", "price", "score") if name in episodes
        },
        "picks": {name: [[_number(share, 2) for share in shares[row]] for row in kept] for name, shares in (picks or {}).items()},
    }
    note = "All episodes." if len(kept) == len(log) else f"{len(kept):,} of {len(log):,} instances, spread evenly over them."
    return Episodes(note, data)


def graded(log: LoggedOutcomes) -> list[str]:
    """Measures, of subgoals and score, that tell more of some episode than its success."""
    return [name for name in _GRADED if (np.isfinite(getattr(log, name)) & (getattr(log, name) != log.success)).any()]


def _kept(ran: NDArray[np.bool_], pictured: set[int]) -> list[int]:
    total, mean = len(ran), max(1.0, float(ran.sum() / max(1, len(ran))))
    most = max(1, int(MOST_EPISODES / mean))
    if total <= most:
        return list(range(total))
    return sorted({*np.linspace(0, total - 1, most).round().astype(int).tolist(), *pictured})


def _instance(log: LoggedOutcomes, row: int, scene: bytes | None, letters: int) -> dict[str, Any]:
    instance = log.instances[row]
    known = log.success[row][np.isfinite(log.success[row])]
    about: dict[str, Any] = {"number": row, "key": instance.key, "task": instance.task, "differ": bool(known.size and known.min() != known.max())}
    for name in ("instruction", "target", "container", "phrasing", "robot"):
        if value := getattr(instance, name):
            about[name] = shortened(value, letters)
    # What osel_sim.report can draw with --scenes: an instance of a task file, which its seed makes again.
    if instance.seed is not None and instance.level is not None and instance.split is not None:
        about["drawable"] = True
    if scene is not None:
        about["scene"] = base64.b64encode(scene).decode()
    return about


def _videos(videos: Mapping[tuple[int, int], Path], beside: Path) -> dict[str, dict[str, Any]]:
    total, entries = 0, dict[str, dict[str, Any]]()
    for (row, policy), file in sorted(videos.items()):
        link = Path(os.path.relpath(file, beside)).as_posix()
        entry: dict[str, Any] = {"file": quote(link), "frames": [base64.b64encode(frame).decode() for frame in frames(file)]}
        if total + file.stat().st_size <= MOST_VIDEO_BYTES:
            content = file.read_bytes()
            total += len(content)
            entry["data"] = base64.b64encode(content).decode()
        entries[f"{row}/{policy}"] = entry
    return entries


def frames(file: Path, count: int = _FRAMES) -> list[bytes]:
    """A few frames of a video, spread evenly, as small JPEGs; none where it cannot be read."""
    return _frames(file, count, file.stat().st_mtime_ns if file.exists() else 0)


@functools.lru_cache(1000)
def _frames(file: Path, count: int, changed: int) -> list[bytes]:
    """The frames; a page that grows asks for the same films again and again."""
    import imageio.v3

    try:
        pictures = imageio.v3.imread(file.absolute(), plugin="FFMPEG")
    except (OSError, ValueError, RuntimeError):
        return []
    return [jpeg(pictures[place]) for place in np.linspace(0, len(pictures) - 1, count).round().astype(int)]


def jpeg(picture: NDArray[np.uint8], height: int = _FRAME_HEIGHT) -> bytes:
    """A picture (H, W, 3) as a JPEG of that height."""
    import cv2

    width = round(picture.shape[1] * height / picture.shape[0])
    small = cv2.resize(np.ascontiguousarray(picture[:, :, ::-1]), (width, height), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes())


def notes_of(rows: Sequence[Any], log: LoggedOutcomes) -> dict[tuple[int, int, int], dict[str, str | None]]:
    """Fallbacks and errors of a log's rows, by (instance, policy, repeat) of its arrays."""
    at_instance, at_policy = ({name: index for index, name in enumerate(names)} for names in (log.keys, log.policies))
    at_repeat = {number: index for index, number in enumerate(sorted({row.repeat for row in rows}))}
    return {
        (at_instance[row.instance], at_policy[row.policy], at_repeat[row.repeat]): note_of(row)
        for row in rows
        if (row.fallback or row.error) and row.instance in at_instance and row.policy in at_policy
    }


def note_of(episode: Decision | Row) -> dict[str, str | None]:
    """Why an episode fell back, how far the fallback drove, and whose its success is; and why it ended in an error."""
    if episode.fallback is None:
        return {"fallback": None, "error": episode.error}
    steps = "" if episode.fallback_steps is None else f"; it drove {episode.fallback_steps} of {episode.steps} steps"
    credit = f"; it solved the task alone, which is no success of {episode.policy}" if stood_in(episode) and episode.success else ""
    return {"fallback": episode.fallback + steps + credit, "error": episode.error}


def _number(value: float, digits: int) -> float | int | None:
    if not math.isfinite(value):
        return None
    return round(value) if digits == 0 else round(float(value), digits)
