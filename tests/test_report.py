"""The report as files: one page, figures as PNG and SVG, tables as CSV; words from logs stay words."""

import base64
import csv
import io
import json
import re
import shutil
import sys
from dataclasses import replace
from urllib.parse import unquote

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from report_helpers import EVIL, FAR, NEAR, WEIGHTS, made_log, made_replay, made_run
from synthetic_log import make_row, write_log

from osel_sim.analysis.estimate import Estimate, mean_of, rate_of
from osel_sim.analysis.log import read_log
from osel_sim.core.errors import UsageError
from osel_sim.episodes.tensorboard import check_installed
from osel_sim.formats.rollout_log import read_rollouts, write_rollouts
from osel_sim.report import main as report_main
from osel_sim.reporting import episodes
from osel_sim.reporting.description import DARK, LIGHT, Bars, Column, Figure, Heat, Line, Panel, Points, Table, colours, thinned
from osel_sim.reporting.episodes import MOST_EPISODES, list_episodes
from osel_sim.reporting.html_tables import to_csv, to_text
from osel_sim.reporting.log_page import log_facts
from osel_sim.reporting.log_sections import context_figure, policy_blocks, time_figure
from osel_sim.reporting.matplotlib_figures import to_images
from osel_sim.reporting.plotly_figures import to_plotly
from osel_sim.reporting.selector_sections import MAIN, style_of


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return made_log(tmp_path_factory.mktemp("log"))


@pytest.fixture(scope="module")
def page_of_log(log, tmp_path_factory):
    """The folder with the report of the log."""
    folder = tmp_path_factory.mktemp("page")
    assert report_main([str(log.source), "--out", str(folder), "--alpha-time", "0.1", "--alpha-price", "0.01"]) == 0
    return folder


