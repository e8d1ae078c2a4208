"""Every TOML file the package reads: whatever is wrong with it is told at once, by file and key, and its JSON Schema is as it is committed."""

import copy
import json
import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from osel_sim.cli.machine_checks import examine
from osel_sim.cli.schemas import schemas
from osel_sim.core import content
from osel_sim.core.errors import ContentError
from osel_sim.formats.catalogue import load_catalogue
from osel_sim.formats.policy_file import load_policy_file
from osel_sim.formats.task_file import load_task_file
from osel_sim.ingestion.columns_file import load_columns
from osel_sim.run import main
from osel_sim.training.recipe import load_recipe

ROOT = content.root()
SHIPPED: dict[str, tuple[Callable[[Path], Any], list[Path]]] = {
    "task": (load_task_file, sorted((ROOT / "tasks").glob("*.toml"))),
    "policy": (load_policy_file, [*sorted((ROOT / "policies").glob("*.toml")), *sorted((ROOT / "examples" / "policies").glob("*.toml"))]),
    "catalogue": (load_catalogue, [ROOT / "assets" / "objects" / "objects.toml"]),
    "recipe": (load_recipe, sorted((ROOT / "policies" / "training").glob("*.toml"))),
    "table-mapping": (load_columns, [ROOT / "examples" / "mmlu.toml"]),
}
FILES = [(kind, file) for kind, (_, files) in SHIPPED.items() for file in files]
TRIED = [(kind, file) for kind, file in FILES if file.stem in ("sort", "open_drawer", "pi0_libero", "local_small", "objects", "remote_base", "mmlu")]
"""Files that have every key between them."""


def names(files: list[tuple[str, Path]]) -> list[str]:
    return [f"{kind}:{file.stem}" for kind, file in files]


def toml(data: dict[str, Any]) -> str:
    """Plain data as inline TOML; JSON's strings, numbers and lists are TOML's."""

    def text(value: Any) -> str:
        if isinstance(value, dict):
            return "{" + ", ".join(f"{json.dumps(key)} = {text(item)}" for key, item in value.items()) + "}"
        return "[" + ", ".join(map(text, value)) + "]" if isinstance(value, list) else json.dumps(value)

    return "".join(f"{json.dumps(key)} = {text(value)}\n" for key, value in data.items())


def faults(kind: str, file: Path, data: dict[str, Any], folder: Path) -> list[str]:
    """`KEY: PROBLEM` of each fault, none where the file is right."""
    changed = folder / file.name
    changed.write_text(toml(data))
    try:
        SHIPPED[kind][0](changed)
    except ContentError as error:
        lines = str(error).splitlines()
        assert all(line.startswith(f"{changed}: ") for line in lines), lines
        return [line.removeprefix(f"{changed}: ") for line in lines]
    return []


def read(kind: str, file: Path) -> dict[str, Any]:
    data = tomllib.loads(file.read_text())
    if kind == "catalogue":  # one thing of each kind will do
        return {key: dict([next(iter(table.items()))]) if isinstance(table, dict) and key != "attribute" else table for key, table in data.items()}
    return data


