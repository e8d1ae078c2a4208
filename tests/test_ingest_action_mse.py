"""Minus the action error on a LeRobotDataset that the test makes, of the shipped policies and of one that knows the answer."""

import numpy as np
import pytest
from synthetic_demonstrations import SIZE, STEPS, write

from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError
from osel_sim.episodes.loop import Driver
from osel_sim.formats import library
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.ingest import main as ingest_main
from osel_sim.ingestion.action_mse import Measurement, action_mse, measure_one, open_datasets
from osel_sim.interface.specification import specification
from osel_sim.policy.local import LocalCaller

EPISODES = 2


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data") / "flat_world", EPISODES, cameras=("agentview", "wrist"), annotated=False)


def test_error_by_hand():
    actions = np.zeros((3, 7), np.float32)
    logged = np.zeros((2, 7), np.float32)
    logged[1, 0] = 0.5
    assert action_mse(actions, logged) == pytest.approx(0.25 / 14)


def test_samples_are_spread_over_each_episode_and_are_what_was_logged(dataset):
    samples = open_datasets([dataset], [library.load_policy("local_small")], Measurement(frames=3))
    assert [sample.instance.key for sample in samples[:3]] == ["flat_world/000000/000000", "flat_world/000000/000004", "flat_world/000000/000008"]
    assert len(samples) == 3 * EPISODES
    last = samples[-1]
    assert (last.frame, last.end) == (STEPS + 8, 2 * STEPS)
    assert last.instance.text == last.dataset.instruction(last.frame)
    (image,) = last.instance.images()
    assert image.dtype == np.uint8 and image.shape == (SIZE, SIZE, 3)


class Replays:
    """A policy that knows what was logged, off by so much."""

    def __init__(self, actions, off=0.0):
        self.actions, self.off = actions, off

    def reset(self, instruction):
        self.instruction = instruction

    def act(self, observation):
        assert observation["observation.images.agentview"].shape == (96, 96, 3) and observation["task"] == self.instruction
        assert set(observation) == {"observation.images.agentview", "observation.state", "task"}
        if self.off is None:
            raise RuntimeError("no\nidea")
        return self.actions + np.float32(self.off)


def test_who_knows_the_answer_has_no_error_and_a_crash_is_no_score(dataset):
    spec = library.load_policy("local_small")
    sample = open_datasets([dataset], [spec], Measurement(frames=3))[2]
    logged = np.zeros((50, 7), np.float32)
    own = sample.dataset.actions[sample.frame : sample.end]
    logged[: len(own)] = own * 0.5
    sample.dataset.actions[sample.frame : sample.end] *= 0.5  # so that being off is not clipped away
    logged[len(own) :] = 1.0  # beyond the episode nothing counts

    def ask(off):
        driver = Driver(spec, LocalCaller(Replays(logged, off), spec, specification()))
        return measure_one(sample, driver, sample.observations(1), 0.05)

    right, wrong, crashed = ask(0.0), ask(0.3), ask(None)
    assert (right.score, right.success, right.actions) == (0.0, True, STEPS - 8)
    assert wrong.score == pytest.approx(-0.09, rel=1e-4) and not wrong.success
    assert (crashed.score, crashed.success, crashed.error) == (None, False, "local_small: RuntimeError: no idea")


@pytest.mark.slow
def test_shipped_policies_are_measured(dataset, tmp_path):
    out = tmp_path / "log"
    command = ["--metric", "action-mse", "--dataset", dataset, "--policies", "local_small", "remote_large", "--frames", 2, "--tolerance", 0.3]
    assert ingest_main([str(item) for item in [*command, "--out", out]]) == 0
    rows, metadata = read_rollouts(out)
    assert [row.policy for row in rows] == ["local_small", "remote_large"] * 2 * EPISODES
    assert all(row.error is None and row.score is not None and -4 < row.score < 0 for row in rows)
    assert [row.success for row in rows] == [row.score >= -0.3 for row in rows]
    local, remote = rows[:2]
    assert (local.task, local.upload, local.inference, local.price, local.calls, local.actions) == ("flat_world", 0.0, 0.015, 0.0, 1, 8)
    assert remote.upload > 0 and remote.download > 0 and remote.price == pytest.approx(library.load_policy("remote_large").price.of(8, 1, 0.0))
    assert (local.steps, local.subgoals, local.motion) == (None, None, None)
    assert metadata["source"] == {"metric": "action-mse", "datasets": ["flat_world"], "frames": 2, "tolerance": 0.3}
    assert len(ContextCache(out).table(metadata["encoder"], [row.instance for row in rows])) == len(rows)


def test_bad_datasets_get_one_line(dataset, tmp_path, capsys):
    spec = [library.load_policy("remote_large")]
    with pytest.raises(DataError, match=r"is no LeRobotDataset, it has no meta/info\.json"):
        open_datasets([tmp_path], spec, Measurement())
    with pytest.raises(DataError, match=r"no images 'observation\.images\.top' .*--camera wrist=COLUMN"):
        open_datasets([dataset], spec, Measurement(cameras={"wrist": "observation.images.top"}))
    other = write(tmp_path / "one_eye", 1, annotated=False)
    with pytest.raises(DataError, match=r"did you mean 'observation\.images\.agentview'.*--camera wrist=COLUMN"):
        open_datasets([other], spec, Measurement())
    assert open_datasets([other], spec, Measurement(cameras={"wrist": "observation.images.agentview"}))
    for file in other.glob("data/**/*.parquet"):
        file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(DataError, match=r"one_eye/data/.*\.parquet: is not a whole Parquet file"):
        open_datasets([other], [library.load_policy("local_small")], Measurement())
    flags = ["--metric", "action-mse", "--dataset", str(dataset), "--policies", "local_small", "--out", str(tmp_path / "log")]
    assert ingest_main([*flags, "--camera", "wrist"]) == 2
    assert ingest_main([*flags, "--camera", "wrist=observation.images.wrist"]) == 2
    error = capsys.readouterr().err
    assert "--camera: must be CAMERA=COLUMN, got 'wrist'" in error
    assert "--camera wrist: no policy has that camera" in error
    assert not (tmp_path / "log").exists()
