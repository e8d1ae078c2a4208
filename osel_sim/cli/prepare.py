"""Compiles now what the first episode and the first replay would wait for: `python -m osel_sim.cli.prepare`, as `make environment` does."""

import sys

from osel_sim.cli.command import reported


def main() -> int:
    """Compile, or find it compiled."""
    from osel_sim.selection.ppo import compiled
    from osel_sim.sim import osc

    osc.prepare()
    compiled.prepare()
    return 0


if __name__ == "__main__":
    sys.exit(reported(main))
