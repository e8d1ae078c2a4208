"""Levels and axes of instances: the same task, perturbed by numbers that only the seed fixes."""

import dataclasses
import hashlib
import itertools

import pytest

from osel_sim.core import content
from osel_sim.core.errors import ContentError, UsageError
from osel_sim.formats.levels import AXES, label, parse_axes, resolve, split_off
from osel_sim.formats.task_file import load_task_file
from osel_sim.sim.instance import SPLITS, make_instance
from osel_sim.sim.perturbation import CLEAN, MORE_DISTRACTORS

TASK = load_task_file(content.find("tasks", "pick_place"))
SEEDS = range(25)

FIELDS = {
    "light": ("lamp", "lamp_turn", "ambient"),
    "camera": ("camera", "wrist"),
    "texture": ("table", "table_tint"),
    "colours": ("tints",),
    "sizes": ("sizes",),
    "robot": ("joints",),
}
"""Which numbers of a perturbation belong to which axis."""


def clean_but(axis, instance):
    return dataclasses.replace(CLEAN, **{field: getattr(instance.perturbation, field) for field in FIELDS.get(axis, ())})


@pytest.mark.parametrize(
    ("items", "message"),
    [
        (["camera"], "must read AXIS=LEVEL"),
        (["camera=two"], "must read AXIS=LEVEL"),
        (["camera=-1"], "must read AXIS=LEVEL"),
        (["camra=2"], "did you mean 'camera'"),
        (["camera=7"], "'camera': unknown level 7, known: 0, 1, 2, 3"),
        (["camera=1", "camera=2"], "twice"),
    ],
)
def test_wrong_axes_are_refused(items, message):
    with pytest.raises(UsageError, match=message):
        parse_axes(items)


def test_equal_settings_have_one_name():
    assert parse_axes(["camera=2", "light=1"]) == {"camera": 2, "light": 1}
    for level, axes, name in [
        (2, None, (2, None)),
        (0, dict.fromkeys(AXES, 2), (2, None)),
        (0, {"light": 1, "camera": 2}, (0, "camera=2,light=1")),
        (1, {"camera": 3, "light": 1}, (1, "camera=3")),
        (0, {"camera": 0}, (0, None)),
    ]:
        assert split_off(resolve(level, axes)) == name
    assert [label(*name) for name in ((2, None), (0, "camera=2"), (1, "camera=3"))] == ["2", "camera=2", "1,camera=3"]


def test_level_0_is_as_it_ever_was():
    """Recorded logs and trained policies refer to these instances."""
    total = hashlib.sha256()
    for split in SPLITS:
        for seed in range(21):
            one = make_instance(TASK, seed, 0, split)
            places = [(place.entity, place.x, place.y, place.yaw) for place in one.placements]
            total.update(repr((one.key, one.instruction, one.phrasing, sorted(one.roles.items()), places)).encode())
            assert one.perturbation == CLEAN and one.axes is None
    assert total.hexdigest() == "c0183a3c3a252f9f3b47c1d6c9a30282306dff880a7a2b7115d5142ae47e4067"


@pytest.mark.parametrize("level", [1, 2, 3])
def test_a_level_is_the_same_task_perturbed(level):
    for seed in SEEDS:
        clean, one = make_instance(TASK, seed), make_instance(TASK, seed, level)
        assert one == make_instance(TASK, seed, level)
        assert one.key == f"pick_place/test/{level}/{seed}"
        assert one.roles == clean.roles
        there = [place.entity for place in clean.placements]
        assert [place.entity for place in one.placements][: len(there)] == there
        assert len({place.entity for place in one.placements}) == len(one.placements)
        assert len(one.placements) - len(there) <= MORE_DISTRACTORS[level][1]
        assert all(TASK.entity(place.entity).kind == "object" for place in one.placements[len(there) :])
        assert one.perturbation != CLEAN


