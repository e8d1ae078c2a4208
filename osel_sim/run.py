"""Run a selector live: `python -m osel_sim.run --task pick_place`."""

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from osel_sim.api.run_settings import RunConfig
from osel_sim.cli.command import INTERRUPTED, Command
from osel_sim.core.errors import BudgetError
from osel_sim.core.shown import shown

if TYPE_CHECKING:
    from osel_sim.api.results import RunResult

EXAMPLES = """examples:
  python -m osel_sim.run --list                                            # tasks and policies there are
  python -m osel_sim.run --task pick_place --episodes 60 --counterfactual  # PPO, compared with what could have been
  python -m osel_sim.run --task tag:short --level 0 2 --episodes 200       # several tasks and levels, mixed
  python -m osel_sim.run --task all --level 0 2 --selector auto --encoder osel_suite --warm-start assets/logs/suite   # it has seen a log's outcomes
  python -m osel_sim.run --task pick_place open_drawer --selector auto --encoder auto --episodes 200   # the encoder that predicts rewards
  python -m osel_sim.run --task pick_place --selector epsilon_greedy --video 3 --out runs/first
  python -m osel_sim.run --task pick_place --selector auto --episodes 200 --budget-cents 500   # never spends more, and says what a dollar would buy
  python -m osel_sim.run --task open_drawer --policies local_small remote_specialist --monitor value   # and who drives on, within the episode
  python -m osel_sim.run --out runs/first --resume                         # goes on with it, if it was cut off
  python -m osel_sim.run --out runs/first --resume --episodes 200          # and on, to more decisions
  python -m osel_sim.run --out runs/first --resume --episodes 300 --add-policies remote_large --retire local_small   # policies join and leave
  python -m osel_sim.run --config runs/first/run.json --seed 1 --out runs/second   # another run with the same settings

Writes into --out: run.json (everything it depends on), episodes.jsonl (the journal), timing.jsonl (what things really took), counterfactual.jsonl,
points.jsonl (what a monitor saw), events.jsonl (policies that joined or left), contexts.npz, selector.safetensors, summary.json, curve.png,
videos/, and report.html, the page about it, with figures/ and tables/ beside it; budget.json with --budget-cents, encoders.jsonl with --encoder auto
(which encoder it went on with, since when and why), and warnings.jsonl where something changed that nobody announced.
Decision t is made on the instance of seed 1,000,000 * --seed + t."""


def _execute(config: RunConfig) -> int:
    from osel_sim.api.run import run
    from osel_sim.cli.causes import print_causes
    from osel_sim.cli.console import console, plain, run_table
    from osel_sim.cli.monitor_words import monitor_words

    result = run(config)
    if result.journal:
        console().print(run_table(dict(result.summary)))
        if config.monitor and "monitor" in result.summary:
            console().print(plain(monitor_words(config.monitor, result.summary)), soft_wrap=True)
        if "encoder" in result.summary:
            console().print(plain(result.summary["encoder"]["text"]), soft_wrap=True)
        if result.verdict:
            console().print(plain(result.verdict, "bold"), soft_wrap=True)
        if result.spent:
            console().print(plain(f"{result.spent.sentence}."), soft_wrap=True)
        print_causes((decision.policy, f"decision {decision.index}", decision.error) for decision in result.journal if decision.error)
        print(f"written to {result.folder}" + (f"; {result.page} shows it" if result.page else ""))
    _print_next(config, result)
    if result.spent and result.spent.ended:
        print(f"ended after {len(result.journal)} of {config.episodes} decisions: {shown(result.spent.ended)}", file=sys.stderr)
        return BudgetError.exit_code
    return INTERRUPTED if result.interrupted else 0


def _print_next(config: RunConfig, result: "RunResult") -> None:
    from osel_sim.cli.next_step import Step, print_next
    from osel_sim.formats.run_config import RUN
    from osel_sim.selection.registry import RECOMMENDED, is_recommended

    folder, steps = result.folder, list[Step]()
    if result.interrupted:
        steps.append(("goes on with it", "run", ["--out", folder, "--resume"]))
    elif result.journal:
        steps.append(("shows its page", "report", [folder, "--open"]))
        steps.append(("estimates what other choices would have earned", "replay", [folder]))
    if result.journal and not is_recommended(config.selector):
        other = folder.with_name(f"{folder.name}-{RECOMMENDED}")
        steps.append(
            ("the same instances with the selector we recommend", "run", ["--config", folder / RUN, "--selector", RECOMMENDED, "--out", other])
        )
    print_next(*steps)


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
