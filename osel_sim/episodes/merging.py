"""Puts the shards of a recording together: to the bytes that the recording of all would have written."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from osel_sim.context.cache import FILE as CONTEXTS
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError, SettingError, UsageError
from osel_sim.core.files import is_partial, write_json
from osel_sim.core.holding import LOCK, is_held
from osel_sim.episodes.shard import Shard
from osel_sim.episodes.workers import repeats_of, worker_died
from osel_sim.formats.rollout_log import DECLARED, ROLLOUTS, Row, read_rollouts, write_rollouts
from osel_sim.formats.run_config import RUN, differences, read_run
from osel_sim.formats.shards import SHARDS

logger = logging.getLogger(__name__)

PARTS = "shards"
"""Folder, in that of a recording on a cluster, where its parts lie."""
_NAMED = 10
"""At most so many missing shards are named."""


@dataclass(frozen=True)
class Part:
    """A shard that is complete.

    Attributes:
        run: its `run.json`.
        rows: of its log.
        metadata: of its log.
    """

    folder: Path
    shard: Shard
    run: Mapping[str, Any]
    rows: Sequence[Row]
    metadata: Mapping[str, Any]

    @property
    def configuration(self) -> dict[str, Any]:
        """That of the whole."""
        return {key: value for key, value in self.run["configuration"].items() if key != "shard"}

    @property
    def lost(self) -> int:
        """Episodes without an outcome because their worker died."""
        return sum(map(worker_died, self.rows))


def read_part(folder: Path) -> Part:
    """Read a shard.

    Raises:
        DataError: there is none, it is damaged, or it is not finished; says which command finishes it.
    """
    if not (folder / RUN).is_file():
        raise DataError(f"{folder} is no shard of a recording: it holds no {RUN}; record --shard NUMBER/ALL --out {folder} makes one")
    run = read_run(folder)
    text = run["configuration"].get("shard")
    if not isinstance(text, str):
        raise DataError(f"{folder} is no shard: its {RUN} says that it holds all instances of its recording")
    try:
        shard = Shard.parse(text)
    except SettingError as error:
        raise DataError(f"{folder / RUN}: configuration.shard {error.problem}") from None
    unfinished = f"{folder}, shard {shard}, is not finished: record --resume --out {folder} goes on with it"
    if is_held(folder):
        raise DataError(f"{folder}, shard {shard}, is being recorded: wait until that has ended")
    if (folder / SHARDS).exists() or not (folder / ROLLOUTS).exists():
        raise DataError(unfinished)
    rows, metadata = read_rollouts(folder)
    part = Part(folder, shard, run, rows, metadata)
    told = {key: value for key, value in metadata.items() if key not in ("schema_version", DECLARED)}
    if any(differences(told, run["configuration"])) or not _has_all(part):
        raise DataError(unfinished)
    return part


def merge(folders: Sequence[Path], out: Path) -> None:
    """Put shards together in a folder that this process holds.

    Raises:
        DataError: a shard is not finished, missing, there twice, or of another recording; says which.
        UsageError: the folder holds what the shards do not.
    """
    parts = _in_order([read_part(folder) for folder in folders])
    for part in parts[1:]:
        _check_together(parts[0], part)
    rows = [row for part in parts for row in part.rows]
    _check_target(out, rows, ContextCache(parts[0].folder).encoders())
    contexts = _contexts(parts, out)
    if lost := [part for part in parts if part.lost]:
        logger.warning(
            "%d episodes were lost, those of shard %s the first; record --resume --out %s records them again, and then merge again",
            *(sum(part.lost for part in lost), lost[0].shard, lost[0].folder),
        )
    first = parts[0]
    settings = {"settings": first.run["settings"] | {"out": str(out), "shard": None, "resume": False}} if "settings" in first.run else {}
    # In the order in which a killed process leaves what looks unfinished, not what looks whole.
    head = {"schema_version": first.run["schema_version"], **settings}
    write_json(out / RUN, head | {"configuration": first.configuration, "environment": first.run["environment"]})
    contexts.save()
    write_rollouts(out, rows, {key: value for key, value in first.metadata.items() if key not in ("shard", "schema_version")})


def _has_all(part: Part) -> bool:
    """Whether a shard has exactly the episodes that its configuration asks for, in their order."""
    told = part.run["configuration"]
    try:
        seeds = range(told["start_seed"], told["start_seed"] + told["instances"])
        instances = part.shard.part([(task, seed) for task in told["tasks"] for seed in seeds])
        wanted = [
            (task, seed, policy, repeat)
            for task, seed in instances
            for policy in told["policies"]
            for repeat in range(repeats_of(seed, len(told["levels"]), told["repeats"], told["repeat_every"]))
        ]
        cache = ContextCache(part.folder)
        keys = [key for key, _ in groupby(row.instance for row in part.rows)]
        has_contexts = all(cache.get(told["encoder"], key) is not None for key in keys)
    except (KeyError, TypeError, ValueError, ZeroDivisionError, SettingError) as error:
        raise DataError(f"{part.folder / RUN}: configuration does not have the promised form ({error})") from None
    return has_contexts and [(row.task, row.seed, row.policy, row.repeat) for row in part.rows] == wanted


def _in_order(parts: Sequence[Part]) -> list[Part]:
    """The shards from the first to the last, each once."""
    by_number: dict[int, Part] = {}
    for part in parts:
        if part.shard.of != parts[0].shard.of:
            raise DataError(f"{part.folder} is shard {part.shard}, but {parts[0].folder} is {parts[0].shard}: they are not of one division")
        if part.shard.number in by_number:
            raise DataError(f"shard {part.shard} is there twice: {by_number[part.shard.number].folder} and {part.folder}")
        by_number[part.shard.number] = part
    if missing := [str(Shard(number, parts[0].shard.of)) for number in range(1, parts[0].shard.of + 1) if number not in by_number]:
        named = ", ".join(missing[:_NAMED]) + (f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else "")
        raise DataError(f"{'shards' if len(missing) > 1 else 'shard'} {named} of the recording {'are' if len(missing) > 1 else 'is'} missing")
    return [by_number[number] for number in sorted(by_number)]


def _check_together(first: Part, part: Part) -> None:
    """Refuse a shard of another recording, or one made with another GL backend, which renders other pictures."""
    for key, was, now in differences(first.configuration, part.configuration):
        raise DataError(f"{part.folder} is not of the recording of {first.folder}: {key} is {now!r} in it, {was!r} there")
    if first.metadata.get(DECLARED) != part.metadata.get(DECLARED):
        raise DataError(f"{part.folder} is not of the recording of {first.folder}: its policies declare other skills")
    for key, was, now in differences(first.run["environment"], part.run["environment"]):
        if key == "gl":
            raise DataError(f"{part.folder} was recorded with the GL backend {now!r}, {first.folder} with {was!r}: their pictures differ")
        logger.warning("%s is %r in %s, and %r in %s", key, now, part.folder, was, first.folder)


def _contexts(parts: Sequence[Part], out: Path) -> ContextCache:
    """The contexts of all, not written yet."""
    merged, of_first = ContextCache(out, autosave=0, mend=True), ContextCache(parts[0].folder).encoders()
    for part in parts:
        cache = ContextCache(part.folder)
        if cache.encoders() != of_first:
            raise DataError(f"{part.folder} has contexts of {', '.join(cache.encoders())}, {parts[0].folder} of {', '.join(of_first)}")
        for encoder in of_first:
            for instance, context in cache.items(encoder):
                merged.put(encoder, instance, context)
    return merged


def _check_target(out: Path, rows: Sequence[Row], encoders: Sequence[str]) -> None:
    """Refuse a folder with anything that would be lost: a log that has all of its episodes in the shards may be replaced by them."""
    ours = {RUN, ROLLOUTS, CONTEXTS, LOCK, PARTS}
    others = [item.name for item in _items(out) if item.name not in ours and not is_partial(item)]
    if others and not (out / RUN).exists():
        raise UsageError(f"--out {out} is not empty and holds {others[0]}; give a new folder")
    if (out / SHARDS).exists():
        raise UsageError(f"--out {out} holds a recording that is not finished; give another folder")
    there, metadata = read_rollouts(out) if (out / ROLLOUTS).exists() else ([], {})
    if (out / RUN).exists() and "shard" in read_run(out)["configuration"]:
        raise UsageError(f"--out {out} is a shard; give another folder")
    if more := set(there) - set(rows):
        row = next(row for row in there if row in more)
        raise UsageError(
            f"--out {out} holds {len(more)} episodes that the shards do not, such as {row.instance}, policy {row.policy}; give another folder"
        )
    if metadata and metadata.get("encoder") not in encoders:
        raise UsageError(f"--out {out} is read with encoder {metadata.get('encoder')}, of which the shards have no contexts; give another folder")


def _items(folder: Path) -> Iterator[Path]:
    return folder.iterdir() if folder.is_dir() else iter(())
