import json
import subprocess
import sys

import numpy as np
import pytest

from osel_sim.collect import main as collect_main
from osel_sim.core import content
from osel_sim.formats.task_file import load_task_file
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.instance import make_instance
from osel_sim.training.demonstrations import Shard, record_shard

TASK = content.find("tasks", "pick_place")


def collect(*arguments):
    return subprocess.run([sys.executable, "-m", "osel_sim.collect", "--task", "pick_place", *map(str, arguments)], capture_output=True, text=True)


def test_a_shard_is_a_lerobot_dataset_of_what_the_expert_did(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    frames, episodes, failed = record_shard(Shard(TASK, tmp_path / "shard", 0, 2, 48, (0,)))
    assert episodes == 2 and failed == []
    dataset = LeRobotDataset("osel_sim/pick_place", root=tmp_path / "shard")
    assert len(dataset) == frames and dataset.fps == 20
    first = dataset[0]
    assert first["task"] == make_instance(load_task_file(TASK), 0, 0, "train").instruction
    assert first["observation.images.wrist"].shape == (3, 48, 48)
    assert first["observation.state"].shape == (8,) and first["action"].shape == (7,)
    task = load_task_file(TASK)
    instance = make_instance(task, 0, 0, "train")
    names = [entity.name for entity in task.entities]
    assert first["annotation.active"].tolist() == [names.index(instance.target), names.index(instance.container)]
    env = TaskEnv(task)
    env.load(instance)
    for camera in ("agentview", "wrist"):
        places = np.array(first[f"annotation.places.{camera}"]).reshape(-1, 2)
        for name, place in zip(names, places, strict=True):
            if (np.abs(place) <= 1).all():
                np.testing.assert_allclose(place, env.project(env.entity_positions()[name][None], camera, 2)[0] - 1, atol=1e-5)
    assert (np.abs(np.array(first["annotation.places.agentview"]).reshape(-1, 2)[names.index(instance.target)]) <= 1).all()
    env.close()
    noise = np.array(dataset.hf_dataset["annotation.noise"])
    assert 0.02 < noise.mean() < 0.6
    actions = np.array(dataset.hf_dataset["action"])
    assert np.abs(actions).max() <= 1.0 and actions[-1, -1] == -1.0  # lets go at the end
    # A finished shard is not recorded again.
    assert record_shard(Shard(TASK, tmp_path / "shard", 0, 2, 48, (0,))) == (frames, episodes, failed)


def test_wrong_input_is_one_line(tmp_path, capsys):
    used = tmp_path / "used"
    used.mkdir()
    for arguments, message in (
        (("--episodes", 0, "--out", tmp_path / "a"), "1 or more"),
        (("--episodes", 1, "--out", used), "--resume"),
        (("--episodes", 1, "--out", tmp_path / "a", "--tasks", tmp_path / "no"), "folder"),
    ):
        assert collect_main(["--task", "pick_place", *map(str, arguments)]) == 2
        told = capsys.readouterr().err
        assert message in told and told.count("\n") == 1


@pytest.mark.slow
def test_worker_count_and_interruption_change_nothing(tmp_path):
    from osel_sim.training.dataset import load_demonstrations

    def contents(folder):
        data = load_demonstrations(folder, ("agentview",), progress=False)
        return data.state, data.action, data.images["agentview"]

    assert collect("--episodes", 22, "--out", tmp_path / "one", "--workers", 1, "--image-size", 32).returncode == 0
    assert collect("--episodes", 20, "--out", tmp_path / "two", "--workers", 2, "--image-size", 32).returncode == 0
    refused = collect("--episodes", 22, "--out", tmp_path / "two", "--image-size", 64, "--resume")
    assert refused.returncode == 2 and "image_size" in refused.stderr
    assert collect("--episodes", 22, "--out", tmp_path / "two", "--workers", 2, "--image-size", 32, "--resume").returncode == 0
    written = {file: file.stat().st_mtime_ns for file in (tmp_path / "two").rglob("*.parquet")}
    again = collect("--episodes", 22, "--out", tmp_path / "two", "--image-size", 32, "--resume")
    assert again.returncode == 0 and "complete" in again.stdout
    assert {file: file.stat().st_mtime_ns for file in written} == written
    for one, two in zip(contents(tmp_path / "one"), contents(tmp_path / "two"), strict=True):
        np.testing.assert_array_equal(one, two)
    side = json.loads((tmp_path / "two" / "meta" / "osel_sim.json").read_text())
    assert side["seeds"] == 22 and side["roles"] == {"object": "object", "container": "container"}
