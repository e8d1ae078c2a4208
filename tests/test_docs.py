"""What the documentation shows works: Python blocks run, TOML blocks are valid files, every command line has flags that exist, links lead somewhere.

A Python block below the line `<!-- test -->` is executed, below `<!-- test: slow -->` in the slow tests; any other only has to compile.
"""

import re
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
from test_cli import commands_of

from osel_sim.__main__ import COMMANDS
from osel_sim.api.run_settings import RunConfig
from osel_sim.cli.command import Command, read_settings
from osel_sim.core import content
from osel_sim.formats.dataset_mapping import load_dataset_mapping
from osel_sim.formats.policy_file import load_policy_file
from osel_sim.formats.task_file import load_task_file
from osel_sim.ingestion.columns_file import load_columns
from osel_sim.policy.registry import kinds
from osel_sim.selection.registry import selector_locations
from osel_sim.suites.gym.tasks import read_task
from osel_sim.suites.registry import select_tasks

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "assets").rglob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
EXAMPLES = sorted(file for file in (ROOT / "examples").rglob("*") if file.suffix in (".py", ".toml"))

BLOCK = re.compile(r"(?m)^(?:<!-- test(: \w+)? -->\n)?```(\w+)\n(.*?)^```$", re.DOTALL)
CALL = re.compile(r"(?:python -m osel_sim\.|\bosel-sim +)(\w+)(?![\w.])(.*)")
OTHERS = ("toy:",)
"""Suites that pages give as an example of one's own."""


@dataclass(frozen=True)
class Block:
    place: str
    mark: str | None
    language: str
    text: str


def blocks(language: str) -> list[Block]:
    found = []
    for page in PAGES:
        text = page.read_text()
        for match in BLOCK.finditer(text):
            place = f"{page.relative_to(ROOT)}:{text[: match.start()].count(chr(10)) + 1}"
            mark = None if not match[0].startswith("<!--") else (match[1] or "").removeprefix(": ") or "quick"
            found.append(Block(place, mark, match[2], match[3]))
    return [block for block in found if block.language == language]


def smaller(code: str) -> str:
    """The code with fewer episodes, seeds and decisions."""
    return re.sub(r"\bseeds=\d+", "seeds=1, decisions=40", re.sub(r"\bepisodes=\d+", "episodes=2", code))


def checkout(folder: Path) -> Path:
    """A folder that looks like the repository's root and can be written to."""
    for name in ("assets", "examples", "policies", "tasks"):
        (folder / name).symlink_to(ROOT / name)
    return folder


