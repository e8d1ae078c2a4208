"""Run a selector live: `python -m osel_sim.run --task pick_place`."""

import sys
from collections.abc import Mapping
from typing import Any

from osel_sim.api.run import RunConfig
from osel_sim.cli.command import INTERRUPTED, Command
from osel_sim.core.shown import shown

EXAMPLES = """examples:
  python -m osel_sim.run --list                                            # tasks and policies there are
  python -m osel_sim.run --task pick_place --episodes 60 --counterfactual  # PPO, compared with what could have been
  python -m osel_sim.run --task tag:short --level 0 2 --episodes 200       # several tasks and levels, mixed
  python -m osel_sim.run --task all --level 0 2 --selector auto --encoder osel_suite --warm-start assets/logs/suite   # it has seen a log's outcomes
  python -m osel_sim.run --task pick_place --selector epsilon_greedy --video 3 --out runs/first
  python -m osel_sim.run --task pick_place --selector epsilon_greedy --video 3 --out runs/first --resume
  python -m osel_sim.run --config runs/first/run.json --seed 1 --out runs/second   # another run with the same settings

Writes into --out: run.json (everything it depends on), episodes.jsonl (the journal), timing.jsonl (what things really took), counterfactual.jsonl,
contexts.npz, selector.safetensors, summary.json, curve.png, videos/, and report.html, the page about it, with figures/ and tables/ beside it.
Decision t is made on the instance of seed 1,000,000 * --seed + t."""


def _execute(config: RunConfig) -> int:
    from osel_sim.api.run import run
    from osel_sim.cli.console import console, run_table

    result = run(config)
    if result.journal:
        console().print(run_table(dict(result.summary)))
        for decision in [decision for decision in result.journal if decision.error][:3]:
            print(f"error in episode {decision.index}: {shown(decision.error or '')}", file=sys.stderr)
        print(f"written to {result.folder}" + ("; report.html shows it" if result.page else ""))
    return INTERRUPTED if result.interrupted else 0


def _list(given: Mapping[str, Any]) -> int:
    from osel_sim.cli.listing import print_listing

    print_listing(bool(given["json"]), given.get("tasks"), given.get("policies_dir"))
    return 0


main = Command(
    "run",
    RunConfig,
    _execute,
    EXAMPLES,
    {"list": (bool, "show tasks and policies, and leave", _list), "json": (bool, "with --list: as JSON", _list)},
)

if __name__ == "__main__":
    sys.exit(main())
