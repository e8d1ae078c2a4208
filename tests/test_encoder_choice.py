"""`--encoder auto`: which of several encoders it is, and that texts encoded in batches come out alike however often it was interrupted."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_log import clusters
from test_offline_live import make_run

import osel_sim as osel
from osel_sim.analysis.encoder_choice import choose_encoder, with_best_encoder
from osel_sim.analysis.log import read_log
from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import UsageError
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.ingestion.write import IngestedInstance, check_out, write_log
from osel_sim.selection.reward import RewardWeights

FREE = RewardWeights(0.0, 0.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A log of clusters with contexts of two encoders: `made_up` tells them apart, `noise` does not."""
    made = clusters(tmp_path_factory.mktemp("encoders") / "log", instances=600, clusters=4, dim=8)
    cache = ContextCache(made.folder, autosave=0)
    noise = np.random.default_rng(1).normal(size=(600, 8)).astype(np.float32)
    for row in range(600):
        cache.put("noise@1", f"made_up/{row}", noise[row])
    cache.save()
    return made


@pytest.mark.parametrize("usual", ["made_up@1", "noise@1"])
def test_the_encoder_that_predicts_rewards_is_taken_whichever_is_usual(made, usual):
    log, choice = with_best_encoder(read_log(made.folder, usual), FREE)
    assert choice.encoder == log.encoder == "made_up@1" and log.contexts.shape == (600, 8)
    assert next(iter(choice.gains)) == usual and choice.gains["made_up@1"][0] > 0.03 > choice.gains["noise@1"][0]
    assert 200 < choice.instances < 400 and "made_up@1" in str(choice)


def test_where_none_tells_anything_the_usual_one_stays(made):
    log = read_log(made.folder, "noise@1")
    for seed in range(5):
        contexts = {f"{name}{seed}": np.random.default_rng([seed, name == "b"]).normal(size=(600, 8)).astype(np.float32) for name in "ab"}
        assert choose_encoder(log, contexts, FREE).encoder == f"a{seed}"


def test_the_scoring_half_has_no_say(made):
    log = read_log(made.folder, "made_up@1")
    success = log.success.copy()
    success[log.half("score")] = 0.0
    contexts = {"noise": read_log(made.folder, "noise@1").contexts, "made_up": log.contexts}
    assert choose_encoder(replace(log, success=success), contexts, FREE) == choose_encoder(log, contexts, FREE)


def test_a_replay_says_which_it_took(made, tmp_path):
    result = osel.replay(made.folder, selectors=["thompson"], seeds=1, decisions=50, encoder="auto", no_frontier=True, out=tmp_path).result
    assert result["log"]["encoder"] == "made_up@1" and "noise@1" in result["log"]["encoder_choice"]["text"]


def test_ingest_takes_what_is_at_hand_and_names_it(tmp_path):
    rows = "".join(f"{'red' if row % 2 else 'blue'} thing number {row},{row % 2},{1 - row % 2}\n" for row in range(300))
    (tmp_path / "t.csv").write_text("text,a,b\n" + rows)
    values = {"files": str(tmp_path / "t.csv"), "text": "text", "policies": ["a", "b"], "success": "{policy}", "encoder": "auto"}
    found = osel.ingest(**values, out=tmp_path / "log")
    assert read_rollouts(tmp_path / "log")[1]["encoder"] == found.encoder and any(found.encoder in note for note in found.notes)
    again = osel.ingest(**values, out=tmp_path / "log")
    assert again.encoder == found.encoder


def test_frames_of_datasets_and_live_runs_are_refused(tmp_path):
    with pytest.raises(UsageError, match="for tables"):
        osel.ingest(metric="action-mse", dataset=[tmp_path], policies=["local_small"], encoder="auto", out=tmp_path / "log")
    with pytest.raises(UsageError, match="for rollout logs"):
        osel.replay(make_run(tmp_path / "run"), encoder="auto", out=tmp_path / "replay")


class Neighbours:
    """An encoder whose contexts depend on what else is in the batch, far more than those of real ones do."""

    name, identity, dimension, image_size = "neighbours", "neighbours@1", 2, 16
    batches = 0

    def encode(self, images, instruction):
        return self.encode_texts([instruction])[0]

    def encode_texts(self, texts):
        self.batches += 1
        return np.array([[len(text), sum(map(len, texts))] for text in texts], np.float32)


def test_an_interrupted_encoding_of_texts_ends_with_the_same_contexts(tmp_path):
    texts = ["word " * (1 + row % 70) for row in range(200)]
    instances = [IngestedInstance(f"t/{row}", text, "", lambda: []) for row, text in enumerate(texts)]

    def write(folder, encoder):
        write_log(folder, check_out(folder, instances), [], instances, lambda: encoder, {})
        return (folder / "contexts.npz").read_bytes()

    whole = Neighbours()
    first = write(tmp_path / "first", whole)
    assert whole.batches == 3  # of 70 different texts
    (tmp_path / "second").mkdir()
    cache = ContextCache(tmp_path / "second", autosave=0)
    kept = ContextCache(tmp_path / "first")
    for item in instances[:150:3]:  # not whole batches
        cache.put("neighbours@1", item.key, kept.get("neighbours@1", item.key))
    cache.save()
    (tmp_path / "second" / "ingest.json").write_bytes((tmp_path / "first" / "ingest.json").read_bytes())
    assert write(tmp_path / "second", Neighbours()) == first
