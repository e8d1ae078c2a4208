"""`python -m osel_sim.suites`: suites of others, and their Python environments."""

import sys
from importlib import import_module

if __name__ == "__main__":
    # By name: what commands share lies above this package, and must not be imported by it.
    sys.exit(import_module("osel_sim.cli.suites_command").main())
