"""The wire between a host process and the process that asks it: WebSocket on loopback, a binary frame a message, without threads.

websockets does the handshake. From then on nothing comes but the answer to a question, so whoever asks or answers writes and reads the frames itself.
The client and the server of websockets have a thread on each side that reads and hands every message over, and are ready for whatever may come at any
time, such as a policy server's pings: both took more of a message's time than all else.
"""

import contextlib
import hmac
import socket
import struct
import time
from http import HTTPStatus
from typing import Self

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidHandshake, InvalidStatus
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri
from websockets.utils import apply_mask

from osel_sim.remote.codec import ProtocolError

LARGEST = 64 << 20
"""Bytes of a message: six images of 1,024 pixels have 19 million."""
PIECE = 1 << 18
"""Bytes that are read at first: most messages, whole. Always to the same place, which is quicker than memory that nobody has touched yet."""
BINARY, CLOSING = 0x82, 0x88
"""First byte of a frame that is a whole binary message, and of one that hangs up."""
MASKED = 0x80
"""Bit of the second byte: the four bytes before the message are a mask of it."""
NO_MASK = bytes(4)
"""A client must send a mask. It is there to protect proxies from web pages; this one leaves the message as it is."""


class Wire:
    """One end of a connection that has been agreed upon. After an error it is fit for nothing but `close`: what would come next on it is unknown.

    Args:
        connection: closed with the wire.
        asks: whether this is the end that asks (WebSocket's client).
    """

    def __init__(self, connection: socket.socket, asks: bool) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._sent, self._expected = (MASKED, 0) if asks else (0, MASKED)
        self._mask = NO_MASK if asks else b""
        self._buffer = memoryview(bytearray(PIECE))

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
        protocol = ClientProtocol(address)
        connection = socket.create_connection((address.host, address.port), seconds)
        try:
            request = protocol.connect()
            request.headers["Authorization"] = f"Api-Key {token}"
            protocol.send_request(request)
            _say(connection, protocol, end)
            _hear(connection, protocol, end)
        except BaseException:
            connection.close()
            raise
        return cls(connection, asks=True)

    @classmethod
    def accept(cls, connection: socket.socket, token: str, seconds: float) -> Self:
        """Answer a client that has connected.

        Args:
            connection: of the client, which must say nothing more before it is answered.
            token: that it must bring.
            seconds: within which it must ask to come in.

        Raises:
            OSError: it hung up, or did not ask in time.
            WebSocketException: it was turned away: it has not the token, or is no WebSocket client.
        """
        protocol, end = ServerProtocol(), time.monotonic() + seconds
        request = _hear(connection, protocol, end)
        if isinstance(request, Request) and _brings(request, token):
            response = protocol.accept(request)
        else:
            response = protocol.reject(HTTPStatus.UNAUTHORIZED, "a token is needed\n")
        protocol.send_response(response)
        _say(connection, protocol, end)
        if protocol.state is not State.OPEN:
            raise InvalidStatus(response)
        return cls(connection, asks=False)

    def send(self, message: bytes, seconds: float | None = None) -> None:
        """Send a message.

        Raises:
            OSError: the other end is gone, or has not taken it in time (`TimeoutError`); without `seconds` it may take as long as it likes.
        """
        size = len(message)
        if size < 126:
            head = struct.pack("!BB", BINARY, self._sent | size)
        elif size < 1 << 16:
            head = struct.pack("!BBH", BINARY, self._sent | 126, size)
        else:
            head = struct.pack("!BBQ", BINARY, self._sent | 127, size)
        parts = (head, self._mask, message)
        self._socket.settimeout(seconds)
        sent = self._socket.sendmsg(parts)  # without a copy, and whole but for large messages
        if sent < len(head) + len(self._mask) + size:
            self._socket.sendall(memoryview(b"".join(parts))[sent:])

    def receive(self, seconds: float | None = None) -> memoryview:
        """The next message, whole. It is overwritten by the one after it.

        Raises:
            OSError: the other end is gone or hung up, or it has not come in time (`TimeoutError`); without `seconds` it may take as long as it likes.
            ProtocolError: it is no binary message in one frame, is too long, or more than it has come.
        """
        end = None if seconds is None else time.monotonic() + seconds
        frame, have = self._buffer, self._more(self._buffer, end)
        while (head := self._head(frame[:have])) is None:
            have += self._more(frame[have:], end)
        begin, size = head
        if begin + size > len(frame):
            frame = memoryview(bytearray(begin + size))
            frame[:have] = self._buffer[:have]
        while have < begin + size:
            have += self._more(frame[have:], end)
        if have > begin + size:
            raise ProtocolError("expected one message, got more than one")
        message = frame[begin:have]
        if self._expected and (mask := bytes(frame[begin - 4 : begin])) != NO_MASK:
            return memoryview(apply_mask(message, mask))
        return message

    def close(self) -> None:
        """Hang up. May be called twice, and while another thread waits for a message: that fails then."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _head(self, frame: memoryview) -> tuple[int, int] | None:
        """Where the message of a frame begins, and its bytes; None where too little of the frame is there to tell."""
        if frame[0] == CLOSING:
            raise ConnectionResetError("the other end hung up")
        if frame[0] != BINARY:
            raise ProtocolError("expected a binary message in one frame")
        if len(frame) < 2:
            return None
        if frame[1] & MASKED != self._expected:
            raise ProtocolError("expected a frame with a mask" if self._expected else "expected a frame without a mask")
        size, begin = frame[1] & ~MASKED, 2
        if size > 125:
            begin = 4 if size == 126 else 10
            size = int.from_bytes(frame[2:begin])
        begin += 4 if self._expected else 0
        if len(frame) < begin:
            return None
        if size > LARGEST:
            raise ProtocolError(f"a message has {size:,} bytes, more than {LARGEST:,}")
        return begin, size

    def _more(self, buffer: memoryview, end: float | None) -> int:
        """Read what has come; how many bytes, at least one."""
        self._socket.settimeout(_left(end))
        count = self._socket.recv_into(buffer)
        if not count:
            raise ConnectionResetError("the connection ended")
        return count


def _brings(request: Request, token: str) -> bool:
    given = request.headers.get_all("Authorization")
    return len(given) == 1 and hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), f"Api-Key {token}".encode())


def _say(connection: socket.socket, protocol: ClientProtocol | ServerProtocol, end: float) -> None:
    """Send what the protocol has to say."""
    for data in protocol.data_to_send():
        connection.settimeout(_left(end))
        connection.sendall(data)


def _hear(connection: socket.socket, protocol: ClientProtocol | ServerProtocol, end: float) -> object:
    """The other end's part of the handshake: its request, or its response."""
    while not (events := protocol.events_received()):
        connection.settimeout(_left(end))
        if data := connection.recv(PIECE):
            protocol.receive_data(data)
        else:
            protocol.receive_eof()
        if protocol.handshake_exc is not None:
            raise protocol.handshake_exc
    if len(events) > 1:
        raise InvalidHandshake("messages came before it was over")
    return events[0]


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
