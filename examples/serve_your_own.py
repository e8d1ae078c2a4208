"""Connect a policy server of your own: anything that speaks openpi's protocol, or a policy in Python served by osel_sim.

    python examples/serve_your_own.py              # starts the server below and calls it as osel_sim would
    python examples/serve_your_own.py --port 9000  # only serves, until Ctrl-C

To have a server judged in simulation, put a policy file beside yours and name its address:

    # my_policies/mine.toml
    version = 1
    name = "mine"
    title = "My policy on my own server"
    location = "remote"
    kind = "openpi"
    execute = 8
    inference_seconds = 0.1

    [observation]
    cameras = ["agentview", "wrist"]
    image_size = 96

    [remote]
    url = "ws://127.0.0.1:9000"
    network = "lte"

    OSEL_SIM_TOKEN=my-secret-token python -m osel_sim.run --task pick_place --policies-dir my_policies --policies mine local_small
"""

import argparse
import asyncio
import os

import numpy as np

from osel_sim.interface.policy import Actions, Observation
from osel_sim.interface.specification import specification
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.protocol import Greeting, example_observation
from osel_sim.remote.server import PolicyServer

GREETING = Greeting("mine", cameras=("agentview", "wrist"), image_size=96, action_dim=7, state_dim=8)


class MyPolicy:
    """Moves the gripper down, slowly. Put your model here; each connection gets its own instance, weights may be shared."""

    def reset(self, instruction: str) -> None:
        """Start a new episode."""
        print(f"new episode: {instruction}")

    def act(self, observation: Observation) -> Actions:
        """The next chunk of actions, (8, 7)."""
        actions = np.zeros((8, 7), np.float32)
        actions[:, 2] = -0.1  # z
        actions[:, 6] = -1.0  # open
        return actions


async def serve(port: int, token: str, demonstrate: bool) -> None:
    stop = asyncio.Event()
    server = PolicyServer(MyPolicy, GREETING, token, port=port)
    address: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    running = asyncio.create_task(server.run(stop, lambda port: address.set_result(f"ws://127.0.0.1:{port}")))
    url = await address
    print(f"serving {url}")
    if demonstrate:
        await asyncio.to_thread(call, url, token)
        stop.set()
    await running


def call(url: str, token: str) -> None:
    with RemoteClient(url, specification(), token, timeout=10) as client:
        client.reset("pick up the can")
        answer = client.act({**example_observation(GREETING), "task": "pick up the can"})
    print(f"actions {answer.actions.shape}, {answer.bytes_up:,} bytes up, {answer.bytes_down:,} down, {1e3 * answer.measured_seconds:.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description="Serve a policy of your own.")
    parser.add_argument("--port", type=int, help="serve on this port until Ctrl-C; without it, only a demonstration")
    options = parser.parse_args()
    token = os.environ.get("OSEL_SIM_TOKEN", "my-secret-token")
    try:
        asyncio.run(serve(options.port or 0, token, demonstrate=options.port is None))
    except KeyboardInterrupt:
        print("stopped")


if __name__ == "__main__":
    main()
