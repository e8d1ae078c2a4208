"""Comparing policies: pairing, what is claimed of it, what is written, and what CI is told."""

import importlib.util
import json
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from report_helpers import FAR, made_run
from synthetic_log import make_row

import osel_sim as osel
from osel_sim.__main__ import main
from osel_sim.analysis.comparison import _verdict
from osel_sim.analysis.pairing import Contender, Pairs
from osel_sim.core.errors import DataError, SettingError, UnknownNameError, UsageError
from osel_sim.formats.rollout_log import Row, write_rollouts

ROOT = Path(__file__).resolve().parent.parent


def rows_of(policy: str, successes: Iterable[object], task: str = "lift", first: int = 0, repeat: int = 0, **values) -> list[Row]:
    return [
        make_row(f"{task}/test/0/{seed}", policy, repeat, bool(success), task=task, seed=seed, level=0, **values)
        for seed, success in enumerate(successes, first)
    ]


def log_of(folder: Path, rows: list[Row], **metadata) -> Path:
    folder.mkdir(parents=True)
    write_rollouts(folder, rows, metadata)
    return folder


def pattern(both: int, lost: int, gained: int, neither: int) -> tuple[list[bool], list[bool]]:
    """Successes of two policies on as many instances of each kind."""
    first = [True] * (both + lost) + [False] * (gained + neither)
    second = [True] * both + [False] * lost + [True] * gained + [False] * neither
    return first, second


def two_logs(tmp_path: Path, both: int, lost: int, gained: int, neither: int) -> list[Path]:
    before, after = pattern(both, lost, gained, neither)
    return [log_of(tmp_path / "before", rows_of("mine", before)), log_of(tmp_path / "after", rows_of("mine", after))]


@pytest.mark.parametrize(
    ("cells", "decision", "code"),
    [
        ((60, 2, 20, 18), "better", 0),
        ((60, 20, 2, 18), "worse", 1),
        ((200, 3, 3, 94), "no worse", 0),
        ((20, 4, 4, 12), "not enough data", 3),
        ((4, 0, 5, 0), "not enough data", 3),  # a p of .03, of nine instances
        ((900, 16, 3, 81), "no worse", 0),  # told apart, and within the margin
    ],
)
def test_the_verdict_and_what_ci_is_told(tmp_path, capsys, cells, decision, code):
    logs = two_logs(tmp_path, *cells)
    out = tmp_path / "out"
    assert main(["compare", *map(str, logs), "--out", str(out)]) == code
    result = json.loads((out / "compare.json").read_text())
    assert result["verdict"]["decision"] == decision and result["verdict"]["exit_code"] == code
    (entry,) = result["pairs"]
    assert entry["first"] == f"mine@{logs[0]}" and entry["test"]["method"] == "exact McNemar, mid-p"
    assert (entry["test"]["gained"], entry["test"]["lost"], len(entry["flips"])) == (cells[2], cells[1], cells[1] + cells[2])
    assert entry["differences"]["success"]["difference"] == pytest.approx((cells[2] - cells[1]) / sum(cells))
    assert (entry["verdict"]["more"] is not None) == (decision == "not enough data")
    shown = " ".join(capsys.readouterr().out.split())
    assert " ".join(result["verdict"]["text"].split()) in shown
    assert ("more instances would tell" in shown) == (decision == "not enough data") == ("--plan" in shown)


def test_a_wider_margin_forgives_and_equal_policies_cannot_be_told_with_none(tmp_path):
    logs = two_logs(tmp_path, 60, 20, 2, 18)
    assert osel.compare(*logs, margin=0.3).decision == "no worse"
    same = two_logs(tmp_path / "same", 10, 5, 5, 10)
    assert "no number of instances" in osel.compare(*same, margin=0.0).verdict


def test_what_has_no_counterpart_and_what_ended_in_error_is_left_out_and_counted(tmp_path):
    first, second = pattern(30, 2, 2, 6)
    broken = rows_of("mine", [False] * 3, first=40, error="the arm fell off")
    one = log_of(tmp_path / "one", rows_of("mine", first) + rows_of("mine", [True] * 8, first=40))
    other = log_of(tmp_path / "other", rows_of("mine", second) + broken)
    (entry,) = osel.compare(one, other).result["pairs"]
    assert (entry["instances"], entry["unpaired"], entry["errors"]) == (40, {"first": 8, "second": 0}, {"first": 0, "second": 3})
    assert entry["differences"]["success"]["first"] == pytest.approx(32 / 40)


