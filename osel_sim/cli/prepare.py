"""Makes now what the first episode, replay and page would wait for: `python -m osel_sim.cli.prepare`, as `make environment` does."""

import sys

from osel_sim.cli.command import reported


def main() -> int:
    """Compile and bundle, or find it in the caches."""
    from osel_sim.reporting.vega import vega_script
    from osel_sim.selection.ppo import compiled
    from osel_sim.sim import osc

    osc.prepare()
    compiled.prepare()
    vega_script()
    return 0


if __name__ == "__main__":
    sys.exit(reported(main))
