"""Serves one policy to several clients over WebSocket, each with its own state."""

import asyncio
import contextlib
import hmac
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, TypeVar

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from osel_sim.core.errors import OselError, PolicyError
from osel_sim.policy.registry import MakeSession
from osel_sim.remote.address import cannot_listen
from osel_sim.remote.batching import Batches, Batching
from osel_sim.remote.codec import ProtocolError, pack
from osel_sim.remote.protocol import HEALTH, Greeting, ObservationError, check_token, example_observation, largest_observation
from osel_sim.remote.session import Session

log = logging.getLogger(__name__)
Result = TypeVar("Result")

CLOSE_SECONDS = 3.0
INTERNAL_ERROR = 1011  # WebSocket close code, as openpi's server sends it


class PolicyServer:
    """A policy server, compatible with openpi's client.

    Inference runs in one thread beside the event loop, so /healthz and other clients are answered meanwhile.

    Args:
        make_session: gives each connection its own policy; weights may be shared.
        greeting: what is served.
        token: what clients must bring as `Authorization: Api-Key ...`.
        host, port: where to listen; port 0 takes a free one.
        batching: how requests of several clients are answered together; None: one after another.

    Raises:
        UsageError: the token is not fit for a header.
    """

    def __init__(
        self, make_session: MakeSession, greeting: Greeting, token: str, host: str = "127.0.0.1", port: int = 0, batching: Batching | None = None
    ) -> None:
        self._make_session, self._greeting, self._host, self._port = make_session, greeting, host, port
        self._authorization = f"Api-Key {check_token(token)}".encode()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="inference")
        self._clients = 0
        self._batches = None if batching is None else Batches(batching, self._in_thread, lambda: self._clients)

    async def run(self, stop: asyncio.Event, ready: Callable[[int], None]) -> None:
        """Serve until `stop` is set. `ready` is told the port.

        Raises:
            RemoteError: the address cannot be used.
        """
        try:
            server = await serve(
                self._handle,
                self._host,
                self._port,
                process_request=self._check_request,
                compression=None,
                max_size=largest_observation(self._greeting),
                close_timeout=CLOSE_SECONDS,
                ping_interval=30,
                ping_timeout=120,  # a client that simulates or compiles may be silent for long
            )
        except OSError as error:
            raise cannot_listen(self._host, self._port, error) from None
        try:
            ready(server.sockets[0].getsockname()[1])
            await stop.wait()
        finally:
            server.close()
            with contextlib.suppress(TimeoutError):  # an inference that does not end must not keep the server up
                await asyncio.wait_for(server.wait_closed(), CLOSE_SECONDS)
            self._thread.shutdown(wait=False, cancel_futures=True)

    def _check_request(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == HEALTH:
            return connection.respond(HTTPStatus.OK, "OK\n")
        given = request.headers.get_all("Authorization")
        if len(given) != 1 or not hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), self._authorization):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "a token is needed: Authorization: Api-Key ...\n")
        return None

    async def _handle(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            try:
                self._clients += 1
                session = Session(await self._in_thread(self._make_session), self._greeting)
                await connection.send(pack(self._greeting.to_dict()))
                async for frame in connection:
                    await self._reply(connection, session, frame)
            except ConnectionClosed:
                raise
            except Exception as error:
                log.exception("the policy failed")
                reason = f"PolicyError: {error}" if isinstance(error, PolicyError) else "InternalError: the policy failed; its server's log says why"
                await connection.send(reason)
                await connection.close(INTERNAL_ERROR, "the policy failed")
            finally:
                self._clients -= 1

    async def _reply(self, connection: ServerConnection, session: Session, frame: str | bytes) -> None:
        """Answer one message; what is wrong with it is told in a text message, as openpi does, and the session goes on."""
        try:
            if isinstance(frame, str):
                raise ProtocolError("expected a binary msgpack frame, got text")
            asked = self._in_thread(session.answer, frame) if self._batches is None else self._batches.answer(session, frame)
            reply: str | bytes = await asked
        except (ProtocolError, ObservationError) as error:
            log.warning("refused a message of %s: %s", connection.remote_address, error)
            reply = f"{type(error).__name__}: {error}"
        await connection.send(reply)

    async def _in_thread(self, function: Callable[..., Result], *arguments: Any) -> Result:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)


def warm_up(make_session: MakeSession, greeting: Greeting) -> None:
    """Run one inference on zeros, so that 'ready' means ready, and a policy that does not fit its file is refused before anybody connects.

    Raises:
        PolicyError: the policy fails or answers in a wrong form.
    """
    try:
        Session(make_session(), greeting).answer(pack(example_observation(greeting)))
    except OselError:
        raise
    except Exception as error:
        log.exception("the first inference failed")
        raise PolicyError(f"{greeting.policy}: the first inference failed ({type(error).__name__}: {error})") from error