def test_repeats_are_one_instance(tmp_path):
    generator = np.random.default_rng(0)
    rates = generator.random(40)
    rows = [row for repeat in range(5) for policy in ("one", "other") for row in rows_of(policy, generator.random(40) < rates, repeat=repeat)]
    (entry,) = osel.compare(log_of(tmp_path / "log", rows)).result["pairs"]
    assert (entry["instances"], entry["pairs_of_repeats"]) == (40, 200)
    assert "sign flips" in entry["test"]["method"]
    means = [np.mean([row.success for row in rows if row.policy == name]) for name in ("one", "other")]
    assert entry["differences"]["success"]["difference"] == pytest.approx(means[1] - means[0])


def test_nothing_is_claimed_of_what_cannot_be_paired(tmp_path):
    one = log_of(tmp_path / "one", rows_of("a", [True] * 20))
    other = log_of(tmp_path / "other", rows_of("b", [False] * 20, first=20))
    with pytest.raises(DataError, match=r"no instance in common.*a has 20, such as 'lift/test/0/0'; b has 20, such as 'lift/test/0/20'"):
        osel.compare(one, other)


@pytest.mark.parametrize(
    ("values", "metadata", "message"),
    [
        ({"instruction": "do something else"}, {}, r"instance 'lift/test/0/0' is not the same.*instruction is 'do it'.*'do something else'"),
        ({"target": "can"}, {}, "its target is '' in .*one, 'can' in .*other"),
        ({}, {"content": {"task lift": "2"}}, "task lift is another file in .*other"),
        ({}, {"action_noise": 0.1}, "action_noise is 0.0 in .*one and 0.1"),
    ],
)
def test_logs_that_are_not_of_the_same_scenes_are_refused_by_name(tmp_path, values, metadata, message):
    plain = {"content": {"task lift": "1"}, "action_noise": 0.0}
    one = log_of(tmp_path / "one", rows_of("a", [True] * 20), **plain)
    other = log_of(tmp_path / "other", rows_of("b", [False] * 20, **values), **plain | metadata)
    with pytest.raises(DataError, match=message):
        osel.compare(one, other)


def test_pairs_of_other_scenes_are_refused_by_name_and_unknown_ones_said(tmp_path):
    def scenes(rows: list[Row], changed: range = range(0), known: range = range(20)) -> list[Row]:
        return [replace(row, scene=f"{row.seed}{'!' if row.seed in changed else ''}" if row.seed in known else None) for row in rows]

    first, second = rows_of("a", [True] * 20), rows_of("b", [False] * 20)
    one = log_of(tmp_path / "one", scenes(first))
    for name, changed, message in (("some", range(3, 6), ", nor are 2 others of 20: "), ("single", range(3, 4), ": assets")):
        other = log_of(tmp_path / name, scenes(second, changed))
        with pytest.raises(DataError, match=f"'lift/test/0/3' is not the same scene in .*one and in .*{name}{message}"):
            osel.compare(one, other)
    same = osel.compare(one, log_of(tmp_path / "same", scenes(second)), markdown=tmp_path / "same.md")
    assert same.result["pairs"][0]["same_scene"] == 20 and "key alone" not in (tmp_path / "same.md").read_text()
    half = osel.compare(one, log_of(tmp_path / "half", scenes(second, known=range(15))), markdown=tmp_path / "half.md")
    assert half.result["pairs"][0]["same_scene"] == 15 and "tell the scenes of 5 of them" in (tmp_path / "half.md").read_text()
    osel.compare(one, log_of(tmp_path / "old", second), markdown=tmp_path / "old.md")
    assert "Paired by key alone" in (tmp_path / "old.md").read_text()


