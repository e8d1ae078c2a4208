import dataclasses

import pytest

from osel_sim.core import content
from osel_sim.core.errors import ContentError, UsageError
from osel_sim.formats.task_file import load_task_file
from osel_sim.sim.instance import GAP, SPLITS, make_instance

TASK = load_task_file(content.find("tasks", "pick_place"))


def test_an_instance_is_fixed_by_task_seed_level_and_split():
    assert make_instance(TASK, 7) == make_instance(TASK, 7)
    assert make_instance(TASK, 7) != make_instance(TASK, 8)
    assert make_instance(TASK, 7, split="train") != make_instance(TASK, 7, split="test")


def test_known_instance_does_not_drift():
    """Recorded logs and trained policies refer to instances by seed."""
    instance = make_instance(TASK, 0)
    assert instance.instruction == "would you mind moving the milk carton over into the bowl"
    assert instance.key == "pick_place/test/0/0"


def test_a_fixed_target_is_always_asked_for_among_distractors_that_change(tmp_path):
    file = tmp_path / "fetch.toml"
    text = content.find("tasks", "pick_place").read_text().replace('name = "pick_place"', 'name = "fetch"')
    file.write_text(text + '\n[fixed]\nobject = "can"\n')
    task = load_task_file(file)
    instances = [make_instance(task, seed) for seed in range(60)]
    assert {instance.target for instance in instances} == {"can"} and len({instance.container for instance in instances}) > 1
    others = {frozenset(one.entity for one in instance.placements) - {"can"} for instance in instances}
    assert len(others) > 10 and all("can" in {one.entity for one in instance.placements} for instance in instances)
    for wrong, complaint in (
        ('object = "cann"', "fixed.object: unknown value 'cann', did you mean 'can'?"),
        ('object = "plate"', "fixed.object: unknown value 'plate'"),
        ('thing = "can"', "fixed.thing: is no role; roles: object, container"),
    ):
        file.write_text(f"{text}\n[fixed]\n{wrong}\n")
        with pytest.raises(ContentError) as refused:
            load_task_file(file)
        assert complaint in str(refused.value)


def test_splits_are_disjoint_by_construction():
    remainders = {split: {round(make_instance(TASK, seed, split=split).placements[0].x * 1e6) % 3 for seed in range(200)} for split in SPLITS}
    assert remainders == {split: {index} for index, split in enumerate(SPLITS)}


def test_held_out_phrasings_appear_in_the_test_split_only():
    phrasings = {split: [make_instance(TASK, seed, split=split).phrasing.split("-")[0] for seed in range(300)] for split in SPLITS}
    assert set(phrasings["train"]) == set(phrasings["validation"]) == {"train"}
    assert 0.4 < phrasings["test"].count("held_out") / 300 < 0.6


def test_scenes_hold_what_the_task_file_says():
    counts = set()
    for seed in range(200):
        instance = make_instance(TASK, seed)
        names = [placement.entity for placement in instance.placements]
        objects = [name for name in names if TASK.entity(name).kind == "object"]
        counts.add(len(objects))
        assert len(set(names)) == len(names)
        assert {"plate", "bowl", "basket"} <= set(names)
        assert instance.target in objects and instance.container in names
        for one in instance.placements:
            region = TASK.regions[TASK.entity(one.entity).kind]
            assert region.x[0] - 1e-5 <= one.x <= region.x[1] and region.y[0] <= one.y <= region.y[1]
            for other in instance.placements:
                if other is not one and TASK.entity(one.entity).kind == "object":
                    distance = ((one.x - other.x) ** 2 + (one.y - other.y) ** 2) ** 0.5
                    assert distance > TASK.entity(one.entity).radius + TASK.entity(other.entity).radius + GAP - 1e-5
    assert counts == {1, 2, 3, 4}


def test_instructions_tell_their_goal_and_nothing_else():
    """Same words, same goal: an instruction names object and container by one of their own names."""
    goals: dict[str, tuple[str, str]] = {}
    for seed in range(500):
        instance = make_instance(TASK, seed)
        goal = (instance.target, instance.container)
        assert goals.setdefault(instance.instruction, goal) == goal
        assert any(name in instance.instruction for name in TASK.entity(instance.target).names)
        assert any(name in instance.instruction for name in TASK.entity(instance.container).names)


def test_every_object_container_and_phrasing_is_drawn():
    drawn = [make_instance(TASK, seed) for seed in range(600)]
    assert {one.target for one in drawn} == {entity.name for entity in TASK.of_kind("object")}
    assert {one.container for one in drawn} == {entity.name for entity in TASK.of_kind("container")}
    assert len({one.phrasing for one in drawn}) == len(TASK.train) + len(TASK.held_out)
    assert len(TASK.train) >= 12 and len(TASK.held_out) >= 6


@pytest.mark.parametrize(("arguments", "message"), [({"split": "tset"}, "tset"), ({"level": 9}, "9"), ({"seed": -1}, "-1")])
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        make_instance(TASK, **{"seed": 0, **arguments})


def test_regions_that_are_too_small_are_refused():
    cramped = dataclasses.replace(TASK.regions["object"], x=(0.0, 0.001), y=(0.0, 0.001))
    with pytest.raises(UsageError, match="too small"):
        for seed in range(20):
            make_instance(dataclasses.replace(TASK, regions={**TASK.regions, "object": cramped}), seed)


BROKEN = [
    ("horizon = 200", "horizon = -3", "horizon"),
    ("horizon = 200", "horizont = 200", "horizon"),
    ('objects = ["can"', 'objects = ["cann"', "did you mean 'can'"),
    ("distractors = [0, 3]", "distractors = [3, 0]", "scene.distractors"),
    ("distractors = [0, 3]", "distractors = [0, 30]", "scene.objects"),
    ('"in(object, container)", "released(object)"', '"im(object, container)"', "did you mean 'in'"),
    ('"in(object, container)", "released(object)"', '"in(object)"', "takes 2 role"),
    ('lifted = "lifted(object)"', 'lifted = "lifted(objct)"', "did you mean 'object'"),
    ('"reach(object)"', '"reech(object)"', "did you mean 'reach'"),
    ('"{object} to {container}"', '"{object} to somewhere"', "language.train"),
    ('"{object} to {container}"', '"{object to {container}"', "language.train"),
    ('name = "pick_place"', 'name = "pick"', "must equal the file's name"),
    ("version = 1", "version = 2", "version"),
    ('arena = "table"', 'arena = "tabel"', "did you mean 'table'"),
    ("yaw = [-0.4, 0.4]", 'yaw = "any"', "scene.region.object.yaw"),
    ("[goal]", "[goals]", "goal"),
    ("[language]", "[language", "TOML"),
]


@pytest.mark.parametrize(("right", "wrong", "message"), BROKEN)
def test_a_broken_task_file_is_refused_by_file_and_key(tmp_path, right, wrong, message):
    text = TASK.file.read_text()
    assert right in text
    file = tmp_path / "pick_place.toml"
    file.write_text(text.replace(right, wrong, 1))
    with pytest.raises(ContentError) as caught:
        load_task_file(file)
    assert "pick_place.toml" in str(caught.value) and message in str(caught.value)
    assert "\n" not in str(caught.value)
