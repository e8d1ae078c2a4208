"""What takes long to make is kept in the user's cache folder, and made anew where that file is torn."""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from osel_sim.reporting import vega
from osel_sim.sim import kept as keeping
from osel_sim.sim.kept import Arrays, kept


def test_arrays_are_made_once_of_the_same_and_again_where_they_are_torn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeping, "prepare", lambda: tmp_path)
    made = []

    def make() -> Arrays:
        made.append(len(made))
        return {"dark-wood": np.arange(6, dtype=np.uint8).reshape(2, 3), "number": np.array(made[-1])}

    for of, expected in (("these", 0), ("these", 0), ("those", 1), ("these", 0)):
        found = kept("things", of, make)
        assert found["number"] == expected and found["dark-wood"].tolist() == [[0, 1, 2], [3, 4, 5]] and found["dark-wood"].dtype == np.uint8
    assert len(made) == 2
    for file in (tmp_path / "osel_sim").iterdir():
        file.write_bytes(file.read_bytes()[:100])
    assert kept("things", "these", make)["number"] == 2 and kept("things", "these", make)["number"] == 2
    assert len(list((tmp_path / "osel_sim").iterdir())) == 2


@pytest.mark.parametrize("content", [b"", b"(() => {half of", b"\xff\xfe", b"(() => {</script>})();"])
def test_a_torn_script_is_not_put_into_a_page(content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vega, "prepare", lambda: tmp_path)
    file = tmp_path / "osel_sim" / f"vega_{version('vl-convert-python')}.js"
    file.parent.mkdir()
    file.write_bytes(b"(() => {whole})();")
    assert vega.vega_script.__wrapped__() == "(() => {whole})();"
    file.write_bytes(content)
    assert vega._kept(file) is None
