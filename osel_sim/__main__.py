"""`python -m osel_sim` and `osel-sim`: lists the commands and runs one."""

import sys
from collections.abc import Sequence
from importlib import import_module

from osel_sim.core import this_python

COMMANDS = {
    "run": "let a selector choose live which policy handles each instance",
    "record": "run every policy on the same instances: a rollout log",
    "merge": "put the shards of a recording together",
    "replay": "show a log to selectors: is routing worth it?",
    "compare": "did a policy get worse? paired differences and a verdict",
    "report": "one page about a run, a replay or a log",
    "ingest": "turn outcome tables of others into a log",
    "collect": "demonstrations of the scripted expert",
    "train": "a policy from demonstrations, or the context encoder",
    "serve": "a policy over WebSocket",
    "suites": "tasks of others: what is there, and how to get it",
    "gallery": "a contact sheet of tasks and levels",
    "doctor": "what works on this machine, and what is missing",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit code."""
    this_python.check()
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in COMMANDS:
        code: int = import_module(f"osel_sim.{words[0]}").main(words[1:])
        return code
    if words and words[0] == "--install-completion":
        return _install_completion()
    if words and words[0] not in ("-h", "--help"):
        from osel_sim.core.errors import did_you_mean

        print(f"error: unknown command {words[0]!r}: {did_you_mean(words[0], COMMANDS)}known: {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    print("Usage: osel-sim COMMAND [FLAGS]   (or python -m osel_sim.COMMAND)\n")
    for name, words_about in COMMANDS.items():
        print(f"  {name:9} {words_about}")
    print("\n`osel-sim COMMAND --help` shows flags and examples; `osel-sim --install-completion` completes them in your shell.")
    return 0


def _install_completion() -> int:
    """Write a completion script for the shell in use, and say where."""
    from cyclopts import App

    from osel_sim.cli.command import Command, reported

    app = App(name="osel-sim", version_flags=[])
    for name in COMMANDS:
        if name == "suites":  # two commands below one name
            app.command(App(name=name), name=name)
            for action, one in import_module("osel_sim.cli.suites_command").commands.items():
                app[name].command(one.app(action), name=action)
            continue
        command = import_module(f"osel_sim.{name}")
        found = command.main if isinstance(command.main, Command) else command.policy_command
        app.command(found.app(name), name=name)

    def install() -> int:
        print(f"written to {app.install_completion()}; open a new shell")
        return 0

    return reported(install)


if __name__ == "__main__":
    sys.exit(main())
