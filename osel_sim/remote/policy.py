"""A remote policy as the episode loop sees it: real answers of a real server, with delays drawn on a virtual clock."""

import contextlib
import os
import time
from collections.abc import Sequence
from typing import Any

from osel_sim.core.errors import RemoteError, UsageError
from osel_sim.formats.policy_file import VLA_EVAL, PolicySpec
from osel_sim.interface.call import Call
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Observation
from osel_sim.interface.specification import specification
from osel_sim.policy.environment_fit import check_environment
from osel_sim.remote.client import Answer, HungUpError, NoAnswerError, RemoteClient, UnsentError
from osel_sim.remote.network import Delays, NetworkModel, NetworkProfile, profile
from osel_sim.remote.policy_process import PolicyServerProcess
from osel_sim.remote.protocol import STATE, TOKEN_VARIABLE, Greeting, example_observation, select_observation
from osel_sim.remote.vla_eval import VlaEvalClient

DEADLINE = "deadline"
OUTAGE = "outage"


class RemotePolicy:
    """Client, network model and deadline of one remote policy; a `Caller`.

    A call whose virtual time passes the deadline failed: the robot waited for as long as the deadline and has nothing. It failed because of an
    `outage` if it would have been in time without one. A server that is dead or breaks the protocol looks the same from the robot: nothing until the
    deadline. After that the rest of the episode's calls fail as well; the next `reset` tries again.

    A connection that was idle between two episodes may be dead by then, because of a proxy, or because the server was started again: where the first
    call of an episode meets such a one, it is made again, once, on a new connection. Later in an episode the server may have lost what it knew of it.

    Args:
        spec: a policy file with a `[remote]` table.
        client: not yet connected, or connected.
        network: None takes the profile that the policy file names.
        server: process to start again when it died and to stop at the end; None for a server that somebody else runs.

    Raises:
        UsageError: `spec` is not remote.
    """

    def __init__(
        self, spec: PolicySpec, client: RemoteClient, network: NetworkProfile | None = None, server: PolicyServerProcess | None = None
    ) -> None:
        if spec.remote is None:
            raise UsageError(f"{spec.file}: is not a remote policy")
        self._spec, self._remote, self._client, self._server = spec, spec.remote, client, server
        self._profile = network or profile(spec.remote.network)
        self._network = NetworkModel(self._profile, ())
        self._broken: str | None = "no episode was started"
        self._instruction = ""
        self._kept = self._begun = False  # the connection is older than the episode; a call of the episode was answered
        self._sent = False

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Start a new episode, on a new connection if the last one broke. A server that cannot be reached makes the calls fail, not this."""
        self._network = NetworkModel(self._profile, seed)
        self._broken, self._instruction = None, instruction
        self._kept, self._begun = self._client.connected, False
        try:
            try:
                self._client.reset(instruction)
            except RemoteError:
                if not self._kept and self._server is None:
                    raise
                self._start_over()
        except RemoteError as error:
            self._broken = self._reason(error)

    def call(self, observation: Observation) -> Call:
        """Actions after the drawn delays, or why there are none."""
        start = time.perf_counter()
        answer = self._ask(observation)
        measured = time.perf_counter() - start
        # Drawn for failed calls as well, so that the next call's luck does not depend on this one's.
        sizes = (answer.bytes_up, answer.bytes_down) if answer else (0, 0)
        delays = self._network.delays(sizes[0], self._spec.inference_seconds, sizes[1])
        megabytes = 1e-6 * sum(sizes)
        deadline = self._remote.deadline
        if answer is None:
            return Call(None, upload=deadline, measured_seconds=measured, failure=self._broken, sent=self._sent)
        if delays.total > deadline:
            upload, inference, download = _cut(delays, deadline)
            failure = OUTAGE if delays.total - delays.outage <= deadline else DEADLINE
            return Call(None, upload, inference, download, megabytes, measured, failure)
        return Call(answer.actions, delays.upload, delays.inference, delays.download, megabytes, measured)

    def close(self) -> None:
        """Hang up, and stop the server if it is ours."""
        self._client.close()
        if self._server is not None:
            self._server.close()

    def _start_over(self) -> None:
        """Begin the episode again on a fresh connection, and with a fresh server where it is ours, dead or hanging alike."""
        self._kept = False
        self._client.close()
        if self._server is not None:
            self._server.close()
            self._client = self._server.start_client()
        self._client.reset(self._instruction)

    def _ask(self, observation: Observation) -> Answer | None:
        self._sent = self._broken is None
        if not self._sent:
            return None
        seen = select_observation(observation, self._spec.cameras, STATE in observation)
        try:
            try:
                answer = self._client.act(seen)
            except (HungUpError, NoAnswerError) as error:
                if self._begun or (isinstance(error, NoAnswerError) and not self._kept):  # a new connection that is silent is not dead
                    raise
                self._start_over()
                answer = self._client.act(seen)
        except RemoteError as error:
            self._broken, self._sent = self._reason(error), not isinstance(error, UnsentError)
            return None
        self._begun = True
        return answer

    def _reason(self, error: RemoteError) -> str:
        # Without the address: a server of ours has another port each time, and a journal must not.
        return str(error).removeprefix(f"{self._client.url}: ")


def open_remote(
    spec: PolicySpec, environment: EnvironmentSpec | None = None, timeout: float | None = None, start_timeout: float = 120.0
) -> RemotePolicy:
    """A remote policy ready for use: connects to the `url` of its file, with the token in OSEL_SIM_TOKEN, or starts a server of its own.

    Close it after use.

    Args:
        environment: what it will drive; None: one of ours.
        timeout: real seconds for one answer; None: as the policy file says.
        start_timeout: real seconds for a server to load its weights, or for one that is not ours to answer its first request; never less than
            for any other.

    Raises:
        RemoteError: the server cannot be started or reached.
        UsageError: `spec` is not remote.
    """
    if spec.remote is None:
        raise UsageError(f"{spec.file}: is not a remote policy")
    environment = environment or specification()
    check_environment(spec, environment)
    timeout = spec.remote.timeout if timeout is None else timeout
    start_timeout = max(start_timeout, timeout)
    if spec.remote.url is not None:
        client = _connected(spec, environment, timeout)
        if client.foreign:
            client.close()
            # A server that compiles its model with the first request takes long for it.
            _try_mapping(spec, environment, _client(spec, environment, start_timeout))
        return RemotePolicy(spec, client)
    with contextlib.ExitStack() as undo:
        server = PolicyServerProcess(spec, environment, timeout, start_timeout)
        undo.callback(server.close)
        client = server.start_client()
        client.connect()
        undo.pop_all()
    return RemotePolicy(spec, client, server=server)


def check_servers(specs: Sequence[PolicySpec], environment: EnvironmentSpec, timeout: float = 10.0) -> None:
    """Connect to the servers that are not started here and hang up again, so that one that is not there is told of before anything is loaded.

    Args:
        specs: policies, of which only those with a `url` are tried.
        environment: what they will drive.
        timeout: real seconds for each.

    Raises:
        RemoteError: naming the policy: nobody there, the token refused or missing, or not a policy server.
    """
    for spec in specs:
        if spec.remote is not None and spec.remote.url is not None:
            _connected(spec, environment, timeout).close()


def _connected(spec: PolicySpec, environment: EnvironmentSpec, timeout: float) -> RemoteClient:
    """A connection to the `url` of a policy file.

    Raises:
        RemoteError: naming the policy.
    """
    client = _client(spec, environment, timeout, Greeting.of(spec, environment))
    try:
        client.connect()
    except RemoteError as error:
        raise RemoteError(f"policy {spec.name!r} ({spec.file}): {error}") from None
    return client


def _client(spec: PolicySpec, environment: EnvironmentSpec, timeout: float, expect: Greeting | None = None) -> RemoteClient:
    """A client of the kind of server that a policy file names, not yet connected."""
    kind = VlaEvalClient if spec.kind == VLA_EVAL else RemoteClient
    url = spec.remote.url if spec.remote else None
    return kind(url or "", environment, os.environ.get(TOKEN_VARIABLE), timeout, expect, spec.mapping)


def _try_mapping(spec: PolicySpec, environment: EnvironmentSpec, client: RemoteClient) -> None:
    """Ask a server that is not ours once, so that a wrong mapping is found now and explained, instead of failing every episode."""
    example = example_observation(Greeting.of(spec, environment))
    try:
        with client:
            length = len(client.act(example).actions)
    except RemoteError as error:
        sent = ", ".join(
            f"{key} ({value.dtype} {value.shape})" if hasattr(value, "shape") else f"{key} (text)"
            for key, value in _flat(client.message(example)).items()
        )
        raise RemoteError(f"{spec.file}: the server does not take what the file's [mapping] gives it: {error}; it was sent {sent}") from None
    if length < spec.execute:
        raise RemoteError(f"{spec.file}: the server's chunks hold {length} actions, execute = {spec.execute}")


def _flat(message: dict[str, Any]) -> dict[str, Any]:
    """A message without maps in it: `images.agentview`."""
    return {f"{key}.{inner}" if inner else key: item for key, value in message.items() for inner, item in _items(value)}


def _items(value: Any) -> "list[tuple[str, Any]]":
    return list(value.items()) if isinstance(value, dict) else [("", value)]


def _cut(delays: Delays, deadline: float) -> tuple[float, float, float]:
    """The three parts of a wait that ended at the deadline."""
    upload = min(delays.upload, deadline)
    inference = min(delays.inference, deadline - upload)
    return upload, inference, deadline - upload - inference