def test_live_runs_are_compared_by_what_they_chose_and_by_all_outcomes(tmp_path):
    whole, chosen = made_run(tmp_path / "whole"), made_run(tmp_path / "chosen", counterfactual=False)
    found = osel.compare(whole)
    (entry,) = found.result["pairs"]
    assert (entry["instances"], sum(entry["errors"].values()), sum(entry["unpaired"].values())) == (39, 1, 1)
    assert found.result["reward"]["alpha_time"] == 0.1, "the run's own weights"
    assert osel.compare(whole, preset="mmlu").result["reward"]["alpha_time"] == 0.03
    same = osel.compare(whole, chosen, policies=FAR)
    (entry,) = same.result["pairs"]
    assert (same.result["policies"][1]["name"], entry["flips"], entry["test"]["p"]) == (f"{FAR}@{chosen}", [], 1.0)
    assert entry["unpaired"]["first"] > 0 == entry["unpaired"]["second"] and entry["instances"] < 39
    with pytest.raises(DataError, match="no instance in common"):
        osel.compare(chosen)
    other = chosen / "episodes.jsonl"
    lines = [json.loads(line) for line in other.read_text().splitlines()]
    for name, folder in (("here", whole), ("there", chosen)):
        (folder / "episodes.jsonl").write_text("".join(json.dumps(line | {"scene": f"{name}{line['index']}"}) + "\r\n" for line in lines))
    with pytest.raises(DataError, match=r"is not the same scene in .*whole and in .*chosen"):
        osel.compare(whole, chosen, policies=FAR)


def test_logs_of_nothing_but_errors_of_other_levels_or_of_other_robots_are_not_compared(tmp_path):
    right = log_of(tmp_path / "right", rows_of("a", [True] * 20))
    for name, rows in (
        ("errors", rows_of("b", [False] * 20, error="the arm fell off")),
        ("level", [replace(row, instance=row.instance.replace("/0/", "/2/", 1), level=2) for row in rows_of("b", [True] * 20)]),
        ("robot", [replace(row, instance=f"{row.instance}-UR5e", robot="UR5e") for row in rows_of("b", [True] * 20)]),
    ):
        with pytest.raises(DataError, match="no instance in common on which both have an outcome"):
            osel.compare(right, log_of(tmp_path / name, rows))
    copy = log_of(tmp_path / "copy", rows_of("a", [True] * 20))
    found = osel.compare(right, copy)
    assert found.decision == "not enough data" and found.result["pairs"][0]["flips"] == []
    (tmp_path / "link").symlink_to(right)
    with pytest.raises(UsageError, match="given twice"):
        osel.compare(right, tmp_path / "link")


def test_unequal_repeats_count_each_instance_once(tmp_path):
    often = [row for repeat in range(7) for row in rows_of("a", [seed % 2 for seed in range(40)], repeat=repeat)]
    broken = rows_of("b", [False] * 40, repeat=1, error="lost")
    (entry,) = osel.compare(log_of(tmp_path / "log", often + rows_of("b", [True] * 40) + broken)).result["pairs"]
    assert (entry["instances"], entry["pairs_of_repeats"], entry["errors"]["second"]) == (40, 40, 40)
    assert entry["differences"]["success"]["difference"] == pytest.approx(0.5)
    assert (entry["test"]["gained"], entry["test"]["lost"]) == (20, 0)


def test_a_task_that_got_worse_is_named_though_the_whole_did_not(tmp_path):
    first, second = pattern(100, 0, 0, 0), pattern(10, 20, 0, 0)
    rows = [
        row
        for column, policy in enumerate(("before", "after"))
        for row in rows_of(policy, first[column]) + rows_of(policy, second[column], task="door") + rows_of(policy, [column] * 30, task="push")
    ]
    found = osel.compare(log_of(tmp_path / "log", rows), policies=["before", "after"], markdown=tmp_path / "out.md")
    tasks = found.tasks.set_index("task")
    assert (tasks.decision["door"], tasks.decision["push"], tasks.decision["lift"]) == ("worse", "better", None)
    assert tasks.p_holm["door"] == pytest.approx(2 * tasks.p["door"], rel=0.6)
    assert found.decision == "better" or "no worse" in found.decision
    assert "Yet after is worse on door." in (tmp_path / "out.md").read_text()


def test_all_pairs_of_several_and_their_letters(tmp_path):
    generator = np.random.default_rng(1)
    rows = [row for name, rate in (("a", 0.5), ("b", 0.9), ("c", 0.5), ("d", 0.1)) for row in rows_of(name, generator.random(200) < rate)]
    found = osel.compare(log_of(tmp_path / "log", rows))
    assert len(found.result["pairs"]) == 6
    letters = found.result["letters"]
    assert next(iter(letters)) == "b" and letters["b"] == "a" and letters["a"] == letters["c"] == "b" and letters["d"] == "c"
    assert (found.decision, found.exit_code) == ("worse", 1)
    assert all(entry["test"]["p_holm"] >= entry["test"]["p"] for entry in found.result["pairs"])
    assert set(found.differences.measure) == {"success", "subgoals", "reward", "steps", "seconds", "price"}
    assert list(osel.compare(log_of(tmp_path / "more", rows), policies=["d", "b"]).flips.columns)[:3] == ["first", "second", "instance"]


