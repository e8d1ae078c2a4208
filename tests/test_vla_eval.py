"""vla-evaluation-harness both ways: its model servers as policies, our tasks as one of its benchmarks.

The slow tests try both against its own package.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from other_packages import beside
from remote_helpers import ENVIRONMENT, TOKEN, observation, serving, serving_with, waiting
from websockets.sync.server import ServerConnection

import osel_sim as osel
from osel_sim.core.errors import ContentError, RemoteError
from osel_sim.formats.conventions import Conventions
from osel_sim.formats.policy_file import load_policy_file
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.codec import pack
from osel_sim.remote.policy import open_remote
from osel_sim.remote.vla_eval import VlaEvalClient

CHUNK = np.sin(np.arange(56.0, dtype=np.float32)).reshape(8, 7)
POLICY = """version = 1
name = "theirs"
title = "Behind a model server of vla-eval"
location = "remote"
kind = "{kind}"
execute = {execute}
inference_seconds = 0.1

[observation]
cameras = ["agentview", "wrist"]
image_size = 96

[remote]
url = "{url}"
network = "none"
timeout = 10

[mapping]
images = {{ wrist = "wrist_cam" }}
"""


def array(value: np.ndarray[Any, Any]) -> dict[str, Any]:
    return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}


def model_server(answer: Callable[[dict[str, Any]], Any], hello: Any = None) -> Any:
    """A server that says hello as theirs do and answers every other message as told; None sends nothing."""

    def handle(connection: ServerConnection) -> None:
        for frame in connection:
            message = msgpack.unpackb(frame)
            payload = {"protocol_version": 1, "model_server": "Test"} if hello is None else hello
            reply = {"type": "hello", "payload": payload} if message["type"] == "hello" else answer(message)
            if reply is not None:
                connection.send(reply if isinstance(reply, bytes | str) else msgpack.packb({"seq": message["seq"], "timestamp": 0.0, **reply}))

    return handle


def acts(message: dict[str, Any]) -> Any:
    return {"type": "action", "payload": {"actions": array(CHUNK)}} if message["type"] == "observation" else None


def ask(handler: Any, mapping: Conventions | None = None, **settings: Any) -> Any:
    with waiting(handler) as url, VlaEvalClient(url, ENVIRONMENT, timeout=2, mapping=mapping, **settings) as client:
        client.reset("pick up the can")
        return client.act(observation())


def test_an_observation_goes_over_in_their_words_and_actions_come_back() -> None:
    seen: list[dict[str, Any]] = []

    def answer(message: dict[str, Any]) -> Any:
        seen.append(message)
        return acts(message)

    mapping = Conventions(images={"wrist": "wrist_cam"}, blank=("second",), gripper="open_positive")
    answered = ask(model_server(answer), mapping)
    assert [message["type"] for message in seen] == ["episode_start", "observation"]
    assert seen[0]["payload"] == {"task": {"name": "pick up the can"}}
    payload = seen[1]["payload"]
    assert set(payload) == {"images", "states", "task_description"} and set(payload["images"]) == {"agentview", "wrist_cam", "second"}
    assert payload["images"]["agentview"]["shape"] == [32, 32, 3] and payload["states"]["shape"] == [8]
    np.testing.assert_array_equal(answered.actions, np.concatenate([CHUNK[:, :6], -CHUNK[:, 6:]], axis=1))


def test_episodes_are_told_apart_and_bytes_do_not_depend_on_those_before() -> None:
    kinds: list[str] = []

    def answer(message: dict[str, Any]) -> Any:
        kinds.append(message["type"])
        return acts(message)

    with waiting(model_server(answer)) as url, VlaEvalClient(url, ENVIRONMENT, timeout=2) as client:
        sizes = []
        for _ in range(3):
            client.reset("pick up the can")
            sizes.append([client.act(observation()).bytes_up for _ in range(60)])
    assert sizes[0] == sizes[1] == sizes[2] and kinds[:1] == ["episode_start"] and kinds.count("episode_end") == 2


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (
            {"type": "error", "payload": {"error": "observation_failed: KeyError: 'proprio'"}},
            "reported an error: observation_failed: KeyError: 'proprio'",
        ),
        ({"type": "action", "payload": {}}, "answered without actions"),
        ({"type": "action", "payload": {"actions": array(np.full((1, 7), np.nan, np.float32))}}, "NaN"),
        ({"type": "action", "payload": {"actions": array(np.zeros((4, 6), np.float32))}}, r"\(4, 6\)"),
        ({"type": "action", "payload": {"actions": array(CHUNK)}, "seq": 99}, "to message 99, where 'action' to message 2 was due"),
        ({"type": "hello", "payload": {}}, "answered 'hello' to message 2"),
        ({"type": "action", "payload": []}, "is no model server of vla-eval"),
        ("Traceback: no", "is no model server of vla-eval"),
        (b"\xc1", "unreadable"),
    ],
)
def test_what_a_server_should_not_answer_is_named(answer: Any, says: str) -> None:
    with pytest.raises(RemoteError, match=says):
        ask(model_server(lambda message: answer if message["type"] == "observation" else None))


def test_an_episode_that_cannot_begin_is_named() -> None:
    def answer(message: dict[str, Any]) -> Any:
        return (
            {"type": "error", "payload": {"error": "episode_start_failed: ValueError: no such task"}} if message["type"] == "episode_start" else None
        )

    with waiting(model_server(answer)) as url, VlaEvalClient(url, ENVIRONMENT, timeout=2) as client:
        client.reset("pick up the can")
        time.sleep(0.2)
        with pytest.raises(RemoteError, match="episode_start_failed: ValueError: no such task"):
            client.act(observation())


@pytest.mark.parametrize(
    ("hello", "says"), [({"protocol_version": 2}, "speaks version 2 of vla-eval's protocol"), ({}, "speaks version None"), ([], "no model server")]
)
def test_another_protocol_is_named(hello: Any, says: str) -> None:
    with pytest.raises(RemoteError, match=says):
        ask(model_server(acts, hello))


def test_a_gripper_that_is_another_than_the_file_says_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    spec = {"gripper": {"name": "gripper", "dims": 1, "format": "binary_close_negative"}}
    ask(model_server(acts, {"protocol_version": 1, "action_spec": spec}))
    assert 'gripper = "open_positive" under [mapping], where the policy file has "closed_positive"' in caplog.text


@pytest.mark.parametrize("ours", [True, False])
def test_a_server_of_the_other_protocol_is_named(ours: bool) -> None:
    with serving() if ours else serving_with(lambda connection: time.sleep(1), pack({})) as url:
        start = time.monotonic()
        with pytest.raises(RemoteError, match='kind = "openpi" is for servers of openpi'):
            VlaEvalClient(url, ENVIRONMENT, TOKEN, timeout=30).connect()
        assert time.monotonic() - start < 5


def test_a_server_without_an_address_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs.toml").write_text(POLICY.format(kind="vla_eval", execute=1, url="ws://x").replace('url = "ws://x"\n', ""))
    with pytest.raises(ContentError, match="a policy of kind 'vla_eval' is a server of its own, give its address"):
        load_policy_file(tmp_path / "theirs.toml")


# -- their own package -------------------------------------------------------------------------------------------------

PACKAGES = ("vla-eval==0.8.0", "jsonargparse==4.53.0", "lazyregistry==0.4.0", "omegaconf==2.4.0", "typeshed-client==2.9.0")
"""It, and what it needs beside what is here."""


@pytest.fixture
def vla_eval(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(sys, "path", [*sys.path, str(beside(*PACKAGES))])
    import vla_eval.api

    return vla_eval


def their_server(chunk_size: int | None) -> Any:
    """A model server of theirs, whose model is `local_small`."""
    from vla_eval.model_servers.predict import PredictModelServer
    from vla_eval.specs import GRIPPER_CLOSE_POS, LANGUAGE, POSITION_DELTA, ROTATION_AA

    class Server(PredictModelServer):
        def __init__(self) -> None:
            super().__init__(chunk_size=chunk_size)
            self.policy = osel.load_policy("local_small")
            self.asked = 0

        def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
            if ctx.is_first:
                self.policy.reset(obs["task_description"])
            self.asked += 1
            shown = {"observation.images.agentview": obs["images"]["agentview"], "observation.state": obs["states"], "task": obs["task_description"]}
            return {"actions": self.policy.act(shown)[:8]}

        def get_action_spec(self) -> dict[str, Any]:
            return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

        def get_observation_spec(self) -> dict[str, Any]:
            return {"language": LANGUAGE}

    return Server()


@pytest.mark.slow
def test_a_model_server_of_theirs_drives_as_the_same_policy_here(vla_eval: Any, tmp_path: Path) -> None:
    task = {"task": "pick_place", "instances": 2, "start_seed": 1000}
    here = osel.record(**task, policies=["local_small"], out=tmp_path / "here").episodes
    for chunk_size, execute in ((8, 1), (None, 8)):  # one that keeps its chunks, and one that sends them
        with vla_eval.api.serve_background(their_server(chunk_size)) as handle:
            (tmp_path / "theirs.toml").write_text(POLICY.format(kind="vla_eval", execute=execute, url=handle.url).replace("0.1\n", "0.0\n"))
            there = osel.record(**task, policies=["theirs"], policies_dir=tmp_path, out=tmp_path / f"there{execute}").episodes
        assert there[["instance", "success", "steps"]].values.tolist() == here[["instance", "success", "steps"]].values.tolist()
        assert there["error"].isna().all()


@pytest.mark.slow
def test_behind_the_wrong_kind_a_model_server_of_theirs_is_named_at_once(vla_eval: Any, tmp_path: Path) -> None:
    with vla_eval.api.serve_background(their_server(8)) as handle:
        (tmp_path / "theirs.toml").write_text(POLICY.format(kind="openpi", execute=1, url=handle.url))
        start = time.monotonic()
        with pytest.raises(RemoteError, match="is a model server of vla-evaluation-harness"):
            open_remote(load_policy_file(tmp_path / "theirs.toml"))
        assert time.monotonic() - start < 5
        (tmp_path / "theirs.toml").write_text(POLICY.format(kind="vla_eval", execute=4, url=handle.url))
        with pytest.raises(RemoteError, match="the server's chunks hold 1 actions, execute = 4"):
            open_remote(load_policy_file(tmp_path / "theirs.toml"))


@pytest.mark.slow
def test_our_tasks_are_a_benchmark_of_theirs(vla_eval: Any, tmp_path: Path) -> None:
    config = {
        "benchmarks": [
            {
                "benchmark": "osel_sim.suites.vla_eval_benchmark:OselSim",
                "name": "osel_sim",
                "episodes_per_task": 2,
                "params": {"tasks": "pick_place", "seed": 1000, "cameras": ["agentview"], "image_size": 96},
            }
        ]
    }
    files = []
    for name, size in (("small", 8), ("smaller", 4)):
        out = tmp_path / name
        (result,) = vla_eval.api.evaluate(their_server(size), config, output_dir=out, docker=False)
        files.append(f"{name}={next(out.glob('*_aggregate.json'))}")
        assert json.loads(Path(files[-1].partition("=")[2]).read_text())["seed"] == 1000
        if name == "small":
            episodes = result["tasks"][0]["episodes"]
    recorded = osel.record(task="pick_place", policies=["local_small"], instances=2, start_seed=1000, out=tmp_path / "log").episodes
    assert [episode.get("failure_reason") for episode in episodes] == [None, None]
    assert [episode["metrics"]["success"] for episode in episodes] == recorded.sort_values("seed")["success"].tolist()
    assert [episode["steps"] for episode in episodes] == recorded.sort_values("seed")["steps"].tolist()
    ingested = osel.ingest(results=files, subgoals=["subgoals"], out=tmp_path / "theirs")
    assert "the run's seed, 1000: 2 episodes of 1 task" in ingested.notes[0] and len(ingested.rows) == 4


def test_their_server_is_no_wait_for_whoever_greets_late() -> None:
    def late(connection: ServerConnection) -> None:
        time.sleep(2.5)
        connection.send(pack({"model": "pi0"}))
        for _ in connection:
            connection.send(pack({"actions": CHUNK}))

    with waiting(late) as url, RemoteClient(url, ENVIRONMENT, timeout=10) as client:
        assert client.foreign and client.act(observation()).actions.shape == (8, 7)
