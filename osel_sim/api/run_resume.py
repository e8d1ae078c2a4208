"""Going on with a live run: with the settings that it began with, and to more decisions than it was to have."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from osel_sim.core.errors import UsageError


def settings_then(folder: Path) -> dict[str, Any]:
    """The settings that the run in a folder began with.

    Raises:
        UsageError: there is no run to resume, or it does not say with which settings it began.
    """
    from osel_sim.formats.run_config import RUN, check_run_folder, read_run

    check_run_folder(folder, {}, resume=True)
    began = read_run(folder).get("settings")
    if not isinstance(began, dict) or not began.get("task"):
        raise UsageError(f"{folder / RUN} does not hold the settings that the run began with: give --task and the other flags again")
    return began


def policies_then(folder: Path) -> list[str] | None:
    """Names of the policies that the run in a folder began with: whatever fits its tasks by now does not join unasked. None where it does not say."""
    from osel_sim.formats.run_config import RUN, read_run
    from osel_sim.formats.values import NAME

    names = read_run(folder)["configuration"].get("policies") if (folder / RUN).is_file() else None
    return names if isinstance(names, list) and all(map(NAME.fits, names)) else None


def episodes_then(folder: Path) -> int | None:
    """How many decisions the run in a folder was to have; None where there is none that says so."""
    from osel_sim.formats.run_config import RUN, read_run

    episodes = read_run(folder)["configuration"].get("episodes") if (folder / RUN).is_file() else None
    return episodes if type(episodes) is int else None


def check_still_unseen(to_come: Collection[str], logged: Collection[str], source: Path, episodes: int) -> None:
    """Refuse to decide on instances whose outcomes a warm start has shown.

    Args:
        to_come: instances that the run would not have come to before.
        logged: those of the log, of which the selector has been shown all that the run was not to decide on.

    Raises:
        UsageError: naming one.
    """
    if shown := set(to_come).intersection(logged):
        raise UsageError(
            f"--episodes {episodes}: {len(shown)} of the instances to come, such as {min(shown)}, are in {source}, "
            "whose outcomes the selector was shown before the first decision; begin a new run"
        )
