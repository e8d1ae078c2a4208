"""The page of a live run, a replay, a comparison or a rollout log."""

import contextlib
import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from osel_sim.api.reward import FLAGS, weights_of
from osel_sim.api.settings import CONTENT, MAIN, OTHER, Folder, Index, LoggedRewardSettings, settings
from osel_sim.core.errors import DataError, SettingError

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.reporting.page import Page

logger = logging.getLogger(__name__)


@settings
class ReportConfig(LoggedRewardSettings):
    """Write one page about a live run, a replay, a comparison or a rollout log: verdict, curves, tables, maps, episodes."""

    folder: Folder
    """folder of a live run, a replay, a comparison or a rollout log"""
    out: Annotated[Path | None, MAIN] = None
    """where to write (default: into the folder itself)"""
    open: Annotated[bool, MAIN] = False
    """show it in the browser"""
    watch: Annotated[bool, MAIN] = False
    """of a live run that goes on: serve the page on this machine, growing with the run, until Ctrl-C"""
    scenes: Annotated[Index, MAIN] = 0
    """render how so many instances begin, again from their seeds"""
    log: Annotated[Folder | None, OTHER] = None
    """of a replay: its rollout log, where that is no longer where it was"""
    encoder: Annotated[str | None, OTHER] = None
    """of a rollout log: whose contexts, where it has several (default: the one it was recorded with)"""
    watch_stdin: Annotated[bool, OTHER] = False
    """with --watch: end when standard input does (for a program that starts it)"""
    tasks: Annotated[Folder | None, CONTENT] = None
    """with --scenes: folder with task files of your own"""


@dataclass(frozen=True)
class ReportResult:
    """What `report` wrote; figures/ and tables/ lie beside the page.

    Attributes:
        page: the file.
        verdict: what it says first.
    """

    page: Path
    verdict: str = ""

    def _repr_html_(self) -> str:
        """A link, in a notebook."""
        from html import escape

        return f'<a href="{escape(self.page.as_posix())}">{escape(str(self.page))}</a>'


def report(folder: "Path | str | ReportConfig", **values: Any) -> ReportResult:
    """Write the page of a live run, a replay, a comparison or a rollout log.

    Args:
        folder: of a run, a replay, a comparison or a log; or all settings as one object, of which `values` change some.
        values: settings by name, as `ReportConfig` has them.

    Raises:
        OselError: the folder holds none of these, or is damaged; the message says what.
    """
    from osel_sim.reporting.page import write_page

    config = folder.changed(**values) if isinstance(folder, ReportConfig) else ReportConfig.of(folder=Path(folder), **values)
    content = _page(config)
    page = write_page(content, config.out or config.folder)
    if config.open:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    return ReportResult(page, content.verdict.headline)


def watch(folder: "Path | str | ReportConfig", on_start: Callable[[str], None], **values: Any) -> None:
    """Serve the page of a live run on this machine while it grows, until Ctrl-C (KeyboardInterrupt, which is not raised).

    Args:
        folder: of a run, which need not have made a decision; or all settings as one object, of which `values` change some.
        on_start: told the address.
        values: settings by name, as `ReportConfig` has them.

    Raises:
        OselError: the folder holds no live run.
    """
    from osel_sim.formats.run_config import RUN
    from osel_sim.reporting.watch import WatchedPage

    config = folder.changed(**values) if isinstance(folder, ReportConfig) else ReportConfig.of(folder=Path(folder), **values)
    if not (config.folder / RUN).is_file() or _is_finished_log(config.folder):
        raise SettingError("watch", f"{config.folder} holds no live run (python -m osel_sim.run); leave the flag out")
    page, stop = WatchedPage(config.folder), threading.Event()
    on_start(page.url)
    if config.watch_stdin:
        threading.Thread(target=_set_at_end_of_stdin, args=(stop,), daemon=True).start()
    if config.open:
        import webbrowser

        webbrowser.open(page.url)
    with contextlib.suppress(KeyboardInterrupt):
        page.serve(stop)


def _set_at_end_of_stdin(stop: threading.Event) -> None:
    while os.read(0, 4096):
        pass
    stop.set()


def _is_finished_log(folder: Path) -> bool:
    from osel_sim.formats.replay_result import REPLAY
    from osel_sim.formats.rollout_log import ROLLOUTS
    from osel_sim.formats.shards import SHARDS

    return any((folder / name).is_file() for name in (REPLAY, ROLLOUTS, SHARDS))


def _page(config: ReportConfig) -> "Page":
    from osel_sim.formats.compare_result import COMPARE
    from osel_sim.formats.journal import JOURNAL
    from osel_sim.formats.moments_result import MOMENTS_RESULT
    from osel_sim.formats.replay_result import REPLAY
    from osel_sim.formats.rollout_log import ROLLOUTS
    from osel_sim.formats.shards import SHARDS

    folder = config.folder

    def draw(log: "LoggedOutcomes") -> dict[int, bytes]:
        from osel_sim.reporting.scenes import render_scenes

        return render_scenes(log, config.scenes, config.tasks) if config.scenes else {}

    if (folder / ROLLOUTS).is_file():
        from osel_sim.analysis.log import read_log
        from osel_sim.reporting.log_page import log_page

        log = read_log(folder, config.encoder)
        weights, _ = weights_of(config, log.metadata)
        return log_page(log, weights, draw)
    if (folder / SHARDS).is_file():
        from osel_sim.analysis.log import read_unfinished
        from osel_sim.reporting.log_page import log_page

        log, rows = read_unfinished(folder)
        logger.warning("%s: the recording goes on or was interrupted; its page is of the %d instances so far", folder, len(log))
        weights, _ = weights_of(config, log.metadata)
        return log_page(log, weights, draw, rows)
    for setting in ("encoder", *FLAGS):
        if getattr(config, setting) is not None:
            raise SettingError(setting, f"{folder} is no rollout log; a run, a replay and a comparison have what they were made with")
    if (folder / REPLAY).is_file():
        from osel_sim.reporting.replay_page import ReplayOptions, replay_page

        return replay_page(folder, ReplayOptions(config.log, draw))
    if (folder / MOMENTS_RESULT).is_file():
        from osel_sim.reporting.moments_page import moments_page

        return moments_page(folder)
    if (folder / COMPARE).is_file():
        from osel_sim.reporting.compare_page import compare_page

        return compare_page(folder)
    if (folder / JOURNAL).is_file():
        from osel_sim.reporting.run_page import run_page

        return run_page(folder, draw, config.out)
    raise DataError(f"{folder} holds neither {JOURNAL} (a live run), {REPLAY} (a replay), {COMPARE} (a comparison) nor {ROLLOUTS} (a rollout log)")
