"""A recording whose shards are recorded by submitit and by Ray: the bytes of one that is not divided; what fails is told, and sent again."""

import os
import sys
from pathlib import Path

import pytest
from run_helpers import command

from osel_sim.core.engines import make_engine, options_of
from osel_sim.core.errors import MissingPackageError, SettingError
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.record import main as record_main

FLAGS = ("--instances", 3, "--start-seed", 40, "--policies", "calm", "--workers", 1)


@pytest.fixture(scope="module")
def world(world):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([os.environ["PYTHONPATH"], *sys.path]))  # of jobs, which are processes of their own
        yield world


def record(world: Path, *flags: object) -> int:
    return record_main(list(map(str, command(world, "record", *FLAGS, *flags)[3:])))


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("rollouts.parquet", "contexts.npz")}


@pytest.fixture(scope="module")
def whole(world):
    """The recording that nobody divided."""
    assert record(world, "--out", world / "whole") == 0
    return files(world / "whole")


def test_options_are_what_they_look_like():
    assert options_of(["timeout_min=60", "slurm_partition=gpu", "num_gpus=0.5", "slurm_comment=a=b"]) == {
        "timeout_min": 60,
        "slurm_partition": "gpu",
        "num_gpus": 0.5,
        "slurm_comment": "a=b",
    }
    for word in ("timeout_min", "=60", "a b=1"):
        with pytest.raises(SettingError, match="cluster_option: must be KEY=VALUE"):
            options_of([word])


@pytest.mark.parametrize(("cluster", "package", "extra"), [("slurm", "submitit", "slurm"), ("local", "submitit", "slurm"), ("ray", "ray", "ray")])
def test_an_engine_that_is_not_installed_is_named_with_how_to_get_it(monkeypatch, tmp_path, cluster, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=rf"--cluster {cluster} needs the package '{package}'.*pip install 'osel-sim\[{extra}\]'"):
        make_engine(cluster, tmp_path, 1, {})
    assert not list(tmp_path.iterdir())


def test_an_engine_that_cannot_be_had_leaves_no_folder(world, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert record(world, "--cluster", "ray", "--shards", 2, "--out", world / "none") == 2
    assert "osel-sim[ray]" in capsys.readouterr().err and not (world / "none").exists()


@pytest.mark.slow
def test_submitit_records_the_shards_and_a_resume_sends_what_failed(world, whole, capsys):
    pytest.importorskip("submitit", reason="needs submitit: make cluster")
    for option, complaint in (("partitoin=gpu", "submitit refuses it"), ("timeout_min=soon", "submitit refuses it")):
        assert record(world, "--cluster", "local", "--shards", 3, "--cluster-option", option, "--out", world / "wrong") == 2
        assert complaint in capsys.readouterr().err and not (world / "wrong").exists()
    folder = world / "submitit"
    in_the_way = folder / "shards" / "2" / "notes.txt"
    in_the_way.parent.mkdir(parents=True)
    in_the_way.write_text("mine")
    assert record(world, "--cluster", "local", "--shards", 3, "--at-once", 2, "--retries", 1, "--out", folder) == 2
    told = capsys.readouterr().err
    assert "shard 2/3 failed: " in told and "it is sent again" in told and "notes.txt" not in told.splitlines()[0]
    assert "1 of 3 shards failed, 2/3 the first" in told.splitlines()[-1] and f"record --resume --out {folder}" in told
    assert not (folder / "rollouts.parquet").exists()
    done = {number: (folder / "shards" / number / "rollouts.parquet").stat().st_mtime_ns for number in "13"}
    in_the_way.unlink()
    assert record_main(["--resume", "--out", str(folder)]) == 0
    assert files(folder) == whole
    assert {number: (folder / "shards" / number / "rollouts.parquet").stat().st_mtime_ns for number in "13"} == done
    assert record_main(["--resume", "--cluster", "local", "--shards", "3", "--out", str(folder)]) == 0, "nothing is missing"
    assert files(folder) == whole
    assert record(world, "--cluster", "local", "--shards", 3, "--out", folder) == 2
    assert "add --resume" in capsys.readouterr().err


@pytest.mark.slow
def test_two_ray_nodes_record_the_shards(world, whole, monkeypatch):
    ray = pytest.importorskip("ray", reason="needs ray: make cluster")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    nodes = Cluster(initialize_head=False)
    try:
        try:
            nodes.add_node(num_cpus=1, include_dashboard=False)
            nodes.add_node(num_cpus=1)
        except Exception as error:
            if "timed out during startup" not in str(error):
                raise
            pytest.skip("Ray gives its processes 30 s to start, which is too little on this machine now")
        ray.init(address=nodes.address, log_to_driver=False, logging_level="warning")
        assert len(ray.nodes()) == 2
        with pytest.raises(SettingError, match="Ray refuses it"):
            make_engine("ray", world, 1, {"num_gpu": 1})
        assert record(world, "--cluster", "ray", "--shards", 2, "--out", world / "ray") == 0
    finally:
        ray.shutdown()
        nodes.shutdown()
    assert files(world / "ray") == whole
    assert len(read_rollouts(world / "ray")[0]) == 3
