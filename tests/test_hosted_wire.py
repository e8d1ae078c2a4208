"""The wire to a host process, both ends in this process: what is not a whole message in time, from who may send it, is an error."""

import contextlib
import socket
import threading
import time

import pytest
from websockets.exceptions import InvalidHandshake, InvalidMessage, WebSocketException

from osel_sim.remote.codec import ProtocolError
from osel_sim.suites.wire import LARGEST, Wire

TOKEN = "secret-enough"


@pytest.fixture
def connected():
    """Two sockets that are connected on loopback."""
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()) as one, listener.accept()[0] as other:
        yield one, other


@pytest.fixture
def client(connected):
    """The asking end, behind its handshake; the other is the plain socket of `connected`."""
    return Wire(connected[0], asks=True)


@pytest.fixture
def server(connected):
    """The answering end."""
    return Wire(connected[1], asks=False)


@contextlib.contextmanager
def beside(function):
    """Run a function in a thread meanwhile."""
    thread = threading.Thread(target=function)
    thread.start()
    yield
    thread.join(10)
    assert not thread.is_alive()


@pytest.mark.parametrize("size", [0, 1, 125, 126, 65_536, 1_000_000])
def test_messages_of_every_length_arrive_whole_and_in_order(size, client, server):
    message = bytes(range(256)) * (size // 256) + bytes(size % 256)

    def answer():
        for _ in range(2):
            server.send(bytes(server.receive(10.0)) + b"!", 10.0)

    with beside(answer):
        for part in (b"a", b"b"):
            client.send(part + message, 10.0)
            assert client.receive(10.0) == part + message + b"!"


def test_a_connection_needs_the_token():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url, accepted = f"ws://127.0.0.1:{listener.getsockname()[1]}", []

        def accept():
            for _ in range(2):
                connection, _ = listener.accept()
                try:
                    accepted.append(Wire.accept(connection, TOKEN, 5.0))
                except WebSocketException as error:
                    connection.close()
                    accepted.append(error)

        with beside(accept):
            with pytest.raises(InvalidHandshake, match="401"):
                Wire.connect(url, "something-else", 5.0)
            client = Wire.connect(url, TOKEN, 5.0)
        assert isinstance(accepted[0], InvalidHandshake)
        accepted[1].send(b"welcome")
        assert client.receive(5.0) == b"welcome"
        client.close()
        with pytest.raises(ConnectionError):
            accepted[1].receive(5.0)
        accepted[1].close()


@pytest.mark.parametrize(
    ("said", "error"),
    [
        (b"", TimeoutError),
        (b"GET / HTTP/1.1\r\nAuth", TimeoutError),
        (b"\x00\xff\r\n\r\n", InvalidMessage),
        (b"GET / HTTP/1.1\r\n\r\n", InvalidHandshake),
    ],
)
def test_who_does_not_ask_properly_is_not_waited_for(said, error, connected):
    connected[0].sendall(said)
    with pytest.raises(error):
        Wire.accept(connected[1], TOKEN, 0.2)


def test_half_a_message_is_an_error_when_the_other_end_is_gone_and_when_time_is_up(client, connected):
    other = connected[1]
    half = b"\x82\x7e\x10\x00" + bytes(100)  # a binary frame of 4,096 bytes begins
    other.sendall(half)
    with pytest.raises(TimeoutError):
        client.receive(0.1)
    other.close()
    with pytest.raises(ConnectionError):
        client.receive(5.0)


def test_time_is_counted_for_the_whole_message(client, connected):
    def drip():
        connected[1].sendall(b"\x82\x7e\x10\x00")
        with contextlib.suppress(OSError):
            for _ in range(60):
                connected[1].sendall(b"x")
                time.sleep(0.02)

    start = time.monotonic()
    with beside(drip):
        with pytest.raises(TimeoutError):
            client.receive(0.2)
        assert time.monotonic() - start < 1.0
        client.close()


def test_a_message_that_nobody_takes_is_given_up(client):
    with pytest.raises(TimeoutError):
        client.send(bytes(16 << 20), 0.2)


LONG = (LARGEST + 1).to_bytes(8, "big")


@pytest.mark.parametrize(
    ("asks", "frame", "error", "message"),
    [
        (True, b"\x82\x7f" + LONG, ProtocolError, "67,108,865 bytes, more than 67,108,864"),
        (False, b"\x82\xff" + LONG + bytes(4), ProtocolError, "more than 67,108,864"),
        (True, b"\x81\x02no", ProtocolError, "binary message in one frame"),
        (True, b"\x02\x02no", ProtocolError, "binary message in one frame"),
        (True, b"\x89\x00", ProtocolError, "binary message in one frame"),
        (True, b"\xc2\x02no", ProtocolError, "binary message in one frame"),
        (True, b"\x82\x82abcdno", ProtocolError, "without a mask"),
        (False, b"\x82\x02no", ProtocolError, "with a mask"),
        (True, b"\x82\x02no\x82\x02no", ProtocolError, "more than one"),
        (True, b"\x88\x00", ConnectionError, "hung up"),
        (True, b"GET / HTTP/1.1\r\n\r\n", ProtocolError, "binary message in one frame"),
    ],
)
def test_what_is_no_message_is_an_error_at_once(asks, frame, error, message, connected):
    connected[1].sendall(frame)
    with pytest.raises(error, match=message):
        Wire(connected[0], asks).receive(5.0)


@pytest.mark.parametrize("size", [3, 200, 100_000])
def test_a_message_is_the_same_in_pieces_and_behind_any_mask(size, server, connected):
    message, mask = bytes(range(256)) * (size // 256) + bytes(size % 256), b"mask"
    masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(message))
    length = bytes([0x80 | size]) if size < 126 else b"\xfe" + size.to_bytes(2, "big") if size < 65_536 else b"\xff" + size.to_bytes(8, "big")

    def say():
        for byte in b"\x82" + length + mask + masked[:2]:
            connected[0].sendall(bytes([byte]))
            time.sleep(0.005)
        connected[0].sendall(masked[2:])

    with beside(say):
        assert server.receive(5.0) == message


def test_whoever_waits_is_woken_when_the_wire_is_closed(client):
    with beside(lambda: (time.sleep(0.2), client.close())), pytest.raises(OSError):
        client.receive(10.0)
