"""Put the shards of a recording together: `python -m osel_sim.merge runs/shards/* --out runs/log`."""

import sys

from osel_sim.api.merge import MergeConfig
from osel_sim.cli.command import Command

EXAMPLES = """examples:
  python -m osel_sim.record --task all --instances 300 --shard 1/2 --out shards/1      # on one machine
  python -m osel_sim.record --task all --instances 300 --shard 2/2 --out shards/2      # on another
  python -m osel_sim.merge shards/1 shards/2 --out logs/suite

Writes what the recording without --shard would have written, byte for byte: rollouts.parquet and contexts.npz, and run.json but for what tells the
machine and the folder. Refuses shards that are missing, there twice, not finished, or of another recording. Where --out holds an earlier merge,
it is replaced if the shards have all of its episodes, such as after record --resume --policies another on each of them."""


def _execute(config: MergeConfig) -> int:
    from osel_sim.api.merge import merge
    from osel_sim.cli.next_step import print_next

    result = merge(config)
    print(f"{len(result.rows)} episodes of {len(config.shards)} shards written to {result.folder}")
    print_next(
        ("replays it to selectors: is routing worth it?", "replay", [result.folder]),
        ("makes a page of it", "report", [result.folder, "--open"]),
    )
    return 0


main = Command("merge", MergeConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
