"""The catalogue of things that task files can name (assets/objects/objects.toml)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from osel_sim.formats.task_file import Entity
from osel_sim.formats.terms import ARTICULATED, HINGED, KINDS, RECEPTACLES
from osel_sim.formats.validate import Table


@dataclass(frozen=True)
class Catalogue:
    """Things by name, and properties by name with what people call the things that have them."""

    things: Mapping[str, Entity]
    attributes: Mapping[str, tuple[str, ...]]


def load_catalogue(file: Path | None = None) -> Catalogue:
    """Read the catalogue; None reads the shipped one.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    if file is None:
        from osel_sim.core import content

        file = content.root() / "assets" / "objects" / "objects.toml"
    table = Table.load(file)
    table.integer("version", 1, 1)
    section = table.table("attribute", {})
    attributes = {name: _attribute(section.table(name)) for name in section.data}
    things: dict[str, Entity] = {}
    for kind in KINDS:
        section = table.table(kind, {})
        for name in section.data:
            if name in things:
                raise section.error(name, f"is the name of a {things[name].kind} already")
            things[name] = _entity(section.table(name), name, kind, tuple(attributes))
    table.done()
    return Catalogue(things, attributes)


def _attribute(table: Table) -> tuple[str, ...]:
    names = table.strings("names")
    table.done()
    return names


def _entity(table: Table, name: str, kind: str, attributes: tuple[str, ...]) -> Entity:
    model = table.get("model", str)
    if not (model in ("box", "cylinder") or model.startswith("robosuite:") or model.endswith(".xml")):
        raise table.error("model", f'must be "box", "cylinder", "robosuite:<class>" or an .xml file, got {model!r}')
    primitive = model in ("box", "cylinder")
    has = table.strings("attributes", [])
    for attribute in has:
        table.one_of("attributes", attribute, attributes)
    entity = Entity(
        name=name,
        kind=kind,
        names=table.strings("names"),
        model=model,
        radius=table.number("radius", 0.001, 1.0),
        size=table.numbers("size", {"box": 3, "cylinder": 2}[model]) if primitive else (),
        rgba=table.numbers("rgba", 4) if primitive or "rgba" in table.data else (),
        symmetry=table.integer("symmetry", 0, 180, 180),
        grasp=table.number("grasp", -0.2, 0.2, 0.0),
        inner=table.number("inner", 0.001, 1.0) if kind in RECEPTACLES else 0.0,
        rim=table.number("rim", 0.0, 1.0) if kind in RECEPTACLES else 0.0,
        floor=table.number("floor", 0.0, 0.2, 0.008) if kind in RECEPTACLES else 0.0,
        handle=table.get("handle", str, ""),
        inside=table.get("inside", str, "") if kind in RECEPTACLES else "",
        lean=table.number("lean", 0.0, 60.0, 0.0) if kind in HINGED else 0.0,
        joint=table.get("joint", str) if kind in ARTICULATED else "",
        attributes=has,
    )
    table.done()
    return entity
