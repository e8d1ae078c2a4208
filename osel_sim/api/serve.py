"""A policy over WebSocket."""

import contextlib
import json
import logging
import os
import secrets
import sys
import threading
from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, Annotated

from osel_sim.api.settings import CONTENT, MAIN, OTHER, Count, Folder, NonNegative, TrustSettings, settings
from osel_sim.core.errors import SettingError, UsageError
from osel_sim.core.trust import trusting
from osel_sim.remote.address import check_address
from osel_sim.remote.protocol import TOKEN_VARIABLE, Greeting, check_token
from osel_sim.remote.serving import run_until_signal, stop_with_stdin

if TYPE_CHECKING:
    from osel_sim.interface.environment import EnvironmentSpec
    from osel_sim.policy.registry import MakeSession
    from osel_sim.remote.batching import Batching

logger = logging.getLogger(__name__)

BATCH_MAX = 32
"""Clients that are answered together at most, where nothing else is said."""


@settings
class ServeConfig(TrustSettings):
    """Serve a policy over WebSocket (openpi's protocol)."""

    policy: str
    """name of a policy file; python -m osel_sim.run --list shows them"""
    host: Annotated[str, MAIN] = "127.0.0.1"
    """address to listen on; the default is reached from this machine only"""
    port: Annotated[int, MAIN] = 8000
    """port, 0 for a free one"""
    batch_ms: Annotated[NonNegative | None, MAIN] = None
    """answer several clients together, each waiting for others for so many milliseconds at most (default: one after another)"""
    batch_max: Annotated[Count | None, MAIN] = None
    """with --batch-ms: at most so many together (default: 32)"""
    token_env: Annotated[str, MAIN] = TOKEN_VARIABLE
    """environment variable with the token"""
    policies_dir: Annotated[Folder | None, CONTENT] = None
    """folder with policy files of your own"""
    task: Annotated[str | None, OTHER] = None
    """a task that it will drive in, where that is none of ours: SUITE:TASK"""
    environment: Annotated[str | None, OTHER] = None
    """what it will drive as JSON, in place of --task (for a program that starts the server)"""
    watch_stdin: Annotated[bool, OTHER] = False
    """stop when standard input ends (for a program that starts the server)"""
    ready_fd: Annotated[int | None, OTHER] = None
    """file descriptor for the line that says it is ready, in place of standard output (for a program that starts the server)"""


def serve(config: ServeConfig) -> None:
    """Serve a policy until SIGTERM or SIGINT; one line of JSON on standard output says when it is ready.

    Raises:
        OselError: whatever is wrong with the settings, the policy file or its checkpoint; the message says what.
    """
    if config.watch_stdin:
        threading.Thread(target=stop_with_stdin, daemon=True).start()
    # What a policy prints must not come before the line that a program may wait for.
    with _ready_line(config.ready_fd) as out, contextlib.redirect_stdout(sys.stderr), trusting(config.trust):
        _serve(config, out)


@contextlib.contextmanager
def _ready_line(descriptor: int | None) -> Iterator[IO[str]]:
    """Where the line goes that says that the server is ready."""
    if descriptor is None:
        yield sys.stdout
        return
    try:
        os.set_inheritable(descriptor, False)  # whoever waits for the line sees that this process ended, also where its children have not
        out = os.fdopen(descriptor, "w", encoding="utf-8")
    except (OSError, ValueError) as error:
        raise SettingError("ready_fd", f"{descriptor} cannot be written to ({error})") from None
    with out:
        yield out


def _serve(config: ServeConfig, out: IO[str]) -> None:
    if not 0 <= config.port <= 65535:
        raise SettingError("port", f"must lie in [0, 65535], got {config.port}")
    if config.batch_max is not None and config.batch_ms is None:
        raise SettingError("batch_max", "says how many are answered together: add --batch-ms, or leave it out")
    from osel_sim.formats import library

    spec = library.load_policy(config.policy, config.policies_dir)
    given = os.environ.get(config.token_env)

    from osel_sim.core.proxies import is_loopback
    from osel_sim.policy.registry import session_factory
    from osel_sim.remote.server import PolicyServer, warm_up

    if given is None and not is_loopback(config.host):
        raise UsageError(f"--host {config.host} can be reached from other machines: put a token into the environment variable {config.token_env}")
    token = check_token(given) if given is not None else secrets.token_urlsafe(32)
    check_address(config.host, config.port)
    if not config.watch_stdin:  # who starts the server itself knows
        secret = f"the token in {config.token_env}" if given is not None else f"a token that is printed then (none is in {config.token_env})"
        logger.info("loading %s; clients connect to port %s of %s with %s ...", spec.name, config.port or "(a free one)", config.host, secret)
    environment = _environment(config)
    greeting = Greeting.of(spec, environment)
    make_session = session_factory(spec, environment)
    warm_up(make_session, greeting)
    server = PolicyServer(make_session, greeting, token, config.host, config.port, _batching(config, make_session, greeting))

    def ready(port: int) -> None:
        host = f"[{config.host}]" if ":" in config.host else config.host
        line = {"policy": spec.name, "url": f"ws://{host}:{port}", "port": port}
        print(json.dumps(line if given is not None else {**line, "token": token}), file=out, flush=True)

    run_until_signal(server, ready)


def _batching(config: ServeConfig, make_session: "MakeSession", greeting: Greeting) -> "Batching | None":
    """How requests are answered together, where that was asked for and the policy can."""
    from osel_sim.policy.batched import why_not_together
    from osel_sim.remote.batching import Batching
    from osel_sim.remote.protocol import differing_observations

    if config.batch_ms is None:
        return None
    if why := why_not_together(make_session, differing_observations(greeting, 3), greeting.action_dim):
        logger.warning("%s answers its clients one after another: %s", greeting.policy, why)
        return None
    return Batching(config.batch_ms / 1e3, config.batch_max or BATCH_MAX)


def _environment(config: ServeConfig) -> "EnvironmentSpec":
    """What the policy will drive: as given, or as a task has it, or any of our own."""
    from osel_sim.interface.environment import EnvironmentSpec

    if config.environment is not None:
        try:
            return EnvironmentSpec.from_dict(json.loads(config.environment))
        except ValueError as error:
            raise SettingError("environment", f"is not JSON ({error})") from None
    if config.task is not None:
        from osel_sim.suites.registry import find_task

        return find_task(config.task).specification
    from osel_sim.interface.specification import specification

    return specification()
