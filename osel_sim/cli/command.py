"""A command: its configuration's fields as flags, one line for an error, exit code 2 for wrong input.

The library is cyclopts. tyro was tried first: it prints its errors itself, as boxes of several lines, where every command here says what is wrong in
one line; cyclopts raises them.
"""

import errno
import functools
import inspect
import io
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

from osel_sim.api.settings import MAIN, OTHER, Group, Settings
from osel_sim.cli.output import show_log
from osel_sim.core.caches import prepare
from osel_sim.core.docstrings import field_docstrings
from osel_sim.core.errors import OselError, SettingError, UnknownNameError, UsageError, did_you_mean
from osel_sim.core.shown import shown
from osel_sim.core.this_python import lacking

if TYPE_CHECKING:
    from cyclopts import App

USAGE = 2
INTERRUPTED = 130
BROKEN_PIPE = 141
ADDING = ("--axis", "--camera", "--cluster-option", "--trust")
"""Flags that may be repeated, each time with more."""

Switch = tuple[Any, str, Callable[[Mapping[str, Any]], int] | None]

_CONFIG_HELP = "TOML or JSON file with settings, or a run.json; flags given beside it win"


class Command[Config: Settings]:
    """One command of the package; calling it runs it.

    Args:
        name: such as `run`.
        config: its configuration.
        execute: what it does with a configuration; returns the exit code.
        examples: shown below `--help`.
        switches: further flags that are no settings of the configuration, such as `--list`: name -> (type, help, what it does instead of `execute`
            with the flags that were given; None for a flag that only another switch reads).
    """

    def __init__(
        self,
        name: str,
        config: type[Config],
        execute: Callable[[Config], int],
        examples: str,
        switches: Mapping[str, Switch] | None = None,
    ) -> None:
        self.name, self.config, self.execute, self.examples = name, config, execute, examples
        self.switches = dict(switches or {})

    def __call__(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command."""
        return reported(functools.partial(self._run, arguments))

    def app(self, name: str | None = None) -> "App":
        """The command as a cyclopts application, for `osel-sim` and shell completion.

        Args:
            name: what usage calls it; None: `python -m osel_sim.NAME`.
        """
        from cyclopts import App, Parameter

        app = App(
            name=name or f"python -m osel_sim.{self.name}",
            help=inspect.getdoc(self.config) or "",
            help_format="plaintext",
            version_flags=[],
            suppress_keyboard_interrupt=False,  # `reported` says that it was interrupted
            default_parameter=Parameter(negative="", consume_multiple=True, allow_repeating=True),
        )
        app["--help"].group = _group(OTHER)
        app.default(self._function)
        return app

    def _run(self, arguments: Sequence[str] | None) -> int:
        from cyclopts import CycloptsError

        words, app = sys.argv[1:] if arguments is None else arguments, self.app()
        if {"-h", "--help"} & set(words):
            app.help_print([])
            print(self.examples)  # as they are: cyclopts would fold their lines
            return 0
        try:
            code = app(self._last_wins(words), exit_on_error=False, print_error=False, result_action="return_value")
        except CycloptsError as error:
            raise UsageError(_one_line(error)) from None
        return code if isinstance(code, int) else 0

    def _last_wins(self, words: Sequence[str]) -> list[str]:
        """The words without what a later flag of the same name replaces; those of `ADDING` add up.

        cyclopts would join the values of a list given twice, so that `make run ARGS="--policies mine"` would add to the policies instead.
        """
        kept: list[list[str]] = [[]]
        for word in words:
            if word.startswith("--"):
                kept.append([])
            kept[-1].append(word)
        names = [part[0].partition("=")[0] if part else "" for part in kept]
        last = {name: index for index, name in enumerate(names)}
        return [word for index, (name, part) in enumerate(zip(names, kept, strict=True)) if name in ADDING or last[name] == index for word in part]

    @functools.cached_property
    def _function(self) -> Callable[..., int]:
        signature = inspect.Signature([*self._parameters()])

        def function(*positional: Any, **given: Any) -> int:
            return self._call(dict(signature.bind_partial(*positional, **given).arguments))

        function.__signature__ = signature  # type: ignore[attr-defined]
        return function

    def _parameters(self) -> list[inspect.Parameter]:
        from cyclopts import Parameter

        hints = get_type_hints(self.config, include_extras=True)
        described = field_docstrings(self.config)
        own = [_parameter(field, hints[field.name], described.get(field.name, "")) for field in fields(self.config)]  # type: ignore[arg-type]
        more: list[tuple[str, Any, Any, str]] = [("config", Path | None, None, _CONFIG_HELP)]
        more += [(flag, kind, False, words) if kind is bool else (flag, kind | None, None, words) for flag, (kind, words, _) in self.switches.items()]
        extra = [
            inspect.Parameter(
                f"{flag}_",
                inspect.Parameter.KEYWORD_ONLY,
                default=default,
                annotation=Annotated[kind, Parameter(name=f"--{flag}", help=words, group=_group(OTHER), show_default=False)],
            )
            for flag, kind, default, words in more
        ]
        return sorted(own, key=lambda parameter: parameter.kind) + extra

    def _call(self, given: dict[str, Any]) -> int:
        """Do what the given flags ask for."""
        for name, value in given.items():
            if value == ():
                raise SettingError(name, "needs at least one value")
        switched = {flag: given.pop(f"{flag}_", None) for flag in self.switches}
        file = given.pop("config_", None)
        for flag, (_, _, action) in self.switches.items():
            if switched[flag] and action is not None:
                return action(given | switched)
        values = {**(read_settings(file, self.config) if file is not None else {}), **given}
        return self.execute(self.config.of(**values))


def read_settings(file: Path, config: type[Settings]) -> dict[str, Any]:
    """Settings of a file: TOML, JSON, or a `run.json` that a run left.

    Raises:
        DataError, ContentError: it cannot be read.
        UnknownNameError: it has a setting that the command does not.
    """
    from osel_sim.core.files import read_json
    from osel_sim.formats.toml_file import read_toml

    data = read_toml(file) if file.suffix == ".toml" else read_json(file)
    data = data["settings"] if isinstance(data.get("settings"), dict) else data
    known = [field.name for field in fields(config)]  # type: ignore[arg-type]
    for name in data:
        if name not in known:
            raise UnknownNameError("setting", name, known, str(file))
    return data


def reported(function: Callable[[], int]) -> int:
    """Run a command; what goes wrong becomes one line and an exit code.

    An `OselError` becomes one line `error: ...` on standard error and its exit code, likewise a package that is not installed, a file that cannot be
    written or a full disk; Ctrl-C becomes a short line and 130; a reader that has gone (`| head`) ends the command without a word. Messages of the
    package's logger go to standard error meanwhile. Letters that the terminal's encoding lacks
    are written as escapes, such as `\\u7b56`.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with show_log():
            prepare()
            code = function()
        sys.stdout.flush()
        return code
    except SettingError as error:
        flag = f"--{error.setting.replace('_', '-')}: " if error.setting else ""
        return _complain(flag + error.problem, error.exit_code)
    except OselError as error:
        return _complain(str(error), error.exit_code)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "osel_sim"):
            raise
        return _complain(lacking(package), USAGE)
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


