"""An output folder is one process's at a time, says whose, and is as it was where nothing came of it."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError, UsageError
from osel_sim.core.holding import LOCK, held, taken
from osel_sim.formats.journal import Lines
from osel_sim.formats.run_config import check_run_folder

HOLD = """import sys, time
from pathlib import Path
from osel_sim.core.holding import held

with held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_told_who_holds_the_folder_and_a_killed_one_blocks_nobody(tmp_path):
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UsageError, match=rf"is in use by process {other.pid} on \S+, since 20\S+: wait until it has ended"), held(tmp_path):
            pass
    finally:
        other.kill()
        other.wait()
        other.stdout.close()
    assert (tmp_path / LOCK).exists()  # as the killed one left it
    check_run_folder(tmp_path, {}, resume=False)  # counts for nothing
    with held(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", [RuntimeError, KeyboardInterrupt])
def test_a_folder_of_which_nothing_came_is_as_it_was(tmp_path, kind):
    for folder in (tmp_path / "new" / "deep", tmp_path):
        there = sorted(tmp_path.iterdir())
        with pytest.raises(kind), taken(folder, ("journal",)):
            (folder / "run.json").write_text("{}")
            (folder / "journal").touch()
            (folder / "videos").mkdir()
            (folder / "videos" / "0.mp4").touch()
            raise kind
        assert not (tmp_path / "new" / "deep").exists()
        if folder == tmp_path:
            assert sorted(tmp_path.iterdir()) == there
    with pytest.raises(kind), taken(tmp_path, ("journal",)):
        (tmp_path / "journal").write_text("{}\n")
        raise kind
    assert (tmp_path / "journal").exists() and not (tmp_path / LOCK).exists()


def test_what_no_result_depends_on_is_mended(tmp_path, caplog):
    file = tmp_path / "timing.jsonl"
    file.write_text('{"index": 0}\n{"ind{"index": 1}\n{"index": 2}\n')
    with pytest.raises(DataError, match="line 2"):
        Lines(file)
    lines = Lines(file, keep=3, mend=True)
    lines.append({"index": 3})
    lines.close()
    assert file.read_text() == '{"index": 0}\n{"index": 3}\n'
    assert "line 2: not JSON" in caplog.text and "dropped" in caplog.text

    (tmp_path / "contexts.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(DataError):
        ContextCache(tmp_path)
    cache = ContextCache(tmp_path, mend=True)
    cache.put("some@1", "a", np.ones(3, np.float32))
    cache.save()
    assert ContextCache(tmp_path).get("some@1", "a").tolist() == [1, 1, 1]
    assert "made again" in caplog.text
