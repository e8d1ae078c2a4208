"""A policy server that answers several clients together: the answers are those of each alone, and what one does spoils no other's."""

import dataclasses
import itertools
import threading
import zlib
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from remote_helpers import ENVIRONMENT, GREETING, TOKEN, Sinusoid, observation, serving

from osel_sim.api.serve import ServeConfig, serve
from osel_sim.core.errors import PolicyError, RemoteError, SettingError
from osel_sim.formats import library
from osel_sim.policy.batched import act_together, why_not_together
from osel_sim.policy.language_chunk import LanguageChunkConfig, LanguageChunkPolicy
from osel_sim.policy.lerobot_policy import drawing, load
from osel_sim.policy.row_random import RowsError, drawing_by_row
from osel_sim.remote.batching import Batching
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.protocol import Greeting, differing_observations


class Together(Sinusoid):
    """A sinusoid that can be asked together; `asked` has the size of every batch."""

    asked: ClassVar[list[int]] = []

    @classmethod
    def act_batch(cls, sessions, observations):
        cls.asked.append(len(sessions))
        if any(one["task"] == "fall" for one in observations):
            raise RuntimeError("somebody fell")
        return [session.act(one) for session, one in zip(sessions, observations, strict=True)]


class Wrong(Together):
    @classmethod
    def act_batch(cls, sessions, observations):
        return [answer + 1e-3 for answer in super().act_batch(sessions, observations)]


def checkpoint(folder: Path, kind: str) -> Path:
    """A small untrained checkpoint, as LeRobot saves it."""
    image, state = PolicyFeature(FeatureType.VISUAL, (3, 48, 48)), PolicyFeature(FeatureType.STATE, (8,))
    features: dict[str, Any] = {
        "device": "cpu",
        "input_features": {"observation.images.agentview": image, OBS_STATE: state},
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (7,))},
    }
    torch.manual_seed(0)
    if kind == "act":
        small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "chunk_size": 8, "n_action_steps": 8}
        config: Any = ACTConfig(**features, **small, pretrained_backbone_weights=None)
        policy: Any = ACTPolicy(config)
    elif kind == "octo_chunk":
        from osel_sim.policy.octo_chunk import OctoChunkConfig, OctoChunkPolicy

        config = OctoChunkConfig(**features, image_size=48, channels=16, stem_channels=8, width=32, layers=1, hidden=32, noise_scale=1.0)
        policy = OctoChunkPolicy(config)
    else:
        config = LanguageChunkConfig(**features, image_size=48, channels=16, stem_channels=8, hidden=32)
        policy = LanguageChunkPolicy(config)
    policy.save_pretrained(folder)
    stats = {
        OBS_STATE: {"mean": torch.linspace(-1, 1, 8), "std": torch.linspace(0.5, 2, 8)},
        "observation.images.agentview": {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)},
        ACTION: {"mean": torch.zeros(7), "std": torch.full((7,), 0.5)},
    }
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder


@pytest.mark.parametrize("kind", ["act", "language_chunk", "octo_chunk"])
def test_checkpoints_answer_together_what_they_answer_alone(tmp_path, kind):
    folder = str(checkpoint(tmp_path, kind))
    spec = dataclasses.replace(library.load_policy("local_small"), checkpoint=folder, cameras=("agentview",), image_size=48)
    make_session = load(spec, ENVIRONMENT)
    shown = differing_observations(Greeting.of(spec, ENVIRONMENT), 5)
    assert why_not_together(make_session, shown, 7) == ""
    sessions = [make_session() for _ in shown]
    for session, one in zip(sessions, shown, strict=True):
        session.reset(one["task"])
    answers = act_together(sessions, shown)
    assert max(np.abs(one - other).max() for one, other in itertools.pairwise(answers)) > 1e-3, "they are asked different things"
    before = [session._calls for session in sessions]
    histories = [{key: value if key == "task" else np.stack([value, value]) for key, value in one.items()} for one in shown]
    with pytest.raises(PolicyError, match="several observations"):
        type(sessions[0]).act_batch(sessions, [*shown[:-1], histories[-1]])
    assert [session._calls for session in sessions] == before, "none has changed where it raises"


def test_a_shipped_checkpoint_answers_together_what_it_answers_alone():
    spec = library.load_policy("remote_base")
    assert why_not_together(load(spec, ENVIRONMENT), differing_observations(Greeting.of(spec, ENVIRONMENT), 3), 7) == ""


