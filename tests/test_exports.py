"""Tables for spreadsheets hold no formulas of others; files of arrays are not inflated beyond what they can hold."""

import io
import os
import struct
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from osel_sim.context.cache import ContextCache
from osel_sim.core import arrays
from osel_sim.core.arrays import read_arrays
from osel_sim.core.csv_text import to_csv
from osel_sim.core.errors import DataError
from osel_sim.formats.replay_result import _csv
from osel_sim.reporting import html_tables
from osel_sim.reporting.html_tables import Column, Table

FORMULAS = [
    "=1+1",
    "=cmd|' /C calc'!A0",
    "+1+1",
    "-1+1",
    "-x",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    "\n=1",
    " =1",
    "\uff1d1",
    "+",
    "-",
    "=",
    "@",
    "--1",
    "+-1",
    "-1e",
]
HARMLESS = ["", "pick_place", "a=b", "a-b", "1+1", "'=1", "-0.5", "+3", "-1e-05", "-inf", "nan", "-.5", "2024-01-01", "model [v2]", "東京"]


@pytest.mark.parametrize("text", FORMULAS)
def test_a_text_that_is_a_formula_to_spreadsheets_is_quoted(text: str) -> None:
    assert to_csv([[text]]) == to_csv([[f"'{text}"]])


@pytest.mark.parametrize("text", HARMLESS)
def test_other_texts_and_numbers_stay_as_they_are(text: str) -> None:
    assert to_csv([[text, 1]]) == (f"{text},1\n")


def test_numbers_keep_their_digits() -> None:
    assert to_csv([["a", "b"], [-0.5, -3], [None, 1e-300], [True, -0.1 - 0.2]]) == "a,b\n-0.5,-3\n,1e-300\nTrue,-0.30000000000000004\n"


def test_every_export_goes_through_it() -> None:
    assert _csv([{"=policy": "=1", "reward": -0.5}]) == b"'=policy,reward\n'=1,-0.5\n" and _csv([]) == b""
    table = Table(
        name="t",
        title="t",
        caption="",
        columns=[Column("policy", "policy"), Column("reward", "reward")],
        rows=[{"policy": "=1", "reward": -0.5}],
    )
    assert html_tables.to_csv(table) == "policy,reward\n'=1,-0.5\n"
    package = Path(arrays.__file__).parents[1]
    writers = {
        file.relative_to(package).as_posix() for file in package.rglob("*.py") if "csv.writer" in file.read_text() or "DictWriter" in file.read_text()
    }
    assert writers == {"core/csv_text.py"}


