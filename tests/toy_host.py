"""A host process with an environment made to be disturbed, and hosts that do not keep to the protocol.

python toy_host.py READY_FD MANNERS

Manners are `good`; `mute`: takes connections and says nothing; `foreign`: speaks another protocol; `half`: ends within its answer; `text`: answers
in text.
"""

import json
import os
import signal
import socket
import sys
import time
import types

import numpy as np

from osel_sim.core.shown import TOKEN_VARIABLE
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.remote.codec import pack
from osel_sim.suites.base import BaseEnvironment
from osel_sim.suites.host import PROTOCOL, serve
from osel_sim.suites.wire import Wire

DIE, HANG, FAIL = 7.0, 8.0, 9.0


class Point(BaseEnvironment):
    """A point on a line; some actions end, stop or break the process that it is in."""

    def __init__(self) -> None:
        action = ActionSpec(("x",), (-1.0,), (1.0,))
        super().__init__(EnvironmentSpec("toy", 10, action, {"x": 1}, ("top",), "top", horizon=100), 100)

    def start(self, instance):
        self.x = float(instance.seed)

    def act(self, action):
        match float(action[0]):
            case value if value == DIE:
                os.kill(os.getpid(), signal.SIGKILL)
            case value if value == HANG:
                time.sleep(60)
            case value if value == FAIL:
                raise ValueError("the point broke")
        self.x += float(action[0])
        return False

    def state(self):
        return {"x": [self.x]}

    def render(self, camera):
        return np.random.default_rng(abs(int(100 * self.x))).integers(0, 256, (32, 32, 3), np.uint8)

    def image(self, camera, width, height, quality="fast"):
        return super().image(camera, width, height) if width == 32 else np.zeros((height, width, 3), np.uint8)


def misbehave(ready: int, manners: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with os.fdopen(ready, "w") as out:
            out.write(json.dumps({"url": f"ws://127.0.0.1:{listener.getsockname()[1]}"}) + "\n")
        if manners == "mute":
            time.sleep(60)
        connection, _ = listener.accept()
        wire = Wire.accept(connection, os.environ[TOKEN_VARIABLE], 10.0)
        wire.receive()
        wire.send(pack({"protocol": "another/1" if manners == "foreign" else PROTOCOL}))
        wire.receive()
        text = b"\x81\x02no"
        half = b"\x82\x7e\x10\x00" + bytes(100)  # a binary frame of 4,096 bytes begins
        connection.sendall(text if manners == "text" else half)
        if manners == "text":
            time.sleep(60)
        os._exit(1)


if __name__ == "__main__":
    module = types.ModuleType("osel_sim.suites.toy.env")
    module.open_environment = lambda task: Point()  # type: ignore[attr-defined]
    sys.modules[module.__name__] = module
    if sys.argv[2] == "good":
        serve("toy", int(sys.argv[1]))
    misbehave(int(sys.argv[1]), sys.argv[2])
