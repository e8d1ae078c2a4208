"""Did a policy get worse? `python -m osel_sim.compare runs/before runs/after`."""

import sys

from osel_sim.api.compare import CompareConfig
from osel_sim.cli.command import Command

EXAMPLES = """examples:
  python -m osel_sim.compare assets/logs/suite --policies local_small remote_large     # two policies of one log
  python -m osel_sim.compare runs/before runs/after                                    # two logs of one policy each
  python -m osel_sim.compare runs/before runs/after --policies mine --margin 0.02      # the same policy in two logs
  python -m osel_sim.compare assets/logs/suite                                         # all pairs of all policies
  python -m osel_sim.compare assets/logs/pick_place --plan --detect 0.05               # how many instances does it take?
  python -m osel_sim.compare runs/before runs/after --out runs/compared --markdown runs/compared.md --junit runs/compared.xml

Instances are paired by their key; one's value is its mean over repeats. What has no counterpart is left out and counted. The first log or policy is
what the others are compared with: better, worse, no worse than it by --margin, or not enough data, and how many more instances would tell.

Exit codes: 0 no worse, 1 worse, 3 not enough data, 2 wrong input. docs/compare.md says how it is decided."""


def _execute(config: CompareConfig) -> int:
    from osel_sim.api.compare import compare
    from osel_sim.cli.compare_tables import print_compare, print_plan
    from osel_sim.cli.console import console
    from osel_sim.cli.next_step import print_next

    found = compare(config)
    if config.plan:
        print_plan(console(), found.result)
    else:
        print_compare(console(), found.result)
    for file in (found.file, found.page, config.markdown, config.junit):
        if file is not None:
            print(f"written to {file}")
    if config.plan or found.decision != "not enough data":
        print_next(("makes a page of the log", "report", [config.logs[-1], "--open"]))
    else:
        policies = ["--policies", *config.policies] if config.policies else []
        print_next(("says how many instances it takes", "compare", [*config.logs, *policies, "--plan", "--detect", f"{config.detect:g}"]))
    return found.exit_code


main = Command("compare", CompareConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
