"""Tables of strangers: what is taken of them, what is refused in one short line, and what is warned of."""

import datetime
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from PIL import Image

import osel_sim as osel
from osel_sim.core.errors import DataError, OselError
from osel_sim.core.images import load_image
from osel_sim.ingest import main as ingest_main
from osel_sim.ingestion.columns import COMMAND_LINE
from osel_sim.ingestion.columns_file import load_columns, parse_columns
from osel_sim.ingestion.convert import Converted, convert
from osel_sim.ingestion.doubts import alike, beyond_reason
from osel_sim.ingestion.flags import as_data
from osel_sim.ingestion.readers import first_columns, read_tables
from osel_sim.replay import main as replay_main

LONG = {"text": "q", "policy_column": "m", "success": ["s"]}
WIDE = {"text": "q", "policies": ["a"], "success": ["a"]}


def table(file: Path, **flags: Any) -> Converted:
    """What becomes of a table read with these flags; nothing is written."""
    from osel_sim.api.ingest import IngestConfig

    config = IngestConfig.of(out=Path("log"), files=(str(file),), **flags)
    columns = parse_columns(as_data(config, config.files or (), first_columns(Path(), config.files or ())), COMMAND_LINE, Path())
    return convert(columns, read_tables(columns))


def csv(folder: Path, text: str) -> Path:
    file = folder / "t.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_column_that_nobody_named_is_not_read(tmp_path: Path) -> None:
    late = pa.array([2**52], pa.timestamp("s"))
    zone = pa.array([0], pa.timestamp("us", "Mars/Phobos"))
    broken = pa.Array.from_buffers(pa.string(), 1, [None, pa.py_buffer(np.array([0, 2], np.int32)), pa.py_buffer(b"\xff\xfe")])
    columns = {"q": ["go"], "a": [True], "late": late, "zone": zone, "broken": broken, "years": pa.array([2**31 - 1], pa.date32())}
    parquet.write_table(pa.table(columns), tmp_path / "t.parquet")
    assert [row.success for row in table(tmp_path / "t.parquet", **WIDE).rows] == [True]
    for name in ("late", "broken", "years", "zone"):
        with pytest.raises(DataError, match=f"row 1, column '{name}': ") as caught:
            table(tmp_path / "t.parquet", **{**WIDE, "group": name})
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("where", ["q", "a", "p", "m"])
@pytest.mark.parametrize(
    "value", ["y" * 10**6, list(range(10**5)), {"bytes": b"\xff" * 10**5, "path": None}, 10**5000], ids=["text", "list", "image", "digits"]
)
def test_quoted_values_end(where: str, value: Any, tmp_path: Path) -> None:
    row = {"q": "go", "m": "a", "a": 1, "p": 1.0} | {where: value if not isinstance(value, dict) else {"bytes": "z" * 10**5}}
    rows = [{"q": "stay", "m": "a", "a": 1, "p": 1.0}, row]
    (tmp_path / "t.jsonl").write_text(
        "\n".join(map(json.dumps, rows)) if value != 10**5000 else '{"q": "go", "m": "a", "p": 1, "a": %s}' % ("9" * 4000)
    )
    flags = {"text": "q", "policy_column": "m", "policies": ["a"], "success": ["a"], "price": ["p"], "group": "q" if where == "q" else None}
    if where == "q" and isinstance(value, str):
        return  # a text may be as long as it likes
    with pytest.raises(OselError) as caught:
        table(tmp_path / "t.jsonl", **flags)
    assert len(str(caught.value)) < 600


def test_an_image_in_a_cell_is_told_to_be_written_into_a_file(tmp_path: Path) -> None:
    columns = {"q": ["go"], "a": [True], "image": [{"bytes": b"\x89PNG" * 10**4, "path": "x.png"}]}
    parquet.write_table(pa.table(columns), tmp_path / "t.parquet")
    with pytest.raises(DataError, match=r"must be the path of an image file, got .*write images into files") as caught:
        table(tmp_path / "t.parquet", **WIDE, image=["image"])
    assert len(str(caught.value)) < 400


