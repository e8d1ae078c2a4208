"""A policy server of ours in a process of its own."""

import json
import sys

from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.process import ServerProcess
from osel_sim.remote.protocol import Greeting


class PolicyServerProcess(ServerProcess):
    """Runs `python -m osel_sim.serve` for one policy file.

    Args:
        spec: which policy.
        environment: what it will drive.
        timeout: real seconds for one answer, of the clients given out.
        start_timeout: real seconds for loading the weights.
    """

    def __init__(self, spec: PolicySpec, environment: EnvironmentSpec, timeout: float = 30.0, start_timeout: float = 120.0) -> None:
        super().__init__(f"the policy server of {spec.name!r}", start_timeout)
        self._spec, self._environment, self._timeout = spec, environment, timeout

    def command(self, ready: int) -> list[str]:
        """The command line that starts it."""
        name, folder, environment = self._spec.file.stem, str(self._spec.file.parent), json.dumps(self._environment.to_dict())
        flags = ["--port=0", f"--policies-dir={folder}", f"--environment={environment}", "--watch-stdin", f"--ready-fd={ready}"]
        return [sys.executable, "-m", "osel_sim.serve", name, *flags]

    def start_client(self) -> RemoteClient:
        """Start the server if it does not run, and give a client for it, not yet connected.

        Raises:
            RemoteError: as `start`.
        """
        self.start()
        return RemoteClient(self.url, self._environment, self.token, self._timeout, Greeting.of(self._spec, self._environment))
