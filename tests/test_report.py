"""The report as files: one page, figures as PNG and SVG, tables as CSV; words from logs stay words."""

import base64
import contextlib
import csv
import io
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from urllib.parse import unquote

import imageio_ffmpeg
import numpy as np
import pytest
import vl_convert
from PIL import Image
from report_helpers import EVIL, FAR, NEAR, WEIGHTS, made_log, made_replay, made_run
from synthetic_log import make_row, write_log

from osel_sim.analysis.estimate import Estimate, mean_of, rate_of
from osel_sim.analysis.log import read_log
from osel_sim.api.report import report
from osel_sim.cli.output import show_log
from osel_sim.core.errors import DataError, UsageError
from osel_sim.episodes.tensorboard import check_installed
from osel_sim.formats.rollout_log import read_rollouts, write_rollouts
from osel_sim.report import main as report_main
from osel_sim.reporting import episodes
from osel_sim.reporting.areas import DARKEST, Cell, heatmap, regions, shares, stacked
from osel_sim.reporting.charts import Figure, Look, numbers, to_images
from osel_sim.reporting.curves import Line, curves, thinned
from osel_sim.reporting.dots import Dot, Path, apart, certain, clouds, rows, scatter
from osel_sim.reporting.episodes import MOST_EPISODES, list_episodes
from osel_sim.reporting.html_tables import Column, Table, to_csv, to_text
from osel_sim.reporting.log_page import log_facts, log_page
from osel_sim.reporting.log_sections import context_figure, policy_blocks, time_figure
from osel_sim.reporting.page import write_page
from osel_sim.reporting.palette import DARK, LIGHT, colours
from osel_sim.reporting.replay_page import ReplayOptions, replay_curve, replay_page
from osel_sim.reporting.routes import Chosen, route_figure
from osel_sim.reporting.run_page import run_curve, run_page
from osel_sim.reporting.selector_sections import MAIN, look_of

SCHEMA = "https://vega.github.io/schema/vega-lite"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return made_log(tmp_path_factory.mktemp("log"))


@pytest.fixture(scope="module")
def page_of_log(log, tmp_path_factory):
    """The folder with the report of the log."""
    folder = tmp_path_factory.mktemp("page")
    assert report_main([str(log.source), "--out", str(folder), "--alpha-time", "0.1", "--alpha-price", "0.01"]) == 0
    return folder


@pytest.fixture(scope="module")
def all_pages(log, page_of_log, tmp_path_factory):
    """The pages of a log, a replay and a live run, each with the folder it was written into."""
    folder = tmp_path_factory.mktemp("pages")
    found = {"log": (log_page(log, WEIGHTS), page_of_log)}
    found["replay"] = replay_page(made_replay(folder / "replay", log), ReplayOptions()), folder / "replay"
    found["run"] = run_page(made_run(folder / "run")), folder / "run"
    for kind in ("replay", "run"):
        write_page(*found[kind])
    return found


def embedded(page: str) -> dict:
    """The JSON of a page."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)[1])


def without_scripts(page: str) -> str:
    """The page before its scripts."""
    return page[: page.index('<script type="application/json"')]


def layers(panel: dict) -> list[dict]:
    """A panel's layers."""
    return panel.get("layer", [panel])


def records(spec: dict, panel: dict) -> list[dict]:
    """All records that a panel draws from."""
    places = [layer.get("data", panel.get("data", spec.get("data"))) for layer in layers(panel)]
    return [record for name in dict.fromkeys(place["name"] for place in places) for record in spec["datasets"][name]]


def scales(spec: dict, channel: str = "color") -> list[dict[str, str]]:
    """Name -> what a channel shows it as, of each layer that has such a scale."""
    found = [layer["encoding"].get(channel, {}).get("scale") for panel in spec["concat"] for layer in layers(panel)]
    return [dict(zip(map(str, scale["domain"]), scale["range"], strict=True)) for scale in found if scale and "domain" in scale and "range" in scale]


