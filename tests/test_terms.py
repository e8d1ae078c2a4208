"""Predicates and skills by name: those of another package beside ours, in a task file of its own."""

import subprocess
import sys

import numpy as np
import pytest

from osel_sim.core import content
from osel_sim.core.errors import ContentError, UsageError
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.formats.task_file import load_task_file
from osel_sim.formats.terms import PREDICATES, SKILLS
from osel_sim.record import main as record_main
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance

PACKAGE = """
import numpy as np

from osel_sim.interface.terms import Skill, predicate
from osel_sim.sim.expert import OPEN

ABOVE = np.array([0.0, 0.0, 0.1])


@predicate(("object",))
def hovered(world, thing):
    return np.linalg.norm(world.grasp_point(thing) + ABOVE - world.grip_position) < 0.02


def _hover(expert, thing):
    return expert.towards(expert.world.grasp_point(thing) + ABOVE, 0.0, OPEN), hovered(expert.world, thing)


hover = Skill((("object",),), _hover)
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A folder of tasks with one that needs the package, which is installed."""
    site, tasks = tmp_path / "site", tmp_path / "tasks"
    info = site / "hovering-2.1.dist-info"
    info.mkdir(parents=True)
    tasks.mkdir()
    (site / "hovering.py").write_text(PACKAGE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hovering\nVersion: 2.1\n")
    (info / "entry_points.txt").write_text(
        "[osel_sim.predicates]\nhovered = hovering:hovered\non = hovering:hovered\nfunction = hovering:_hover\n"
        "[osel_sim.skills]\nhover = hovering:hover\n"
    )
    text = content.find("tasks", "lift").read_text()
    scene = text[: text.index("[goal]")].replace('name = "lift"', 'name = "hover"')
    (tasks / "hover.toml").write_text(
        scene + '[goal]\nall = ["hovered(object)"]\n\n[subgoals]\nabove = "hovered(object)"\n\n[expert]\nplan = ["hover(object)"]\n'
    )
    monkeypatch.syspath_prepend(site)
    return tasks


def test_another_packages_predicate_and_skill(installed):
    env = TaskEnv(load_task_file(installed / "hover.toml"))
    env.load(make_instance(env.task, 3))
    assert not env.success
    expert = Expert(env.world)
    while not env.done:
        action = expert.act()
        assert np.isfinite(action).all() and np.abs(action).max() <= 1
        env.advance(action)
    env.close()
    assert env.success and env.subgoal_fraction == 1.0


@pytest.mark.slow
def test_a_task_that_needs_them_is_recorded_in_workers(installed, tmp_path):
    flags = ["--task", "hover", "--tasks", str(installed), "--policies", "scripted_expert", "--instances", "2", "--workers", "1"]
    assert record_main([*flags, "--out", str(tmp_path / "log")]) == 0
    assert [row.success for row in read_rollouts(tmp_path / "log")[0]] == [True, True]


def test_they_are_checked_as_ours_are(installed, monkeypatch):
    assert {"hovered", "in", "near"} <= set(PREDICATES) and {"hover", "reach"} <= set(SKILLS)
    assert PREDICATES["on"] == (("object",), ("object",)), "ours cannot be replaced"
    text = (installed / "hover.toml").read_text()
    for goal, complaint in (
        ("hoverd(object)", "did you mean 'hovered'?"),
        ("hovered(object, object)", "hovered takes 1 role(s), got 2"),
    ):
        (installed / "hover.toml").write_text(text.replace("hovered(object)", goal))
        with pytest.raises(ContentError) as refused:
            load_task_file(installed / "hover.toml")
        assert complaint in str(refused.value)
    (installed / "hover.toml").write_text(text.replace('all = ["hovered', 'all = ["function'))
    with pytest.raises(UsageError, match=r"predicate 'function' of the package hovering 2\.1: hovering:_hover must be a Predicate, it is a function"):
        load_task_file(installed / "hover.toml")


def test_without_the_package_the_task_is_refused(installed, monkeypatch):
    monkeypatch.setattr(sys, "path", sys.path[1:])
    with pytest.raises(ContentError, match="unknown value 'hovered'"):
        load_task_file(installed / "hover.toml")


def test_reading_task_files_imports_no_simulator():
    code = (
        "import sys\nfrom osel_sim.core import content\nfrom osel_sim.formats.task_file import load_task_file\n"
        "[load_task_file(file) for file in content.files('tasks').values()]\n"
        "print({'mujoco', 'robosuite', 'torch', 'numba', 'numpy'} & set(sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"
