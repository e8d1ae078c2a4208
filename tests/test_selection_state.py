"""Selector state on disk."""

import numpy as np
import pytest
from safetensors.numpy import save_file

from osel_sim.core.errors import DataError
from osel_sim.selection.state import load_state, save_state

STATE = {
    "numbers": np.arange(6, dtype=np.float32).reshape(2, 3).T,
    "scalar": np.float32(0.1) * np.ones(()),
    "empty": np.zeros((0, 3)),
    "key": np.arange(4, dtype=np.uint32),
    "big": 2**100,
    "exact": 0.1 + 0.2,
    "nested": {"list": [1, None, True], "text": "ä"},
}


def test_round_trip(tmp_path):
    file = tmp_path / "state"
    save_state({"old": 1}, file)
    save_state(STATE, file)
    loaded = load_state(file)
    assert loaded.keys() == STATE.keys()
    for key, value in STATE.items():
        if isinstance(value, np.ndarray):
            assert loaded[key].dtype == value.dtype and loaded[key].shape == value.shape
            assert np.array_equal(loaded[key], value)
        else:
            assert loaded[key] == value
    assert [path.name for path in tmp_path.iterdir()] == ["state"], "no temporary file is left behind"


def test_state_without_arrays(tmp_path):
    save_state({"only": "values"}, tmp_path / "state")
    assert load_state(tmp_path / "state") == {"only": "values"}


def test_failed_write_keeps_the_old_file(tmp_path):
    with pytest.raises(DataError, match="cannot be written"):
        save_state(STATE, tmp_path / "missing" / "state")


def test_wrong_files(tmp_path):
    file = tmp_path / "state"
    with pytest.raises(DataError, match="no such"):
        load_state(file)
    file.write_bytes(b"not safetensors at all")
    with pytest.raises(DataError, match="cannot be read"):
        load_state(file)
    save_state(STATE, file)
    file.write_bytes(file.read_bytes()[:-10])
    with pytest.raises(DataError, match="cannot be read"):
        load_state(file)
    save_file({"weights": np.zeros(3)}, file)
    with pytest.raises(DataError, match="not a selector state"):
        load_state(file)
