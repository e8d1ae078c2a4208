import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import pytest

from osel_sim.__main__ import COMMANDS, main
from osel_sim.api.settings import MAIN, Count, Folder, Index, Levels, NonNegative, Settings, settings
from osel_sim.cli import suites_command
from osel_sim.cli.command import BROKEN_PIPE, Command, reported
from osel_sim.core.docstrings import field_docstrings
from osel_sim.core.errors import SettingError, UnknownNameError, UsageError


@settings
class DemoConfig(Settings):
    """Does nothing."""

    word: Annotated[str, MAIN] = ""
    """a word"""
    episodes: Count = 3
    """how many"""
    alpha: NonNegative = 0.0
    seed: Index = 0
    level: Levels = (0,)
    tasks: Folder | None = None
    split: Literal["train", "validation", "test"] = "test"


@settings
class LogConfig(Settings):
    """Needs a log."""

    log: Path
    """the log"""


def show(config: Settings) -> int:
    print(json.dumps(config.to_json()))
    return 0


demo = Command("demo", DemoConfig, show, "examples:\n  python -m osel_sim.demo --episodes 3")
needs_log = Command("demo", LogConfig, show, "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--episodes 0", "--episodes: must be 1 or more, got 0"),
        ("--episodes many", "--episodes: must be an integer, got 'many'"),
        ("--episodes", "--episodes: needs a value"),
        ("--alpha -0.1", "--alpha: must be 0.0 or more, got -0.1"),
        ("--alpha nan", "--alpha: must be 0.0 or more, got nan"),
        ("--alpha much", "--alpha: must be a number, got 'much'"),
        ("--seed -1", "--seed: must be 0 or more, got -1"),
        ("--level", "--level: needs at least one value"),
        ("--level 0 -1", "--level: must be 0 or more, got -1"),
        ("--tasks /no/such", "--tasks: there is no folder /no/such"),
        ("--tasks /dev/null", "--tasks: /dev/null is not a folder"),
        ("--split tets", "--split: unknown value 'tets', did you mean 'test'? known: train, validation, test"),
        ("--epsodes 3", "unknown argument '--epsodes': did you mean '--episodes'? --help lists them"),
        ("--epi 3", "unknown argument '--epi'"),
        ("stray", "unknown argument 'stray'"),
    ],
)
def test_wrong_flags_get_one_line_and_exit_code_2(arguments: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert demo(arguments.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_a_flag_given_twice_means_the_last_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert demo(["--level", "0", "2", "--episodes=4", "--level", "1", "--episodes", "5"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["level"], found["episodes"]) == ([1], 5)


def test_a_positional_setting_is_needed(capsys: pytest.CaptureFixture[str]) -> None:
    assert needs_log([]) == 2
    assert capsys.readouterr().err == "error: LOG is missing\n"
    assert needs_log(["here"]) == 0


def test_help_shows_fields_and_the_examples_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert demo(["--help"]) == 0
    out = capsys.readouterr().out
    assert "how many [default: 3]" in out and out.index("What matters most") < out.index("--episodes")
    assert "  python -m osel_sim.demo --episodes 3\n" in out


@pytest.mark.parametrize("name", ["settings.toml", "settings.json", "run.json"])
def test_a_file_gives_settings_and_flags_beside_it_win(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = {"episodes": 7, "level": [0, 2], "word": "x"}
    text = {"settings.toml": '\ufeffepisodes = 7\nlevel = [0, 2]\nword = "x"\n', "settings.json": json.dumps(values)}
    (tmp_path / name).write_text(text.get(name, json.dumps({"settings": values, "configuration": {}})), encoding="utf-8")
    assert demo(["--config", str(tmp_path / name), "--episodes", "9"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["episodes"], found["level"], found["word"], found["seed"]) == (9, [0, 2], "x", 0)
    (tmp_path / "wrong.toml").write_text("episods = 3\n")
    assert demo(["--config", str(tmp_path / "wrong.toml")]) == 2
    assert "unknown setting 'episods': did you mean 'episodes'?" in capsys.readouterr().err


def test_a_configuration_is_checked_where_it_is_made_and_survives_json() -> None:
    config = DemoConfig.of(level=2, episodes=4)
    assert config.level == (2,) and config.given == {"level", "episodes"}
    assert DemoConfig.of(**json.loads(json.dumps(config.to_json()))) == config
    with pytest.raises(UnknownNameError, match="did you mean 'episodes'"):
        DemoConfig.of(episods=4)
    with pytest.raises(SettingError, match=r"episodes: must be an integer, got 'x'"):
        config.changed(episodes="x")
    with pytest.raises(SettingError, match="did you mean 'test'"):
        DemoConfig.of(split="tets")


def commands_of(name: str) -> list[Command]:
    """The commands of that name: `train` and `suites` are two each."""
    if name == "suites":
        return list(suites_command.commands.values())
    found = vars(import_module(f"osel_sim.{name}"))
    return [found["main"]] if isinstance(found["main"], Command) else [found["policy_command"], found["encoder_command"]]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_setting_of_every_command_is_explained(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for each in commands_of(name):
        described = field_docstrings(each.config)
        assert [field.name for field in fields(each.config) if not described.get(field.name)] == []
    assert main([name, "--help"]) == 0
    assert "examples:" in capsys.readouterr().out


def test_the_console_script_lists_commands_and_corrects_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {name} " in listed for name in COMMANDS)
    assert main(["rekord"]) == 2
    assert "unknown command 'rekord': did you mean 'record'?" in capsys.readouterr().err


def test_completion_is_installed_for_the_shell_in_use(tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": str(tmp_path), "SHELL": "/bin/bash"}
    command = [sys.executable, "-m", "osel_sim", "--install-completion"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    script = next(file for file in tmp_path.rglob("osel-sim") if file.is_file())
    assert str(script) in done.stdout and "--warm-start" in script.read_text()


def raises(error: BaseException) -> Callable[[], int]:
    def command() -> int:
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (UsageError("no task 'x'"), 2, "error: no task 'x'\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (PermissionError(13, "Permission denied", "runs/a"), 2, "error: runs/a: Permission denied\n"),
        (OSError(28, "No space left on device"), 2, "error: No space left on device\n"),
    ],
)
def test_errors_become_one_line_and_an_exit_code(error: BaseException, code: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert reported(raises(error)) == code
    assert capsys.readouterr().err == message


def test_mistakes_of_ours_keep_their_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        reported(raises(ZeroDivisionError()))


def test_a_reader_that_has_gone_ends_a_command_quietly() -> None:
    code = "import sys; from osel_sim.cli.command import reported; sys.exit(reported(lambda: [print('x' * 9999) for _ in range(999)] and 0))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.read(1)
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == BROKEN_PIPE


@pytest.mark.parametrize("flag", ["--list", "--help"])
def test_list_and_help_are_quick_and_import_nothing_heavy(flag: str, tmp_path: Path) -> None:
    command = [sys.executable, "-X", "importtime", "-m", "osel_sim.run", flag]
    seconds = []
    for _ in range(3):  # the first compiles the byte code; the quickest counts, and its own time: other tests run beside this one
        start = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
        end = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(end.ru_utime - start.ru_utime + end.ru_stime - start.ru_stime)
        if seconds[-1] < 1.5:
            break
    assert min(seconds) < 1.5
    assert done.returncode == 0
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "osel_sim" in imported
    heavy = {"torch", "mujoco", "robosuite", "gymnasium", "stable_baselines3", "open_clip", "lerobot", "matplotlib", "numba", "pandas"}
    assert not imported & (heavy if flag == "--list" else heavy | {"numpy"})  # a list asks the suites of others, which are made with numpy


def test_a_list_names_tasks_and_policies(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--list"]) == 0
    table = capsys.readouterr().out
    assert main(["run", "--list", "--json"]) == 0
    data = capsys.readouterr().out
    for name in ("pick_place", "local_small", "remote_large"):
        assert name in table
    listed = json.loads(data)
    assert "pick_place" in [task["name"] for task in listed["tasks"]]
    assert {"Panda", "UR5e", "Kinova3"} <= {robot["name"] for robot in listed["robots"]}
    assert {"auto", "ppo", "thompson"} <= {selector["name"] for selector in listed["selectors"]}
    assert {"osel_small", "osel_suite", "MODEL:TAG"} <= {encoder["name"] for encoder in listed["encoders"]}
    assert {"mmlu", "oxe"} <= {preset["name"] for preset in listed["presets"]}
    for words in ("one we recommend", "sentence:MODEL", "0.0008 cents", "(default)", "next: "):
        assert words in table
    assert {"local_small": "local", "remote_large": "remote"}.items() <= {policy["name"]: policy["location"] for policy in listed["policies"]}.items()
