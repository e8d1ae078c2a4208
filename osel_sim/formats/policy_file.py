"""A policy file: what drives the robot, where it runs, what it needs to see, what it costs."""

import re
from dataclasses import dataclass, field
from pathlib import Path

from osel_sim.core.errors import ContentError
from osel_sim.formats.mapping import Mapping, read_mapping
from osel_sim.formats.validate import Table

NETWORKS = ("none", "ethernet", "wifi", "lte", "satellite")  # the profiles themselves: osel_sim.remote.network
CAMERAS = ("agentview", "wrist")
MODES = ("blocking", "async")
PRIVILEGED = ("scripted_expert",)
"""Kinds that see the simulator's state: a ceiling to compare with, never chosen unless named, and never behind a server."""


@dataclass(frozen=True)
class Price:
    """Cents per executed action, per call and per megabyte moved (up and down)."""

    per_action: float = 0.0
    per_call: float = 0.0
    per_megabyte: float = 0.0

    def of(self, actions: int, calls: int, megabytes: float) -> float:
        """Price in cents of so many actions, calls and megabytes."""
        return self.per_action * actions + self.per_call * calls + self.per_megabyte * megabytes


@dataclass(frozen=True)
class Remote:
    """How a remote policy is reached.

    Attributes:
        network: a named profile (`ethernet`, `wifi`, `lte`, `satellite`).
        mode: `blocking` (hold still until the answer is there) or `async` (finish the chunk at hand meanwhile).
        deadline: seconds on the virtual clock after which a call is given up.
        fallback: local policy that takes over then; None makes it an error outcome.
        url: connect to this server (`ws://...`) instead of starting one.
    """

    network: str = "wifi"
    mode: str = "blocking"
    deadline: float = 2.0
    fallback: str | None = None
    url: str | None = None


@dataclass(frozen=True)
class PolicySpec:
    """One policy file, validated.

    Attributes:
        kind: which class drives it; built in: `lerobot` (checkpoint folder or hub name), `openpi` (any openpi-protocol server), `scripted_expert`.
        checkpoint: folder relative to the content root, absolute folder, or hub name; empty for kinds without one.
        cameras, image_size: what it is shown (square, pixels).
        execute: how many actions of each chunk are executed before it is asked again.
        inference_seconds: declared time of one inference on the virtual clock.
        remote: None for a local policy.
        skills: tasks that it was made for (names, `tag:TAG` or `all`), for selectors that want to know; None: the file does not say.
        mapping: the policy's own names and conventions; those of this package where the file has no such table.
    """

    name: str
    title: str
    kind: str
    checkpoint: str
    cameras: tuple[str, ...]
    image_size: int
    execute: int
    inference_seconds: float
    remote: Remote | None
    price: Price
    file: Path
    version: int = 1
    mapping: Mapping = field(default_factory=Mapping)
    skills: tuple[str, ...] | None = None

    @property
    def is_remote(self) -> bool:
        """Whether it runs behind a server."""
        return self.remote is not None

    @property
    def is_privileged(self) -> bool:
        """Whether it sees what no robot could."""
        return self.kind in PRIVILEGED


def load_policy_file(file: Path) -> PolicySpec:
    """Read and check a policy file.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    table = Table.load(file)
    version = table.integer("version", 1, 1)
    name = table.get("name", str)
    if name != file.stem:
        raise ContentError(file, "name", f"must equal the file's name {file.stem!r}, got {name!r}")
    location = table.choice("location", ("local", "remote"))
    kind = table.get("kind", str)
    privileged = kind in PRIVILEGED
    if privileged and location != "local":
        raise table.error("location", f"must be 'local': a policy of kind {kind!r} sees the simulator's state, which nothing sends over a network")
    observation = table.table("observation", {"cameras": [], "image_size": 16} if privileged else ...)
    cameras = observation.strings("cameras")
    for camera in cameras:
        if camera not in CAMERAS:
            raise observation.error("cameras", f"unknown camera {camera!r}, known: {', '.join(CAMERAS)}")
    if not (cameras or privileged) or len(set(cameras)) < len(cameras):
        raise observation.error("cameras", f"must name one or more different cameras of {', '.join(CAMERAS)}, got {list(cameras)}")
    image_size = observation.integer("image_size", 16, 1024)
    observation.done()
    remote = None
    if location == "remote":
        section = table.table("remote", {})
        remote = Remote(
            network=section.choice("network", NETWORKS, "wifi"),
            mode=section.choice("mode", MODES, "blocking"),
            deadline=section.number("deadline", 0.001, 3600.0, 2.0),
            fallback=section.get("fallback", str, None),
            url=section.get("url", str, None),
        )
        if remote.url is not None and not remote.url.startswith(("ws://", "wss://")):
            told = f", got {remote.url!r}" if re.fullmatch(r"\w+://[\w.-]*", remote.url) else ""  # else there may be a password in it
            raise section.error("url", f"must start with ws:// or wss://{told}")
        if remote.url is not None and not re.fullmatch(r"wss?://[^\s\"'<>]+", remote.url):
            raise section.error("url", "must hold no spaces, quotes, < or > (within a password: %20, %22, %27, %3C, %3E)")
        section.done()
    cost = table.table("price", {})
    price = Price(*(cost.number(key, 0.0, 1e6, 0.0) for key in ("per_action", "per_call", "per_megabyte")))
    cost.done()
    spec = PolicySpec(
        name=name,
        title=table.get("title", str),
        kind=kind,
        checkpoint=table.get("checkpoint", str, ""),
        cameras=cameras,
        image_size=image_size,
        execute=table.integer("execute", 1, 1000),
        inference_seconds=table.number("inference_seconds", 0.0, 3600.0),
        remote=remote,
        price=price,
        file=file,
        version=version,
        mapping=read_mapping(table.table("mapping", {}), cameras),
        skills=table.strings("skills") if "skills" in table.data else None,
    )
    if spec.skills == ():
        raise table.error("skills", "must name at least one task; leave it out where nothing is known")
    if kind == "openpi" and (remote is None or remote.url is None):
        raise table.error("remote.url", "is missing: a policy of kind 'openpi' is a server of its own, give its address (ws://host:port)")
    if location == "local" and "remote" in table.data:
        raise table.error("remote", 'only a policy with location = "remote" has this table')
    table.done()
    return spec
