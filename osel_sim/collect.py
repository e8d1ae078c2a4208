"""`python -m osel_sim.collect`: demonstrations of the scripted expert as a LeRobotDataset."""

import sys

from osel_sim.api.collect import CollectConfig
from osel_sim.cli.command import Command

EXAMPLES = """examples:
  python -m osel_sim.collect --task pick_place --episodes 1500 --out data/pick_place
  python -m osel_sim.collect --task all --episodes 200 --level 0 1 --out data/suite
  python -m osel_sim.collect --task metaworld:all --episodes 40 --every 4 --image-size 80 --out data/metaworld
  python -m osel_sim.collect --task pick_place --episodes 3000 --out data/pick_place --resume     (goes on after an interruption, or adds to it)
"""


def _execute(config: CollectConfig) -> int:
    from osel_sim.api.collect import collect
    from osel_sim.cli.next_step import print_next

    result = collect(config)
    for line in result.collected:
        print(line)
    out = config.out or result.datasets[0]
    policy = "metaworld_small" if config.task[0].startswith("metaworld:") else "local_small"
    print_next(("trains a policy on it", "train", ["--policy", policy, "--data", out, "--out", f"runs/train/{policy}"]))
    return 0


main = Command("collect", CollectConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
