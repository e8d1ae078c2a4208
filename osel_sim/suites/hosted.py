"""Environments that run in a host process, in their suite's own Python environment, as environments of this process.

A chunk of actions goes over at once. Images come when they are asked for, or with the answer to a chunk that says what is looked at next. What the
episode loop asks after every step (steps, success, whether it is over) is known here. A host that has ended is an error of the episode under way,
and the next one has a fresh host: nobody else notices.
"""

import atexit
import contextlib
import dataclasses
import functools
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import WebSocketException

from osel_sim.core.errors import MissingPackageError, RemoteError, SuiteHostError, UsageError
from osel_sim.interface.environment import Environment, EnvironmentSpec, Image
from osel_sim.interface.policy import Actions, Observation
from osel_sim.remote.codec import ProtocolError, unpack
from osel_sim.remote.process import ServerProcess
from osel_sim.sim.gl import choose_backend
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.environments import SuiteEnvironment, environment
from osel_sim.suites.host import PROTOCOL, Message, module_of, packed
from osel_sim.suites.wire import Wire

BOOT = Path(__file__).resolve().parent / "boot.py"
START_SECONDS = 120.0
ANSWER_SECONDS = 300.0
"""A simulator that compiles a scene, or makes its meshes light for the first time, takes its time."""


class HostGoneError(SuiteHostError):
    """The host has ended, or does not answer."""


class Host(ServerProcess):
    """The host process of one suite, started when something is first asked of it, and again where it has ended.

    Args:
        suite: package below `osel_sim.suites`.
        where: the Python environment that it runs in.

    Attributes:
        life: how often it has been started: environments of an earlier life are gone.
    """

    def __init__(self, suite: str, where: SuiteEnvironment) -> None:
        super().__init__(f"the host of suite {suite!r}", START_SECONDS)
        self._suite, self._where = suite, where
        self._wire: Wire | None = None
        self._lock = threading.Lock()
        self.life = 0

    def command(self, ready: int) -> list[str]:
        """The command line that starts it."""
        return [str(self._where.python), "-I", str(BOOT), self._suite, str(ready)]

    def ask(self, message: Message, life: int | None = None) -> Message:
        """The answer to one message.

        Args:
            life: in which what it is about began; None: it is about nothing, and starts a host that is not there.

        Raises:
            HostGoneError: it cannot be started, has ended, or does not answer; the next question starts it again.
            MissingPackageError: what was asked for needs a package that its environment does not have.
            UsageError: it refuses, since something is wrong with what was asked for.
            SuiteHostError: the simulator failed.
            ProtocolError: the message cannot be sent.
        """
        with self._lock:
            wire = self._wire if self.running else None
            if life is not None and (life != self.life or wire is None):
                raise self._gone("has ended") if life == self.life else HostGoneError(f"{self._what} has ended")
            question = packed(message)
            try:
                wire = wire or self._connect()
                wire.send(question, ANSWER_SECONDS)
                answer = _message(wire.receive(ANSWER_SECONDS))
            except TimeoutError:
                raise self._gone(f"does not answer within {ANSWER_SECONDS:g} s") from None
            except (OSError, WebSocketException, ProtocolError) as error:
                raise self._gone(f"hung up ({error})") from None
            except BaseException:
                self.close()  # interrupted: an answer that comes later must not be taken for that to the next question
                raise
        if "missing" in answer:
            package = answer["missing"]
            raise MissingPackageError(f"suite {self._suite!r}", package, f"uv pip install --python {self._where.python} {package}")
        if "refused" in answer:
            raise UsageError(answer["refused"])
        if "failed" in answer:
            raise SuiteHostError(f"{self._what}: {answer['failed']}")
        return answer

    def close(self) -> None:
        """End it. May be called twice."""
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()
        super().close()

    def _connect(self) -> Wire:
        self.close()
        try:
            self.start()
            self._wire = Wire.connect(self.url, self.token, START_SECONDS)
            self._wire.send(packed({"do": "greet"}), START_SECONDS)
            greeting = _message(self._wire.receive(START_SECONDS))
        except (OSError, WebSocketException, ProtocolError, RemoteError) as error:
            raise self._gone(str(error).removeprefix(f"{self._what} ")) from None
        if greeting.get("protocol") != PROTOCOL:
            raise self._gone(f"speaks {str(greeting)[:80]}, expected {PROTOCOL}")
        self.life += 1
        return self._wire

    def _gone(self, reason: str) -> HostGoneError:
        lines = self._last_lines()  # waits for its end, where that is under way
        ended = self.pid is not None and not self.running
        self.close()
        return HostGoneError(f"{self._what} {'has ended' if ended else reason}{lines}")