def test_integers_beyond_what_a_log_holds_are_refused(tmp_path: Path) -> None:
    for flags, text in (({"steps": ["n"]}, "1e30"), ({"repeat_column": "n"}, "99999999999999999999"), ({"price": ["n*1e12"]}, "1e300")):
        with pytest.raises(DataError, match=r"row 1 .line 2., column 'n': .*(lie in|integer in|finite)"):
            table(csv(tmp_path, f"q,m,s,n\ngo,a,1,{text}\n"), **LONG, **flags)


def test_images_are_upright_and_small_enough(tmp_path: Path) -> None:
    tall = Image.new("RGB", (30, 20))
    tall.putpixel((0, 0), (255, 0, 0))
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by a quarter to see it upright
    tall.save(tmp_path / "turned.png", exif=exif)
    upright = load_image(tmp_path / "turned.png", "t.csv, row 1")
    assert upright.shape == (30, 20, 3) and upright[0, 19].tolist() == [255, 0, 0]
    Image.new("I;16", (4, 4), 40_000).save(tmp_path / "depth.png")
    Image.new("F", (4, 4)).save(tmp_path / "depth.tiff")
    Image.new("1", (20_000, 20_000)).save(tmp_path / "bomb.png")
    Image.new("1", (10_000, 10_000)).save(tmp_path / "large.png")
    (tmp_path / "text.png").write_text("hello")
    for name, says in (
        ("depth.png", "more than 8 bits a channel"),
        ("depth.tiff", "more than 8 bits a channel"),
        ("bomb.png", "is too large .400000000 pixels"),
        ("large.png", "is too large .100000000 pixels"),
        ("text.png", "cannot be read"),
        ("none.png", "cannot be read"),
    ):
        with pytest.raises(DataError, match=rf"^t\.csv, row 1: image .*{name} .*{says}") as caught:
            load_image(tmp_path / name, "t.csv, row 1")
        assert "\n" not in str(caught.value)


def test_a_folder_of_parts_is_a_table(tmp_path: Path) -> None:
    for part, question in (("split=train/part-0", "go"), ("split=a%2Fb/part-1", "stay")):
        file = tmp_path / "t.parquet" / f"{part}.parquet"
        file.parent.mkdir(parents=True)
        parquet.write_table(pa.table({"q": [question], "a": [1], **({"more": [1]} if question == "go" else {})}), file)
    parquet.write_table(pa.table({"q": pa.array([], pa.string()), "a": pa.array([], pa.int64())}), tmp_path / "t.parquet" / "part-2.parquet")
    (tmp_path / "t.parquet" / "_SUCCESS").touch()
    (tmp_path / "t.parquet" / "dataset_info.json").write_text("{}")
    (tmp_path / "t.parquet" / ".part-0.parquet.crc").write_bytes(b"x")
    rows = table(tmp_path / "t.parquet", **WIDE, group="split").rows
    assert [(row.task, row.instruction) for row in rows] == [("a/b", "stay"), ("train", "go")]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="is a folder without tables"):
        table(tmp_path / "empty", **WIDE)


def test_damaged_pages_and_odd_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "12:30"
    folder.mkdir()
    file = folder / "t.parquet"
    parquet.write_table(pa.table({"q": ["go", "stay"], "a": [1, 0]}), file, compression="none", write_page_checksum=True)
    monkeypatch.chdir(tmp_path)
    assert len(table(Path("12:30/t.parquet"), **WIDE).rows) == 2
    file.write_bytes(file.read_bytes().replace(b"stay", b"sway", 1))
    with pytest.raises(DataError, match="is not a whole Parquet file"):
        table(Path("12:30/t.parquet"), **WIDE)


@pytest.mark.parametrize("blank", ["", "   ", "\t", "\u00a0", "\u200b", " \ufeff "])
def test_blanks_are_empty(blank: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"row 1 .line 2., column 'q': is empty, expected text"):
        table(csv(tmp_path, f'q,a\n"{blank}",1\n'), **WIDE)
    assert [row.instruction for row in table(csv(tmp_path, f'q,a\ngo,"{blank}"\nstay,1\n'), **WIDE).rows] == ["stay"]


def test_ids_that_differ_only_in_form_are_told(tmp_path: Path) -> None:
    for one, other in (("1", "1.0"), ("01", "1"), ("Lamp 1", "lamp  1")):
        (said,) = alike("instances", [("log", one), ("log", other), ("log", "other")])
        assert f"'log/{one}' and 'log/{other}' differ only in form" in said
    assert not list(alike("instances", [("a", "1"), ("b", "1.0"), ("a", "10")]))


