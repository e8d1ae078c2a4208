"""One client of a policy server: what it sends is read and checked, what its policy answers is checked and packed."""

import time
from typing import Any

import numpy as np

from osel_sim.interface.policy import Observation, Policy
from osel_sim.policy.local import check_form
from osel_sim.remote.codec import ProtocolError, pack, unpack
from osel_sim.remote.libero_client import is_libero, read_libero
from osel_sim.remote.protocol import RESET, TASK, Greeting, check_instruction, check_observation


class Session:
    """One client's policy. Not safe for threads; the server runs one inference at a time."""

    def __init__(self, policy: Policy, greeting: Greeting) -> None:
        self.policy, self._greeting = policy, greeting
        self._instruction: str | None = None

    def answer(self, frame: bytes) -> bytes:
        """The reply to one frame: actions, or the same map back for a reset.

        Raises:
            ProtocolError, ObservationError: the client's fault, the session goes on.
            Exception: the policy's fault.
        """
        read = self._read(frame)
        if isinstance(read, bytes):
            return read
        start = time.perf_counter()
        return self._reply(self.policy.act(read), time.perf_counter() - start)

    def read_safely(self, frame: bytes) -> bytes | Observation | Exception:
        """What the policy is to be asked, the policy being reset where that is due; or the reply to a reset; or what is wrong with the frame."""
        try:
            return self._read(frame)
        except Exception as error:
            return error

    def reply_safely(self, actions: Any, seconds: float) -> bytes | Exception:
        """The reply with a policy's answer, which took so long; or what is wrong with that, or what it raised in place of it."""
        if isinstance(actions, Exception):
            return actions
        try:
            return self._reply(actions, seconds)
        except Exception as error:
            return error

    def _read(self, frame: bytes) -> bytes | Observation:
        message = unpack(frame)
        if isinstance(message, dict) and RESET in message:
            if len(message) != 1:
                raise ProtocolError(f"a reset has the one key {RESET!r}")
            self._reset(check_instruction(message[RESET]))
            return pack(message)
        observation = check_observation(read_libero(message, self._greeting) if is_libero(message) else message, self._greeting)
        if observation[TASK] != self._instruction:
            self._reset(observation[TASK])
        return observation

    def _reply(self, answer: Any, seconds: float) -> bytes:
        actions = check_form(answer, self._greeting.action_dim)
        actions = actions.astype(np.float32) if self._greeting.action is None else self._greeting.action.clip(actions)
        return pack({"actions": actions, "server_timing": {"infer_ms": 1e3 * seconds}})

    def _reset(self, instruction: str) -> None:
        self.policy.reset(instruction)
        self._instruction = instruction
