"""`python -m osel_sim.suites`: suites of others, and their Python environments."""

import sys

from osel_sim.suites import main

if __name__ == "__main__":
    sys.exit(main())