def embedded(page: str) -> dict:
    """The JSON of a page."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)[1])


def without_plotly(page: str) -> str:
    """The page before its scripts."""
    return page[: page.index('<script type="application/json"')]


def test_page_of_a_log(page_of_log):
    folder, page = page_of_log, (page_of_log / "report.html").read_text()
    data = embedded(page)
    for ending in ("png", "svg"):
        assert {file.stem for file in (folder / "figures").glob(f"*.{ending}")} == set(data["figures"])
    assert {"policies_by_task", "policies_by_target", "weights_map", "frontier", "clusters", "contexts", "times"} == set(data["figures"])
    tables = {file.stem for file in (folder / "tables").glob("*.csv")}
    assert tables == {"policies", "policies_by_target", "outcome_rates", "clusters", "inequality", "trivial_weights"}
    assert len(data["episodes"]["episodes"]["policy"]) == 240
    assert "There is something to route by" in page
    assert not list(folder.rglob("*.partial"))
    assert len(page) < 8_000_000


def test_robots_are_told_apart_where_there_are_several(log, tmp_path):
    rows, metadata = read_rollouts(log.source)
    assert "robots" not in dict(log_facts(log, WEIGHTS)) and not any(log.labels("robot"))
    shutil.copy(log.source / "contexts.npz", tmp_path)
    write_rollouts(tmp_path, [replace(row, robot="UR5e") if row.seed % 3 == 1 else row for row in rows], metadata)
    mixed = read_log(tmp_path)
    blocks = {block.name: block for block in policy_blocks(mixed, WEIGHTS)}
    assert "policies_by_robot" in blocks and "policies_by_robot" not in {block.name for block in policy_blocks(log, WEIGHTS)}
    assert ("robots", "Panda, UR5e") in log_facts(mixed, WEIGHTS)
    told = list_episodes(mixed, WEIGHTS).data["instances"]
    assert [item["robot"] for item in told[:3]] == ["Panda", "UR5e", "Panda"]
    assert all("robot" not in item for item in list_episodes(log, WEIGHTS).data["instances"])


def test_words_from_a_log_stay_words(page_of_log):
    page = (page_of_log / "report.html").read_text()
    body, data = without_plotly(page), embedded(page)
    assert EVIL in [instance["instruction"] for instance in data["episodes"]["instances"]]
    assert "window.pwned" not in body
    assert FAR not in body and "far&lt;i&gt;" in body
    assert page.count("</script>") == 3 + page.count("<\\/script>")  # data, plotly, own: no word ends one early
    assert not re.search(r'(?:src|href)="(?!#)', body)  # nothing is fetched


def test_page_of_a_replay(log, tmp_path):
    folder = made_replay(tmp_path, log)
    assert report_main([str(folder)]) == 0
    page = (folder / "report.html").read_text()
    data = embedded(page)
    assert {"curves", "regret", "gap_closed", "success_against_penalty", "choices", "frontier"} <= set(data["figures"])
    result = json.loads((folder / "replay.json").read_text())
    with (folder / "tables" / "selectors.csv").open() as handle:
        rows = {row["selector"]: row for row in csv.DictReader(handle)}
    assert float(rows["ppo"]["reward"]) == result["selectors"]["ppo"]["mean_reward"]
    assert set(rows) == {"ppo", "random", f"always {NEAR} (worst single)", f"always {FAR} (best single)"}
    curve = next(trace for trace in data["figures"]["curves"]["panels"][0]["data"] if trace["name"] == "ppo" and trace.get("showlegend", True))
    assert curve["y"][-1] == pytest.approx(result["selectors"]["ppo"]["mean_reward"], abs=1e-4)
    panels = data["figures"]["frontier"]["panels"]
    lines = [next(trace for trace in panel["data"] if trace["name"] == "ppo" and trace["mode"] == "lines+markers") for panel in panels]
    assert [line["y"] for line in lines] == [[90.0, 80.0, None], [70.0, 60.0, 50.0]] and lines[0]["x"] == [5.0, 4.0, None]
    assert set(data["episodes"]["picks"]) == {"ppo"}
    headline = "Route with ppo" if result["verdict"]["decision"] == "route" else "Do not route: always use far&lt;i&gt;"
    assert headline in page


def test_a_replay_whose_log_has_moved(log, tmp_path, capsys):
    folder = made_replay(tmp_path / "replay", log)
    result = json.loads((folder / "replay.json").read_text())
    result["log"]["folder"] = str(tmp_path / "gone")
    (folder / "replay.json").write_text(json.dumps(result))
    assert report_main([str(folder)]) == 2
    assert "give its folder with --log" in capsys.readouterr().err
    other = made_log(tmp_path / "other", instances=30)
    assert report_main([str(folder), "--log", str(other.source)]) == 2
    assert "are not in this log" in capsys.readouterr().err
    assert not (folder / "report.html").exists()
    assert report_main([str(folder), "--log", str(log.source)]) == 0
    assert (folder / "report.html").exists()


def test_page_of_a_live_run(tmp_path):
    folder = made_run(tmp_path)
    assert report_main([str(folder)]) == 0
    page = (folder / "report.html").read_text()
    data = embedded(page)
    assert {"curves", "regret", "success_against_penalty", "choices", "propensities", "times"} <= set(data["figures"])
    columns = data["episodes"]["episodes"]
    assert sum(columns["chosen"]) == 40 and len(columns["policy"]) == 80
    assert [text for text in columns["error"] if text] == ["the server died <b>"]
    with (folder / "tables" / "chosen.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert [row["who"] for row in rows] == ["ppo", f"chose {NEAR}", f"chose {FAR}"]
    assert rows[0]["errors"] == "1"
    with (folder / "tables" / "off_policy.csv").open() as handle:
        assert [row["who"] for row in csv.DictReader(handle)] == ["ppo (as it was)", f"always {NEAR}", f"always {FAR}", "random", "greedy"]


def test_page_of_a_run_that_knows_only_what_was_chosen(tmp_path):
    folder = made_run(tmp_path, decisions=5, counterfactual=False)
    assert report_main([str(folder)]) == 0
    page = (folder / "report.html").read_text()
    assert "run with --counterfactual to compare" in page
    assert "regret" not in embedded(page)["figures"]


def test_videos_are_put_into_the_page_or_linked_from_it(tmp_path, monkeypatch):
    folder = made_run(tmp_path / "run", decisions=3)
    chosen = json.loads((folder / "episodes.jsonl").read_text().splitlines()[1])["policy"]
    film = folder / "videos" / f"00001-{chosen}.mp4"
    film.parent.mkdir()
    writer = imageio_ffmpeg.write_frames(str(film), (32, 32), fps=10)
    writer.send(None)
    for shade in range(8):
        writer.send(np.full((32, 32, 3), 20 * shade, np.uint8))
    writer.close()
    assert report_main([str(folder)]) == 0
    (video,) = embedded((folder / "report.html").read_text())["episodes"]["videos"].values()
    assert base64.b64decode(video["data"]) == film.read_bytes() and len(video["frames"]) == 5
    monkeypatch.setattr(episodes, "MOST_VIDEO_BYTES", 10)
    assert report_main([str(folder), "--out", str(tmp_path / "elsewhere")]) == 0
    (video,) = embedded((tmp_path / "elsewhere" / "report.html").read_text())["episodes"]["videos"].values()
    assert "data" not in video and (tmp_path / "elsewhere" / unquote(video["file"])).resolve() == film


def test_the_same_input_is_the_same_bytes(log, page_of_log, tmp_path, capsys):
    assert report_main([str(log.source), "--out", str(tmp_path), "--alpha-time", "0.1", "--alpha-price", "0.01"]) == 0
    assert str(tmp_path / "report.html") in capsys.readouterr().out
    files = {file.relative_to(page_of_log): file.read_bytes() for file in page_of_log.rglob("*") if file.is_file()}
    assert len(files) > 15
    for name, content in files.items():
        assert content == (tmp_path / name).read_bytes(), name


def test_wrong_folders_and_flags(tmp_path, capsys):
    assert report_main([str(tmp_path)]) == 2
    assert "holds neither episodes.jsonl (a live run), replay.json (a replay) nor rollouts.parquet" in capsys.readouterr().err
    folder = made_run(tmp_path / "run", decisions=3)
    assert report_main([str(folder), "--alpha-time", "1"]) == 2
    assert "--alpha-time" in capsys.readouterr().err
    assert not (folder / "report.html").exists()


def test_every_mark_is_drawn_both_ways():
    line = Line("a<b>", [1, 2, 3], [1.0, np.nan, 2.0], low=[0, np.nan, 1], high=[2, np.nan, 3], dash=True, steps=True)
    hidden = Line("hidden", [1, 2], [5.0, 6.0], shown=False)
    points = Points("p", [1.0], [2.0], texts=["<i>"], x_interval=([0.5], [1.5]), y_interval=([1.0], [3.0]), labelled=True)
    bars = Bars("bars", ["x $1", "y"], [1.0, 2.0], low=[0.5, 1.5], high=[1.5, 2.5])
    heat = Heat("heat", [1.0, 10.0], [1.0, 10.0], [[0.0, 1.0], [0.5, np.nan]], "diverging")
    panels = [
        Panel("lines", "x", "y", [line, hidden, points]),
        Panel("bars", "", "y", [bars], stacked=True),
        Panel("map", "x", "y", [heat], True, True),
    ]
    figure = Figure("all", "All $ marks", "", panels)
    images = to_images(figure)
    assert images["png"].startswith(b"\x89PNG") and b"<svg" in images["svg"]
    assert images == to_images(figure)
    drawn = to_plotly(figure)["panels"]
    json.dumps(drawn, allow_nan=False)
    assert drawn[0]["data"][1]["y"] == [1.0, None, 2.0]
    assert drawn[0]["data"][1]["name"] == "a&lt;b&gt;"
    assert drawn[0]["data"][2]["visible"] == "legendonly"
    assert drawn[1]["layout"]["barmode"] == "stack" and drawn[2]["layout"]["xaxis"]["type"] == "log"


def test_tables_as_text_and_csv():
    columns = [Column("who", "who", "text"), Column("rate", "rate", "percent"), Column("cost", "cost")]
    rows = [
        {"who": "a, b", "rate": Estimate(0.5, 0.4, 0.6), "cost": -1.23456},
        {"who": "c", "rate": None, "cost": float("nan")},
        {"who": "d", "rate": 0.25, "cost": 1234},
    ]
    table = Table("t", "T", "", columns, rows)
    assert [to_text(rows[0][column.key], column) for column in columns] == ["a, b", "50% [40, 60]", "\u22121.23"]
    assert [to_text(rows[1][column.key], column) for column in columns] == ["c", "–", "–"]
    assert to_text(1234, columns[2]) == "1,234"
    assert to_csv(table) == 'who,rate,rate_low,rate_high,cost\n"a, b",0.5,0.4,0.6,-1.23456\nc,,,,\nd,0.25,,,1234\n'
    with pytest.raises(UsageError, match="table t"):
        Table("t", "T", "", columns, [{"who": "a"}])


def test_estimates():
    assert mean_of([np.nan]) is None and rate_of(np.full((3, 2), np.nan)) is None
    once = rate_of(np.array([[1.0], [0.0], [1.0], [np.nan]]))
    assert once.value == pytest.approx(2 / 3) and once.low > 0.1  # Wilson
    # Repeats of one instance are no independent trials: the interval is that of the instances.
    repeated = rate_of(np.repeat([[1.0], [0.0], [1.0], [1.0]], 50, axis=1))
    assert repeated.value == 0.75 and repeated.high - repeated.low > 0.5


def test_thinned_keeps_ends_and_the_beginning():
    kept = thinned(10_000, 200)
    assert kept[0] == 0 and kept[-1] == 9_999 and len(kept) <= 200
    assert set(range(5)) <= set(kept.tolist())
    assert thinned(5).tolist() == [0, 1, 2, 3, 4]


def made_table(folder, groups, seed=None, **values):
    """A log from elsewhere: some groups of three instances each; `large` is better in all of them but the last two."""
    rows, contexts = [], {}
    for group in range(groups):
        for number in range(3):
            key = f"g{group:02d}/{number}"
            contexts[key] = np.eye(8)[group % 8] + 0.01 * number
            for policy in ("small", "large"):
                about = {"task": f"subject_{group:02d}", "seed": seed, "level": None, "split": None, "upload": None, "download": None, "motion": None}
                success = (policy == "large") == (group < groups - 2)
                rows.append(make_row(key, policy, success=success, **about, inference=0.4, price=0.04 if policy == "large" else 0.0, **values))
    return read_log(write_log(folder, rows, contexts))


def test_every_one_of_many_groups_has_a_row(tmp_path):
    (figure,) = [block for block in policy_blocks(made_table(tmp_path, 30), WEIGHTS) if isinstance(block, Figure)]
    for panel in figure.panels:
        assert len(panel.rows) == 31 and panel.rows[0] == "all"
        # What there is to route by comes first: the groups in which the best policy of all is behind.
        assert set(panel.rows[1:3]) == {"subject 28", "subject 29"}
        assert all(len(np.asarray(mark.y)) == 31 for mark in panel.marks)
    assert "in the first 2 of 30 groups it is behind" in figure.caption
    drawn = to_plotly(figure)["panels"][0]
    assert drawn["layout"]["yaxis"]["ticktext"] == list(figure.panels[0].rows) and drawn["layout"]["yaxis"]["range"] == [30.5, -0.5]
    few = made_table(tmp_path / "few", 5)
    assert all(isinstance(mark, Bars) for block in policy_blocks(few, WEIGHTS) if isinstance(block, Figure) for mark in block.panels[0].marks)


def test_a_cloud_of_many_groups_shows_the_largest_and_the_rest(tmp_path):
    panel = context_figure(made_table(tmp_path, 30), WEIGHTS).panels[0]
    assert [mark.colour for mark in panel.marks].count("muted") == 1
    assert panel.marks[0].name == "19 others" and len(panel.marks) == 12
    assert sum(len(np.asarray(mark.x)) for mark in panel.marks) == 90
    panel = context_figure(made_table(tmp_path / "fewer", 20), WEIGHTS).panels[0]
    assert len({(mark.colour, mark.symbol) for mark in panel.marks}) == 20


def test_images_grow_with_what_is_in_them():
    def height(panel):
        return Image.open(io.BytesIO(to_images(Figure("f", "F", "", [panel]))["png"])).height

    clouds = [Points(f"group {number}", [number], [1.0]) for number in range(60)]
    few, many = Panel("", "", "", clouds[:2], bare=True), Panel("", "", "", clouds, bare=True)
    assert height(many) > height(few) + 12 * 15  # twelve more lines of legend do not take the room of the plot
    short, long = (Panel("", "", "y", [Bars(who, [8 * name for name in "abcdefgh"], range(8)) for who in ("p", "q")]) for _ in range(2))
    long = Panel("", "", "y", [Bars(mark.name, [f"{name} and so on and on" for name in mark.categories], mark.y) for mark in long.marks])
    assert height(long) > height(short)
    assert height(Panel("", "", "", clouds[:2], rows=[str(row) for row in range(60)])) > 1.5 * height(few)


def test_seventeen_ways_of_choosing_have_a_colour_each():
    found = colours([str(number) for number in range(17)])
    for palette in (LIGHT, DARK):
        assert len({palette[name] for name in found.values()}) == 17
    assert LIGHT.keys() == DARK.keys()


def test_prices_show_three_digits_whatever_their_size():
    def texts(*values, digits=None):
        table = Table("t", "T", "", [Column("x", "x", digits=digits)], [{"x": value} for value in values])
        return [to_text(row["x"], table.columns[0]) for row in table.rows]

    assert texts(0.04, Estimate(0.1195, 0.1, 0.12), None) == ["0.040", "0.119 [0.100, 0.120]", "–"]
    assert texts(16.88, 0.454, 0.0) == ["16.9", "0.5", "0.0"]
    assert texts(1234.5) == ["1,234.5"] and texts(0.0) == ["0.0"] and texts(float("nan")) == ["–"]
    assert texts(0.04, digits=1) == ["0.0"]
    assert to_text(0.00071, Column("", "", digits=None)) == "0.000710"


def test_grades_are_shown_where_they_tell_more_than_success(tmp_path):
    def columns(log):
        table = policy_blocks(log, WEIGHTS)[0]
        return {column.key for column in table.columns}, list_episodes(log, WEIGHTS).data["episodes"]

    keys, data = columns(made_table(tmp_path / "plain", 4))
    assert not {"subgoals", "score"} & (keys | data.keys())
    keys, data = columns(made_table(tmp_path / "graded", 4, subgoals=0.75, score=-0.0123))
    assert {"subgoals", "score"} <= keys
    assert data["subgoals"][0] == 0.75 and data["score"][0] == -0.0123


def test_a_log_from_elsewhere_is_told_no_tales(tmp_path, log):
    other = made_table(tmp_path, 4)
    assert "virtual clock" in time_figure(log).caption and "without network" in time_figure(log).caption
    assert "virtual" not in time_figure(other).caption and "without network" not in time_figure(other).caption
    assert all(instance["drawable"] for instance in list_episodes(log, WEIGHTS).data["instances"])
    book = list_episodes(other, WEIGHTS).data
    assert not any("drawable" in instance for instance in book["instances"])
    assert book["digits"]["price"] == 4


def test_many_episodes_are_thinned_by_instance(tmp_path):
    log = made_log(tmp_path, instances=MOST_EPISODES // 2 + 100)
    book = list_episodes(log, WEIGHTS, scenes={1: b"picture"})
    assert len(book.data["episodes"]["policy"]) <= MOST_EPISODES + 2
    assert "of 2,100 instances" in book.note
    assert [instance["number"] for instance in book.data["instances"] if "scene" in instance] == [1]


def test_tensorboard_is_optional(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(UsageError, match=r"pip install 'osel-sim\[tensorboard\]'"):
        check_installed()


def test_selectors_shown_together_differ_in_colour():
    """More of them than there are colours, as in a replay of all; those shown are the first and the last."""
    names = [*MAIN[1:], *(f"other_{number}" for number in range(9)), MAIN[0]]
    style = style_of(names, ("one", "two", "three", "four"), {})
    shown = [style.colour[name] for name in names if name in style.shown]
    assert len(shown) == len(MAIN) == len(set(shown))
