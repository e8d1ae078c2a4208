"""The host process of a suite: its simulator, behind the wire that policies have. `osel_sim.suites.hosted` is the other end.

It runs in the suite's own Python environment, so nothing is imported here that needs more than numpy, msgpack and websockets. There is one
connection, and one thread that does everything: what draws must not change threads. A message is a map with what to `do`, and is answered with a map;
after every message that may change an environment the answer says how it stands (`status`).

`osel_sim.suites.NAME.env` knows how to make environments: `open_environment(task)` returns one, whose snapshots are plain data (numbers, texts,
arrays, lists and maps of such), and `describe(task)`, where there is one, says as plain data what nobody knows without the simulator.
"""

import hmac
import json
import os
import threading
import traceback
from collections.abc import Callable, Mapping
from http import HTTPStatus
from importlib import import_module
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection
from websockets.sync.server import serve as listen

from osel_sim.core.errors import OselError
from osel_sim.core.shown import TOKEN_VARIABLE
from osel_sim.interface.environment import Environment, Expert, HasExpert, TellsLandmarks, TellsScene
from osel_sim.remote.codec import pack, unpack
from osel_sim.remote.serving import stop_with_stdin
from osel_sim.suites.base import PlainInstance

PROTOCOL = "osel_sim.suite/1"
LARGEST = 64 << 20
"""Bytes of a message: six images of 1,024 pixels have 19 million."""

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
            "advance": lambda env, message: {"made": advance_chunk(env, message["actions"]), "status": status(env)},
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
        "hold": env.hold_action(),
    }


def advance_chunk(env: Environment, actions: Any) -> int:
    """Make the actions (T, D) until the episode is over; how many were made."""
    for made, action in enumerate(actions):
        if env.done:
            return made
        env.advance(action)
    return len(actions)


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
    authorization = f"Api-Key {os.environ.pop(TOKEN_VARIABLE)}".encode()
    table = Table(module_of(suite))

    def check(connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get_all("Authorization")
        if len(given) != 1 or not hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), authorization):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "a token is needed\n")
        return None

    def converse(connection: ServerConnection) -> None:
        try:
            connection.send(pack({"protocol": PROTOCOL, "suite": suite}))
            for frame in connection:
                connection.send(_reply(table, frame))
        except ConnectionClosed:
            pass
        finally:
            table.close()

    options: dict[str, Any] = {"compression": None, "max_size": LARGEST, "ping_interval": None}
    with listen(converse, "127.0.0.1", 0, process_request=check, **options) as server:
        with os.fdopen(ready, "w") as out:
            out.write(json.dumps({"url": f"ws://127.0.0.1:{server.socket.getsockname()[1]}"}) + "\n")
        server.serve_forever()


def _reply(table: Table, frame: str | bytes) -> bytes:
    """The answer to one message; what goes wrong is told, and the connection goes on."""
    try:
        message = unpack(frame if isinstance(frame, bytes) else frame.encode())
        return pack(table.answer(message))
    except OselError as error:
        return pack({"refused": str(error)})
    except ModuleNotFoundError as error:
        return pack({"missing": (error.name or str(error)).partition(".")[0]})
    except Exception as error:
        traceback.print_exc()
        return pack({"failed": f"{type(error).__name__}: {' '.join(str(error).split())}"[:2000]})
