"""Real policies, policy files and servers for the tests of the network side."""

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from websockets.sync.server import ServerConnection, serve

from osel_sim.formats.policy_file import PolicySpec, load_policy_file
from osel_sim.interface.policy import Actions, Observation, Policy
from osel_sim.interface.specification import specification
from osel_sim.remote.batching import Batching
from osel_sim.remote.codec import pack
from osel_sim.remote.protocol import Greeting, example_observation
from osel_sim.remote.server import PolicyServer

TOKEN = "test-token-123"
ENVIRONMENT = specification()
GREETING = Greeting("sinusoid", ("agentview", "wrist"), 32, ENVIRONMENT.action.dimension, ENVIRONMENT.state_size, ENVIRONMENT.action)


class Sinusoid:
    """Replays a sinusoid: the chunk tells the instruction (its length), the number of calls since reset, and the state's first number."""

    def __init__(self) -> None:
        self.instruction, self.calls = "", 0

    def reset(self, instruction: str) -> None:
        self.instruction, self.calls = instruction, 0

    def act(self, observation: Observation) -> Actions:
        self.calls += 1
        chunk = np.sin(np.arange(8)[:, None] + np.arange(7)[None, :]).astype(np.float32)
        chunk[0, 0] = len(self.instruction) / 100
        chunk[0, 1] = self.calls / 100
        chunk[0, 2] = observation["observation.state"][0]
        return chunk


def observation(task: str = "pick up the can", state: float = 0.0) -> Observation:
    value = example_observation(GREETING)
    value["observation.state"][0] = state
    return {**value, "task": task}


POLICY_FILE = """
version = 1
name = "{name}"
title = "A sinusoid"
location = "remote"
kind = "{kind}"
execute = 4
inference_seconds = 0.1

[observation]
cameras = ["agentview", "wrist"]
image_size = 32

[remote]
network = "{network}"
deadline = {deadline}
{url}

[price]
per_megabyte = 2.0
per_call = 0.5
per_action = 0.01
"""


def policy_spec(
    folder: Path, name: str = "sinusoid", kind: str = "sinusoid", network: str = "wifi", deadline: float = 2.0, url: str = ""
) -> PolicySpec:
    file = folder / f"{name}.toml"
    file.write_text(POLICY_FILE.format(name=name, kind=kind, network=network, deadline=deadline, url=f'url = "{url}"' if url else ""))
    return load_policy_file(file)


def install_plugin(folder: Path) -> None:
    """A package `toy_policies` with an entry point, as pip would leave it behind, in a folder to be put on PYTHONPATH."""
    here = Path(__file__).parent
    (folder / "toy_policies.py").write_text(
        f"import sys, os, time\nsys.path.append({str(here)!r})\n"
        "from remote_helpers import Sinusoid\n"
        "def load(spec, environment):\n"
        "    return Sinusoid\n"
        "def load_broken(spec, environment):\n"
        "    raise RuntimeError('the weights are on holiday')\n"
        "def load_chatty(spec, environment):\n"
        '    print(\'{"url": "ws://127.0.0.1:1"}\', flush=True)\n'
        "    os.write(1, b'loading ' * 20_000 + b'\\n')\n"
        "    if spec.kind == 'chatty_broken':\n"
        "        load_broken(spec, environment)\n"
        "    return Sinusoid\n"
        "def load_loud(spec, environment):\n"
        "    print('loading')\n"
        "    return Sinusoid\n"
        "class Stuck(Sinusoid):\n"
        "    def act(self, observation):\n"
        "        if observation['task'] == 'wait':\n"
        "            time.sleep(1000)\n"
        "        return super().act(observation)\n"
        "def load_stuck(spec, environment):\n"
        "    return Stuck\n"
    )
    info = folder / "toy_policies-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-policies\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[osel_sim.policies]\nsinusoid = toy_policies:load\nbroken = toy_policies:load_broken\n"
        "chatty = toy_policies:load_chatty\nloud = toy_policies:load_loud\nchatty_broken = toy_policies:load_chatty\n"
        "stuck = toy_policies:load_stuck\nmissing = toy_policies:none\n"
    )


@contextlib.contextmanager
def serving(make_session: Callable[[], Policy] = Sinusoid, greeting: Greeting = GREETING, batching: Batching | None = None) -> Iterator[str]:
    """Our server in a thread; its address."""
    started, stop_server = threading.Event(), []
    address: list[str] = []

    def ready(port: int) -> None:
        address.append(f"ws://127.0.0.1:{port}")
        started.set()

    async def run() -> None:
        loop, stop = asyncio.get_running_loop(), asyncio.Event()
        stop_server.append(lambda: loop.call_soon_threadsafe(stop.set))
        await PolicyServer(make_session, greeting, TOKEN, batching=batching).run(stop, ready)

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    assert started.wait(10)
    try:
        yield address[0]
    finally:
        stop_server[0]()
        thread.join(10)
        assert not thread.is_alive()


@contextlib.contextmanager
def serving_with(handler: Callable[[ServerConnection], None], greeting: bytes | str | None = None) -> Iterator[str]:
    """A WebSocket server that greets like ours and then does what it likes."""

    def handle(connection: ServerConnection) -> None:
        connection.send(pack(GREETING.to_dict()) if greeting is None else greeting)
        handler(connection)

    with waiting(handle) as url:
        yield url


@contextlib.contextmanager
def waiting(handler: Callable[[ServerConnection], None]) -> Iterator[str]:
    """A WebSocket server that does not greet."""
    with serve(handler, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(10)


def alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has buried is dead."""
    status = Path(f"/proc/{pid}/stat")
    if status.parent.parent.is_dir() and not status.exists():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return status.read_text().rsplit(")", 1)[1].split()[0] != "Z" if status.exists() else True
