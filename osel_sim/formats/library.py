"""The policy files there are, by name: the shipped ones and those of a folder of the user's own."""

from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core import content

if TYPE_CHECKING:  # importing pydantic and building the models takes longer than the help of a command
    from osel_sim.formats.policy_file import PolicySpec


def load_policy(name: str, extra: Path | None = None) -> "PolicySpec":
    """Find and read a policy file.

    Raises:
        UnknownNameError: with the nearest known name.
        ContentError: naming the file, the key and what would be right.
    """
    from osel_sim.formats.policy_file import load_policy_file

    return load_policy_file(content.find("policies", name, extra))
