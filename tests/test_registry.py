"""Names that packages bring."""

import pytest

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.core.registry import Registry

GROUP = "osel_sim.tests"


def install(folder, name, points, module=""):
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}")
    (folder / f"{name}.py").write_text(module)


@pytest.fixture
def numbers(tmp_path, monkeypatch):
    """A registry with one of its own, and two packages, one of which cannot be imported."""
    install(
        tmp_path,
        "fine_numbers",
        "seven = fine_numbers:SEVEN\npi = fine_numbers:SEVEN\nlost = fine_numbers:EIGHT\nboth = fine_numbers:SEVEN\n",
        "SEVEN = 7.0",
    )
    install(tmp_path, "poor_numbers", "ten = poor_numbers:TEN\n", "import no_such_package.of_numbers")
    install(tmp_path, "broken_numbers", "nine = broken_numbers:NINE\nboth = broken_numbers:NINE\n", "raise ValueError('no numbers today')")
    monkeypatch.syspath_prepend(tmp_path)
    return Registry("number", GROUP, {"pi": "math:pi", "nested": "sys:float_info.max", "text": "string:digits"}, float)


def test_listing_imports_nothing(numbers):
    assert sorted(numbers) == ["both", "lost", "nested", "nine", "pi", "seven", "ten", "text"]
    assert numbers.locations()["nine"] == "broken_numbers:NINE"
    assert "nine" in numbers and "eleven" not in numbers


def test_names_are_loaded_and_a_plugin_cannot_replace_a_built_in_one(numbers):
    assert numbers.load("seven") == 7.0
    assert round(numbers.load("pi"), 2) == 3.14
    assert numbers.load("nested") > 1e300


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nine", "number 'nine' of the package broken_numbers 1.0: cannot import broken_numbers:NINE (ValueError: no numbers today)"),
        ("lost", "number 'lost' of the package fine_numbers 1.0: cannot import fine_numbers:EIGHT (AttributeError: "),
        (
            "ten",
            "number 'ten' of the package poor_numbers 1.0 needs the package 'no_such_package', which is not installed: pip install no_such_package",
        ),
        ("text", "number 'text': string:digits must be a float, it is a str"),
        ("both", "number 'both' is offered by several packages: "),
    ],
)
def test_what_cannot_be_loaded_is_named_with_its_package_and_the_cause(numbers, name, message):
    with pytest.raises(UsageError) as refused:
        numbers.load(name)
    assert str(refused.value).startswith(message)


def test_unknown_names(numbers):
    with pytest.raises(UnknownNameError, match=r"unknown number 'sevn': did you mean 'seven'\? known: both, .*\(in the book\)"):
        numbers.load("sevn", "in the book")
