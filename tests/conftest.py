"""Set before any test imports a library: no network, and one thread a process, because the tests run in several."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

gc.disable()  # until the tests are collected: what they import is no garbage, and to look through it takes a fifth of the time
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Mesa's llvmpipe draws small images in less time, to the same bytes, in the thread that asks for them.
os.environ.setdefault("LP_NUM_THREADS", "0")
# Byte code is kept whatever the environment says: to rewrite the assertions of the tests takes each process seconds, and so does it to compile the
# package, which tests start in dozens of processes.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_collection_finish() -> None:
    """What is imported by now stays: to look through it for garbage again and again takes a twentieth of all time."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True, scope="session")
def sb3_logs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Where stable-baselines3 makes a folder whenever something learns, though it logs nothing."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder that `make_world` makes, its plugin installed here and for the processes that are started from here."""
    from run_helpers import environment, make_world

    with pytest.MonkeyPatch.context() as patch:
        folder = make_world(tmp_path_factory.mktemp("world"))
        patch.syspath_prepend(str(folder / "plugin"))
        patch.setenv("PYTHONPATH", environment(folder)["PYTHONPATH"])
        yield folder
