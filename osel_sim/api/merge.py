"""Shards of a recording, put together."""

from pathlib import Path
from typing import Annotated, Any

from annotated_types import MinLen
from pydantic import BeforeValidator

from osel_sim.api.results import RecordResult
from osel_sim.api.settings import MAIN, Folder, Settings, settings
from osel_sim.core.errors import SettingError


def _one_or_many(value: Any) -> Any:
    return (value,) if isinstance(value, str | Path) else value


@settings
class MergeConfig(Settings):
    """Put the shards of a recording together: the rollout log that the recording of all would have written, byte for byte."""

    shards: Annotated[tuple[Folder, ...], MinLen(1), BeforeValidator(_one_or_many)]
    """folders that record --shard wrote, all of one recording, in any order"""
    out: Annotated[Path | None, MAIN] = None
    """where to write"""


def merge(*shards: "Path | str | MergeConfig", **values: Any) -> RecordResult:
    """Put the shards of a recording together.

    Args:
        shards: folders that `record(shard="3/40")` wrote, in any order; or all settings as one object, of which `values` change some.
        values: settings by name, as `MergeConfig` has them.

    Raises:
        OselError: a shard is missing, there twice, not finished or of another recording, or `out` holds something else; the message says which.
    """
    from osel_sim.core.holding import taken
    from osel_sim.episodes.merging import merge as merged
    from osel_sim.formats.rollout_log import ROLLOUTS
    from osel_sim.formats.run_config import RUN, check_writable

    if shards and isinstance(shards[0], MergeConfig):
        config = shards[0].changed(**values)
    else:
        config = MergeConfig.of(**({"shards": shards} if shards else {}), **values)
    if config.out is None:
        raise SettingError("out", "is missing: give the folder to write to")
    if config.out.resolve() in [folder.resolve() for folder in config.shards]:
        raise SettingError("out", f"{config.out} is one of the shards; give another folder")
    check_writable(config.out)
    with taken(config.out, (RUN, ROLLOUTS)):
        merged(config.shards, config.out)
    return RecordResult(config.out)
