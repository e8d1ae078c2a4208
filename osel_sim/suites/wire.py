"""The wire between a host process and the process that asks it: WebSocket on loopback, without threads.

websockets does the protocol; whoever asks or answers reads and writes the socket itself. The blocking client and server of websockets have a thread
on each side that reads and hands every message over, which took most of a message's time. They are right where something may come at any time, such
as a policy server's pings. Here nothing comes but the answer to a question.
"""

import contextlib
import hmac
import socket
import time
from collections import deque
from http import HTTPStatus
from typing import Self

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import Event, State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from osel_sim.remote.codec import ProtocolError

LARGEST = 64 << 20
"""Bytes of a message: six images of 1,024 pixels have 19 million."""
PIECE = 1 << 16
"""Bytes that are read at once."""


class Wire:
    """One end of a connection. After an error it is fit for nothing but `close`, since what would come next on it is unknown.

    Args:
        connection: connected; closed with the wire.
        protocol: of this end, before anything is said.
    """

    def __init__(self, connection: socket.socket, protocol: ClientProtocol | ServerProtocol) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._protocol = connection, protocol
        self._events: deque[Event] = deque()

    @classmethod
    def connect(cls, url: str, token: str, seconds: float) -> Self:
        """Connect to a host.

        Args:
            url: `ws://127.0.0.1:port`.
            token: that it wants to see.
            seconds: within which it must agree.

        Raises:
            OSError: nobody is there, or does not answer in time.
            WebSocketException: the token is refused, or it is no WebSocket server.
        """
        address, end = parse_uri(url), time.monotonic() + seconds
        protocol = ClientProtocol(address, max_size=LARGEST)
        wire = cls(socket.create_connection((address.host, address.port), seconds), protocol)
        try:
            request = protocol.connect()
            request.headers["Authorization"] = f"Api-Key {token}"
            protocol.send_request(request)
            wire._flush(end)
            wire._event(end)
            if protocol.handshake_exc is not None:
                raise protocol.handshake_exc
        except BaseException:
            wire.close()
            raise
        return wire

    @classmethod
    def accept(cls, connection: socket.socket, token: str, seconds: float) -> Self:
        """Answer a client that has connected.

        Args:
            connection: of the client.
            token: that it must bring.
            seconds: within which it must ask to come in.

        Raises:
            OSError: it hung up, or did not ask in time.
            WebSocketException: it was turned away: it has not the token, or is no WebSocket client.
        """
        protocol, end = ServerProtocol(max_size=LARGEST), time.monotonic() + seconds
        wire = cls(connection, protocol)
        request = wire._event(end)
        if isinstance(request, Request) and _brings(request, token):
            response = protocol.accept(request)
        else:
            response = protocol.reject(HTTPStatus.UNAUTHORIZED, "a token is needed\n")
        protocol.send_response(response)
        wire._flush(end)
        if protocol.state is not State.OPEN:
            raise InvalidStatus(response)
        return wire

    def send(self, message: bytes, seconds: float | None = None) -> None:
        """Send a message.

        Raises:
            OSError: the other end is gone, or has not taken it in time (`TimeoutError`); without `seconds` it may take as long as it likes.
            WebSocketException: one of both has hung up before.
        """
        self._protocol.send_binary(message)
        self._flush(_end(seconds))

    def receive(self, seconds: float | None = None) -> bytes:
        """The next message, whole.

        Raises:
            OSError: the other end is gone, or it has not come in time (`TimeoutError`); without `seconds` it may take as long as it likes.
            WebSocketException: the other end hung up, or sent what is no WebSocket message or too long.
            ProtocolError: it is text, or comes in several frames.
        """
        end = _end(seconds)
        while True:
            frame = self._event(end)
            if isinstance(frame, Frame) and frame.opcode in (Opcode.TEXT, Opcode.BINARY):
                if frame.opcode is Opcode.TEXT or not frame.fin:
                    raise ProtocolError("expected a binary message in one frame")
                return bytes(frame.data)

    def close(self) -> None:
        """Hang up. May be called twice, and while another thread waits for a message: that fails then."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _event(self, end: float | None) -> Event:
        """What happens next: a request, a response, a frame."""
        while not self._events:
            if self._protocol.close_expected():
                self._protocol.receive_eof()  # one end has said that it hangs up: what else may come does not count
            if self._protocol.state is State.CLOSED:
                raise self._protocol.handshake_exc or self._protocol.close_exc
            self._socket.settimeout(_left(end))
            if data := self._socket.recv(PIECE):
                self._protocol.receive_data(data)
            else:
                self._protocol.receive_eof()
            self._events.extend(self._protocol.events_received())
            self._flush(end)
        return self._events.popleft()

    def _flush(self, end: float | None) -> None:
        """Send what the protocol has to say."""
        for data in self._protocol.data_to_send():
            self._socket.settimeout(_left(end))
            self._socket.sendall(data)


def _brings(request: Request, token: str) -> bool:
    given = request.headers.get_all("Authorization")
    return len(given) == 1 and hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), f"Api-Key {token}".encode())


def _end(seconds: float | None) -> float | None:
    return None if seconds is None else time.monotonic() + seconds


def _left(end: float | None) -> float | None:
    """Seconds until then.

    Raises:
        TimeoutError: there are none.
    """
    if end is None:
        return None
    left = end - time.monotonic()
    if left <= 0:
        raise TimeoutError("timed out")
    return left