def _parameter(field: "Field[Any]", hint: Any, description: str) -> inspect.Parameter:
    """A field as a parameter of the function that cyclopts parses for; one without a default is positional."""
    from cyclopts import Parameter

    group = next((mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, Group)), OTHER)
    kind = _plain_type(hint)
    needed = field.default is MISSING and field.default_factory is MISSING
    default = inspect.Parameter.empty if needed else field.default
    shown = not needed and default is not None and default != () and default is not False
    choices = _choices(hint)
    flag = Parameter(
        name=field.name.upper() if needed else None,
        help=description + (f": {', '.join(choices)}" if choices else ""),
        group=_group(MAIN if needed else group),
        show_default=_words if shown else False,
    )
    annotation = Annotated[kind, flag]  # type: ignore[valid-type]
    style = inspect.Parameter.POSITIONAL_ONLY if needed else inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(field.name, style, default=default, annotation=annotation)


def _plain_type(hint: Any) -> Any:
    """A type hint without the marks that only pydantic understands."""
    if get_origin(hint) is Annotated:
        return _plain_type(get_args(hint)[0])
    arguments = get_args(hint)
    if get_origin(hint) is tuple:
        return tuple[*(part if part is ... else _plain_type(part) for part in arguments)]  # type: ignore[misc]
    if get_origin(hint) is Literal:
        return type(arguments[0])  # the configuration checks it, and says what would be near
    if type(None) in arguments:
        return functools.reduce(lambda left, right: left | right, (_plain_type(part) for part in arguments))
    return hint


def _choices(hint: Any) -> list[str]:
    """The values of a hint that lists them; empty for any other."""
    if get_origin(hint) is Literal:
        return [str(value) for value in get_args(hint)]
    return [choice for part in get_args(hint) if part is not hint for choice in _choices(part)]


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


@functools.cache
def _group(group: Group) -> Any:
    from cyclopts import Group as Heading

    return Heading(group.title, sort_key=group.order)


def _one_line(error: Exception) -> str:
    """A parsing error of cyclopts in the words of our own errors."""
    from cyclopts import CoercionError, MissingArgumentError, UnknownOptionError, UnusedCliTokensError

    text = " ".join(str(error).split())
    if isinstance(error, UnknownOptionError):
        flag = str(error.token.keyword or error.token.value).partition("=")[0]
        known = [name for argument in error.argument_collection for name in argument.names]
        return f"unknown argument {flag!r}: {did_you_mean(flag, known)}--help lists them"
    if isinstance(error, UnusedCliTokensError):
        return f"unknown argument {str((error.unused_tokens or ['?'])[0])!r}: --help shows what there is"
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        name = error.argument.name
        return f"{name}: needs a value" if name.startswith("-") else f"{name} is missing"
    if isinstance(error, CoercionError) and error.argument is not None and error.token is not None and error.target_type in (int, float):
        kind = "an integer" if error.target_type is int else "a number"
        return f"{error.argument.name}: must be {kind}, got {str(error.token.value)!r}"
    return text[:1].lower() + text[1:]


def _complain(message: str, code: int) -> int:
    print(f"error: {shown(message)}", file=sys.stderr)
    return code
