"""Write the page of a live run, a replay, a comparison or a rollout log: `python -m osel_sim.report runs/first`."""

import sys

from osel_sim.api.report import ReportConfig
from osel_sim.cli.command import Command

EXAMPLES = """examples:
  python -m osel_sim.report runs/first --open              # a live run (osel_sim.run)
  python -m osel_sim.report runs/first --watch             # a live run that goes on: the page grows with it
  python -m osel_sim.report replays/first                  # a replay (osel_sim.replay)
  python -m osel_sim.report runs/compared                  # a comparison (osel_sim.compare --out)
  python -m osel_sim.report assets/logs/pick_place --out /tmp/page --alpha-price 0.02     # a rollout log (osel_sim.record)

Writes report.html, one file that needs no network, with figures/*.png, figures/*.svg and tables/*.csv beside it."""


def _execute(config: ReportConfig) -> int:
    from osel_sim.api.report import report, watch
    from osel_sim.core.shown import shown

    if config.watch:
        watch(config, lambda url: print(f"{url} shows {config.folder} as it grows", flush=True))
        return 0
    result = report(config)
    page = result.page
    print(shown(result.verdict))
    print(f"written to {page}")
    if not config.open:
        print(f"next: open {page.resolve().as_uri()} in a browser, or give --open")
    return 0


main = Command("report", ReportConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
