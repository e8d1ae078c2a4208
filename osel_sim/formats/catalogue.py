"""The catalogue of things that task files can name (assets/objects/objects.toml)."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticKnownError

from osel_sim.formats.terms import KINDS
from osel_sim.formats.toml_file import load_toml
from osel_sim.formats.toml_types import TABLE, Faults, Number, Texts, Version, between, quoted, refuse, unknown_value

_EXTENTS = {"box": 3, "cylinder": 2}
"""Models that are built from their size, and how many numbers that has."""
Names = Annotated[Texts, Field(min_length=1)]


@dataclass(frozen=True, config=TABLE)
class Attribute:
    """A property that a rule can go by."""

    names: Names
    """What people call the things that have it."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class Thing:
    """The keys of an object, and of every other kind."""

    names: Names
    """What people call it; the first is the canonical one. Every other one only appears in some phrasings."""
    model: str
    """`robosuite:<class of robosuite.models.objects>`, `box` or `cylinder`, or an XML file beside this one."""
    radius: Annotated[float, between(0.001, 1.0)]
    """Footprint, for placing things without overlap (metres)."""
    size: Annotated[tuple[Number, ...] | None, Field(validate_default=True)] = None
    """Half extents of a box (3 numbers) or cylinder (radius and half height), metres; other models have their own."""
    rgba: Annotated[tuple[Number, Number, Number, Number] | None, Field(validate_default=True)] = None
    """Colour of a box, a cylinder, or of the geoms of an XML file whose names start with "painted"."""
    grasp: Annotated[float, between(-0.2, 0.2)] = 0.0
    """Height of the grasp above its origin (metres)."""
    symmetry: Annotated[int, between(0, 180)] = 180
    """It looks the same when turned by this many degrees (0: by any), so the gripper turns no further than it must."""
    handle: str = ""
    """Site of the model to grasp or press instead."""
    attributes: Texts = ()
    """Properties that a rule can go by."""

    @field_validator("model")
    @classmethod
    def _can_be_built(cls, model: str) -> str:
        if not (model in _EXTENTS or model.startswith("robosuite:") or model.endswith(".xml")):
            raise ValueError(f'must be "box", "cylinder", "robosuite:<class>" or an .xml file, got {quoted(model)}')
        return model

    @field_validator("size")
    @classmethod
    def _size_of_a_primitive(cls, size: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        wanted = _EXTENTS.get(info.data.get("model", ""))
        if size is None and wanted:
            raise PydanticKnownError("missing")
        if size is not None and "model" in info.data and len(size) != wanted:
            raise ValueError(f"must be a list of {wanted} numbers, got {quoted(list(size))}" if wanted else "is only for the models box and cylinder")
        return size

    @field_validator("rgba")
    @classmethod
    def _colour_of_a_primitive(cls, rgba: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        if rgba is None and info.data.get("model") in _EXTENTS:
            raise PydanticKnownError("missing")
        return rgba


@dataclass(frozen=True, kw_only=True, config=TABLE)
class Receptacle(Thing):
    """A container, zone, peg or drawer: objects can be put into, onto or around it."""

    inner: Annotated[float, between(0.001, 1.0)]
    """Radius within which a thing counts as being in (on, around) it (metres)."""
    rim: Annotated[float, between(0.0, 1.0)]
    """Height above that place below which its lowest point must be (metres)."""
    floor: Annotated[float, between(0.0, 0.2)] = 0.008
    """Thickness of what it is put down on (metres)."""
    inside: str = ""
    """Site where things are put, instead of the origin."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class Button(Thing):
    """A thing with a part that moves."""

    joint: str
    """The moving part's joint."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class Door(Button):
    """A thing that opens and closes."""

    lean: Annotated[float, between(0.0, 60.0)] = 0.0
    """Degrees by which a gripper that holds the handle leans away from what the handle is fixed to, for want of room."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class Drawer(Receptacle, Door):
    """A thing that opens and closes, and holds others."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CatalogueFile:
    """Everything a task file can name: a table for each kind, and in it a table for each thing."""

    version: Version
    """Of the format."""
    attribute: dict[str, Attribute] = dataclasses.field(default_factory=dict)
    """Properties by name."""
    object: dict[str, Thing] = dataclasses.field(default_factory=dict)
    """Things that lie loose."""
    container: dict[str, Receptacle] = dataclasses.field(default_factory=dict)
    """Things that objects are put into."""
    zone: dict[str, Receptacle] = dataclasses.field(default_factory=dict)
    """Marks on the table that objects are put or pushed onto."""
    peg: dict[str, Receptacle] = dataclasses.field(default_factory=dict)
    """Pegs that nuts are put around."""
    drawer: dict[str, Drawer] = dataclasses.field(default_factory=dict)
    """Drawers."""
    button: dict[str, Button] = dataclasses.field(default_factory=dict)
    """Buttons."""
    door: dict[str, Door] = dataclasses.field(default_factory=dict)
    """Doors."""

    @field_validator(*KINDS)
    @classmethod
    def _are_told_apart(cls, things: dict[str, Thing], info: ValidationInfo) -> dict[str, Thing]:
        if faults := list(_faults(things, info.data)):
            refuse(*faults)
        return things


def _faults(things: Mapping[str, Thing], before: Mapping[str, Mapping[str, object]]) -> Faults:
    for name, thing in things.items():
        for kind in KINDS:
            if name in before.get(kind, ()):
                yield (name,), f"is a name in [{kind}] already"
        for index, attribute in enumerate(thing.attributes):
            if "attribute" in before and attribute not in before["attribute"]:
                yield (name, "attributes", index), unknown_value(attribute, before["attribute"])


@dataclasses.dataclass(frozen=True)
class Entity:
    """A thing of the catalogue that takes part in a task (`Thing` and those after it explain the fields).

    One type for all kinds, so that code may ask any thing for any of it; what a kind does not have is 0, empty or no text.
    """

    name: str
    kind: str
    names: tuple[str, ...]
    model: str
    radius: float
    size: tuple[float, ...] = ()
    rgba: tuple[float, ...] = ()
    grasp: float = 0.0
    inner: float = 0.0
    rim: float = 0.0
    floor: float = 0.0
    symmetry: int = 180
    handle: str = ""
    inside: str = ""
    lean: float = 0.0
    joint: str = ""
    attributes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """Things by name, and properties by name with what people call the things that have them."""

    things: Mapping[str, Entity]
    attributes: Mapping[str, tuple[str, ...]]


def load_catalogue(file: Path | None = None) -> Catalogue:
    """Read the catalogue; None reads the shipped one.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    return _shipped() if file is None else _load(file)


@functools.cache
def _shipped() -> Catalogue:
    from osel_sim.core import content

    return _load(content.root() / "assets" / "objects" / "objects.toml")


def _load(file: Path) -> Catalogue:
    found = load_toml(CatalogueFile, file)
    things = {name: _entity(name, kind, thing) for kind in KINDS for name, thing in getattr(found, kind).items()}
    return Catalogue(things, {name: attribute.names for name, attribute in found.attribute.items()})


def _entity(name: str, kind: str, thing: Thing) -> Entity:
    given = {field.name: getattr(thing, field.name) for field in dataclasses.fields(thing)}
    return Entity(name=name, kind=kind, **given | {"size": thing.size or (), "rgba": thing.rgba or ()})