@pytest.mark.parametrize(("content", "success"), [("yes", True), ("No", False), ("Y", True), ("n", False), ("T", True), ("FALSE", False)])
def test_yes_and_no(content: str, success: bool, tmp_path: Path) -> None:
    assert [row.success for row in table(csv(tmp_path, f"q,a\ngo,{content}\n"), **WIDE).rows] == [success]


def test_units_are_told(tmp_path: Path) -> None:
    file = csv(tmp_path, "q,a,time_ms,usd,rating/10\ngo,1,1234,0.03,7\n")
    (row,) = table(file, **WIDE, seconds=["time_ms/1000"], price=["usd"], price_unit="usd", score=["rating/10"]).rows
    assert (row.inference, row.price, row.score) == (1.234, 3.0, 7.0)
    (row,) = table(file, **WIDE, seconds=["a=time_ms * 2"], price=["usd*100"]).rows
    assert (row.inference, row.price) == (2468.0, 3.0)
    with pytest.raises(OselError, match="must not be 0"):
        table(file, **WIDE, seconds=["time_ms/0"])
    (tmp_path / "m.toml").write_text(
        'version = 1\nname = "x"\ntable.files = ["t.csv"]\ninstance.text = "q"\noutcome.price_unit = "usd"\n'
        'outcome.seconds = { column = "time_ms", divide = 1000 }\noutcome.price = ["usd", 0.01]\npolicies.a.success = "a"\n'
    )
    columns = load_columns(tmp_path / "m.toml")
    (row,) = convert(columns, read_tables(columns)).rows
    assert (row.inference, row.price) == (1.234, pytest.approx(4.0))


@pytest.mark.parametrize(
    ("cell", "cents"), [("$0.03", 3.0), ("$ 1.5", 150.0), ("US$2", 200.0), ("-$0", 0.0), ("$1,000", 100_000.0), ("$1,234,567.5", 123_456_750.0)]
)
def test_dollar_signs_say_the_unit(cell: str, cents: float, tmp_path: Path) -> None:
    for unit in ({}, {"price_unit": "usd"}):
        (row,) = table(csv(tmp_path, f'q,a,p\ngo,1,"{cell}"\n'), **WIDE, price=["p"], **unit).rows
        assert row.price == pytest.approx(cents)


@pytest.mark.parametrize(
    ("prices", "flags", "says"),
    [
        (("$0.03", "0.04"), {}, r"row 2 .line 3., column 'p': has no dollar sign, row 1 of .* has one"),
        (("$0.03", "$0.04"), {"price_unit": "cents"}, "row 1 .line 2., column 'p': is in dollars, and the unit of prices is told to be cents"),
        (("$x", "$0.04"), {}, r"must be a number, got '\$x'"),
        (("€1", "2"), {}, "must be a number, got '€1'"),
        (("1,000", "2"), {}, "must be a number, got '1,000'; write 1000, or 1.000 if the comma is a decimal one"),
        (("0,500", "2"), {}, "must be a number, got '0,500'$"),
        (("1.234,5", "2"), {}, "must be a number, got '1.234,5'$"),
    ],
)
def test_amounts_that_nobody_can_be_sure_of(prices: tuple[str, str], flags: dict[str, Any], says: str, tmp_path: Path) -> None:
    content = "q,a,p\n" + "".join(f'{question},1,"{price}"\n' for question, price in zip(("go", "stay"), prices, strict=True))
    with pytest.raises(DataError, match=says):
        table(csv(tmp_path, content), **WIDE, price=["p"], **flags)
    if flags == {} and prices == ("$0.03", "0.04"):
        assert [row.price for row in table(csv(tmp_path, content), **WIDE, price=["p"], price_unit="usd").rows] == [3.0, 4.0]


@pytest.mark.parametrize(("cell", "value"), [("1,234,567", 1234567.0), ("1,234.5", 1234.5), ("12,345.", 12345.0)])
def test_thousands_that_are_sure(cell: str, value: float, tmp_path: Path) -> None:
    assert table(csv(tmp_path, f'q,a,p\ngo,1,"{cell}"\n'), **WIDE, score=["p"]).rows[0].score == value


