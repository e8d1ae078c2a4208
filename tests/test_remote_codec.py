import contextlib

import msgpack
import numpy as np
import pytest
from openpi_client import msgpack_numpy

from osel_sim.remote.codec import DTYPES, ProtocolError, pack, unpack

MESSAGE = {
    "image": np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3),
    "state": np.linspace(-1, 1, 8, dtype=np.float32),
    "empty": np.zeros((0, 7), np.float64),
    "scalar": np.float32(0.5),
    "nested": {"flag": True, "list": [1, 2.5, "three", None]},
    "task": "pick up the can – now",
}


def same(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())
    return a == b and type(a) is type(b)


def test_frames_are_openpis_frames_byte_for_byte():
    assert pack(MESSAGE) == msgpack_numpy.packb(MESSAGE)
    assert same(msgpack_numpy.unpackb(pack(MESSAGE)), MESSAGE)
    assert same(unpack(msgpack_numpy.packb(MESSAGE)), MESSAGE)


@pytest.mark.parametrize("dtype", sorted(DTYPES))
def test_every_allowed_dtype_survives(dtype):
    array = np.asarray([[0, 1], [1, 0]], dtype)
    assert same(unpack(pack(array)), array)
    assert unpack(pack(array[0, 1])) == array[0, 1]


def test_a_message_stays_what_it_is_when_the_frame_is_overwritten():
    frame = bytearray(pack(MESSAGE))
    message = unpack(memoryview(frame))
    frame[:] = bytes(len(frame))
    assert same(message, MESSAGE)


def test_a_non_contiguous_array_keeps_its_meaning():
    array = np.arange(24, dtype=np.float32).reshape(4, 6)
    for view in (array[::2, ::-1].T, array.T, np.asfortranarray(array)):
        assert same(unpack(memoryview(pack(view))), view)


@pytest.mark.parametrize(
    "value", [np.array([object()]), np.zeros(2, "V4"), np.zeros(2, complex), np.array(["text"]), np.zeros(2, ">f4"), object(), {1, 2}, 1 << 70]
)
def test_what_has_no_wire_form_is_refused(value):
    with pytest.raises(ProtocolError):
        pack({"value": value})


def array(**changes):
    return msgpack.packb(
        {b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f4", b"shape": [2], **{key.encode(): value for key, value in changes.items()}}
    )


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (b"", "not a msgpack frame"),
        (b"\xc1", "not a msgpack frame"),
        (b"GET / HTTP/1.1\r\n\r\n", "not a msgpack frame"),
        (pack(MESSAGE)[:-3], "not a msgpack frame"),
        (pack(MESSAGE) + b"\0", "not a msgpack frame"),
        (b"\xdd\xff\xff\xff\xff", "not a msgpack frame"),  # a list of 2^32 - 1 items in five bytes
        (b"\xdf\xff\xff\xff\xff", "not a msgpack frame"),
        (b"\xc6\xff\xff\xff\xff", "not a msgpack frame"),
        (b"\x91" * 100_000, "not a msgpack frame"),  # lists in lists in lists
        (b"\xdc\xff\xff" + b"\0" * 65535, "not a msgpack frame"),
        (msgpack.packb({1: 2}), "not a msgpack frame"),
        (array(dtype="|O"), "dtype '|O' is not allowed"),
        (array(dtype="|V4"), "is not allowed"),
        (array(dtype="<U2"), "is not allowed"),
        (array(dtype=["<f4"]), "is not allowed"),
        (array(dtype=None), "is not allowed"),
        (array(shape=[3]), "has 12 bytes, got 8"),
        (array(shape=[1 << 30, 1 << 30, 1 << 30]), "bytes, got 8"),
        (array(shape=[-2]), "shape must be"),
        (array(shape=[2.0]), "shape must be"),
        (array(shape=[True, 2]), "shape must be"),
        (array(shape=[1] * 40 + [2]), "shape must be"),
        (array(shape="2"), "shape must be"),
        (array(data="text"), "data must be bytes"),
        (array(data=None), "data must be bytes"),
        (msgpack.packb({b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"}), "must hold a number"),
        (msgpack.packb({b"__npgeneric__": True, b"data": 300, b"dtype": "|u1"}), "not a msgpack frame"),
        (msgpack.packb({b"__npgeneric__": True, b"data": 1, b"dtype": "|O"}), "is not allowed"),
    ],
)
def test_a_bad_frame_is_refused_with_its_reason(frame, complaint):
    with pytest.raises(ProtocolError, match="(?s)" + complaint.replace("|", r"\|")):
        unpack(frame)


def test_random_damage_never_gets_past_the_error_type():
    random = np.random.default_rng(0)
    frame, read = bytearray(pack(MESSAGE)), 0
    for _ in range(3000):
        damaged = bytearray(frame)
        for place in random.integers(0, len(frame), random.integers(1, 6)):
            damaged[place] = random.integers(0, 256)
        with contextlib.suppress(ProtocolError):
            unpack(bytes(damaged))
            read += 1
    assert 0 < read < 3000, "some damage is within an array's data, and most is not"
