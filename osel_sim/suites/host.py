"""The host process of a suite: its simulator, behind the wire that policies have. `osel_sim.suites.hosted` is the other end.

It runs in the suite's own Python environment, so nothing is imported here that needs more than numpy, msgpack and websockets. There is one
connection at a time, and one thread that does everything: what draws must not change threads. A message is a map with what to `do`, and is answered
with a map; after every message that may change an environment the answer says how it stands (`status`).

`osel_sim.suites.NAME.env` knows how to make environments: `open_environment(task)` returns one, whose snapshots are plain data (numbers, texts,
arrays, lists and maps of such), and `describe(task)`, where there is one, says as plain data what nobody knows without the simulator.
"""

import contextlib
import json
import os
import socket
import threading
import traceback
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
from websockets.exceptions import WebSocketException

from osel_sim.core.errors import OselError
from osel_sim.core.shown import TOKEN_VARIABLE
from osel_sim.interface.environment import Environment, Expert, HasExpert, TellsLandmarks, TellsScene
from osel_sim.remote.codec import ProtocolError, pack, unpack
from osel_sim.remote.serving import stop_with_stdin
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.wire import LARGEST, Wire

PROTOCOL = "osel_sim.suite/1"
HANDSHAKE_SECONDS = 10.0
"""Whoever has connected and says nothing keeps others waiting for so long."""

Message = dict[str, Any]


def module_of(suite: str) -> Any:
    """What makes environments of a suite."""
    return import_module(f"osel_sim.suites.{suite}.env")


class Table:
    """The environments that are open, by number, and what can be asked of them.

    Args:
        module: with `open_environment`, and maybe `describe`.
    """

    def __init__(self, module: Any) -> None:
        self._module = module
        self._envs: dict[int, Environment] = {}
        self._experts: dict[int, Expert] = {}
        self._next = 0
        self._verbs: Mapping[str, Callable[[Environment, Message], Message]] = {
            "load": self._load,
            "observe": lambda env, message: {"observation": env.observe(message["cameras"], message["size"])},
            "image": lambda env, message: {"image": env.image(message["camera"], message["width"], message["height"], message["quality"])},
            "advance": self._advance,
            "hold": lambda env, message: {"action": env.hold_action()},
            "scene": lambda env, message: {"scene": env.scene_digest() if isinstance(env, TellsScene) else ""},
            "snapshot": lambda env, message: {"snapshot": env.snapshot()},
            "restore": self._restore,
            "expert": self._expert,
            "act": lambda env, message: {"action": np.asarray(self._experts[message["env"]].act(), np.float64)},
            "landmarks": self._landmarks,
            "close": self._close,
        }

    def answer(self, message: Message) -> Message:
        """What comes of one message.

        Raises:
            Exception: whatever the simulator raises.
        """
        match message["do"]:
            case "greet":
                return {"protocol": PROTOCOL}
            case "open":
                return self._open(message["task"])
            case "describe":
                return {"description": self._module.describe(message["task"])}
        return self._verbs[message["do"]](self._envs[message["env"]], message)

    def close(self) -> None:
        """Close all environments."""
        while self._envs:
            self._envs.popitem()[1].close()

    def _open(self, task: str) -> Message:
        env, number = self._module.open_environment(task), self._next
        self._envs[number], self._next = env, number + 1
        names = env.landmark_names if isinstance(env, TellsLandmarks) else ()
        return {"env": number, "specification": env.specification.to_dict(), "expert": isinstance(env, HasExpert), "landmarks": list(names)}

    def _load(self, env: Environment, message: Message) -> Message:
        env.load(PlainInstance(**message["instance"]))
        return {"status": status(env)}

    def _advance(self, env: Environment, message: Message) -> Message:
        answer = {"made": advance_chunk(env, message["actions"]), "status": status(env)}
        if message["look"] is not None and not env.done:
            with contextlib.suppress(Exception):  # told to whoever asks for it
                answer["observation"] = env.observe(*message["look"])
        return answer

    def _restore(self, env: Environment, message: Message) -> Message:
        env.restore(message["snapshot"])
        return {"status": status(env)}

    def _expert(self, env: Environment, message: Message) -> Message:
        if not isinstance(env, HasExpert):
            raise TypeError(f"the environment of {env.specification.name} has no scripted expert")
        self._experts[message["env"]] = env.expert()
        return {}

    def _landmarks(self, env: Environment, message: Message) -> Message:
        if not isinstance(env, TellsLandmarks):
            raise TypeError(f"the environment of {env.specification.name} tells of no landmarks")
        return {"landmarks": env.landmarks(message["cameras"])}

    def _close(self, env: Environment, message: Message) -> Message:
        self._experts.pop(message["env"], None)
        del self._envs[message["env"]]
        env.close()
        return {}


def status(env: Environment) -> Message:
    """How an environment stands."""
    return {
        "steps": int(env.steps),
        "success": bool(env.success),
        "subgoals": float(env.subgoal_fraction),
        "done": bool(env.done),
    }


def advance_chunk(env: Environment, actions: Any) -> int:
    """Make the actions (T, D) until the episode is over; how many were made."""
    for made, action in enumerate(actions):
        if env.done:
            return made
        env.advance(action)
    return len(actions)


def packed(message: Message) -> bytes:
    """One message, as it goes over the wire.

    Raises:
        ProtocolError: it holds something that has no wire form, or is too long.
    """
    frame = pack(message)
    if len(frame) > LARGEST:
        raise ProtocolError(f"cannot be sent: it has {len(frame):,} bytes, more than {LARGEST:,}")
    return frame


def serve(suite: str, ready: int) -> None:
    """Serve until standard input ends.

    Args:
        suite: whose environments.
        ready: descriptor to which the address is written.
    """
    os.set_inheritable(ready, False)
    parent = os.dup(0)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # a simulator that asks its user something (LIBERO does) must fail, not wait
    threading.Thread(target=stop_with_stdin, args=(parent,), daemon=True).start()
    token = os.environ.pop(TOKEN_VARIABLE)
    table = Table(module_of(suite))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with os.fdopen(ready, "w") as out:
            out.write(json.dumps({"url": f"ws://127.0.0.1:{listener.getsockname()[1]}"}) + "\n")
        while True:
            connection, _ = listener.accept()
            with connection, contextlib.suppress(OSError, WebSocketException, ProtocolError):  # whoever it was hung up, or was turned away
                converse(Wire.accept(connection, token, HANDSHAKE_SECONDS), table)


def converse(wire: Wire, table: Table) -> None:
    """Answer messages until the other end hangs up."""
    try:
        while True:
            wire.send(_reply(table, wire.receive()))
    finally:
        table.close()


def _reply(table: Table, frame: memoryview) -> bytes:
    """The answer to one message; what goes wrong is told, and the connection goes on."""
    try:
        return packed(table.answer(unpack(frame)))
    except OselError as error:
        return pack({"refused": str(error)})
    except ModuleNotFoundError as error:
        return pack({"missing": (error.name or str(error)).partition(".")[0]})
    except Exception as error:
        traceback.print_exc()
        return pack({"failed": f"{type(error).__name__}: {' '.join(str(error).split())}"[:2000]})
