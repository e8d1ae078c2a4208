"""A model server of vla-evaluation-harness as a policy: `kind = "vla_eval"`.

Its protocol (version 1, as the package vla-eval 0.8.0 has it): msgpack maps of `type`, `payload`, `seq` and `timestamp` over a WebSocket. The client
speaks first (`hello`), says when an episode begins and ends, and gets an `action` or an `error` for each `observation`, with the observation's `seq`.
A server that keeps its chunks answers one action at a time: `execute = 1` then.
"""

import contextlib
import logging
import time
from dataclasses import replace
from typing import Any

import msgpack  # type: ignore[import-untyped,unused-ignore]
import numpy as np

from osel_sim.core.errors import PolicyError, RemoteError
from osel_sim.formats.conventions import Conventions
from osel_sim.interface.policy import Observation
from osel_sim.policy.local import check_actions
from osel_sim.policy.mapping import actions_of, message_of
from osel_sim.remote.client import Answer, RemoteClient, UnsentError, cameras_in
from osel_sim.remote.codec import ProtocolError
from osel_sim.remote.dialects import actions_in, size_of, unpack_any
from osel_sim.remote.protocol import TASK

VERSION = 1
HELLO_SECONDS = 10.0
"""A server answers a hello at once: it begins to listen when its model is loaded."""
OURS = Conventions()
GRIPPERS = {"binary_close_positive": "closed_positive", "binary_close_negative": "open_positive", "binary_close_01": "closed_one"}
"""How a server may describe its gripper -> what `gripper` under [mapping] calls it."""
_IMAGES = "images/"
_NOT_THEIRS = 'is no model server of vla-eval; kind = "openpi" is for servers of openpi\'s protocol'

logger = logging.getLogger(__name__)


class VlaEvalClient(RemoteClient):
    """A connection to one model server; its arguments are `RemoteClient`'s."""

    _seq = 0
    _playing = False

    @property
    def foreign(self) -> bool:
        """It is never ours."""
        return self.connected

    def connect(self) -> None:
        """Connect and exchange hellos; nothing if connected already.

        Raises:
            RemoteError: nobody there, the token refused, or no model server of vla-eval.
        """
        if self.connected:
            return
        self._playing = False
        end = time.monotonic() + min(self._timeout, HELLO_SECONDS)
        self._open_connection()
        self._tell("hello", {"harness_version": "osel_sim", "protocol_version": VERSION})
        said = self._hear(end, "hello")
        version = said.get("protocol_version")
        if version != VERSION:
            raise self._fail(f"speaks version {str(version)[:20]} of vla-eval's protocol; version {VERSION} is known here")
        self._warn_of_gripper(said)

    def reset(self, instruction: str) -> None:
        """End the episode, if there is one, and begin another, on a new connection if there is none.

        Raises:
            RemoteError: as `connect`.
        """
        self.connect()
        if self._playing:
            self._tell("episode_end", {})
        self._seq = 0  # it counts in the bytes of a message, which must not depend on the episodes before
        self._tell("episode_start", {"task": {"name": instruction}})
        self._playing = True

    def act(self, observation: Observation) -> Answer:
        """Actions for one observation; begins an episode where none is.

        Raises:
            UnsentError: the connection was closed before, or the server sent something before it was asked.
            RemoteError: timeout, closed, an error message, or an answer without proper actions.
        """
        start = time.perf_counter()
        if not self.connected:
            raise UnsentError(f"{self.url}: not connected")
        if not self._playing:
            self.reset(observation[TASK])
        end = time.monotonic() + self._timeout
        bytes_up = self._tell("observation", self.message(observation))
        reply = self._hear(end, "action")
        action, key = self._environment.action, self._mapping.actions
        try:
            actions = check_actions(actions_of(actions_in(reply, key), self._mapping, action, key), action)
        except PolicyError as error:
            raise self._fail(str(error)) from None
        return Answer(actions, time.perf_counter() - start, bytes_up, size_of(reply))

    def message(self, observation: Observation) -> dict[str, Any]:
        """An observation in their words: cameras within `images`."""
        mapping, cameras = self._mapping, cameras_in(observation)
        named = replace(
            mapping,
            images={camera: _IMAGES + mapping.images.get(camera, camera) for camera in cameras},
            blank=tuple(_IMAGES + key for key in mapping.blank),
            state="states" if mapping.state == OURS.state else mapping.state,  # what their servers look for, where the file says nothing else
            prompt="task_description" if mapping.prompt == OURS.prompt else mapping.prompt,
        )
        flat = message_of(observation, named, cameras, self._environment)
        images = {key.removeprefix(_IMAGES): value for key, value in flat.items() if key.startswith(_IMAGES)}
        return {"images": images, **{key: value for key, value in flat.items() if not key.startswith(_IMAGES)}}

    def close(self) -> None:
        """Hang up, which ends an episode as well."""
        self._playing = False
        super().close()

    def _tell(self, kind: str, payload: dict[str, Any]) -> int:
        """Send one message. Returns its length in bytes."""
        self._seq += 1
        frame: bytes = msgpack.packb({"type": kind, "payload": payload, "seq": self._seq, "timestamp": time.time()}, default=_to_wire)
        self._send(frame)
        return len(frame)

    def _hear(self, end: float, kind: str) -> dict[str, Any]:
        """The payload of the next message, which must be of a kind and answer the last one sent."""
        frame = self._receive(end)
        message = None if isinstance(frame, str) else self._decode(frame, "answer", True)
        if not isinstance(message, dict) or not isinstance(message.get("payload"), dict) or "type" not in message:
            raise self._fail(_NOT_THEIRS)
        if message["type"] == "error":
            raise self._fail(_reported(message["payload"]))
        if message["type"] != kind or message.get("seq") != self._seq:
            got = f"{str(message['type'])[:40]!r} to message {str(message.get('seq'))[:20]}"
            raise self._fail(f"answered {got}, where {kind!r} to message {self._seq} was due")
        payload: dict[str, Any] = message["payload"]
        return payload

    def _unasked(self, frame: bytes) -> str:
        """What a message says that lies there before a question: an episode could not be begun, most likely."""
        with contextlib.suppress(ProtocolError):
            message = unpack_any(frame)
            if isinstance(message, dict) and message.get("type") == "error" and isinstance(message.get("payload"), dict):
                return _reported(message["payload"])
            if not isinstance(message, dict) or "type" not in message:
                return _NOT_THEIRS  # a greeting
        return super()._unasked(frame)

    def _warn_of_gripper(self, said: dict[str, Any]) -> None:
        """Say so where the server describes its gripper otherwise than the policy file does."""
        spec = said.get("action_spec")
        gripper = spec.get("gripper") if isinstance(spec, dict) else None
        form = str(gripper.get("format"))[:60] if isinstance(gripper, dict) else ""
        named = GRIPPERS.get(form)
        if named is not None and named != self._mapping.gripper:
            logger.warning(
                '%s: says that its gripper is %s: gripper = "%s" under [mapping], where the policy file has "%s"',
                self.url,
                form,
                named,
                self._mapping.gripper,
            )


def _reported(payload: dict[str, Any]) -> str:
    return f"reported an error: {str(payload.get('error', payload))[:300]}"


def _to_wire(value: Any) -> dict[str, Any]:
    """An array in their form, whose keys are text."""
    if not isinstance(value, np.ndarray):
        raise RemoteError(f"{type(value).__name__} cannot be sent")
    return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}
