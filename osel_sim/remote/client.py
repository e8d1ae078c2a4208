"""The robot's end of the line: asks a policy server for actions, trusts nothing it says, and never waits for ever."""

import contextlib
import importlib.util
import os
import socket
import struct
import time
from dataclasses import dataclass
from typing import Any, Self
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, InvalidProxy, InvalidStatus, ProxyError, WebSocketException
from websockets.sync.client import ClientConnection, connect

from osel_sim.core.errors import PolicyError, RemoteError
from osel_sim.core.proxies import Proxy, proxy_for
from osel_sim.core.shown import TOKEN_VARIABLE, shown
from osel_sim.formats.conventions import Conventions
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Actions, Observation
from osel_sim.policy.local import check_actions
from osel_sim.policy.mapping import actions_of, message_of
from osel_sim.remote.codec import ProtocolError, pack, unpack
from osel_sim.remote.dialects import actions_in, size_of, unpack_any
from osel_sim.remote.protocol import IMAGES, RESET, Greeting, check_header
from osel_sim.remote.silent_servers import what_waits

MAX_ANSWER = 16 << 20  # bytes; a chunk of 1,000 actions has 56,000
CLOSE_SECONDS = 1.0
QUIET_SECONDS = 2.0
"""Without a greeting for so long, a server is asked what it is."""


class HungUpError(RemoteError):
    """The connection ended: the server may be there all the same, behind a new one."""


class NoAnswerError(RemoteError):
    """Nothing came, or went, in time: the server takes long, or something between has dropped the connection without a word."""


class UnsentError(RemoteError):
    """The question never left this machine."""


class GoneError(UnsentError, HungUpError):
    """The connection had ended before the question."""


@dataclass(frozen=True)
class Answer:
    """What came back for one observation.

    Attributes:
        actions: (T, D) float32 within the environment's bounds.
        measured_seconds: from sending to having it, on this machine.
        bytes_up, bytes_down: length of the two frames; the answer's without its timing entries, which would make a price depend on the machine.
    """

    actions: Actions
    measured_seconds: float
    bytes_up: int
    bytes_down: int


