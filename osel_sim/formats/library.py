"""The policy files there are, by name: the shipped ones and those of a folder of the user's own."""

from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core import content
from osel_sim.core.errors import UsageError

if TYPE_CHECKING:  # importing pydantic and building the models takes longer than the help of a command
    from osel_sim.formats.policy_file import PolicySpec


def load_policy(name: str, extra: Path | None = None) -> "PolicySpec":
    """Find and read a policy file.

    Raises:
        UnknownNameError: with the nearest known name.
        UsageError: it is a merge, which has no file.
        ContentError: naming the file, the key and what would be right.
    """
    from osel_sim.formats.merged_policy import is_merge, part_names
    from osel_sim.formats.policy_file import load_policy_file

    if is_merge(name):
        raise UsageError(f"policy {name!r} only drives in a run or a recording, where all of it is asked; name one: {', '.join(part_names(name))}")
    return load_policy_file(content.find("policies", name, extra))