def test_each_row_draws_what_it_would_draw_alone():
    def draws(rows: int) -> list[torch.Tensor]:
        start = torch.zeros(rows, 3)
        later = [torch.randn(rows, 4, 7), torch.rand(rows), torch.normal(0.0, 2.0, size=(rows, 5)), torch.randn_like(start), start.clone().normal_()]
        return [*later, start.clone().uniform_(), torch.bernoulli(torch.full((rows, 6), 0.5)), torch.randint(9, (rows, 2)).float()]

    calls = [("pick up the can", 0), ("pick up the can", 1), ("open the drawer", 0)]
    alone = []
    for call in calls:
        with drawing(*call):
            alone.append(draws(1))
    before = torch.get_rng_state()
    with torch.inference_mode(), drawing_by_row([zlib.crc32(text.encode()) + number for text, number in calls]):
        together = draws(3)
    assert torch.equal(torch.get_rng_state(), before)
    for index, drawn in enumerate(together):
        assert torch.equal(drawn, torch.cat([one[index] for one in alone]))
    with pytest.raises(RowsError, match="3 sessions"), drawing_by_row([1, 2, 3]):
        torch.randn(2, 3)


def test_what_cannot_be_asked_together_is_said():
    shown = differing_observations(GREETING, 3)
    assert why_not_together(Together, shown, 7) == ""
    assert why_not_together(Sinusoid, shown, 7) == "Sinusoid has no act_batch"
    assert "act_batch answers 0.001 away from act" in why_not_together(Wrong, shown, 7)
    falling = [*shown[:2], {**shown[2], "task": "fall"}]
    assert "act_batch fails (RuntimeError: somebody fell)" in why_not_together(Together, falling, 7)


def drive(url: str, index: int, found: dict[int, list[float]]) -> None:
    with RemoteClient(url, ENVIRONMENT, TOKEN, timeout=20) as client:
        client.reset("x" * index)
        chunks = [client.act(observation("x" * index)).actions for _ in range(10)]
    found[index] = [round(float(chunk[0, 0]) * 100) * 1000 + round(float(chunk[0, 1]) * 100) for chunk in chunks]


@pytest.mark.parametrize("kind", [Together, Sinusoid])
def test_clients_are_answered_together_each_with_its_own_state(kind):
    Together.asked.clear()
    found: dict[int, list[float]] = {}
    with serving(kind, batching=Batching(0.05, 4)) as url:
        threads = [threading.Thread(target=drive, args=(url, index, found)) for index in range(1, 7)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    assert found == {index: [1000 * index + call for call in range(1, 11)] for index in range(1, 7)}
    assert max(Together.asked, default=0) in ((2, 3, 4) if kind is Together else (0,)), "at most four together"


def test_one_client_does_not_wait_for_others():
    found: dict[int, list[float]] = {}
    with serving(Together, batching=Batching(600.0, 32)) as url:
        drive(url, 3, found)
    assert found == {3: [3000 + call for call in range(1, 11)]}


def test_a_client_whose_policy_fails_fails_alone():
    class Falls(Together):
        def act(self, observation):
            if observation["task"] == "fall":
                raise RuntimeError("it fell")
            return super().act(observation)

    results: list[Any] = []
    with serving(Falls, batching=Batching(0.2, 8)) as url:

        def fall() -> None:
            with pytest.raises(RemoteError), RemoteClient(url, ENVIRONMENT, TOKEN, timeout=20) as client:
                client.act(observation("fall"))
            results.append("fell")

        def stand() -> None:
            with RemoteClient(url, ENVIRONMENT, TOKEN, timeout=20) as client:
                results.extend(float(client.act(observation("stand")).actions[0, 1]) for _ in range(3))

        threads = [threading.Thread(target=target) for target in (stand, fall)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    assert sorted(map(str, results)) == sorted(["fell", *map(str, map(float, np.float32([0.01, 0.02, 0.03])))])


def test_settings_are_checked():
    with pytest.raises(SettingError, match="batch_max: says how many are answered together: add --batch-ms"):
        serve(ServeConfig.of(policy="local_small", batch_max=4))
    with pytest.raises(SettingError, match="batch_ms"):
        ServeConfig.of(policy="local_small", batch_ms=-1)