def test_medians_beyond_reason_are_told(tmp_path: Path) -> None:
    rows = table(csv(tmp_path, "q,m,s,t,p\nx,a,1,1200,1\ny,a,1,1500,1\nx,b,1,1,2000\ny,b,0,2,3000\n"), **LONG, seconds=["t"], price=["p"]).rows
    seconds, price = beyond_reason(rows, True)
    assert "policy 'a' have a seconds of more than 1350 seconds" in seconds and "--seconds COLUMN/1000" in seconds
    assert "policy 'b' have a price of more than 2500 cents" in price and "--price-unit" in price
    assert not list(beyond_reason(table(csv(tmp_path, "q,m,s,t\nx,a,1,599\n"), **LONG, seconds=["t"]).rows, True))


NESTED = [
    {"q": "go", "scores": {"gpt-4.1": {"ok": True}, "small": {"ok": False}}},
    {"q": "stay", "scores": {"gpt-4.1": {"ok": True}, "small": {"ok": None}}},
]


@pytest.mark.parametrize("form", ["lines", "array", "object", "pretty", "parquet"])
def test_nested_and_array_json(form: str, tmp_path: Path) -> None:
    file = tmp_path / {"lines": "t.jsonl", "parquet": "t.parquet"}.get(form, "t.json")
    if form == "parquet":
        parquet.write_table(pa.Table.from_pylist(NESTED), file)
    else:
        file.write_text(
            {
                "lines": "\n".join(map(json.dumps, NESTED)),
                "array": json.dumps(NESTED),
                "object": json.dumps({"version": 3, "data": NESTED}),
                "pretty": json.dumps(NESTED, indent=2),
            }[form]
        )
    rows = table(file, text="q", policies=["gpt-4.1", "small"], success=["scores.{policy}.ok"]).rows
    assert [(row.instruction, row.policy, row.success) for row in rows] == [
        ("go", "gpt-4.1", True),
        ("go", "small", False),
        ("stay", "gpt-4.1", True),
    ]
    with pytest.raises(DataError, match=r"there is no column 'scores\.big\.ok', which --success of policy 'big' names"):
        table(file, text="q", policies=["big"], success=["scores.{policy}.ok"])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('[{"q": "go"}, 3]', r"t\.json, row 2: must be an object, got int"),
        ('[{"q": "go"},\n {"q"', r"t\.json, line 2: is not JSON"),
        ('[{"q": "go", "q": "x"}]', r"t\.json: key 'q' is there twice"),
        ("[]", "has no rows"),
        ("", "has no rows"),
        ("[" * 10**5, "is not JSON"),
    ],
)
def test_damaged_json_is_one_line(content: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(content)
    with pytest.raises(DataError, match=says):
        table(tmp_path / "t.json", **WIDE)


def test_template_keys(tmp_path: Path) -> None:
    file = csv(tmp_path, "q,m,s,topic,n\ngo,a,1,x,1\nstay,a,1,x,2\ngo,b,0,x,1\n")
    assert [(row.instance, row.policy) for row in table(file, **LONG, key="{topic}-{n}").rows] == [
        ("log/x-1", "a"),
        ("log/x-1", "b"),
        ("log/x-2", "a"),
    ]
    assert [row.task for row in table(file, **LONG, group="{topic}/{n}").rows] == ["x/1", "x/1", "x/2"]


def test_the_next_command_is_one_that_works(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    csv(tmp_path, "q,a,b,t\nwhere is it,1,0,2\nwho was there,0,1,3\n")
    words = ["--files", str(tmp_path / "t.csv"), "--text", "q", "--policies", "a", "b", "--success", "{policy}", "--out", str(tmp_path / "my log")]
    assert ingest_main(words) == 0
    assert f"-m osel_sim.replay '{tmp_path}/my log' --alpha-time 0 --alpha-price 0 " in capsys.readouterr().out
    words[-1] = str(tmp_path / "log")
    assert ingest_main([*words, "--seconds", "t", "--preset", "mmlu"]) == 0
    assert f"-m osel_sim.replay {tmp_path}/log --preset mmlu --alpha-price 0 " in capsys.readouterr().out


def test_files_whose_unused_columns_differ_and_an_index_without_a_name(tmp_path: Path) -> None:
    (tmp_path / "1.csv").write_text(",q,a,one,one\n0,go,1,x,y\n")
    (tmp_path / "2.csv").write_text(",two,q,a\n0,x,stay,0\n")
    assert [(row.instruction, row.success) for row in table(tmp_path / "*.csv", **WIDE).rows] == [("go", True), ("stay", False)]
    (tmp_path / "1.jsonl").write_text('{"q": "go", "a": 1}\n{"q": "stay", "a": 0, "why": "gone"}\n')
    (tmp_path / "2.jsonl").write_text('{"q": "run", "a": 1}\n')
    rows = table(tmp_path / "*.jsonl", **WIDE, error=["why"]).rows
    assert [row.error for row in rows] == [None, "gone", None]
    (tmp_path / "3.csv").write_text("q,b\ngo,1\n")
    with pytest.raises(DataError, match=r"3\.csv: column 'a' is missing, and is in .*1\.csv: columns: q, b"):
        table(tmp_path / "*.csv", **WIDE)


def test_duplicates_that_differ_in_labels_only_do_not_differ(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("q,a,w\ngo,1,x\ngo,1,y\n")
    (tmp_path / "m.toml").write_text(
        'version = 1\nname = "x"\ntable.files = ["t.csv"]\ninstance = { text = "q", phrasing = "w", duplicates = "drop" }\npolicies.a.success = "a"\n'
    )
    columns = load_columns(tmp_path / "m.toml")
    found = convert(columns, read_tables(columns))
    assert (found.dropped, found.differing) == (1, 0)


def test_dates_are_texts(tmp_path: Path) -> None:
    parquet.write_table(pa.table({"q": ["go"], "a": [1], "day": [datetime.date(2024, 2, 29)]}), tmp_path / "t.parquet")
    assert table(tmp_path / "t.parquet", **WIDE, group="day").rows[0].task == "2024-02-29"


def test_logged_decisions_tell_what_others_would_have_earned(tmp_path: Path) -> None:
    chance = np.random.default_rng(0)
    lines, weighted = ["q,m,p,s,kind"], {"large": 0.0, "small": 0.0}
    for _ in range(600):
        poem, large = chance.random() < 0.5, chance.random() < 0.7
        success = chance.random() < (0.9 if large else 0.8 if poem else 0.3)
        policy, propensity = ("large", 0.7) if large else ("small", 0.3)
        weighted[policy] += success / propensity / 600
        lines.append(f"{'write a poem' if poem else 'add these numbers'},{policy},{propensity},{success},{poem}")
    flags = {"text": "q", "policy_column": "m", "success": ["s"], "propensity": "p"}
    osel.ingest(files=[str(csv(tmp_path, "\n".join(lines)))], out=tmp_path / "log", **flags)
    found = osel.replay(tmp_path / "log", alpha_time=0, alpha_price=0, out=tmp_path / "replay").off_policy
    assert found is not None and found["run"]["decisions"] == 600
    for policy, ips in weighted.items():
        entry = found["targets"][f"fixed:{policy}"]
        assert entry["ips"] == pytest.approx(ips) and abs(entry["dr"] - {"large": 0.9, "small": 0.55}[policy]) < 0.1
    page = osel.report(tmp_path / "log", alpha_time=0, alpha_price=0).page.read_text()
    assert "Always large is estimated to earn" in page and "effective decisions" in page


@pytest.mark.parametrize(
    ("row", "more", "says"),
    [
        ("go,a,1,0", {}, r"row 1 .line 2., column 'p': must be the probability, in \(0, 1\], .* got '0'"),
        ("go,a,1,1.2", {}, "got '1.2'"),
        ("go,a,1,", {}, "got nothing"),
        ("go,a,1,x", {}, "must be a number, got 'x'"),
        ("go,a,1,0.5", {"duplicates": "drop"}, "--propensity: says that each row is a decision of its own"),
        ("go,a,1,0.5", {"policy_column": None, "policies": ["s"], "success": ["s"]}, "--propensity: is of the row's policy"),
    ],
)
def test_propensities_that_are_none(row: str, more: dict[str, Any], says: str, tmp_path: Path) -> None:
    with pytest.raises(OselError, match=says):
        table(csv(tmp_path, f"q,m,s,p\n{row}\n"), **{**LONG, "propensity": "p", **more})


def test_each_row_of_logged_decisions_is_an_instance(tmp_path: Path) -> None:
    found = table(csv(tmp_path, "q,m,s,p\ngo,a,1,0.5\ngo,a,0,0.25\ngo,b,1,0.5\n"), **LONG, propensity="p")
    assert [(row.instance, row.policy) for row in found.rows] == [("log/000001", "a"), ("log/000002", "a"), ("log/000003", "b")]
    assert found.propensities == [0.5, 0.25, 0.5]


CONTEXT = "q,s,room,size,a,b\ngo,x,attic,1,1,0\nrun,y,cellar,,0,1\nstop,x,,3,1,1\n"


def test_columns_are_part_of_the_context_beside_the_text(tmp_path: Path) -> None:
    flags = {"text": "q", "group": "s", "policies": ["a", "b"], "success": ["{policy}"], "context": ["room", "size", "task"]}
    found = osel.ingest(files=[str(csv(tmp_path, CONTEXT))], out=tmp_path / "log", **flags)
    log, text = osel.load_log(tmp_path / "log"), osel.load_log(tmp_path / "log", "tfidf")
    assert log.encoder == found.encoder and log.parts == (text.contexts.shape[1], 33) and not text.parts
    assert np.array_equal(log.contexts[:, :-33], text.contexts)
    room, size, task = np.split(log.contexts[:, -33:], [16, 17], axis=1)
    assert np.linalg.norm(room, axis=1) == pytest.approx([1, 1, 0])
    assert np.ravel(size) == pytest.approx([-1, 0, 1])
    assert np.array_equal(task[0], task[2]) and not np.array_equal(task[0], task[1])
    replayed = osel.replay(
        tmp_path / "log", selectors=["auto"], seeds=1, no_frontier=True, alpha_time=0, alpha_price=0, out=tmp_path / "replay", workers=1
    )
    assert osel.report(replayed.folder).page.is_file()


def test_a_task_is_appended_when_a_log_is_replayed(tmp_path: Path) -> None:
    flags = {"text": "q", "group": "s", "policies": ["a", "b"], "success": ["{policy}"]}
    osel.ingest(files=[str(csv(tmp_path, CONTEXT))], out=tmp_path / "log", **flags)
    settings = {"selectors": ["auto", "linucb"], "seeds": 1, "no_frontier": True, "alpha_time": 0, "alpha_price": 0, "workers": 1}
    replayed = osel.replay(tmp_path / "log", context="task", out=tmp_path / "replay", **settings)
    assert replayed.result["log"]["encoder"].endswith("+task#16")
    assert osel.report(replayed.folder).page.is_file()
    osel.ingest(files=[str(csv(tmp_path, CONTEXT))], out=tmp_path / "other", context=["task"], **flags)
    with pytest.raises(OselError, match="have the task already"):
        osel.replay(tmp_path / "other", context="task", out=tmp_path / "again", **settings)


@pytest.mark.parametrize(
    ("content", "context", "says"),
    [
        ("q,m,s,size\ngo,a,1,1\ngo,b,1,2\n", "size", r"row 2 .*column 'size': is 2.0 here, of the same instance .* it is 1.0 in row 1"),
        ("q,m,s\ngo,a,1\n", "size", "size"),
    ],
)
def test_columns_of_the_context_that_are_none(content: str, context: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(OselError, match=says):
        table(csv(tmp_path, content), **LONG, context=[context])


def test_hundreds_of_policies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"model-{number:03d}" for number in range(200)]
    rows = [f"question {row}," + ",".join(str(int((row + column) % 200 < 100)) for column in range(200)) for row in range(4)]
    file = csv(tmp_path, "q," + ",".join(names) + "\n" + "\n".join(rows))
    flags = ["--alpha-time", "0", "--alpha-price", "0", "--workers", "1"]
    assert ingest_main(["--files", str(file), "--text", "q", "--success", "{policy}", "--policies", *names, "--out", str(tmp_path / "log")]) == 0
    told = capsys.readouterr().out
    assert (
        replay_main([str(tmp_path / "log"), "--selectors", "auto", "--seeds", "1", "--no-frontier", *flags, "--out", str(tmp_path / "replay")]) == 0
    )
    told += capsys.readouterr().out
    assert told.count("more policies") == 2 and told.count("\n") < 150
    assert osel.load_log(tmp_path / "log").policies == tuple(names)