def test_page_of_a_log(page_of_log):
    folder, page = page_of_log, (page_of_log / "report.html").read_text()
    data = embedded(page)
    for ending in ("png", "svg"):
        assert {file.stem for file in (folder / "figures").glob(f"*.{ending}")} == set(data["figures"])
    assert {"routes", "policies_by_task", "policies_by_target", "weights_map", "frontier", "clusters", "contexts", "times"} == set(data["figures"])
    tables = {file.stem for file in (folder / "tables").glob("*.csv")}
    assert tables == {"policies", "policies_by_target", "outcome_rates", "clusters", "inequality", "trivial_weights"}
    assert len(data["episodes"]["episodes"]["policy"]) == 240
    assert "Route with auto" in page and "% success at" in page and "a success is worth 100 cents" in page
    assert not list(folder.rglob("*.partial"))
    assert len(page) < 1_300_000


def test_robots_are_told_apart_where_there_are_several(log, tmp_path):
    rows, metadata = read_rollouts(log.source)
    assert "robots" not in dict(log_facts(log, WEIGHTS)) and not any(log.labels("robot"))
    shutil.copy(log.source / "contexts.npz", tmp_path)
    write_rollouts(tmp_path, [replace(row, seed=None, robot="UR5e") if row.seed % 3 == 1 else row for row in rows], metadata)
    mixed = read_log(tmp_path)
    blocks = {block.name: block for block in policy_blocks(mixed, WEIGHTS)}
    assert "policies_by_robot" in blocks and "policies_by_robot" not in {block.name for block in policy_blocks(log, WEIGHTS)}
    assert ("robots", "Panda, UR5e") in log_facts(mixed, WEIGHTS)
    told = list_episodes(mixed, WEIGHTS).data["instances"]
    assert [item["robot"] for item in told[:3]] == ["Panda", "UR5e", "Panda"]
    assert all("robot" not in item for item in list_episodes(log, WEIGHTS).data["instances"])


def test_words_from_a_log_stay_words(page_of_log):
    page = (page_of_log / "report.html").read_text()
    body, data = without_scripts(page), embedded(page)
    assert EVIL in [instance["instruction"] for instance in data["episodes"]["instances"]]
    assert "window.pwned" not in body
    assert FAR not in body and "far&lt;i&gt;" in body
    assert page.count("</script>") == 3 + page.count("<\\/script>")  # data, vega, own: no word ends one early
    assert not re.search(r'src="|href="(?!#|figures/|tables/)', body)  # nothing is fetched
    for file in (page_of_log / "figures").glob("*.svg"):
        assert "window.pwned" not in re.sub(r"<text.*?</text>", "", file.read_text())


def test_page_of_a_replay(all_pages):
    _, folder = all_pages["replay"]
    page = (folder / "report.html").read_text()
    data = embedded(page)
    assert {"curves", "regret", "gap_closed", "success_against_penalty", "choices", "frontier"} <= set(data["figures"])
    result = json.loads((folder / "replay.json").read_text())
    with (folder / "tables" / "selectors.csv").open() as handle:
        rows = {row["selector"]: row for row in csv.DictReader(handle)}
    assert float(rows["ppo"]["reward"]) == result["selectors"]["ppo"]["mean_reward"]
    assert set(rows) == {"ppo", "random", f"always {NEAR} (worst single)", f"always {FAR} (best single)"}
    spec = data["figures"]["curves"]
    curve = next(record for record in records(spec, spec["concat"][0]) if record.get("name") == "ppo")
    assert curve["y"][-1] == pytest.approx(result["selectors"]["ppo"]["mean_reward"], abs=1e-3)
    spec = data["figures"]["frontier"]
    lines = [next(record for record in records(spec, panel) if record["name"] == "ppo" and "order" in record) for panel in spec["concat"]]
    assert [line["y"] for line in lines] == [[90.0, 80.0, None], [70.0, 60.0, 50.0]] and lines[0]["x"] == [5.0, 4.0, None]
    assert set(data["episodes"]["picks"]) == {"ppo"}
    assert result["verdict"]["headline"].replace("<", "&lt;").replace(">", "&gt;") in page


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
    assert (folder / "report.html").exists() and str(folder / "report.html") in capsys.readouterr().out