class RemoteClient:
    """A connection to one policy server, ours or any that speaks openpi's protocol.

    After an error the connection is closed, since what would come next on it is unknown; `reset` opens a new one.

    Args:
        url: `ws://host:port` or `wss://...`.
        environment: what the actions are for; they are checked and clipped accordingly.
        token: sent as `Authorization: Api-Key ...`; none is sent if it is None or empty.
        timeout: real seconds for one answer, and for connecting.
        expect: what a server of ours must say it is; None takes any.
        mapping: names and conventions of a server that is not ours.

    Raises:
        UsageError: the token is not fit for a header.
    """

    def __init__(
        self,
        url: str,
        environment: EnvironmentSpec,
        token: str | None = None,
        timeout: float = 30.0,
        expect: Greeting | None = None,
        mapping: Conventions | None = None,
    ) -> None:
        self._environment = environment
        self.url = shown(url)
        """The address without what is secret in it; errors begin with it."""
        self._address, self._timeout, self._expect = url, timeout, expect
        self._token = None if token is None else check_header(token)
        self._mapping = mapping or Conventions()
        self._connection: ClientConnection | None = None
        self._hang_up = contextlib.ExitStack()
        self._greeting: Greeting | None = None

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def connected(self) -> bool:
        """Whether a call can be made without a `reset` first."""
        return self._connection is not None

    @property
    def foreign(self) -> bool:
        """Whether the server it is connected to is not ours: then the mapping counts, and it knows no reset."""
        return self._connection is not None and self._greeting is None

    def connect(self) -> None:
        """Connect and read the greeting; nothing if connected already.

        Raises:
            RemoteError: nobody there, the token refused, or not a policy server we can work with.
        """
        if self._connection is not None:
            return
        end = time.monotonic() + self._timeout
        self._open_connection()
        metadata = self._decode(self._first(end), "greeting", foreign=True)  # whose it is, only the greeting says
        try:
            self._greeting = Greeting.parse(metadata)
        except ProtocolError as error:
            raise self._fail(str(error)) from None
        there, here = self._greeting, (self._environment.action.dimension, self._environment.state_size)
        if there is not None and (there.action_dim, there.state_dim) != here:
            theirs = f"{there.action_dim} and {there.state_dim} numbers"
            raise self._fail(f"its actions and states have {theirs}, those of the environment of {self._environment.name} {here[0]} and {here[1]}")
        if self._greeting is not None and self._expect is not None and self._greeting != self._expect:
            raise self._fail(f"serves {self._greeting}, expected {self._expect}")

    def reset(self, instruction: str) -> None:
        """Start a new episode, on a new connection if there is none. A server that does not know the word is not bothered with it.

        Raises:
            RemoteError: as `connect`, or the server did not agree.
        """
        self.connect()
        if self._greeting is None:
            return
        reply, _ = self._ask({RESET: instruction})
        if reply != {RESET: instruction}:
            raise self._fail("answered a reset with something else")

    def act(self, observation: Observation) -> Answer:
        """Actions for one observation.

        Raises:
            UnsentError: the connection was closed before, or the server sent something before it was asked.
            RemoteError: timeout, closed, an error message, or an answer without proper actions.
        """
        start = time.perf_counter()
        environment = self._environment
        if self._connection is None:
            raise UnsentError(f"{self.url}: not connected")
        reply, bytes_up = self._ask(self.message(observation) if self.foreign else observation)
        measured = time.perf_counter() - start
        try:
            if self.foreign:
                key = self._mapping.actions
                own = actions_of(actions_in(reply, key), self._mapping, environment.action, key)
            elif isinstance(reply, dict) and "actions" in reply:
                own = reply["actions"]
            else:
                raise PolicyError("answered without actions")
            actions = check_actions(own, environment.action)
        except PolicyError as error:
            raise self._fail(str(error)) from None
        payload = {key: value for key, value in reply.items() if not key.endswith("timing")} if isinstance(reply, dict) else reply
        return Answer(actions, measured, bytes_up, size_of(payload) if self.foreign else len(pack(payload)))

    def message(self, observation: Observation) -> dict[str, Any]:
        """What a server that is not ours is sent for an observation."""
        return message_of(observation, self._mapping, cameras_in(observation), self._environment)

    def close(self) -> None:
        """Hang up. May be called twice; takes at most a second or so."""
        self._connection = None
        with contextlib.suppress(OSError, WebSocketException):
            self._hang_up.close()

    def _open_connection(self) -> None:
        self._connection = self._open()

    def _open(self) -> ClientConnection:
        headers = {"Authorization": f"Api-Key {self._token}"} if self._token else None
        proxy = self._proxy()
        way = f" by way of {proxy}" if proxy else ""
        advice = f"; a server on your own network needs no proxy: {_excepting(self._address)}" if proxy else ""
        try:
            opening = connect(
                self._address,
                additional_headers=headers,
                compression=None,
                max_size=MAX_ANSWER,
                open_timeout=self._timeout,
                close_timeout=CLOSE_SECONDS,
                ping_interval=None,  # a server that computes in its event loop (openpi's) answers no pings meanwhile
                proxy=proxy.address if proxy else None,
            )
            connection = self._hang_up.enter_context(opening)
        except InvalidStatus as error:
            status = error.response.status_code
            raise RemoteError(f"{self.url}: " + (self._unauthorised() if status in (401, 403) else f"answered HTTP {status}")) from None
        except TimeoutError:
            raise RemoteError(f"{self.url}: no connection{way} within {self._timeout:g} s{advice}") from None
        except OSError as error:
            raise RemoteError(f"{self.url}: cannot connect{way} ({error.strerror or error}){advice}") from None
        except (ProxyError, InvalidProxy) as error:
            raise RemoteError(f"{self.url}: cannot connect{way} ({error}){advice}") from None
        except (WebSocketException, ValueError, AssertionError) as error:
            # AssertionError: websockets trips over its own close_deadline when the other side talks nonsense before the handshake is sent.
            raise RemoteError(f"{self.url}: is no WebSocket server ({str(error) or type(error).__name__})") from None
        # Sending blocks for ever when the server stops reading and the buffers are full, unless the socket itself has a limit.
        seconds, fraction = divmod(self._timeout, 1.0)
        with contextlib.suppress(OSError):  # the server has hung up already, and its socket is closed: the next receive says so
            connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", int(seconds), int(fraction * 1e6)))
        return connection

    def _proxy(self) -> Proxy | None:
        """The proxy to go through.

        Raises:
            RemoteError: it wants a package that is not there.
        """
        proxy = proxy_for(self._address)
        if proxy is not None and proxy.socks and importlib.util.find_spec("python_socks") is None:
            raise RemoteError(
                f"{self.url}: the connection would go by way of {proxy}, which needs the package python-socks[asyncio]: install it, "
                f"or, for a server on your own network, {_excepting(self._address)}"
            )
        return proxy

    def _unauthorised(self) -> str:
        if self._token:
            return f"refused the token; the environment variable {TOKEN_VARIABLE} holds the one that is sent"
        return f"wants a token: put it into the environment variable {TOKEN_VARIABLE}"

    def _ask(self, message: Any) -> tuple[Any, int]:
        end = time.monotonic() + self._timeout
        frame = pack(message)
        self._send(frame)
        return self._decode(self._receive(end), "answer", self.foreign), len(frame)

    def _send(self, frame: bytes) -> None:
        if self._connection is None:
            raise UnsentError(f"{self.url}: not connected")
        self._check_silent(self._connection)
        try:
            self._connection.send(frame)
        except ConnectionClosed as error:
            full = isinstance(error.__cause__, BlockingIOError)  # what SO_SNDTIMEO makes of a full buffer
            if full:
                raise self._fail(f"took no message within {self._timeout:g} s", NoAnswerError) from None
            raise self._fail(f"closed the connection ({error})", HungUpError) from None

    def _check_silent(self, connection: ClientConnection) -> None:
        """Refuse an answer that lies ready before its question: a server that answers twice would shift all answers by one, unnoticed."""
        try:
            early = connection.recv(timeout=0)
        except TimeoutError:
            return
        except (ConnectionClosed, OSError) as error:
            raise self._fail(f"closed the connection ({error})", GoneError) from None
        if isinstance(early, str):
            raise self._fail(_reported(early), UnsentError)
        raise self._fail(self._unasked(early), UnsentError)

    def _unasked(self, frame: bytes) -> str:
        """What is wrong with a message that lies there before a question."""
        return "sent a message that nobody asked for: it must answer each message once"

    def _first(self, end: float) -> str | bytes:
        """The first message, which a server of openpi's protocol sends by itself. Of one that stays silent it is found out what it is."""
        if self._connection is not None:
            try:
                return self._connection.recv(timeout=max(0.001, min(QUIET_SECONDS, end - time.monotonic())))
            except TimeoutError:
                if waits := what_waits(self._address):
                    raise self._fail(waits) from None
            except (ConnectionClosed, OSError):
                pass  # the next receive says so
        return self._receive(end)

    def _receive(self, end: float) -> str | bytes:
        if self._connection is None:
            raise RemoteError(f"{self.url}: not connected")
        try:
            return self._connection.recv(timeout=max(0.001, end - time.monotonic()))
        except TimeoutError:
            raise self._fail(f"no answer within {self._timeout:g} s (timeout under [remote] allows more)", NoAnswerError) from None
        except (ConnectionClosed, OSError) as error:
            raise self._fail(f"closed the connection ({error})", HungUpError) from None

    def _decode(self, frame: str | bytes, what: str, foreign: bool) -> Any:
        if isinstance(frame, str):
            raise self._fail(_reported(frame))
        try:
            return unpack_any(frame) if foreign else unpack(frame)
        except ProtocolError as error:
            raise self._fail(f"its {what} is unreadable: {error}") from None

    def _fail(self, reason: str, kind: type[RemoteError] = RemoteError) -> RemoteError:
        self.close()
        return kind(f"{self.url}: {reason}")


def _reported(text: str) -> str:
    """What a text message says went wrong: openpi sends a whole traceback, whose last line is the error."""
    lines = text.strip().splitlines() or [""]
    return f"reported an error: {lines[-1][:300]}"


def cameras_in(observation: Observation) -> tuple[str, ...]:
    """Cameras whose images an observation has."""
    return tuple(key.removeprefix(IMAGES) for key in observation if key.startswith(IMAGES))


def _excepting(url: str) -> str:
    """How to keep a host from the proxy."""
    said = os.environ.get("no_proxy") or os.environ.get("NO_PROXY")
    return f"set NO_PROXY={f'{said},' if said else ''}{urlsplit(url).hostname}"
