"""Servers that are not ours: their arrays are read, and what cannot be read beside the actions does not matter."""

import msgpack
import numpy as np
import pytest
from remote_helpers import ENVIRONMENT, observation, serving_with

from osel_sim.core.errors import PolicyError, RemoteError
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.codec import ProtocolError, pack, unpack
from osel_sim.remote.dialects import Unreadable, actions_in, unpack_any

CHUNK = np.linspace(-0.5, 0.5, 56, dtype=np.float32).reshape(8, 7)
RAW = {"data": CHUNK.tobytes(), "shape": [8, 7]}


def keys_as_bytes(value):
    return {key.encode(): item for key, item in value.items()}


ARRAYS = {
    "openpi": keys_as_bytes({"__ndarray__": True, "dtype": "<f4", **RAW}),
    "openpi with text for keys": {"__ndarray__": True, "dtype": "<f4", **RAW},
    "msgpack-numpy": keys_as_bytes({"nd": True, "type": "<f4", "kind": b"", **RAW}),
    "vLLM": {"nd": True, "type": "<f4", "kind": "f", **RAW},
    "a name for the dtype": {"nd": True, "type": b"float32", **RAW},
    "big-endian": {"nd": True, "type": ">f4", "shape": [8, 7], "data": CHUNK.astype(">f4").tobytes()},
    "a batch of one": {"nd": True, "type": "<f4", "shape": [1, 1, 8, 7], "data": RAW["data"]},
    "lists": CHUNK.tolist(),
    "a list of arrays": [keys_as_bytes({"__ndarray__": True, "dtype": "<f4", "shape": [7], "data": row.tobytes()}) for row in CHUNK],
}
BESIDE = {
    "text": keys_as_bytes({"__ndarray__": True, "dtype": "<U4", "shape": [1], "data": bytes(16)}),
    "objects": {"nd": True, "type": "|O", "shape": [1], "data": b"cos\nsystem"},
    "false": {"nd": True, "type": "<f4", "shape": [1 << 30], "data": b"1234"},
    "complex": {"complex": True, "data": "1+2j"},
    "numbered": {0: 1.0, None: 2},
    "when": msgpack.Timestamp(1),
    "extension": msgpack.ExtType(5, b"x"),
    "long": list(range(6000)),
    "words": "x" * 70_000,
    "not UTF-8": b"\xff",
    "server_timing": {"infer_ms": 12.3},
}


def answered(answer, greeting=None):
    """What a client makes of an answer of a server that is not ours."""
    frame = msgpack.packb(answer) if not isinstance(answer, bytes) else answer

    def answers(connection):
        for _ in connection:
            connection.send(frame)

    with serving_with(answers, pack({}) if greeting is None else greeting) as url, RemoteClient(url, ENVIRONMENT, timeout=5) as client:
        client.reset("x")
        return client.act(observation("x"))


@pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS)
def test_arrays_of_every_dialect_are_read_and_what_lies_beside_them_is_passed_over(array):
    answer = answered({b"actions": array, **BESIDE}, greeting=msgpack.packb({"norm_stats": {0: 1.0}, "when": msgpack.Timestamp(1)}))
    np.testing.assert_allclose(answer.actions, CHUNK, atol=1e-6)
    assert answer.bytes_down > 70_000


def test_what_an_answer_is_charged_for_does_not_depend_on_how_long_it_took():
    sizes = {answered({"actions": ARRAYS["vLLM"], "server_timing": {"infer_ms": value}}).bytes_down for value in (1, 1e-300, "long ago")}
    assert len(sizes) == 1


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        ({"action": CHUNK}, "answered without actions (it has: action (float32 (8, 7))); actions under [mapping] says what they are called"),
        ({"data": {"actions": 1}, "ok": True}, "answered without actions (it has: data (a map of actions), ok (bool)); actions under [mapping]"),
        (
            {"actions": {"arm": CHUNK[:, :6], "hand": CHUNK[:, 6:]}},
            "actions is a map of arm (float32 (8, 6)), hand (float32 (8, 1)), where one array",
        ),
        ({"actions": Unreadable("an array of the dtype '<U4'")}, "actions is an array of the dtype '<U4', where an array (T, N) is needed"),
        ({"actions": "none"}, "actions is text, where"),
        ({"actions": [{"x": 1}]}, "actions is a list with a map of x in it, where numbers are needed"),
        ("done", "answered without actions (it is text)"),
        ([], "answered without actions (it is a list)"),
    ],
)
def test_what_should_be_the_actions_is_named(reply, says):
    with pytest.raises(PolicyError) as error:
        actions_in(reply, "actions")
    assert says in str(error.value)


def test_an_entry_that_should_be_the_actions_is_named_by_the_client():
    with pytest.raises(RemoteError, match=r"actions is an array of the dtype '\|O', where an array \(T, N\) is needed"):
        answered({"actions": BESIDE["objects"]})
    with pytest.raises(RemoteError, match=r"actions have the shape \(2, 4, 7\), one chunk \(T, 7\) is needed"):
        answered({"actions": {"nd": True, "type": "<f4", "shape": [2, 4, 7], "data": RAW["data"]}})


@pytest.mark.parametrize("frame", [b"", b"\xc1", b"\x81\xa1a", b"\x91" * 5000, b"\xdd\xff\xff\xff\xff"])
def test_what_is_no_msgpack_is_refused(frame):
    with pytest.raises(ProtocolError):
        unpack_any(frame)


def test_our_own_protocol_stays_strict():
    with pytest.raises(ProtocolError, match="int is not allowed for map key"):
        unpack(msgpack.packb({0: 1}))