def test_page_of_a_live_run(all_pages):
    _, folder = all_pages["run"]
    page = (folder / "report.html").read_text()
    assert "The selector we recommend is auto (--selector auto)" in page
    data = embedded(page)
    assert {"routes", "curves", "regret", "success_against_penalty", "propensities", "times"} <= set(data["figures"])
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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", ["one decision", "one policy chosen", "one policy always fails", "a log with a policy that always fails"])
def test_what_is_not_known_is_no_warning(case, tmp_path):
    if case.startswith("a log"):
        rows = [
            make_row(f"t/test/0/{number}", policy, 0, number % 2 == 0, **({"error": "gone"} if policy == "b" else {}))
            for number in range(12)
            for policy in ("a", "b", "c")
        ]
        write_log(tmp_path, rows, {row.instance: np.arange(4.0) + len(row.instance) for row in rows})
        with contextlib.suppress(DataError):  # no instance has an outcome of every policy
            report(tmp_path, alpha_time=0, alpha_price=0)
        return
    made_run(tmp_path, decisions=1 if case == "one decision" else 12, counterfactual=case == "one policy always fails")
    file = tmp_path / "episodes.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    kept = [line for line in lines if case != "one policy chosen" or line["policy"] == NEAR]
    for index, line in enumerate(kept):
        line |= {"index": index, "seed": lines[0]["seed"] + index}
        if case == "one policy always fails" and line["policy"] == FAR:
            line |= {"error": "gone", "success": False, "reward": None}
    file.write_text("".join(json.dumps(line) + "\n" for line in kept))
    assert "Mean reward" in report(tmp_path).page.read_text()


def test_commands_keep_what_libraries_warn_of_to_themselves(capsys):
    def noisy():
        warnings.warn("Mean of empty slice", RuntimeWarning, stacklevel=1)
        logging.getLogger("library").warning("this may change")
        return subprocess.run([sys.executable, "-c", "import warnings; warnings.warn('from a child')"], capture_output=True, text=True).stderr

    before = warnings.filters[:]
    with show_log():
        assert noisy() == ""
        logging.getLogger("osel_sim.somewhere").warning("of ours")
    assert capsys.readouterr().err == "warning: of ours\n"
    assert warnings.filters == before and "PYTHONWARNINGS" not in os.environ


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


def test_the_same_input_is_the_same_bytes(all_pages, page_of_log, tmp_path):
    write_page(all_pages["log"][0], tmp_path)  # made once more, beside the command's
    files = {file.relative_to(page_of_log): file.read_bytes() for file in page_of_log.rglob("*") if file.is_file()}
    assert len(files) > 15
    for name, content in files.items():
        assert content == (tmp_path / name).read_bytes(), name


def test_wrong_folders_and_flags(tmp_path, capsys):
    assert report_main([str(tmp_path)]) == 2
    assert (
        "holds neither episodes.jsonl (a live run), replay.json (a replay), compare.json (a comparison) nor rollouts.parquet"
        in capsys.readouterr().err
    )
    folder = made_run(tmp_path / "run", decisions=3)
    assert report_main([str(folder), "--alpha-time", "1"]) == 2
    assert "--alpha-time" in capsys.readouterr().err
    assert not (folder / "report.html").exists()