@functools.cache
def host_of(suite: str, where: str) -> Host:
    """The host of a suite in this process: it ends with the process."""
    host = Host(suite, environment(where))
    atexit.register(host.close)
    return host


class HostedEnvironment:
    """An environment of a host process, and an `Environment` and `LooksAhead` of this one.

    Args:
        host: where it runs.
        task: what to open there, without the suite.
    """

    def __init__(self, host: Host, task: str) -> None:
        self._host, self._task = host, task
        self._instance: PlainInstance | None = None
        self._status: Message = {}
        self._seen: tuple[tuple[list[str], int], Message] | None = None
        self._closed = False
        self._open()

    @property
    def specification(self) -> EnvironmentSpec:
        """What it offers a policy."""
        return self._specification

    @property
    def steps(self) -> int:
        """Control steps since the instance was loaded."""
        return int(self._status["steps"])

    @property
    def success(self) -> bool:
        """Whether the task is done now."""
        return bool(self._status["success"])

    @property
    def subgoal_fraction(self) -> float:
        """Share of the subgoals reached so far."""
        return float(self._status["subgoals"])

    @property
    def done(self) -> bool:
        """Success, or the horizon is reached."""
        return bool(self._status["done"])

    @property
    def instance(self) -> PlainInstance | None:
        """The one that is loaded."""
        return self._instance

    def load(self, instance: PlainInstance) -> None:
        """Reset to an instance, in a fresh host where the last one has ended."""
        self._instance = instance
        self._untouched, self._seen = True, None
        self._status = self._ask("load", instance=dataclasses.asdict(instance))["status"]

    def advance(self, action: NDArray[Any]) -> None:
        """One control step."""
        self.advance_chunk(np.asarray(action)[None])

    def advance_chunk(self, actions: NDArray[Any]) -> int:
        """Make the actions (T, D) until `done`; how many were made."""
        return self._advance(actions)

    def advance_and_look(self, actions: NDArray[Any], cameras: Sequence[str], size: int) -> int:
        """The same. What is to be observed next comes with the answer."""
        return self._advance(actions, (list(cameras), size))

    def _advance(self, actions: NDArray[Any], look: tuple[list[str], int] | None = None) -> int:
        self._untouched, self._seen = False, None
        answer = self._ask("advance", actions=np.asarray(actions, np.float32), look=look)
        self._status = answer["status"]
        if look is not None and "observation" in answer:
            self._seen = look, answer["observation"]
        return int(answer["made"])

    def observe(self, cameras: Sequence[str], size: int) -> Observation:
        """What a policy is shown now."""
        look = list(cameras), size
        if self._seen is not None and self._seen[0] == look:
            observation = self._seen[1]
        else:
            observation = self._ask("observe", cameras=look[0], size=size)["observation"]
        return {key: value.copy() if isinstance(value, np.ndarray) else value for key, value in observation.items()}

    def hold_action(self) -> Actions:
        """The action (D,) that holds still."""
        return np.array(self._ask("hold")["action"], np.float32)

    def image(self, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) of a camera."""
        return np.array(self._ask("image", camera=camera, width=width, height=height, quality=quality)["image"], np.uint8)

    def scene_digest(self) -> str:
        """Digest of the scene as it was loaded; empty where the simulator cannot tell."""
        return str(self._ask("scene")["scene"])

    def snapshot(self) -> Any:
        """The state now: plain data, which a fresh host can go back to as well."""
        return self._instance, self._status, self._ask("snapshot")["snapshot"]

    def restore(self, snapshot: Any) -> None:
        """Back to a snapshot, in a fresh host where the last one has ended."""
        self._instance, status, state = snapshot
        self._untouched, self._seen = True, None
        self._status = self._ask("restore", snapshot=state)["status"]
        self._untouched = status["steps"] == 0

    def expert(self) -> "HostedExpert":
        """The scripted expert of the loaded instance."""
        self._ask("expert")
        return HostedExpert(self)

    def act(self) -> NDArray[np.float64]:
        """The expert's next action (D,)."""
        return np.array(self._ask("act")["action"], np.float64)

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """What it tells the places of; nothing where it cannot."""
        return self._landmark_names

    def landmarks(self, cameras: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Where those are now."""
        return {name: np.array(value) for name, value in self._ask("landmarks", cameras=list(cameras))["landmarks"].items()}

    def close(self) -> None:
        """Give it back. The host stays, for others and for the next."""
        if not self._closed:
            with contextlib.suppress(SuiteHostError):
                self._ask_now("close")
        self._closed = True

    def _open(self) -> None:
        answer = self._host.ask({"do": "open", "task": self._task})
        self._number, self._life = int(answer["env"]), self._host.life
        self._specification = EnvironmentSpec.from_dict(answer["specification"])
        self._landmark_names = tuple(answer["landmarks"])
        self._status = {"steps": 0, "success": False, "subgoals": 0.0, "done": False}
        self._untouched = True

    def _ask(self, do: str, **arguments: Any) -> Message:
        """An answer. Where the host has ended and nothing has moved yet, a fresh one comes to the same beginning."""
        try:
            return self._ask_now(do, **arguments)
        except HostGoneError:
            if not self._untouched or self._closed:
                raise
        status, instance = self._status, self._instance
        self._open()
        self._status = status
        if do != "load" and instance is not None:
            self._ask_now("load", instance=dataclasses.asdict(instance))
        return self._ask_now(do, **arguments)

    def _ask_now(self, do: str, **arguments: Any) -> Message:
        return self._host.ask({"do": do, "env": self._number, **arguments}, self._life)


class HostedExpert:
    """The scripted expert of a hosted environment."""

    def __init__(self, env: HostedEnvironment) -> None:
        self._env = env

    def act(self) -> NDArray[np.float64]:
        """The next action (D,)."""
        return self._env.act()


def open_environment(suite: str, task: str, place: str | None = None, here: bool = False) -> Environment:
    """Make the environment of a task: in this process where what the suite needs is installed here, else in its host.

    Args:
        suite: package below `osel_sim.suites`.
        task: its name within the suite.
        place: its Python environment, where that is not called as the suite is.
        here: in this process in any case.

    Raises:
        MissingPackageError: it is neither here nor has been made.
        SuiteHostError: the host cannot be started, or the simulator fails.
    """
    host = _host(suite, place, here)
    if host is None:
        made: Environment = module_of(suite).open_environment(task)
        return made
    return HostedEnvironment(host, task)


def describe(suite: str, task: str, place: str | None = None, here: bool = False) -> Message:
    """What only the simulator knows of a task, as plain data (`describe` of the suite's module). Arguments and errors as `open_environment`."""
    host = _host(suite, place, here)
    return dict(module_of(suite).describe(task) if host is None else host.ask({"do": "describe", "task": task})["description"])


def _message(frame: memoryview) -> Message:
    message = unpack(frame)
    if not isinstance(message, dict):
        raise ProtocolError(f"expected a map, got {type(message).__name__}")
    return message


def _host(suite: str, place: str | None, here: bool) -> Host | None:
    """The host that a suite runs in; None: this process."""
    choose_backend()  # before MuJoCo is imported, here or there: it looks only once
    where = environment(place or suite)
    if here or where.here:
        return None
    where.require(suite)
    return host_of(suite, where.name)
