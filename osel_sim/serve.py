"""Serve a policy file over WebSocket: `python -m osel_sim.serve remote_large --port 8000`."""

import argparse
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
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core.errors import OselError, UsageError
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


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s", level=logging.WARNING)
    if options.watch_stdin:
        threading.Thread(target=_stop_with_stdin, daemon=True).start()
    try:
        return _serve(options)
    except OselError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m osel_sim.serve",
        description="Serve a policy over WebSocket (openpi's protocol).",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", help="name of a policy file; python -m osel_sim.run --list shows them")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s, reached from this machine only)")
    parser.add_argument("--port", type=int, default=8000, help="port, 0 for a free one (default: %(default)s)")
    parser.add_argument("--token-env", default=TOKEN_VARIABLE, metavar="VARIABLE", help="environment variable with the token (default: %(default)s)")
    parser.add_argument("--policies-dir", type=Path, metavar="DIR", help="folder with policy files of your own")
    parser.add_argument("--watch-stdin", action="store_true", help="stop when standard input ends (for a program that starts the server)")
    return parser


def _serve(options: argparse.Namespace) -> int:
    from osel_sim.formats import library

    if not 0 <= options.port <= 65535:
        raise UsageError(f"--port must lie in [0, 65535], got {options.port}")
    spec = library.load_policy(options.policy, options.policies_dir)
    given = os.environ.get(options.token_env)

    from osel_sim.policy.registry import load_policy
    from osel_sim.remote.server import PolicyServer, is_loopback, warm_up

    if given is None and not is_loopback(options.host):
        raise UsageError(f"--host {options.host} can be reached from other machines: put a token into the environment variable {options.token_env}")
    token = check_token(given) if given is not None else secrets.token_urlsafe(32)
    greeting = Greeting.of(spec)
    make_session = load_policy(spec)
    warm_up(make_session, greeting)
    server = PolicyServer(make_session, greeting, token, options.host, options.port)

    def ready(port: int) -> None:
        host = f"[{options.host}]" if ":" in options.host else options.host
        line = {"policy": spec.name, "url": f"ws://{host}:{port}", "port": port}
        print(json.dumps(line if given is not None else {**line, "token": token}), flush=True)

    _run_until_signal(server, ready)
    return 0


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


if __name__ == "__main__":
    sys.exit(main())