@pytest.fixture(scope="module")
def made_of_all_marks():
    """A figure with every kind of panel, and names that must stay names."""
    evil = Look({"a.b[c]": "c0", EVIL: "c1", "ink": "ink"}, {EVIL}, {"ink": "diamond"}, {"ink"})
    lines = [
        Line("a.b[c]", [1.0, np.nan, 2.0], [0, np.nan, 1], [2, np.nan, 3]),
        Line(EVIL, [0.5, 0.7, 0.6]),
        Line("ink", [1, 1, 1]),
    ]
    dots = [Dot(EVIL, Estimate(1.0, 0.5, 1.5), Estimate(2.0, 1.0, 3.0)), Dot("ink", certain(1.0), certain(2.0), "here")]
    found = {EVIL: {"x $1": Estimate(0.5, 0.4, 0.6)}, "a.b[c]": {"x $1": certain(0.1), EVIL: certain(0.2)}}
    places = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 2.0]])
    map_axes = np.array([0.1, 1.0, 10.0]), np.array([1.0, 10.0])
    panels = [
        curves("lines", [1, 2, 3], lines, evil, ("x", "y")),
        curves("steps", [1.0, 2.0, 3.5], lines[:1], evil, ("x", "y"), (0.0, 3.0), steps=True),
        scatter("dots", dots, evil, ("x", "y"), [Path("a.b[c]", [1, 2, np.nan], [3, 2, 1], ["p", "q", "r"])]),
        rows("rows", ["x $1", EVIL], found, evil, "success", percent=True),
        *clouds(places, ([EVIL, "b", "c"], [0, 1, 2]), {"cloud": (["a.b[c]", EVIL, "ink"], evil)}),
        heatmap("cells", [Cell("row", "a.b[c]", 0.5, "50%", "half"), Cell("row", EVIL, 2.0, "all", "all")], evil),
        shares("bars", ["one", EVIL], {"a.b[c]": [40, 60], EVIL: [60, np.nan]}, evil, "episodes (%)"),
        stacked("areas", [1, 2], {"a.b[c]": [40, 60], EVIL: [60, 40]}, evil, ("decision", "chosen (%)")),
        regions("map", ("x", "y"), *map_axes, np.array([[0.0, 0.5, 0.5], [1.0, 0.2, 0.0]]), 1.0, "gain", {"here": (1.0, 10.0), EVIL: (0.1, 1.0)}),
    ]
    return Figure("all", f"All {EVIL} marks", "", "", panels, ["ink"], one_legend=False)


def test_every_kind_of_panel_is_drawn(made_of_all_marks):
    figure = made_of_all_marks
    assert figure.chart.to_dict(validate=True)["$schema"].startswith(SCHEMA)
    json.dumps(figure.spec, allow_nan=False)
    images = to_images(figure)
    assert images == to_images(figure)
    assert b"window.pwned" in images["svg"] and b"<img" not in images["svg"] and b"<script" not in images["svg"]
    # Hidden names are not drawn, nor in the legend of the images.
    assert images["svg"].count(b'class="mark-line role-mark') == 4  # two lines, one in steps, a path
    assert ">ink</text>" not in images["svg"].decode()
    (one, two), panels = records(figure.spec, figure.spec["concat"][0])[:2], figure.spec["concat"]
    assert one["y"] == [1.0, None, 2.0] and one["low"] == [0.0, None, 1.0] and two["low"] == [None] * 3
    assert panels[-1]["layer"][0]["encoding"]["x"]["scale"]["type"] == "log"
    shown = figure._repr_mimebundle_()  # in a notebook
    assert shown["application/vnd.vegalite.v6+json"] == figure.spec and base64.b64decode(shown["image/png"]) == images["png"]


def test_lines_that_leave_their_panel_are_cut_off_together():
    look = Look({"a": "c0", "b": "c1"})
    lines = [Line("a", [0.0, 1.0, 2.0]), Line("b", [2.0, 1.0, 0.0])]
    svg = to_images(Figure("cut", "Cut", "", "", [curves("lines", [1, 2, 3], lines, look, ("x", "y"), (0.5, 1.5))]))["svg"]
    assert svg.count(b" clip-path=") == svg.count(b'_pathgroup" clip-path=') == 1
    assert svg.count(b"_marks") > 2


