"""Names that look like markup stay what they are in every table and line, and two of them stay two."""

import sys
from pathlib import Path

import pytest
from rich.console import Console
from synthetic_log import make_row

from osel_sim import doctor
from osel_sim.cli.console import Table, console, plain, run_table
from osel_sim.cli.policy_report import print_report
from osel_sim.cli.replay_tables import print_off_policy, print_replay
from osel_sim.cli.rollout_tables import print_rollouts
from osel_sim.core.progress import progress
from osel_sim.episodes.policy_check import PROBLEM, Report
from osel_sim.run import main as run_main
from osel_sim.selection.reward import preset

NAMES = ["model [v2]", "model [v3]", "[/bold]", "[bold]b", ":fire:", "\\[x]", "[link=http://h]l"]
CONSOLES = [console, lambda: Console(file=sys.stdout, width=400)]


def said(capsys: pytest.CaptureFixture[str]) -> str:
    text = capsys.readouterr().out
    return " ".join("".join(character for character in text if character not in "│┃").split())


@pytest.mark.parametrize("make", CONSOLES, ids=["ours", "theirs"])
def test_names_are_no_markup(capsys: pytest.CaptureFixture[str], make) -> None:
    part = {"decisions": 1, "mean_reward": 0.5, "success_rate": 0.5, "success_interval": [0.1, 0.9], "mean_steps": 1.0, "mean_seconds": 1.0}
    part |= {"price": 0.0, "fallbacks": 0, "solved_by_fallback": 0, "errors": 0}
    summary = {"task": "[/bold] t", "selector": "[/red] s", **part, "policies": dict.fromkeys(NAMES, part)}
    summary |= {"regret": 0.1, "hindsight_oracle": 0.9, "always": dict.fromkeys(NAMES, 0.5), "best_single_policy": NAMES[0]}
    make().print(run_table(summary))
    text = said(capsys)
    assert all(f"chose {name} " in text and f"always {name} " in text for name in NAMES) and "[/bold] t: 1 decisions" in text and "[/red] s" in text


@pytest.mark.parametrize("make", CONSOLES, ids=["ours", "theirs"])
def test_names_of_a_log_are_no_markup(capsys: pytest.CaptureFixture[str], make) -> None:
    for names in (NAMES[:4], NAMES[4:]):
        rows = [make_row(f"i{number}", name, task=f"{name} t", target=name, container="c") for number, name in enumerate(names)]
        print_rollouts(make(), rows, preset("oxe"))
        text = said(capsys)
        assert all(f" {name} " in text and f" {name} t " in text for name in names)


@pytest.mark.parametrize("make", CONSOLES, ids=["ours", "theirs"])
def test_names_of_a_replay_are_no_markup(capsys: pytest.CaptureFixture[str], make) -> None:
    entry = {"mean_reward": 0.5, "ci95": [0.4, 0.6], "success_rate": 0.5, "mean_seconds": 1.0, "mean_price": 1.0, "regret": {"expected": 0.0}}
    entry |= {f"{name}_gap_closed{part}{end}": None for name in ("learnable", "predictable") for part in ("", "_late") for end in ("", "_ci95")}
    entry |= {"decisions_until_ahead": None, "kind": "learner"}
    result = {
        "log": {"tasks": NAMES, "instances": 1, "left_out": {"instances": 1}},
        "decisions": 1,
        "seeds": [0],
        "learnable_oracle": {"name": "expected", "beaten": {"per_task": NAMES[0]}},
        "selectors": {**dict.fromkeys(NAMES, entry), "best_single": entry | {"policy": NAMES[0]}},
        "oracles": {"expected": entry | {"gain": 0.1, "gain_ci95": [0.0, 0.2]}},
        "verdict": {"text": f"Do not route: always use {NAMES[2]}."},
    }
    print_replay(make(), result)
    text = said(capsys)
    assert all(f" {name} " in text for name in NAMES) and "always use [/bold]." in text and "[v2], model [v3], [/bold] and 4 more" in text
    target = {"few": [], "measured": 0.5, "unsupported": 0} | {f"{way}_effective": 9.0 for way in ("ips", "snips", "dr")}
    target |= {f"{way}{end}": None for way in ("ips", "snips", "dr") for end in ("", "_ci95")}
    run = {"selector": "[/x]", "decisions": 3, "errors": 1, "mean_reward": 0.5, "ci95": [0.4, 0.6]}
    print_off_policy(make(), {"run": run, "targets": {f"fixed:{name}": target for name in NAMES}})
    text = said(capsys)
    assert all(f"fixed:{name} " in text for name in NAMES) and "[/x], 3 decisions" in text


def test_names_of_a_report_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    measured = {"min": 0.0, "mean": 0.0, "max": 0.0, "std": 0.0, "at_limit": 0.0}
    outcome = {"success": False, "steps": 3, "subgoals": 0.0}
    actions, inputs = dict.fromkeys(NAMES, measured), {name: f"{name} shape" for name in NAMES}
    report = Report("[/p]", "i", "say [/bold]", inputs, actions=actions, outcome=outcome, findings=[(PROBLEM, "[/words]")])
    print_report(report, Path("[/out]"))
    text = said(capsys)
    assert all(f"{name} {name} shape" in text and text.count(f"{name} ") >= 3 for name in NAMES)
    assert all(word in text for word in ("[/p] on i", "say [/bold]", f"{PROBLEM} [/words]", "in [/out]"))


def test_names_in_lists_are_no_markup(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, name in enumerate(NAMES):
        (tmp_path / f"p{number}.toml").write_text(
            f"version = 1\nname = 'p{number}'\ntitle = '{name}'\nlocation = 'local'\nkind = 'lerobot'\nexecute = 1\ninference_seconds = 0.1\n"
            "[observation]\ncameras = ['agentview']\nimage_size = 64\n"
        )
    assert run_main(["--list", "--policies-dir", str(tmp_path)]) == 0
    text = said(capsys)
    assert all(f"p{number} {name} local" in text for number, name in enumerate(NAMES))
    (tmp_path / "[v2].toml").write_text("[/bold] =")
    doctor.main(["--policies-dir", str(tmp_path)])
    assert "[v2].toml" in said(capsys).replace(" ", "")


def test_a_name_too_long_for_its_column_is_folded() -> None:
    narrow = Console(width=24)
    table = Table("", ["a", "b"])
    names = [f"{'long' * 10}{end}" for end in "xy"]
    for name in names:
        table.add(name, plain("1", "bold"))
    with narrow.capture() as captured:
        narrow.print(table)
    text = "".join(character for character in captured.get() if character.isalpha())
    assert names[0] in text and names[1] in text and "…" not in captured.get()


def test_bars_show_names_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(2, "episode", "a\nb\x1b[2J") as bar:
        bar.note("[/bold] x\ny\x07")
        bar.update(2)
    text = capsys.readouterr().err
    assert "a b\\x1b[2J" in text and "[/bold] x y\\x07" in text and "\x1b[2J" not in text and "\x07" not in text


def test_commands_have_one_kind_of_table() -> None:
    package = Path(doctor.__file__).parent
    others = [file for file in package.rglob("*.py") if "rich.table" in file.read_text() or "from rich import table" in file.read_text()]
    assert others == [package / "cli" / "console.py"]