def npy(shape: Any, descr: str = "'<f4'", data: bytes = b"", version: bytes = b"\x01\x00", length: int | None = None) -> bytes:
    """A member that says what it likes."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".ljust(117).encode() + b"\n"
    size = struct.pack("<H" if version[0] == 1 else "<I", len(header) if length is None else length)
    return b"\x93NUMPY" + version + size + header + data


def npz(folder: Path, method: int = zipfile.ZIP_STORED, **members: bytes) -> Path:
    with zipfile.ZipFile(folder / "contexts.npz", "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return folder / "contexts.npz"


def test_what_numpy_writes_is_read(tmp_path: Path) -> None:
    written = {
        "a": np.arange(6.0, dtype=np.float32).reshape(2, 3),
        "b|c@d": np.array(["x", "yy"]),
        "e": np.zeros((0, 4)),
        "f": np.array(3),
        "g": np.zeros(9, bool),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **written)
        read = read_arrays(tmp_path / "a.npz", "things")
        assert list(read) == list(written) and all(
            np.array_equal(read[key], written[key]) and read[key].dtype == written[key].dtype for key in written
        )


@pytest.mark.parametrize(
    "member",
    [
        npy("(10**9,)"),
        npy("(1000000000,)"),
        npy("(1000000000, 1000000000, 1000000000)"),
        npy("(-1,)"),
        npy("(2,)", data=b"1234"),
        npy("(1,)", data=b"12345678"),
        npy("(1,)", "'|O'", b"\x80\x04N."),
        npy("(1,)", "[('a', '|O')]", b"12345678"),
        npy("(1,)", "'|V4'", b"1234"),
        npy("(1,)", "'<U1000000000'"),
        npy("(1,)", "__import__('os').system('true')"),
        npy("(1,)", "'<f4'", b"1234", version=b"\x02\x00", length=0xFFFFFFF0),
        npy("(1,)", "'<f4'", b"1234", version=b"\x09\x00"),
        b"\x93NUMPY",
        b"",
        b"no array at all, but some text instead",
    ],
)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_member_that_claims_what_it_does_not_hold_is_refused(tmp_path: Path, member: bytes, method: int) -> None:
    file = npz(tmp_path, method, a=npy("(1,)", data=b"1234"), b=member)
    tracemalloc.start()
    with pytest.raises(DataError, match=f"{file}: not a file of things"):
        read_arrays(file, "things")
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_a_bomb_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    zeros = 80 << 20
    with zipfile.ZipFile(tmp_path / "contexts.npz", "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w", force_zip64=True) as handle:
        handle.write(npy(f"({zeros},)", "'|i1'"))
        for _ in range(zeros >> 20):
            handle.write(bytes(1 << 20))
    start = time.perf_counter()
    tracemalloc.start()
    with pytest.raises(DataError, match=r"claims \d+ bytes, a file of \d+ bytes cannot hold so many"):
        ContextCache(tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 4 << 20 and time.perf_counter() - start < 2
    tracemalloc.stop()


def test_members_that_share_their_bytes_or_are_too_many_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = npz(tmp_path, a=npy("(1000,)", data=bytes(4000)))
    raw = file.read_bytes()
    start = raw.index(b"PK\x01\x02")
    end = raw.index(b"PK\x05\x06")
    entry = raw[start:end]
    entries = b"".join(entry.replace(b"a.npy", b"%c.npy" % letter) for letter in b"abcdefgh")
    tail = bytearray(raw[end:])
    tail[8:16] = struct.pack("<HHI", 8, 8, len(entries))
    file.write_bytes(raw[:start] + entries + bytes(tail))
    with pytest.raises(DataError):
        read_arrays(file, "things")
    monkeypatch.setattr(arrays, "MAX_MEMBERS", 2)
    with pytest.raises(DataError, match="has 3 members"):
        read_arrays(npz(tmp_path, a=b"", b=b"", c=b""), "things")


def test_damage_is_told_in_one_line_and_never_a_traceback(tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    np.savez_compressed(file, **{"e|instances": np.array(["x", "y"]), "e|contexts": np.ones((2, 3), np.float32)})
    raw = file.read_bytes()
    damaged = [raw[:at] + bytes([raw[at] ^ bits]) + raw[at + 1 :] for at in range(len(raw)) for bits in (0x01, 0xFF)]
    refused = 0
    for content in [*damaged, *(raw[:length] for length in range(0, len(raw), 5))]:
        file.write_bytes(content)
        try:
            read_arrays(file, "things")
        except DataError as error:
            refused += 1
            assert "\n" not in str(error) and str(file) in str(error)
    assert refused > len(raw)


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06" + bytes(18), b"no zip", zlib.compress(b"x" * 1000)])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "contexts.npz").write_bytes(content)
    if content.startswith(b"PK"):
        assert ContextCache(tmp_path).encoders() == []
    else:
        with pytest.raises(DataError, match="not a file of contexts"):
            ContextCache(tmp_path)


def test_a_pickle_is_not_loaded(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return os.system, (f"touch {tmp_path / 'ran'}",)

    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb()], object), allow_pickle=True)
    with pytest.raises(DataError, match="objects"):
        ContextCache(npz(tmp_path, **{"e|instances": buffer.getvalue()}).parent)
    assert not (tmp_path / "ran").exists()


def test_a_parquet_file_of_more_rows_than_it_can_hold_is_refused(tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    from osel_sim.core.parquet import read_parquet
    from osel_sim.formats.rollout_log import ROLLOUTS, read_rollouts

    equal = pyarrow.table({"success": pyarrow.repeat(True, 2_000_000)})
    for name in (ROLLOUTS, "table.parquet"):
        parquet.write_table(equal, tmp_path / name, compression="zstd")
    for read in (lambda: read_rollouts(tmp_path), lambda: read_parquet(tmp_path / "table.parquet", ["success"])):
        with pytest.raises(DataError, match=r"claims 2000000 rows, a file of \d+ bytes cannot hold so many"):
            read()