@pytest.mark.parametrize("kind", ["log", "replay", "run"])
def test_every_figure_keeps_to_the_schema_is_not_blank_and_says_what_it_shows(all_pages, kind):
    page, folder = all_pages[kind]
    for figure in page.figures:
        figure.chart.to_dict(validate=True)
        png, svg = (folder / "figures" / f"{figure.name}.{ending}" for ending in ("png", "svg"))
        picture = np.asarray(Image.open(png).convert("RGB")).astype(int)
        assert len(figure.panels) > 0 and (np.abs(picture - 255).sum(axis=2) > 60).mean() > 0.002, figure.name
        # Every panel has marks, not only axes.
        drawn = re.split(r'<g class="mark-group role-scope concat_\d+_group"', svg.read_text())[1:]
        assert len(drawn) == len(figure.panels)
        for panel in drawn:
            assert re.search(r"role-mark[^>]*>\s*<(?:path|text)", panel), figure.name
        assert len(figure.alternative) > 60 and re.search(r"\d", figure.alternative), figure.name


def test_a_figure_is_saved_by_its_ending(made_of_all_marks, tmp_path):
    files = [made_of_all_marks.save(tmp_path / "new" / f"figure.{ending}") for ending in ("png", "svg", "json")]
    assert [file.read_bytes()[:5] for file in files] == [b"\x89PNG\r", b"<svg ", b'{"con']
    with pytest.raises(UsageError, match=r"saved as \.png, \.svg or \.json"):
        made_of_all_marks.save(tmp_path / "figure.pdf")


def test_the_page_and_the_images_show_the_same_specification(page_of_log):
    embedded_figures = embedded((page_of_log / "report.html").read_text())["figures"]
    for name in ("routes", "policies_by_task"):
        svg, png = ((page_of_log / "figures" / f"{name}.{ending}").read_bytes() for ending in ("svg", "png"))
        again = vl_convert.vegalite_to_svg(embedded_figures[name])
        assert re.sub(r"clip\d+", "clip", svg.decode()) == re.sub(r"clip\d+", "clip", again)
        assert png == vl_convert.svg_to_png(svg.decode(), scale=2)


@pytest.mark.parametrize("kind", ["log", "replay", "run"])
def test_a_policy_has_one_colour_everywhere_which_no_outcome_has(all_pages, kind):
    outcomes = {LIGHT[name] for name in ("good", "bad", "good_local", "good_remote")}
    found: dict[str, set[str]] = {NEAR: set(), FAR: set()}
    for figure in all_pages[kind][0].figures:
        for scale in scales(figure.spec):
            for name, colour in scale.items():
                policy = name.removeprefix("always ").partition(" (")[0]
                if policy in found and set(scale.values()) not in ({LIGHT["good"]}, {LIGHT["ink"]}):  # a heatmap of success, or of reward
                    found[policy].add(colour)
    assert found == {NEAR: {LIGHT["c0"]}, FAR: {LIGHT["c1"]}}
    assert not outcomes & {LIGHT[f"c{number}"] for number in range(18)}