@pytest.mark.parametrize(("cells", "kind"), [((60, 20, 2, 18), "failure"), ((20, 4, 4, 12), "skipped"), ((60, 2, 20, 18), None)])
def test_junit_says_what_the_exit_code_says(tmp_path, cells, kind):
    osel.compare(*two_logs(tmp_path, *cells), junit=tmp_path / "new" / "out.xml")
    root = ElementTree.fromstring((tmp_path / "new" / "out.xml").read_text())
    (case,) = root.iter("testcase")
    assert [child.tag for child in case if child.tag != "system-out"] == ([kind] if kind else [])
    (suite,) = root
    assert (root.tag, suite.tag) == ("testsuites", "testsuite") and suite.attrib["name"] == case.attrib["classname"] == "osel_sim.compare"
    assert root.attrib["failures"] == suite.attrib["failures"] == str(int(kind == "failure")) and suite.attrib["skipped"] == str(
        int(kind == "skipped")
    )
    assert {"tests", "errors", "time"} <= suite.attrib.keys() and {"name", "time"} <= case.attrib.keys()
    if kind:
        assert case[0].attrib["message"] == case[0].text and "points of success" in str(case[0].text)


NAMES = (
    "a|b<script>alert(1)</script>",
    "c\x1b[31m*d*",
    "@somebody and #12",
    "- [x](http://evil.example/?q=1)",
    "two\nlines  of `it` \\",
    "$x_1$ &amp; \uffff",
)


def test_names_of_others_are_neither_markup_nor_control_characters(tmp_path):
    from markdown_it import MarkdownIt

    odd = "a|<b>\nc"
    rows = [row for name in NAMES for row in rows_of(name, [True] * 20) + rows_of(name, [name == NAMES[0]] * 20, task=odd)]
    rows = [replace(row, instance=f"{odd}{row.seed}", seed=None, level=None, split=None) if row.task == odd else row for row in rows]
    result = osel.compare(log_of(tmp_path / "log", rows), markdown=tmp_path / "out.md", junit=tmp_path / "out.xml", out=tmp_path / "out").result
    text = (tmp_path / "out.md").read_text()
    assert "\x1b" not in text
    html = MarkdownIt("commonmark").enable("table").render(text)
    for markup in ("<script", "<em>", "<code>", "<a ", "<li>", "<h1>", "<b>", "<img"):
        assert markup not in html, markup
    assert html.count("<table>") == text.count("| --- |\n") and html.count("<strong>") == 1
    for table in html.split("<table>")[1:]:
        lines = [line.count("<td") + line.count("<th") for line in table.split("</table>")[0].split("<tr>")[1:]]
        assert len(set(lines)) == 1, "every row has as many cells as the headings"
    for mention in ("@somebody", "#12", "http://evil"):
        assert mention not in html
    cases = list(ElementTree.fromstring((tmp_path / "out.xml").read_bytes()).iter("testcase"))
    assert len(cases) == len(NAMES) - 1 and "<script>" in cases[0].attrib["name"]
    assert len(result["pairs"]) == 15
    page = (tmp_path / "out" / "report.html").read_text()
    assert "alert(1)</script>" not in page and "\x1b" not in page