@pytest.mark.parametrize(
    "block",
    [pytest.param(block, id=block.place, marks=[pytest.mark.slow] if block.mark == "slow" else []) for block in blocks("python")],
)
def test_python_blocks_run(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = compile(smaller(block.text), block.place, "exec")
    if block.mark is not None:
        monkeypatch.chdir(checkout(tmp_path))
        exec(code, {"__name__": "documentation"})


def test_some_python_blocks_are_executed() -> None:
    assert {block.place.partition(":")[0] for block in blocks("python") if block.mark} >= {"README.md", "docs/index.md", "docs/selectors.md"}


@pytest.mark.parametrize("block", blocks("toml"), ids=lambda block: block.place)
def test_toml_blocks_are_valid_files(block: Block, tmp_path: Path) -> None:
    data = tomllib.loads(block.text)
    if "project" in data:
        sources = "".join(file.read_text() for file in (ROOT / "osel_sim").rglob("*.py"))
        for group in data["project"]["entry-points"]:
            assert f'"{group}"' in sources
        return
    file = tmp_path / f"{data.get('name', 'settings')}.toml"
    file.write_text(block.text)
    if "scene" in data:
        load_task_file(file)
    elif "id" in data:
        read_task(file)
    elif "kind" in data:
        assert load_policy_file(file).kind in kinds()
    elif "table" in data:
        load_columns(file)
    elif "columns" in data:
        load_dataset_mapping(file)
    else:
        RunConfig.of(**read_settings(file, RunConfig))


def shown_in(page: Path) -> list[str]:
    """Lines of code on a page: in blocks of a shell or of no language, indented, or between backticks."""
    text = re.sub(r"\\\n\s*", " ", page.read_text())
    if page.suffix != ".md":
        return text.splitlines()
    found: list[str] = []
    language: str | None = None
    for line in text.splitlines():
        if line.startswith("```"):
            language = line[3:].strip() if language is None else None
        elif language is not None or line.startswith("    "):
            found.append(line)
        else:
            found += re.findall(r"`([^`]+)`", line)
    return found


def calls() -> dict[str, tuple[str, str]]:
    """Each command line in documentation, examples and `--help`: where it stands -> command, and what follows."""
    lines = [(str(page.relative_to(ROOT)), line) for page in [*PAGES, *EXAMPLES] for line in shown_in(page)]
    for name in COMMANDS:
        for command in commands_of(name):
            lines += [(f"{name} --help", line) for line in re.sub(r"\\\n\s*", " ", command.examples).splitlines()]
    found = {f"{place}: {call[0].strip()}": (call[1], call[2]) for place, line in lines for call in CALL.finditer(line)}
    return {place: call for place, call in found.items() if not call[0].isupper()}


def words_of(text: str) -> list[str]:
    """Arguments, without what is said beside them."""
    text = re.split(r"\\?\||&&|;| {3,}(?=[^-#\s])", text)[0]
    return [word for word in shlex.split(text, comments=True) if word != "..."]


def configuration(command: Command, words: list[str], capsys: pytest.CaptureFixture[str]) -> object:
    """The configuration that a command line gives, without doing anything; None where it only lists. Folders that it needs are made."""
    seen: list[object] = []
    switches = {flag: (kind, help, action and (lambda given: 0)) for flag, (kind, help, action) in command.switches.items()}
    probe = Command(command.name, command.config, lambda config: len(seen.append(config) or ()), "", switches)
    for _ in range(5):
        code, complaint = probe(words), capsys.readouterr().err
        if code == 0:
            return seen[0] if seen else None
        missing = re.search(r"there is no folder (.+)", complaint)
        if missing is None:
            break
        Path(missing[1].strip()).mkdir(parents=True)
    pytest.fail(complaint)


@pytest.mark.parametrize(("name", "rest"), calls().values(), ids=calls())
def test_command_lines_have_flags_that_exist(
    name: str, rest: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert name in COMMANDS
    monkeypatch.chdir(checkout(tmp_path))
    words = words_of(rest)
    if not words:
        return
    other = words.pop(0) == "install" if name == "suites" else any(word.startswith("--encoder") for word in words)
    command = commands_of(name)[-1 if other else 0]
    if "--config" in words:
        Path("settings.toml").write_text("")
        words[words.index("--config") + 1] = "settings.toml"
    config = configuration(command, words, capsys)
    for selector in [*(getattr(config, "selectors", None) or ()), *([config.selector] if hasattr(config, "selector") else [])]:
        assert selector.partition(":")[0] in selector_locations()
    tasks = getattr(config, "task", None) or ()
    if getattr(config, "tasks", None) is None:
        for task in [tasks] if isinstance(tasks, str) else tasks:
            if not task.startswith((*OTHERS, "SUITE:")) and not task.endswith(".toml"):
                select_tasks([task])


def test_a_flag_that_does_not_exist_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(pytest.fail.Exception, match="unknown argument '--epsiodes'"):
        configuration(commands_of("run")[0], ["--task", "lift", "--epsiodes", "3"], capsys)


def test_relative_links_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            assert re.match(r"\w+:", target) or (page.parent / target).exists(), f"{page.relative_to(ROOT)}: {target}"


def test_every_selector_and_task_is_described() -> None:
    selectors, tasks = (ROOT / "docs" / "selectors.md").read_text(), (ROOT / "docs" / "tasks.md").read_text()
    assert [name for name in selector_locations() if f"`{name}" not in selectors] == []
    assert [name for name in content.files("tasks") if f"`{name}`" not in tasks] == []


def test_known_names_of_task_files_are_those_of_the_page() -> None:
    from osel_sim.formats import terms

    page = (ROOT / "docs" / "tasks.md").read_text()
    assert [name for name in terms.KINDS if f"`{name}`" not in page] == []


def test_every_exit_code_is_described() -> None:
    from osel_sim.cli import command

    page = (ROOT / "docs" / "ci.md").read_text()
    for code in (0, 1, command.USAGE, command.INTERRUPTED, command.BROKEN_PIPE):
        assert f"\n| {code} |" in page


def test_presets_are_those_of_the_page() -> None:
    from osel_sim.selection.reward import PRESETS

    page = (ROOT / "docs" / "concepts.md").read_text()
    for name, weights in PRESETS.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}`"))
        unit = weights.time_unit.replace("-", " ")
        assert row.endswith(f"| {weights.alpha_time:g} | {weights.alpha_price:g} | {weights.success} | {unit} |")