def test_what_goes_where(log, tmp_path):
    figure = route_figure(log, WEIGHTS)
    cells = {(cell["row"], cell["name"]): cell["text"] for cell in records(figure.spec, figure.spec["concat"][0])}
    solved = log.success[:, log.policies.index(FAR)]
    kitchen = np.array(log.labels("task")) == "kitchen"
    assert cells["kitchen", FAR] == f"{100 * np.nanmean(solved[kitchen]):.0f}%" and cells["all", FAR] == f"{100 * np.nanmean(solved):.0f}%"
    assert "kitchen" in figure.alternative
    # One task: by what was asked for. Whom a selector chose is beside it.
    table = log.take(np.flatnonzero(kitchen))
    wants = np.array([[int(target != "cup") for target in table.labels("target")]])
    chosen = Chosen("ppo", np.arange(len(table))[None], wants, " of this run")
    figure = route_figure(table, WEIGHTS, chosen)
    cells = {(cell["row"], cell["name"]): cell["text"] for cell in records(figure.spec, figure.spec["concat"][1])}
    assert cells["cup", NEAR] == "100%" and cells["pan", NEAR] == "0%" and cells["all", FAR] == "67%"
    many = made_table(tmp_path, 30)
    figure = route_figure(many, WEIGHTS)
    names = list(dict.fromkeys(cell["row"] for cell in records(figure.spec, figure.spec["concat"][0])))
    assert names[0] == "all" and set(names[1:3]) == {"subject_28", "subject_29"} and len(names) == 12  # the first screen, what matters first
    assert "11 of 30" in figure.caption


def test_dots_that_coincide_are_told_apart():
    x, y = np.array([0.0, 0.001, 1.0, 0.5, np.nan]), np.array([0.0, 0.001, 1.0, 0.5, 0.0])
    moved = apart(x, y)
    assert np.abs(moved[0] - moved[1]).max() > 12 and not moved[2:].any()
    places = apart(np.zeros(6), np.zeros(6))
    assert min(np.hypot(*(places[one] - places[two])) for one in range(6) for two in range(one)) > 8
    same = np.tile([[1.0, 2.0]], (5, 1))
    (panel,) = clouds(np.concatenate([same, [[9.0, 9.0]]]), (list("abcdef"), range(6)), {"by": (["a"] * 6, Look({"a": "c0", "b": "c1"}))})
    (record,) = panel.to_dict()["datasets"].values()
    assert len(set(zip(record[0]["x"], record[0]["y"], strict=True))) == 6


def test_curves_of_runs_and_replays_are_the_pages(all_pages):
    for kind, curve in (("run", run_curve), ("replay", replay_curve)):
        assert next(figure for figure in all_pages[kind][0].figures if figure.name == "curves").spec == curve(all_pages[kind][1]).spec


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
    for panel in figure.spec["concat"]:
        names = next(layer["encoding"]["y"]["scale"]["domain"] for layer in layers(panel) if "scale" in layer["encoding"].get("y", {}))
        # What there is to route by comes first: the groups in which the best policy of all is behind.
        assert len(names) == 31 and names[0] == "all" and set(names[1:3]) == {"subject_28", "subject_29"}
        dots = [record for record in records(figure.spec, panel) if "value" in record]
        assert all(len(record["value"]) == 31 for record in dots) and {record["name"] for record in dots} == {"small", "large"}
    assert "in the first 2 of 30 groups it is behind" in figure.caption


def test_a_cloud_of_many_groups_shows_the_largest_and_the_rest(tmp_path):
    spec = context_figure(made_table(tmp_path, 30), WEIGHTS).spec
    (scale,) = scales({"concat": spec["concat"][:1]})
    assert scale["19 others"] == LIGHT["muted"] and len(scale) == 12
    (record,) = records(spec, spec["concat"][0])
    assert len(record["x"]) == 90 == len(record["n0"]) and set(record["labels0"]) == set(scale)
    spec = context_figure(made_table(tmp_path / "fewer", 20), WEIGHTS).spec
    (scale,), (shapes,) = (scales({"concat": spec["concat"][:1]}, channel) for channel in ("color", "shape"))
    assert len({(scale[name], shapes[name]) for name in scale}) == 20
    assert not set(scale.values()) & {LIGHT["c0"], LIGHT["c1"]}  # these are the policies'