def test_a_page_shows_the_comparison_and_a_damaged_one_is_refused(tmp_path, capsys):
    generator = np.random.default_rng(3)
    rows = [
        row
        for name, rate in (("a", 0.5), ("b", 0.9), ("c", 0.5))
        for task in ("lift", "push")
        for row in rows_of(name, generator.random(60) < rate, task=task)
    ]
    out = tmp_path / "out"
    found = osel.compare(log_of(tmp_path / "log", rows), out=out)
    assert found.page == out / "report.html"
    page = found.page.read_text()
    assert "points of success" in page and "Who was told apart" in page
    assert sorted(file.stem for file in (out / "tables").iterdir()) == ["differences", "flips", "letters", "means", "pairs", "tasks"]
    written = {file: file.read_bytes() for file in out.rglob("*.*") if file.suffix != ".json"}
    assert main(["report", str(out)]) == 0
    assert written == {file: file.read_bytes() for file in written}, "the same page of what was written"
    right = json.loads((out / "compare.json").read_text())
    for keys, value, message in (
        (("schema_version",), 2, "schema_version must be 1, got 2"),
        (("schema_version",), True, "schema_version must be 1, got True"),
        (("pairs", 0, "instances"), "120", "pairs.0.instances: Input should be a valid integer"),
        (("pairs", 0, "instances"), 0, "pairs.0.instances: .*greater than or equal to 1"),
        (("pairs", 1, "verdict", "decision"), "fine", "pairs.1.verdict.decision: .*'better', 'worse'"),
        (("pairs", 0, "differences", "success", "ci95"), [1.0, 0.0], "pairs.0.differences.success: the ends of an interval"),
        (("pairs", 0, "differences", "luck"), {}, "pairs.0.differences.luck"),
        (("pairs", 0, "flips"), [], "pairs.0: flips must be the"),
        (("pairs", 0, "test", "p"), float("nan"), "pairs.0.test.p"),
        (("pairs",), [], "pairs must be all pairs"),
        (("letters",), None, "letters are those of three policies or more"),
        (("verdict", "exit_code"), 0, "exit_code must be the decision's"),
        (("more",), 1, "more: Extra inputs"),
    ):
        data = json.loads(json.dumps(right))
        place = data
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        (out / "compare.json").write_text(json.dumps(data).replace("\n", "\r\n"))
        with pytest.raises(DataError, match=f"compare.json.*{message}"):
            osel.report(out)
    (out / "compare.json").write_text(json.dumps({"schema_version": 1, "plan": []}))
    with pytest.raises(DataError, match="is a plan, which compares nothing"):
        osel.report(out)
    (out / "compare.json").write_text(json.dumps(right, indent=1).replace("\n", "\r\n"))
    assert osel.report(out).page.is_file()
    with pytest.raises(SettingError, match="is no rollout log"):
        osel.report(out, encoder="x")
    with pytest.raises(UsageError, match="--open shows the page"):
        osel.compare(tmp_path / "log", open=True)


def test_a_pipe_is_written_into_and_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    logs = two_logs(tmp_path, 10, 5, 5, 10)
    with ThreadPoolExecutor(1) as pool:
        told = pool.submit((tmp_path / "pipe").read_text)
        osel.compare(*logs, markdown=tmp_path / "pipe")
        assert "points of success" in told.result(30)
    assert (tmp_path / "pipe").is_fifo()


def test_a_plan_says_how_many_instances_it_takes(tmp_path, capsys):
    logs = two_logs(tmp_path, 40, 10, 10, 40)
    assert main(["compare", *map(str, logs), "--plan", "--detect", "0.1"]) == 0
    assert "more than the log has" in " ".join(capsys.readouterr().out.split())
    fine, coarse = (int(osel.compare(*logs, plan=True, detect=detect).plan.needed[0]) for detect in (0.05, 0.1))
    assert 3.5 < fine / coarse < 4.5 and 150 < coarse < 180  # a fifth of the pairs are discordant
    with pytest.raises(UsageError, match="--plan compares nothing"):
        osel.compare(*logs, plan=True, junit=tmp_path / "x.xml")


def test_tables_of_others_are_compared(tmp_path):
    first, second = pattern(20, 6, 1, 20)
    table = tmp_path / "evals.csv"
    lines = [
        f"q{row},question {row},{model},{int(score)}" for model, column in (("small", first), ("large", second)) for row, score in enumerate(column)
    ]
    table.write_text("\n".join(["id,prompt,model,correct", *lines]) + "\n")
    osel.ingest(files=[str(table)], out=tmp_path / "log", key="id", text="prompt", policy_column="model", success="correct")
    found = osel.compare(tmp_path / "log", policies=["small", "large"])
    (entry,) = found.result["pairs"]
    assert (entry["instances"], entry["test"]["gained"], entry["test"]["lost"]) == (47, 1, 6)
    assert "reward" in entry["missing"] and "reward" not in entry["differences"]


