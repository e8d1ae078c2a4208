"""What to type next: commands as they can be pasted, with the paths that the last one wrote to."""

import os
import shlex
import sys
from typing import TextIO

from osel_sim.core.shown import shown
from osel_sim.core.this_python import called

Step = tuple[str, str, list[object]]
"""What for, the command's name, and its arguments."""


def print_next(*steps: Step, file: TextIO | None = None) -> None:
    """Print the commands below each other, each with what it is for.

    Args:
        file: None: standard output.
    """
    lines = [(_command(name, arguments), about) for about, name, arguments in steps]
    widest = max((len(command) for command, _ in lines), default=0)
    for number, (command, about) in enumerate(lines):
        print(shown(f"{'      ' if number else 'next: '}{command:{widest}}   # {about}"), file=file)


def _command(name: str, arguments: list[object]) -> str:
    """The command line, called as this one was."""
    command = f"osel-sim {name}" if os.path.basename(sys.argv[0]) == "osel-sim" else f"{shlex.quote(called())} -m osel_sim.{name}"
    return " ".join([command, *(shlex.quote(str(word)) for word in arguments)])