def test_images_grow_with_what_is_in_them():
    def height(panel):
        return Image.open(io.BytesIO(to_images(Figure("f", "F", "", "", [panel]))["png"])).height

    def cloud(count):
        names = [f"a group of the number {number}" for number in range(count)]
        places = np.stack([np.arange(count), np.ones(count)], axis=1).astype(float)
        return clouds(places, (names, range(count)), {"by": (names, Look(colours(names)))})[0]

    assert height(cloud(60)) > height(cloud(2)) + 12 * 15  # more lines of legend do not take the room of the plot
    few, many = (rows("", [str(row) for row in range(count)], {"a": {"1": certain(1.0)}}, Look({"a": "c0"}), "x") for count in (5, 60))
    assert height(many) > 3 * height(few)


def linear(colour: str) -> np.ndarray:
    """Linear RGB, (3,)."""
    values = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def contrast(one: str, other: str) -> float:
    """WCAG's contrast of two colours."""
    high, low = sorted((float(linear(colour) @ [0.2126, 0.7152, 0.0722]) + 0.05 for colour in (one, other)), reverse=True)
    return high / low


PROTAN = np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]])
DEUTAN = np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]])


def oklab(colour: str, eyes: np.ndarray) -> np.ndarray:
    """A colour as certain eyes see it (Machado 2009), in Oklab."""
    cones = np.array([[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]])
    axes = np.array([[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]])
    return axes @ np.cbrt(cones @ np.clip(eyes @ linear(colour), 0.0, 1.0))


@pytest.mark.parametrize("palette", [LIGHT, DARK], ids=["light", "dark"])
def test_words_can_be_read_and_colours_told_apart(palette):
    for name in ("ink", "muted", "link", "good", "bad"):
        assert min(contrast(palette[name], palette[ground]) for ground in ("surface", "raised")) >= 4.5, name
    names = [f"c{number}" for number in range(18)]
    assert LIGHT.keys() == DARK.keys() and len(set(palette.values())) == len(palette)
    assert min(contrast(palette[name], palette["surface"]) for name in names) >= 3.0
    for eyes, eight, eighteen in ((np.eye(3), 0.085, 0.075), (PROTAN, 0.05, 0.03), (DEUTAN, 0.05, 0.04)):
        for first, least in ((8, eight), (18, eighteen)):
            places = [oklab(palette[name], eyes) for name in [*names[:first], "good", "bad"]]
            apart_by = {(one, two): np.linalg.norm(places[one] - places[two]) for one in range(len(places)) for two in range(one)}
            del apart_by[len(places) - 1, len(places) - 2]  # success and failure are told apart by words as well
            assert min(apart_by.values()) > least


def test_a_heatmap_can_be_read():
    """The number in the darkest cell of any colour."""
    for palette in (LIGHT, DARK):
        for name in ("good", "ink", *(f"c{number}" for number in range(18))):
            mixed = [
                DARKEST * int(palette[name][place : place + 2], 16) + (1 - DARKEST) * int(palette["surface"][place : place + 2], 16)
                for place in (1, 3, 5)
            ]
            shade = "#" + "".join(f"{round(value):02x}" for value in mixed)
            assert contrast(palette["ink"], shade) >= 4.5, (name, shade)


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
    assert "of 1,350 instances" in book.note
    assert [instance["number"] for instance in book.data["instances"] if "scene" in instance] == [1]


def test_tensorboard_is_optional(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(UsageError, match=r"pip install 'osel-sim\[tensorboard\]'"):
        check_installed()


def test_selectors_shown_together_differ_in_colour():
    """More of them than there are colours, as in a replay of all; those shown are the first and the last."""
    names = [*MAIN[1:], *(f"other_{number}" for number in range(9)), MAIN[0]]
    look = look_of(names, ("one", "two", "three", "four"), {})
    assert len(look.shown) == len(MAIN) == len({look.colour[name] for name in look.shown})


def test_numbers_for_json():
    assert numbers([1.23456, np.nan, np.inf, -0.000123456]) == [1.235, None, None, -0.0001235]
