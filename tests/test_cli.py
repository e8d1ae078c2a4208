import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from osel_sim import cli
from osel_sim.core.errors import UsageError


def parser() -> cli.Parser:
    result = cli.Parser("demo", "Does nothing.", "examples:\n  python -m osel_sim.demo --episodes 3")
    result.add_argument("--episodes", type=cli.positive_int)
    result.add_argument("--alpha", type=cli.non_negative_float)
    result.add_argument("--seed", type=cli.non_negative_int)
    result.add_argument("--tasks", type=cli.folder)
    result.add_argument("--split", choices=("train", "validation", "test"))
    return result


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--episodes 0", "argument --episodes: must be 1 or more, got 0"),
        ("--episodes many", "argument --episodes: must be an integer, got 'many'"),
        ("--episodes", "argument --episodes: expected one argument"),
        ("--alpha -0.1", "argument --alpha: must be a number of 0 or more, got -0.1"),
        ("--alpha nan", "argument --alpha: must be a number of 0 or more, got nan"),
        ("--alpha much", "argument --alpha: must be a number, got 'much'"),
        ("--seed -1", "argument --seed: must be 0 or more, got -1"),
        ("--tasks /no/such", "argument --tasks: there is no folder /no/such"),
        ("--tasks /dev/null", "argument --tasks: /dev/null is not a folder"),
        ("--split tets", "argument --split: unknown value 'tets': did you mean 'test'? known: train, validation, test"),
        ("--epsodes 3", "unknown argument '--epsodes': did you mean '--episodes'? python -m osel_sim.demo --help lists them"),
        ("--epi 3", "unknown argument '--epi'"),
    ],
)
def test_wrong_flags_get_one_line_and_exit_code_2(arguments: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parser().parse_args(arguments.split())
    error = capsys.readouterr().err
    assert ended.value.code == 2
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_help_shows_the_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parser().parse_args(["--help"])
    assert ended.value.code == 0
    assert "  python -m osel_sim.demo --episodes 3\n" in capsys.readouterr().out


def raises(error: BaseException) -> cli.Command:
    def command(arguments: list[str] | None = None) -> int:
        raise error

    return cli.main(command)


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
    assert raises(error)(None) == code
    assert capsys.readouterr().err == message


def test_mistakes_of_ours_keep_their_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        raises(ZeroDivisionError())(None)


def test_a_reader_that_has_gone_ends_a_command_quietly() -> None:
    code = "import sys; from osel_sim import cli; sys.exit(cli.main(lambda a: [print('x' * 9999) for _ in range(999)] and 0)(None))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.read(1)
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == cli.BROKEN_PIPE


@pytest.mark.parametrize("flag", ["--list", "--help"])
def test_list_and_help_are_quick_and_import_nothing_heavy(flag: str, tmp_path: Path) -> None:
    command = [sys.executable, "-X", "importtime", "-m", "osel_sim.run", flag]
    seconds = []
    for _ in range(3):  # the first compiles the byte code; the quickest counts, other tests run beside this one
        start = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 1.5
    assert done.returncode == 0
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "osel_sim" in imported
    assert not imported & {"torch", "mujoco", "robosuite", "gymnasium", "stable_baselines3", "open_clip", "lerobot", "matplotlib", "numba", "numpy"}


def test_a_list_names_tasks_and_policies() -> None:
    table, data = (
        subprocess.run([sys.executable, "-m", "osel_sim.run", *flags], capture_output=True, text=True).stdout
        for flags in (["--list"], ["--list", "--json"])
    )
    for name in ("pick_place", "local_small", "remote_large"):
        assert name in table
    listed = json.loads(data)
    assert "pick_place" in [task["name"] for task in listed["tasks"]]
    assert {"local_small": "local", "remote_large": "remote"}.items() <= {policy["name"]: policy["location"] for policy in listed["policies"]}.items()
