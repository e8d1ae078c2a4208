"""Serve a policy file over WebSocket: `python -m osel_sim.serve remote_large --port 8000`."""

import asyncio
import json
import logging
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

from osel_sim.api.settings import CONTENT, MAIN, OTHER, Folder, TrustSettings, settings
from osel_sim.cli.command import Command
from osel_sim.core.errors import SettingError, UsageError
from osel_sim.core.shown import shown
from osel_sim.core.trust import trusting
from osel_sim.remote.protocol import TOKEN_VARIABLE, Greeting, check_token

if TYPE_CHECKING:
    from osel_sim.remote.server import PolicyServer

GRACE_SECONDS = 2.0  # for an inference that is still running when everything else has stopped

EXAMPLES = """examples:
  python -m osel_sim.serve remote_large                       # 127.0.0.1:8000; makes a token and prints it
  OSEL_SIM_TOKEN=... python -m osel_sim.serve remote_large --host 0.0.0.0 --port 8000
  python -m osel_sim.serve my_policy --policies-dir my_policies

Clients are osel_sim itself (url = "ws://host:8000" in a policy file) and openpi's WebsocketClientPolicy(host, port, api_key=TOKEN).
One line of JSON on standard output says when it is ready. GET /healthz needs no token."""


@settings
class ServeConfig(TrustSettings):
    """Serve a policy over WebSocket (openpi's protocol)."""

    policy: str
    """name of a policy file; python -m osel_sim.run --list shows them"""
    host: Annotated[str, MAIN] = "127.0.0.1"
    """address to listen on; the default is reached from this machine only"""
    port: Annotated[int, MAIN] = 8000
    """port, 0 for a free one"""
    token_env: Annotated[str, MAIN] = TOKEN_VARIABLE
    """environment variable with the token"""
    policies_dir: Annotated[Folder | None, CONTENT] = None
    """folder with policy files of your own"""
    watch_stdin: Annotated[bool, OTHER] = False
    """stop when standard input ends (for a program that starts the server)"""


def _execute(config: ServeConfig) -> int:
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    if config.watch_stdin:
        threading.Thread(target=_stop_with_stdin, daemon=True).start()
    with trusting(config.trust):
        return _serve(config)


def _serve(config: ServeConfig) -> int:
    if not 0 <= config.port <= 65535:
        raise SettingError("port", f"must lie in [0, 65535], got {config.port}")
    from osel_sim.formats import library

    spec = library.load_policy(config.policy, config.policies_dir)
    given = os.environ.get(config.token_env)

    from osel_sim.policy.registry import session_factory
    from osel_sim.remote.server import PolicyServer, is_loopback, warm_up

    if given is None and not is_loopback(config.host):
        raise UsageError(f"--host {config.host} can be reached from other machines: put a token into the environment variable {config.token_env}")
    token = check_token(given) if given is not None else secrets.token_urlsafe(32)
    greeting = Greeting.of(spec)
    make_session = session_factory(spec)
    warm_up(make_session, greeting)
    server = PolicyServer(make_session, greeting, token, config.host, config.port)

    def ready(port: int) -> None:
        host = f"[{config.host}]" if ":" in config.host else config.host
        line = {"policy": spec.name, "url": f"ws://{host}:{port}", "port": port}
        print(json.dumps(line if given is not None else {**line, "token": token}), flush=True)

    _run_until_signal(server, ready)
    return 0


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return shown(super().format(record))  # clients have a say in it


def _run_until_signal(server: "PolicyServer", ready: Callable[[int], None]) -> None:
    async def run() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        await server.run(stop, ready)

    asyncio.run(run())
    # Python waits for the inference thread at exit; one that never returns must not keep the process.
    last_resort = threading.Timer(GRACE_SECONDS, os._exit, [1])
    last_resort.daemon = True
    last_resort.start()


def _stop_with_stdin() -> None:
    """Stop this process when whoever holds the other end of standard input is gone."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(10.0)
    os._exit(1)  # whatever kept it


main = Command("serve", ServeConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
