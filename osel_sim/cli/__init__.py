"""What all commands share: flags refused with a suggestion, one line for an error, exit code 2 for wrong input."""

import argparse
import errno
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from osel_sim.core.errors import OselError, did_you_mean

USAGE = 2
INTERRUPTED = 130
BROKEN_PIPE = 141

Command = Callable[[list[str] | None], int]


def main(function: Command) -> Command:
    """Wrap a command's function of its arguments (None: those of the process) that returns the exit code.

    An `OselError` becomes one line `error: ...` on standard error and its exit code, likewise a file that cannot be written or a full disk; Ctrl-C
    becomes a short line and 130; a reader that has gone (`| head`) ends the command without a word.
    """

    @functools.wraps(function)
    def wrapped(arguments: list[str] | None = None) -> int:
        try:
            code = function(arguments)
            sys.stdout.flush()
            return code
        except OselError as error:
            return _complain(str(error), error.exit_code)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return INTERRUPTED
        except BrokenPipeError:
            # Python flushes standard output once more at exit; it must find somewhere to write.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return BROKEN_PIPE
        except OSError as error:
            if error.filename is None and error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            return _complain(f"{error.filename}: {error.strerror}" if error.filename is not None else str(error.strerror), USAGE)

    return wrapped


class Parser(argparse.ArgumentParser):
    """argparse, with examples below the flags and one-line errors that name the nearest right flag or choice.

    Flags cannot be abbreviated: an abbreviation stops working, or changes its meaning, with the next flag that is added.
    """

    def __init__(self, command: str, description: str, examples: str) -> None:
        super().__init__(
            prog=f"python -m osel_sim.{command}",
            description=description,
            epilog=examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def _check_value(self, action: argparse.Action, value: object) -> None:
        # The only place where argparse knows both the value and the choices.
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(action, f"unknown value {str(value)!r}: {did_you_mean(str(value), known)}known: {', '.join(known)}")

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with code 2."""
        unknown = message.removeprefix("unrecognized arguments: ").split()
        if message.startswith("unrecognized arguments: "):
            flag = unknown[0].partition("=")[0]
            message = f"unknown argument {unknown[0]!r}: {did_you_mean(flag, self._option_string_actions)}{self.prog} --help lists them"
        self.exit(_complain(message, USAGE))


def positive_int(text: str) -> int:
    """Argument type: an integer of at least 1."""
    return _integer(text, 1)


def non_negative_int(text: str) -> int:
    """Argument type: an integer of at least 0."""
    return _integer(text, 0)


def non_negative_float(text: str) -> float:
    """Argument type: a finite number of at least 0."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}") from None
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number of 0 or more, got {text}")
    return value


def folder(text: str) -> Path:
    """Argument type: a folder that exists and can be read."""
    path = Path(text)
    if not path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is not a folder" if path.exists() else f"there is no folder {text}")
    if not os.access(path, os.R_OK | os.X_OK):
        raise argparse.ArgumentTypeError(f"folder {text} cannot be read")
    return path


def _integer(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be an integer, got {text!r}") from None
    if value < least:
        raise argparse.ArgumentTypeError(f"must be {least} or more, got {value}")
    return value


def _complain(message: str, code: int) -> int:
    print(f"error: {message}", file=sys.stderr)
    return code
