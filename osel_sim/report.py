"""Write the page of a live run, a replay or a rollout log: `python -m osel_sim.report runs/first`."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim import cli
from osel_sim.cli.reward_flags import FLAGS, add_reward_flags, weights_of
from osel_sim.core.errors import DataError, UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.reporting.page import Page

EXAMPLES = """examples:
  python -m osel_sim.report runs/first --open              # a live run (osel_sim.run)
  python -m osel_sim.report replays/first                  # a replay (osel_sim.replay)
  python -m osel_sim.report assets/logs/pick_place --out /tmp/page --alpha-price 0.02     # a rollout log (osel_sim.record)

Writes report.html, one file that needs no network, with figures/*.png, figures/*.svg and tables/*.csv beside it."""


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = parser().parse_args(arguments)
    from osel_sim.reporting.page import write_page

    file = write_page(_page(options), options.out or options.folder)
    print(f"written to {file}")
    if options.open:
        import webbrowser

        webbrowser.open(file.resolve().as_uri())
    return 0


def parser() -> cli.Parser:
    """Flags of the command."""
    result = cli.Parser("report", "Write one page about a live run, a replay or a rollout log: verdict, curves, tables, maps, episodes.", EXAMPLES)
    add = result.add_argument
    add("folder", type=cli.folder, metavar="RUN_OR_REPLAY", help="folder of a live run, a replay or a rollout log")
    add("--out", type=Path, metavar="DIR", help="where to write (default: into the folder itself)")
    add("--open", action="store_true", help="show it in the browser")
    add("--log", type=cli.folder, metavar="DIR", help="of a replay: its rollout log, where that is no longer where it was")
    add("--scenes", type=cli.non_negative_int, default=0, metavar="N", help="render how N instances begin, again from their seeds (default: none)")
    add("--tasks", type=cli.folder, metavar="DIR", help="with --scenes: folder with task files of your own")
    add("--encoder", metavar="NAME", help="of a rollout log: whose contexts, where it has several (default: the one it was recorded with)")
    add_reward_flags(result, "of a rollout log: ")
    return result


def _page(options: argparse.Namespace) -> "Page":
    from osel_sim.analysis.live import JOURNAL
    from osel_sim.formats.replay_result import REPLAY
    from osel_sim.formats.rollout_log import ROLLOUTS

    folder: Path = options.folder

    def draw(log: "LoggedOutcomes") -> dict[int, bytes]:
        from osel_sim.reporting.scenes import render_scenes

        return render_scenes(log, options.scenes, options.tasks) if options.scenes else {}

    if (folder / ROLLOUTS).is_file():
        from osel_sim.analysis.log import read_log
        from osel_sim.reporting.log_page import log_page

        log = read_log(folder, options.encoder)
        weights, _ = weights_of(options, log.metadata)
        return log_page(log, weights, draw)
    for flag in ("encoder", *FLAGS):
        if getattr(options, flag) is not None:
            raise UsageError(f"--{flag.replace('_', '-')}: {folder} is no rollout log; a run and a replay have what they were made with")
    if (folder / REPLAY).is_file():
        from osel_sim.reporting.replay_page import ReplayOptions, replay_page

        return replay_page(folder, ReplayOptions(options.log, draw))
    if (folder / JOURNAL).is_file():
        from osel_sim.reporting.run_page import run_page

        return run_page(folder, draw, options.out)
    raise DataError(f"{folder} holds neither {JOURNAL} (a live run), {REPLAY} (a replay) nor {ROLLOUTS} (a rollout log)")


if __name__ == "__main__":
    sys.exit(main(None))