@pytest.mark.parametrize(("axis", "level"), [*itertools.product(AXES, (1, 3))])
def test_an_axis_alone_does_what_it_does_within_a_level(axis, level):
    changed = set()
    for seed in SEEDS:
        clean, all_axes, alone = make_instance(TASK, seed), make_instance(TASK, seed, level), make_instance(TASK, seed, axes={axis: level})
        assert alone.key == f"pick_place/test/{axis}={level}/{seed}" and alone.level == 0
        assert alone.perturbation == clean_but(axis, all_axes)
        count = len(clean.placements)
        if axis == "start":
            assert alone.placements == all_axes.placements[:count]
        elif axis == "distractors":
            assert alone.placements[:count] == clean.placements
        else:
            assert alone.placements == clean.placements
        if axis == "phrasing":
            assert (alone.instruction, alone.phrasing) == (all_axes.instruction, all_axes.phrasing)
        else:
            assert (alone.instruction, alone.phrasing) == (clean.instruction, clean.phrasing)
        same = dataclasses.replace(alone, axes=None)
        changed.add(same != clean)
    assert True in changed


def test_a_higher_level_changes_more():
    def size(level):
        drawn = [make_instance(TASK, seed, level).perturbation for seed in range(60)]
        return [
            sum(abs(one.camera.azimuth) for one in drawn),
            sum(abs(one.lamp_turn[0]) for one in drawn),
            sum(abs(factor - 1) for one in drawn for _, factor in one.sizes),
            sum(abs(joint) for one in drawn for joint in one.joints),
        ]

    for low, high in itertools.pairwise([size(level) for level in (0, 1, 2, 3)]):
        assert all(one < other for one, other in zip(low, high, strict=True))

    def held_out(level):
        return sum(make_instance(TASK, seed, axes={"phrasing": level}).phrasing.startswith("held_out") for seed in range(300)) / 300

    assert [held_out(level) for level in (0, 1, 2, 3)] == pytest.approx([0.5, 0.67, 0.83, 1.0], abs=0.06)


def test_nothing_shows_in_the_instruction():
    """At every level an instruction is one of the task's phrasings with names of the things it is about, and nothing else."""
    for level, seed in itertools.product((1, 2, 3), SEEDS):
        one = make_instance(TASK, seed, level)
        kind, number = one.phrasing.split("-")
        names = [TASK.entity(one.roles[role]).names for role in TASK.roles]
        templates = {"train": TASK.train, "held_out": TASK.held_out}[kind]
        assert one.instruction in {templates[int(number)].format(**dict(zip(TASK.roles, words, strict=True))) for words in itertools.product(*names)}


def test_splits_stay_disjoint_and_held_out_phrasings_stay_held_out():
    for level, (index, split) in itertools.product((1, 2, 3), enumerate(SPLITS)):
        drawn = [make_instance(TASK, seed, level, split) for seed in SEEDS]
        assert {round(one.placements[0].x * 1e6) % 3 for one in drawn} == {index}
        if split != "test":
            assert {one.phrasing.split("-")[0] for one in drawn} == {"train"}


def task_with(tmp_path, line):
    file = tmp_path / "pick_place.toml"
    file.write_text(TASK.file.read_text().replace('arena = "table"', f'arena = "table"\n{line}', 1))
    return load_task_file(file)


def test_a_task_may_allow_some_axes_only(tmp_path):
    task = task_with(tmp_path, 'axes = ["camera", "light"]')
    one = make_instance(task, 3, 2)
    assert one.key == "pick_place/test/2/3"
    both = make_instance(TASK, 3, axes={"camera": 2, "light": 2})
    assert (one.perturbation, one.placements) == (both.perturbation, both.placements)
    assert make_instance(task, 3, 1, axes={"camera": 3}).key == "pick_place/test/1,camera=3/3"
    with pytest.raises(UsageError, match="'pick_place' does not allow the axis 'sizes'; it allows: camera, light"):
        make_instance(task, 3, axes={"sizes": 1})
    with pytest.raises(ContentError, match=r"scene\.axes: unknown value 'lights', did you mean 'light'"):
        task_with(tmp_path, 'axes = ["lights"]')
    nothing = task_with(tmp_path, "axes = []")
    assert make_instance(nothing, 3, 3).perturbation == CLEAN
