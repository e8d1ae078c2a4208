"""Record outcomes of every policy on the same instances: `python -m osel_sim.record --task pick_place --instances 200 --out logs/mine`."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.api.record_settings import RecordConfig
from osel_sim.cli.command import Command
from osel_sim.core.errors import DataError, SettingError

if TYPE_CHECKING:
    from osel_sim.api.results import RecordResult

EXAMPLES = """examples:
  python -m osel_sim.record --task pick_place --instances 200 --out logs/mine
  python -m osel_sim.record --resume --out logs/mine                                       # go on after an interruption
  python -m osel_sim.record --resume --out logs/mine --policies another                    # record one more policy on the same instances
  python -m osel_sim.record --resume --out logs/mine --repeats 3 --repeat-every 5          # for a surer expected oracle
  python -m osel_sim.record --resume --out logs/mine --encoder ViT-L-14:openai             # read the log with another encoder from now on
  python -m osel_sim.record --task pick_place --instances 50 --repeats 4 --workers 8 --policies local_small --out logs/small
  python -m osel_sim.record --task all --instances 300 --level 0 1 2 3 --repeats 3 --repeat-every 10 --out logs/suite
  python -m osel_sim.record --task pick_place --policies old new --instances 500 --until-decided --out logs/which    # stop as soon as it is told
  python -m osel_sim.record --policies new --baseline logs/old --until-decided --out logs/new     # the same, against a log, on its instances
  python -m osel_sim.record --task lift --instances 20 --policies local_small remote_large --moments 6 --out logs/moments     # when to hand over
  python -m osel_sim.record --task all --instances 300 --shard 3/40 --out shards/3         # a part, for osel_sim.merge
  python -m osel_sim.record --task all --instances 300 --cluster slurm --shards 40 --cluster-option slurm_partition=gpu --out logs/suite
  python -m osel_sim.record --summary logs/mine                                            # print the tables of a log again

Writes into --out: run.json, rollouts.parquet (a row an episode) and contexts.npz. Every policy starts from the same state of the same instance. The
files do not depend on the number of workers, nor on interruptions. --resume takes all settings from run.json; policies, more
repeats and an encoder given with it are added to what is there, and the log is read with the encoder given last.
--moments K cuts every episode before every K-th call and lets every other policy drive on from there: moments.parquet, which replay reads.
--until-decided looks after every 10 instances or more, --instances being the most; docs/compare.md says why such looks are honest.
--cluster sends the shards to Slurm or Ray, those that fail again (--retries), and merges them; --resume sends what is missing (docs/cluster.md)."""


def _execute(config: RecordConfig) -> int:
    from osel_sim.api.record import record

    result = record(config)
    if result.recorded:
        hourly = 3600 * result.recorded / result.seconds
        how = f"in {config.shards} shards" if config.cluster and config.shards else f"with {config.workers} workers"
        print(f"{result.recorded} episodes in {result.seconds:.0f} s {how}: {hourly:.0f} episodes an hour, starting up included")
    _print_summary(result.folder)
    print(f"written to {result.folder}")
    if result.planned:
        _print_decision(result)
    _print_next(result.folder)
    return 0


def _print_decision(result: "RecordResult") -> None:
    from osel_sim.core.shown import shown

    if result.verdict:
        print(shown(result.verdict))
    if result.spared:
        saved = f"{result.spared} of {result.spared + len(result.rows)} planned episodes were not needed"
        print(f"stopped after {result.instances} of {result.planned} instances: {saved}")
    else:
        print(f"all {result.planned} instances were needed")


def _print_next(folder: Path) -> None:
    from osel_sim.api.replay_moments import has_moments
    from osel_sim.cli.next_step import print_next
    from osel_sim.formats.run_config import read_run

    if read_run(folder)["configuration"].get("shard"):
        print_next(("puts it together with the others", "merge", [folder, "OTHER_SHARDS", "--out", "LOG"]))
        return
    if has_moments(folder):
        print_next(("compares monitors on it: is it worth handing over?", "replay", [folder]), ("makes a page of it", "report", [folder, "--open"]))
        return
    print_next(
        ("replays it to selectors: is routing worth it?", "replay", [folder]),
        ("makes a page of it", "report", [folder, "--open"]),
        ("records one more policy on the same instances", "record", ["--resume", "--out", folder, "--policies", "NAME"]),
    )


def _print_summary(folder: Path) -> None:
    from osel_sim.api.reward import DEFAULT_PRESET
    from osel_sim.cli.causes import print_causes
    from osel_sim.cli.console import console
    from osel_sim.cli.rollout_tables import print_rollouts
    from osel_sim.formats.rollout_log import read_rollouts
    from osel_sim.selection.reward import preset

    rows, _ = read_rollouts(folder)
    if not rows:
        raise DataError(f"{folder}: the rollout log has no rows")
    weights = preset(DEFAULT_PRESET)
    print_rollouts(console(), rows, weights)
    print_causes((row.policy, row.instance, row.error) for row in rows if row.error)
    print(f"reward: success - {weights.alpha_time} {weights.time_text} - {weights.alpha_price} cents; episodes with errors count nowhere else")


def _summary(given: Mapping[str, Any]) -> int:
    if not given["summary"].is_dir():
        raise SettingError("summary", f"there is no folder {given['summary']}")
    _print_summary(given["summary"])
    _print_next(given["summary"])
    return 0


main = Command("record", RecordConfig, _execute, EXAMPLES, {"summary": (Path, "print the tables of the log in this folder, and leave", _summary)})

if __name__ == "__main__":
    sys.exit(main())