def test_wrong_settings_are_named(tmp_path):
    (one, other) = two_logs(tmp_path, 5, 5, 5, 5)
    both = log_of(tmp_path / "both", rows_of("mine", [True] * 10) + rows_of("yours", [True] * 10))
    for call, kind, message in (
        (lambda: osel.compare(one), UsageError, "one policy, mine, is compared with nothing"),
        (lambda: osel.compare(one, one), UsageError, "given twice"),
        (lambda: osel.compare(one, one / ".." / one.name), UsageError, "mine of .* is given twice"),
        (lambda: osel.compare(one, other, detect=0.1), UsageError, "--detect is what --plan plans for"),
        (lambda: osel.compare(one, both), UsageError, "both has several policies, mine, yours: name one with --policies"),
        (lambda: osel.compare(one, other, policies=["a", "b", "c"]), UsageError, "2 logs need one name for all, or one each"),
        (lambda: osel.compare(one, other, policies="mime"), UnknownNameError, "did you mean 'mine'"),
        (lambda: osel.compare(one, tmp_path / "none"), SettingError, "there is no folder"),
        (lambda: osel.compare(), SettingError, "logs"),
        (lambda: osel.compare(one, other, margin=2), SettingError, r"margin: must lie in \[0.0, 1.0\]"),
        (lambda: osel.compare(one, other, detect=0.0, plan=True), SettingError, "detect: must lie in"),
        (lambda: osel.compare(one, other, out=one), UsageError, "is not empty"),
        (lambda: osel.compare(one, other, junit=tmp_path), UsageError, "--junit .* is a folder"),
    ):
        with pytest.raises(kind, match=message):
            call()
    osel.compare(one, other, out=tmp_path / "out")
    with pytest.raises(UsageError, match="add --overwrite"):
        osel.compare(one, other, out=tmp_path / "out")
    assert osel.compare(one, other, out=tmp_path / "out", overwrite=True).file == tmp_path / "out" / "compare.json"


def made_up(generator: np.random.Generator, pairs: int, gained: float, lost: float) -> Pairs:
    cells = generator.choice(4, size=pairs, p=[0.5, gained, lost, 0.5 - gained - lost])
    values = [{"success": np.isin(cells, kinds).astype(float)} for kinds in ((0, 2), (0, 1))]
    contenders = [Contender(name, name, None) for name in ("before", "after")]
    return Pairs(*contenders, ("",) * pairs, ("",) * pairs, *values, pairs, 0, 0, (0, 0), {})


def test_claims_are_wrong_as_rarely_as_promised():
    from osel_sim.analysis.comparison import _probability

    def decisions(pairs: int, gained: float, lost: float, comparisons: int = 500) -> dict[str, float]:
        generator = np.random.default_rng([pairs, int(1000 * lost)])
        found = []
        for _ in range(comparisons):
            sample = made_up(generator, pairs, gained, lost)
            found.append(_verdict(sample, _probability(sample), 1, 0.05, 0.8)["decision"])
        return {name: found.count(name) / comparisons for name in ("better", "worse", "no worse", "not enough data")}

    slack = 2 * np.sqrt(0.025 * 0.975 / 500)
    for pairs in (25, 100, 400):
        equal = decisions(pairs, 0.1, 0.1)
        assert equal["better"] <= 0.025 + slack and equal["worse"] <= 0.025 + slack
        at_margin = decisions(pairs, 0.075, 0.125)  # 5 points lower, as the margin says
        assert at_margin["better"] + at_margin["no worse"] <= 0.025 + slack
    assert decisions(1000, 0.05, 0.15)["worse"] > 0.95 and decisions(1000, 0.1, 0.1)["no worse"] > 0.85


def test_the_benchmark_of_claims_finds_them_true():
    spec = importlib.util.spec_from_file_location("benchmark_of_compare", ROOT / "benchmarks" / "compare.py")
    benchmark = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = benchmark
    spec.loader.exec_module(benchmark)
    for name, kind in benchmark.KINDS.items():
        for size in (10, 50, 200):
            found = benchmark.simulate(kind, size, 1, 120)
            assert found["wrong"] <= (0.025 if "margin" in name else 0.05) + 0.035, (name, size, found)
            assert found["coverage"] >= 0.90, (name, size, found)
        assert benchmark.sequential(kind, 100, 100)["wrong"] <= 0.05, name
    assert benchmark.simulate(benchmark.KINDS["worse"], 200, 1, 50)["worse"] > 0.9
    assert benchmark.simulate(benchmark.noisy(benchmark.KINDS["equal"]), 20, 3, 20)["wrong"] <= 0.2


def test_the_instances_that_would_tell_mostly_do():
    generator = np.random.default_rng(4)
    from osel_sim.analysis.comparison import _probability

    told = 0
    for _ in range(200):
        more = _verdict(made_up(generator, 60, 0.05, 0.15), 1.0, 1, 0.02, 0.8)["more"] or 0
        sample = made_up(generator, 60 + min(more, 400), 0.05, 0.15)
        told += _verdict(sample, _probability(sample), 1, 0.02, 0.8)["decision"] != "not enough data"
    assert told / 200 > 0.7
