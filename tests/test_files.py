"""Files and folders that are written whole or not at all."""

import hashlib

import pytest

from osel_sim.core.errors import DataError
from osel_sim.core.files import (
    atomic,
    atomic_files,
    atomic_folder,
    content_digest,
    digest,
    file_digest,
    is_partial,
    read_json,
    write_json,
    write_text,
)


class ProblemError(Exception):
    pass


@pytest.mark.parametrize("settings", [{}, {"sync": True}, {"shared": True}])
def test_a_file_is_replaced_at_the_end_and_stays_where_something_goes_wrong(tmp_path, settings):
    file = tmp_path / "a.txt"
    for text in ("old", "new"):
        with atomic(file, **settings) as partial:
            partial.write_text(text)
            assert partial.parent == tmp_path and is_partial(partial)
            assert not file.exists() if text == "old" else file.read_text() == "old"
    with pytest.raises(ProblemError), atomic(file, **settings) as partial:
        partial.write_text("half")
        raise ProblemError
    assert file.read_text() == "new" and list(tmp_path.iterdir()) == [file]


def test_a_folder_is_replaced_at_the_end_and_stays_where_something_goes_wrong(tmp_path):
    folder = tmp_path / "set"
    for name in ("old", "new"):
        with atomic_folder(folder) as partial:
            assert not partial.exists() and is_partial(partial)
            partial.mkdir()
            (partial / name).touch()
    assert [file.name for file in folder.iterdir()] == ["new"]
    (tmp_path / ".set.partial").mkdir()  # of a process that was killed
    (tmp_path / ".set.partial" / "left").touch()
    with pytest.raises(ProblemError), atomic_folder(folder) as partial:
        partial.mkdir()
        raise ProblemError
    assert [file.name for file in folder.iterdir()] == ["new"] and list(tmp_path.iterdir()) == [folder]


def test_files_of_a_folder_are_replaced_and_others_stay(tmp_path):
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    for name in ("weights", "state"):
        (folder / name).write_text("old")
    with atomic_files(folder) as partial:
        (partial / "weights").write_text("new")
        assert (folder / "weights").read_text() == "old"
    with pytest.raises(ProblemError), atomic_files(folder) as partial:
        (partial / "weights").write_text("half")
        raise ProblemError
    assert {file.name: file.read_text() for file in folder.iterdir()} == {"weights": "new", "state": "old"}
    assert list(tmp_path.iterdir()) == [folder]


def test_json(tmp_path):
    file = tmp_path / "a.json"
    write_json(file, {"word": "größer", "numbers": [1, 2.5]})
    assert file.read_bytes() == '{\n  "word": "größer",\n  "numbers": [\n    1,\n    2.5\n  ]\n}\n'.encode()
    assert read_json(file) == {"word": "größer", "numbers": [1, 2.5]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, {"word": float("nan")})
    assert read_json(file)["word"] == "größer"
    write_text(file, "[1]")
    with pytest.raises(DataError, match=r"a\.json: expected an object, got list"):
        read_json(file)
    with pytest.raises(DataError, match=r"b\.json cannot be read as JSON .*; write one"):
        read_json(tmp_path / "b.json", "write one")


def test_digests(tmp_path):
    (tmp_path / "folder").mkdir()
    for name in ("a", "b"):
        (tmp_path / "folder" / name).write_bytes(name.encode() * 1000)
    a = tmp_path / "folder" / "a"
    assert file_digest(a) == content_digest("a" * 1000) == content_digest("a" * 400, b"a" * 600) == hashlib.sha256(a.read_bytes()).hexdigest()
    before = digest(tmp_path / "folder")
    a.rename(tmp_path / "folder" / "c")
    assert digest(tmp_path / "folder") != before, "names count"