def keys(data: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """All keys of tables within tables."""
    for key, value in data.items() if isinstance(data, dict) else ():
        yield (*place, key)
        yield from keys(value, (*place, key))


def changed(data: dict[str, Any], place: tuple[str, ...], change: Callable[[dict[str, Any], str], None]) -> dict[str, Any]:
    data = copy.deepcopy(data)
    table = data
    for key in place[:-1]:
        table = table[key]
    change(table, place[-1])
    return data


def misspell(table: dict[str, Any], key: str) -> None:
    """A letter left out, or one too many, where the key is."""
    items = {(key[:-2] + key[-1] if len(key) > 4 else key + key[-1]) if name == key else name: value for name, value in table.items()}
    table.clear()
    table.update(items)


def chosen_by_the_writer(kind: str, place: tuple[str, ...]) -> bool:
    """Whether a key is a name that the file gives, such as a role's."""
    return {
        "task": place[0] in ("roles", "unnamed", "subgoals") and len(place) == 2,
        "catalogue": len(place) == 2,
        "recipe": place[:2] == ("data", "weights") and len(place) == 3,
        "policy": place[:2] in (("mapping", "images"), ("mapping", "flip")) and len(place) == 3,
        "table-mapping": place[0] == "policies" and len(place) == 2,
    }[kind]


def key_of(fault: str) -> str:
    """The key of a fault, without the numbers of a list's items."""
    return re.sub(r"\[\d+\]", "", fault.partition(": ")[0])


SCHEMAS = schemas()


@pytest.mark.parametrize("kind", SCHEMAS)
def test_the_schemas_are_as_committed(kind):
    committed = ROOT / "docs" / "schemas" / f"{kind}.schema.json"
    assert json.loads(committed.read_text()) == SCHEMAS[kind], "run make schemas"
    jsonschema.Draft202012Validator.check_schema(SCHEMAS[kind])


def test_the_schemas_explain_every_key():
    for kind, schema in SCHEMAS.items():
        for table in (schema, *schema.get("$defs", {}).values()):
            assert table.get("description"), (kind, table["title"])
            for key, value in table.get("properties", {}).items():
                assert value.get("description") or "$ref" in value, (kind, table.get("title"), key)


@pytest.mark.parametrize(("kind", "file"), FILES, ids=names(FILES))
def test_shipped_files_are_right_for_the_schema_too(kind, file):
    jsonschema.validate(tomllib.loads(file.read_text()), SCHEMAS[kind])


@pytest.mark.parametrize(("kind", "file"), TRIED, ids=names(TRIED))
def test_every_misspelt_key_is_one_fault_that_names_it(kind, file, tmp_path):
    data, schema = read(kind, file), jsonschema.Draft202012Validator(SCHEMAS[kind])
    for place in keys(data):
        if not chosen_by_the_writer(kind, place):
            wrong = changed(data, place, misspell)
            found = faults(kind, file, wrong, tmp_path)
            assert len(found) == 1 and found[0].endswith(f"is not a known key, did you mean {place[-1]!r}?"), (place, found)
            assert not schema.is_valid(wrong), place


@pytest.mark.parametrize(("kind", "file"), TRIED, ids=names(TRIED))
def test_every_value_of_a_wrong_type_is_told_by_its_key(kind, file, tmp_path):
    data, schema = read(kind, file), jsonschema.Draft202012Validator(SCHEMAS[kind])
    for place in keys(data):
        right = data
        for key in place:
            right = right[key]
        for value in (True, "3", 7, 0.5, [], {}):
            also_right = type(value) is type(right) or (isinstance(right, float) and type(value) is int) or (place[-1] == "lean" and value == 0.5)
            also_right |= kind == "table-mapping" and place[-1] in ("seconds", "price") and type(value) in (str, int, float)
            if not also_right:
                wrong = changed(data, place, lambda table, key, value=value: table.update({key: value}))
                found = faults(kind, file, wrong, tmp_path)
                assert found and all(key_of(fault).startswith(".".join(place)) for fault in found), (place, value, found)
                assert not schema.is_valid(wrong), (place, value)


@pytest.mark.parametrize(("kind", "file"), TRIED, ids=names(TRIED))
def test_every_missing_key_that_is_needed_is_one_fault(kind, file, tmp_path):
    data, schema = read(kind, file), jsonschema.Draft202012Validator(SCHEMAS[kind])
    needed = 0
    for place in keys(data):
        wrong = changed(data, place, lambda table, key: table.pop(key) and None)
        if not schema.is_valid(wrong) and not chosen_by_the_writer(kind, place):
            found = faults(kind, file, wrong, tmp_path)
            assert len(found) == 1 and found[0].startswith(f"{'.'.join(place)}: is missing, expected "), (place, found)
            needed += 1
    assert needed


TASK = """
version = 1
name = "mein"
title = 3
horizn = 200

[scene]
arena = "tabel"
objects = ["cann", "milk"]
containers = ["plate"]

[scene.region.objct]
x = [-0.13, 0.02, 3]
y = [0.24, -0.24]

[scene.region.container]
x = [0.10, nan]
y = [true, 0.26]

[roles]
object = "object"
container = "container"

[language]
train = ["put the {object} in"]
held_out = ["{object}, {container}"]

[goal]
al = ["im(object, container)", 3]

[subgoals]
reached = "near(objct)"

[expert]
plan = ["fly(object)", "lift(container)"]
"""
FAULTS = """
scene.region.objct: is not a known key, did you mean 'object'?
goal.al: is not a known key, did you mean 'all'?
horizn: is not a known key, did you mean 'horizon'?
name: must equal the file's name 'mine', got 'mein'
title: must be a string, got 3
scene.arena: unknown value 'tabel', did you mean 'table'? known: table
scene.objects[0]: unknown value 'cann', did you mean 'can'? known: can, milk
scene.region.container.x[1]: must be a finite number, got nan
scene.region.container.y[0]: must be a number, got True
scene.region.object.x: must be a list of 2 numbers, got [-0.13, 0.02, 3]
scene.region.object.y: must be [low, high] with low <= high, got [0.24, -0.24]
language.train[0]: 'put the {object} in' must name {container}, {object} and nothing else
goal.all[0]: 'im(object, container)': unknown value 'im', did you mean 'in'? known: in, near
goal.all[1]: must be a string, got 3
subgoals.reached: 'near(objct)': unknown value 'objct', did you mean 'object'? known: object, container
expert.plan[0]: 'fly(object)': unknown value 'fly', known: reach
"""


def test_all_faults_are_told_at_once(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(TASK)
    with pytest.raises(ContentError) as raised:
        load_task_file(file)
    told, expected = str(raised.value).splitlines(), FAULTS.strip().splitlines()
    assert len(told) == len(expected)
    for line, start in zip(told, expected, strict=True):
        assert line.startswith(f"{file}: {start}")
    assert raised.value.faults[2] == ("horizn", "is not a known key, did you mean 'horizon'?")


def test_listing_and_doctor_tell_them_all(tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(TASK)
    assert main(["--list", "--tasks", str(tmp_path)]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("error: ") and shown.count("mine.toml: ") == 16 and "horizn" in shown and "Traceback" not in shown
    checks = [check for check in examine(tmp_path) if check.name == "mine"]
    assert len(checks) == 1 and "horizn" in checks[0].found and "objct" in checks[0].found


@pytest.mark.parametrize(("kind", "file"), TRIED, ids=names(TRIED))
def test_a_byte_order_mark_and_line_ends_of_other_systems_change_nothing(kind, file, tmp_path):
    text = file.read_text()
    same = tmp_path / file.name
    same.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert repr(SHIPPED[kind][0](same)).replace(str(tmp_path), str(file.parent)) == repr(SHIPPED[kind][0](file))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\xff\xfev\x00e\x00", "TOML: is UTF-16 text; save it as UTF-8"),
        (b"version = 1\n# na\xefve\n", "TOML: is not UTF-8 text (at line 2); save it as UTF-8"),
        (b"version = 1\nname = mine\n", "TOML: Invalid value (at line 2, column 8)"),
        (b"version = " + b"9" * 5000, "TOML: Exceeds the limit"),
        (b"version = " + b"[" * 5000, "TOML: has lists or tables within each other too deep to be read"),
        (None, "file: cannot be read (No such file or directory)"),
    ],
)
def test_a_file_that_is_not_toml_is_told_with_the_line(data, message, tmp_path):
    file = tmp_path / "mine.toml"
    if data is not None:
        file.write_bytes(data)
    for load, _ in SHIPPED.values():
        with pytest.raises(ContentError, match=re.escape(f"{file}: {message}")):
            load(file)


def test_values_are_shown_short_and_without_control_characters(tmp_path):
    data = read("policy", ROOT / "policies" / "local_small.toml")
    for key, value in (("kind", ["\x1b[2J"] * 40), ("title", {"\x07": 1}), ("title", "a\x9bb"), ("execute", 10**4000), ("\x1b[31mred", 1)):
        lines = faults("policy", ROOT / "policies" / "local_small.toml", {**data, key: value}, tmp_path)
        assert lines and all(line.isprintable() and len(line) < 260 for line in lines), lines


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('model = "sphere"\n', 'model: must be "box", "cylinder", "robosuite:<class>" or an .xml file, got \'sphere\''),
        ('model = "box"\nrgba = [1, 1, 1, 1]\n', "size: is missing, expected a list"),
        ('model = "cylinder"\nsize = [0.1, 0.1, 0.1]\nrgba = [1, 1, 1, 1]\n', "size: must be a list of 2 numbers, got [0.1, 0.1, 0.1]"),
        ('model = "ball.xml"\nsize = [0.1]\n', "size: is only for the models box and cylinder"),
        ('model = "box"\nsize = [0.1, 0.1, 0.1]\n', "rgba: is missing, expected a list of 4 numbers"),
        ('model = "ball.xml"\nattributes = ["foot"]\n', "attributes[0]: unknown value 'foot', did you mean 'food'? known: food"),
        ('model = "ball.xml"\ninner = 0.1\n', "inner: is not a known key"),
    ],
)
def test_a_thing_of_the_catalogue_is_what_its_model_needs(text, fault, tmp_path):
    file = tmp_path / "objects.toml"
    file.write_text(f'version = 1\n[attribute.food]\nnames = ["the food"]\n[object.ball]\nnames = ["ball"]\nradius = 0.03\n{text}')
    with pytest.raises(ContentError) as raised:
        load_catalogue(file)
    assert str(raised.value).startswith(f"{file}: object.ball.{fault}")


def test_a_name_of_two_things_is_told(tmp_path):
    file = tmp_path / "objects.toml"
    thing = 'names = ["it"]\nmodel = "it.xml"\nradius = 0.03\n'
    file.write_text(f"version = 1\n[object.it]\n{thing}[button.it]\njoint = 'j'\n{thing}")
    with pytest.raises(ContentError, match=r"button\.it: is a name in \[object\] already"):
        load_catalogue(file)
