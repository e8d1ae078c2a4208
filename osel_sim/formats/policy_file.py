"""A policy file: what drives the robot, where it runs, what it needs to see, what it costs."""

import re
from dataclasses import field, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticKnownError

from osel_sim.formats.conventions import Conventions
from osel_sim.formats.toml_file import load_toml
from osel_sim.formats.toml_types import TABLE, FileName, OneOf, Texts, Version, between, quoted, refuse

NETWORKS = ("none", "ethernet", "wifi", "lte", "satellite")  # the profiles themselves: osel_sim.remote.network
MODES = ("blocking", "async")
PRIVILEGED = ("scripted_expert",)
"""Kinds that see the simulator's state: a ceiling to compare with, never chosen unless named, and never behind a server."""
VLA_EVAL = "vla_eval"
SERVERS = ("openpi", VLA_EVAL)
"""Kinds that only exist as somebody's server, reached by `url` of the policy file: what protocol it speaks."""
_CAMERAS_WANTED = "must name one or more different cameras, "

Cents = Annotated[float, between(0.0, 1e6)]


@dataclass(frozen=True, config=TABLE)
class Price:
    """Cents per executed action, per call and per megabyte moved (up and down)."""

    per_action: Cents = 0.0
    """Cents for each action that is executed."""
    per_call: Cents = 0.0
    """Cents for each question to the policy."""
    per_megabyte: Cents = 0.0
    """Cents for each megabyte moved, up and down."""

    def of(self, actions: int, calls: int, megabytes: float) -> float:
        """Price in cents of so many actions, calls and megabytes."""
        return self.per_action * actions + self.per_call * calls + self.per_megabyte * megabytes


@dataclass(frozen=True, config=TABLE)
class Remote:
    """How a remote policy is reached."""

    network: Annotated[str, OneOf(NETWORKS)] = "wifi"
    """A named profile of bandwidth, delay and loss."""
    mode: Annotated[str, OneOf(MODES)] = "blocking"
    """`blocking` (hold still until the answer is there) or `async` (finish the chunk at hand meanwhile)."""
    deadline: Annotated[float, between(0.001, 3600.0)] = 2.0
    """Seconds on the virtual clock after which a call is given up."""
    fallback: str | None = None
    """Local policy that takes over then; without one it is an error outcome."""
    url: str | None = None
    """Connect to this server (`ws://...`) instead of starting one."""
    timeout: Annotated[float, between(0.1, 3600.0)] = 30.0
    """Real seconds that a server may take for an answer, or for a new connection."""

    @field_validator("url")
    @classmethod
    def _is_a_websockets(cls, url: str | None) -> str | None:
        if url is not None and not url.startswith(("ws://", "wss://")):
            told = f", got {quoted(url)}" if re.fullmatch(r"\w+://[\w.-]*", url) else ""  # else there may be a password in it
            raise ValueError(f"must start with ws:// or wss://{told}")
        if url is not None and not re.fullmatch(r"wss?://[^\s\"'<>]+", url):
            raise ValueError("must hold no spaces, quotes, < or > (within a password: %20, %22, %27, %3C, %3E)")
        return url


@dataclass(frozen=True, config=TABLE)
class ObservationTable:
    """What a policy is shown."""

    cameras: Texts
    """Different cameras, one or more."""
    image_size: Annotated[int, between(16, 1024)]
    """Pixels of each side: images are square."""
    history: Annotated[int, between(1, 16)] = 1
    """How many successive observations it is shown at a call, one control step apart, the newest last."""

    @field_validator("cameras")
    @classmethod
    def _differ(cls, cameras: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(cameras)) < len(cameras):
            raise ValueError(_CAMERAS_WANTED + f"got {quoted(list(cameras))}")
        return cameras


@dataclass(frozen=True, kw_only=True, config=TABLE)
class _Keys:
    """The keys of a policy file that mean in code what they mean in the file."""

    name: FileName
    """The file's name without `.toml`."""
    title: str
    """One line for listings."""
    kind: str
    """Which class drives it; built in: `lerobot` (checkpoint folder or hub name), `openpi` (any openpi-protocol server), `vla_eval` (any model server
    of vla-evaluation-harness), `scripted_expert`."""
    checkpoint: str = ""
    """Folder relative to the content root, absolute folder, or hub name; empty for kinds without one."""
    execute: Annotated[int, between(1, 1000)]
    """How many actions of each chunk are executed before it is asked again."""
    inference_seconds: Annotated[float, between(0.0, 3600.0)]
    """Declared time of one inference on the virtual clock."""
    skills: Texts | None = None
    """Tasks that it was made for (names, `tag:TAG`, `all`, and `SUITE:` before them for those of other suites), for selectors that want to know; left
    out: nothing is said."""
    price: Price = field(default_factory=Price)
    """What it costs; left out: nothing."""

    @field_validator("skills")
    @classmethod
    def _names_some(cls, skills: Texts | None) -> Texts | None:
        if skills == ():
            raise ValueError("must name at least one task; leave it out where nothing is known")
        return skills


@dataclass(frozen=True, kw_only=True, config=TABLE)
class PolicySpec(_Keys):
    """One policy file as code wants it: what is shown to the policy is not a table of its own, and where it runs is said once.

    Attributes:
        cameras, image_size: what it is shown (square, pixels).
        history: how many successive observations at a call.
        remote: None for a local policy.
        mapping: the policy's own names and conventions; those of this package where the file has no such table.
    """

    cameras: tuple[str, ...]
    image_size: int
    remote: Remote | None
    mapping: Conventions = field(default_factory=Conventions)
    file: Path
    version: int = 1
    history: int = 1

    @property
    def is_remote(self) -> bool:
        """Whether it runs behind a server."""
        return self.remote is not None

    @property
    def is_privileged(self) -> bool:
        """Whether it sees what no robot could."""
        return self.kind in PRIVILEGED


@dataclass(frozen=True, kw_only=True, config=TABLE)
class PolicyFile(_Keys):
    """A policy: one file in policies/."""

    version: Version
    """Of the format."""
    location: Annotated[str, OneOf(("local", "remote"))]
    """Where it runs: on the robot, or behind a server."""
    observation: Annotated[ObservationTable | None, Field(validate_default=True)] = None
    """What it is shown; only a privileged policy needs no such table."""
    remote: Annotated[Remote | None, Field(validate_default=True)] = None
    """How it is reached, where `location` is remote."""
    mapping: Conventions = field(default_factory=Conventions)
    """Which names and conventions of the policy are others than those of this package."""

    @field_validator("location")
    @classmethod
    def _privileged_stay(cls, location: str, info: ValidationInfo) -> str:
        kind = info.data.get("kind")
        if kind in PRIVILEGED and location != "local":
            raise ValueError(f"must be 'local': a policy of kind {kind!r} sees the simulator's state, which nothing sends over a network")
        return location

    @field_validator("observation")
    @classmethod
    def _sees_something(cls, observation: ObservationTable | None, info: ValidationInfo) -> ObservationTable | None:
        if info.data.get("kind", PRIVILEGED[0]) in PRIVILEGED:
            return observation
        if observation is None:
            raise PydanticKnownError("missing")
        if not observation.cameras:
            refuse((("cameras",), _CAMERAS_WANTED + "got []"))
        return observation

    @field_validator("remote")
    @classmethod
    def _where_it_says(cls, remote: Remote | None, info: ValidationInfo) -> Remote | None:
        location, kind = info.data.get("location"), info.data.get("kind")
        if location == "local" and remote is not None:
            raise ValueError('only a policy with location = "remote" has this table')
        if kind in SERVERS and location is not None and (remote is None or remote.url is None):
            refuse((("url",), f"is missing: a policy of kind {kind!r} is a server of its own, give its address (ws://host:port)"))
        return Remote() if location == "remote" and remote is None else remote

    @field_validator("mapping")
    @classmethod
    def _fits_the_cameras(cls, mapping: Conventions, info: ValidationInfo) -> Conventions:
        observation = info.data.get("observation")
        if isinstance(observation, ObservationTable) and (faults := list(mapping.faults(observation.cameras))):
            refuse(*faults)
        return mapping

    def spec(self, file: Path) -> PolicySpec:
        """The policy as code wants it."""
        same = {key.name: getattr(self, key.name) for key in fields(_Keys)}
        seen = self.observation or ObservationTable(cameras=(), image_size=16)
        return PolicySpec(
            **same,
            cameras=seen.cameras,
            image_size=seen.image_size,
            history=seen.history,
            remote=self.remote,
            mapping=self.mapping,
            file=file,
        )


def load_policy_file(file: Path) -> PolicySpec:
    """Read and check a policy file.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    return load_toml(PolicyFile, file).spec(file)
