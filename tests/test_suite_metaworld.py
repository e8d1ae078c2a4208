"""Meta-World: real tasks in the suite's own Python environment. Skipped where that has not been made."""

import json
import os
import signal

import numpy as np
import pytest

import osel_sim
from osel_sim.core.errors import MissingPackageError, SuiteHostError, UsageError
from osel_sim.episodes.loop import Driver, Subscriber, run_episode
from osel_sim.episodes.start import Start
from osel_sim.formats import library
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.interface.call import Call
from osel_sim.policy.expert import ExpertCaller
from osel_sim.suites import environments
from osel_sim.suites.check import check_task
from osel_sim.suites.environments import environment
from osel_sim.suites.hosted import host_of
from osel_sim.suites.metaworld.tasks import load_tasks
from osel_sim.suites.registry import find_task, select_tasks

PLACE = environment("metaworld")
made = pytest.mark.skipif(not PLACE.installed, reason=f"the suite's environment has not been made: {PLACE.command}")


def expert() -> Driver:
    spec = library.load_policy("scripted_expert", None)
    return Driver(spec, ExpertCaller(spec))


@pytest.fixture(scope="module")
def drawer():
    """An environment that is open for the whole file."""
    env = find_task("metaworld:drawer-open-v3").open()
    yield env
    env.close()


# -- without the simulator ---------------------------------------------------------------------------------------------


def test_there_are_fifty_tasks_each_with_phrasings_of_its_own():
    texts = load_tasks()
    assert len(texts) == 50 and [task.name for task in select_tasks(["metaworld:all"])] == [f"metaworld:{name}" for name in texts]
    assert all(len(text.train) >= 6 and len(text.held_out) >= 4 for text in texts.values())
    phrasings = [phrasing for text in texts.values() for phrasing in (*text.train, *text.held_out)]
    assert len(set(phrasings)) == len(phrasings)


def test_held_out_phrasings_are_for_tests_only_and_the_axis_brings_more_of_them():
    task = find_task("metaworld:push-v3")
    text = load_tasks()["push-v3"]

    def held_out(**arguments):
        return np.mean([task.instance(seed, **arguments).instruction in text.held_out for seed in range(60)])

    assert held_out(split="train") == held_out(split="validation") == 0.0
    assert 0.3 < held_out() < 0.7 and held_out(axes={"phrasing": 3}) == 1.0


def test_an_axis_changes_nothing_but_what_it_is_of():
    task = find_task("metaworld:push-v3")
    clean, light, all_of_it = task.instance(4), task.instance(4, axes={"light": 2}), task.instance(4, level=2)
    assert clean.details == {} and set(light.details) == {"light"} and light.instruction == clean.instruction
    assert all_of_it.details["light"] == light.details["light"] and set(all_of_it.details) == {"light", "camera", "texture", "wider"}
    assert (light.key, all_of_it.key) == ("metaworld:push-v3/test/light=2/4", "metaworld:push-v3/test/2/4")


def test_what_is_not_installed_is_named_with_the_command_that_gets_it(tmp_path, monkeypatch):
    monkeypatch.setattr(environments, "prepare", lambda: tmp_path)
    with pytest.raises(
        MissingPackageError,
        match=r"suite 'metaworld' needs the package 'metaworld', which is not installed: python -m osel_sim\.suites install metaworld",
    ):
        find_task("metaworld:push-v3").specification  # noqa: B018


# -- with it -----------------------------------------------------------------------------------------------------------


@made
def test_the_expert_opens_the_drawer_and_a_snapshot_leads_to_the_same_end(drawer):
    instance = find_task("metaworld:drawer-open-v3").instance(1)
    start = Start(drawer, instance)
    first = run_episode(drawer, instance, expert())
    assert first.success and first.error is None and first.subgoals == 1.0 and 50 < first.steps < 200
    start.again()
    assert drawer.steps == 0 and drawer.subgoal_fraction == 0.0
    assert run_episode(drawer, instance, expert()) == first
    drawer.load(instance)
    assert run_episode(drawer, instance, expert()) == first


@made
def test_a_snapshot_in_the_middle_goes_on_to_the_same_bits(drawer):
    rewind_and_compare(drawer, find_task("metaworld:drawer-open-v3").instance(2))


def rewind_and_compare(env, instance):
    """Let the expert act, go back to a snapshot on the way, and see the same happen."""
    env.load(instance)
    hand = env.expert()
    for _ in range(30):
        env.advance(hand.act())
    snapshot = env.snapshot()
    actions = [np.random.default_rng(number).uniform(-1, 1, 4).astype(np.float32) for number in range(12)]

    def after():
        seen = []
        for action in actions:
            env.advance(action)
            state, advice = env.observe([], 64)["observation.state"], env.expert().act()
            seen.append((env.steps, env.success, env.subgoal_fraction, state.tolist(), advice.tolist()))
        return seen

    first = after()
    env.restore(snapshot)
    assert after() == first
    env.load(find_task(instance.task).instance(instance.seed + 7))
    env.restore(snapshot)
    assert after() == first, "an instance between the snapshot and its return must not matter"


@made
def test_levels_look_otherwise_and_full_quality_has_shadows(drawer):
    task = find_task("metaworld:drawer-open-v3")

    def picture(quality="fast", **arguments):
        drawer.load(task.instance(3, **arguments))
        return drawer.image("corner2", 64, 64, quality).astype(int)

    clean = picture()
    for axis in ("light", "camera", "texture", "start"):
        assert np.abs(picture(axes={axis: 3}) - clean).mean() > 0.3, axis
    assert np.array_equal(picture(axes={"phrasing": 3}), clean) and np.array_equal(picture(), clean)
    assert 1.0 < np.abs(picture("full") - clean).mean() < 30.0


class Slow:
    """A caller whose chunks do nothing, and that does something at its second call."""

    def __init__(self, at_second) -> None:
        self.calls, self.at_second = 0, at_second

    def reset(self, instruction, seed):
        self.calls = 0

    def call(self, observation):
        self.calls += 1
        if self.calls == 2:
            self.at_second()
        return Call(np.zeros((8, 4), np.float32))

    def close(self):
        pass


def kill_host() -> None:
    host = host_of("metaworld", "metaworld")
    os.kill(host.pid, signal.SIGKILL)
    host._process.wait(10)


@pytest.mark.slow
@made
def test_a_host_that_is_killed_is_an_error_of_that_episode_and_the_next_has_a_fresh_one(drawer):
    class Watch(Subscriber):
        def on_step(self, frame):
            frame.env.image("corner2", 16, 16)

    task = find_task("metaworld:drawer-open-v3")
    instance = task.instance(1)
    start = Start(drawer, instance)
    sane = run_episode(drawer, instance, expert())
    spec = library.load_policy("scripted_expert", None)
    start.again()
    outcome = run_episode(drawer, instance, Driver(spec, Slow(kill_host)), subscribers=[Watch()])
    assert outcome.error is not None and "the host of suite 'metaworld' has ended" in outcome.error and not outcome.success and outcome.steps > 0
    start.again()  # its snapshot is of a host that is no more
    assert run_episode(drawer, instance, expert()) == sane
    drawer.load(instance)
    before = drawer.image("corner2", 32, 32)
    kill_host()  # nothing has moved yet: nobody need know
    assert np.array_equal(drawer.image("corner2", 32, 32), before)
    assert run_episode(drawer, instance, expert()) == sane


@made
def test_what_is_wrong_with_a_question_is_told_and_the_host_goes_on(drawer):
    drawer.load(find_task("metaworld:drawer-open-v3").instance(0))
    pid = host_of("metaworld", "metaworld").pid
    with pytest.raises(UsageError, match="unknown camera 'corner9': did you mean 'corner"):
        drawer.image("corner9", 16, 16)
    with pytest.raises(SuiteHostError, match="the host of suite 'metaworld'"):
        drawer.advance(np.zeros(3, np.float32))
    assert host_of("metaworld", "metaworld").pid == pid


@pytest.mark.slow
@made
@pytest.mark.parametrize("name", sorted(load_tasks()))
def test_every_task_is_repeatable_and_most_experts_solve_theirs(name):
    task = find_task(f"metaworld:{name}")
    check_task(task)
    env = task.open()
    rewind_and_compare(env, task.instance(0))
    outcomes = []
    for seed in range(3):
        env.load(task.instance(seed))
        outcomes.append(run_episode(env, task.instance(seed), expert()))
    env.close()
    assert all(outcome.error is None for outcome in outcomes) and any(outcome.success for outcome in outcomes)


@pytest.fixture(scope="module")
def experts(tmp_path_factory):
    """Policy files: the scripted expert, and one that thinks for half a second before every action."""
    folder = tmp_path_factory.mktemp("experts")
    for name, seconds in (("quick", 0.0), ("pensive", 0.5)):
        (folder / f"{name}.toml").write_text(
            f'version = 1\nname = "{name}"\ntitle = "The scripted expert"\nlocation = "local"\nkind = "scripted_expert"\n'
            f"execute = 1\ninference_seconds = {seconds}\n"
        )
    return folder


@pytest.mark.slow
@made
def test_a_live_run_and_its_page(experts, tmp_path):
    result = osel_sim.run(
        task=("metaworld:drawer-open-v3", "metaworld:window-open-v3"),
        policies=["quick", "pensive"],
        policies_dir=experts,
        selector="random",
        episodes=2,
        counterfactual=True,
        level=(0, 2),
        out=tmp_path / "run",
    )
    assert all(decision.outcome.error is None and decision.task.startswith("metaworld:") for decision in result.journal)
    versions = json.loads((tmp_path / "run" / "run.json").read_text())["environment"]["versions"]
    assert versions["metaworld/metaworld"] == "3.0.0" and versions["metaworld/mujoco"] == versions["mujoco"]
    assert result.page is not None and result.page.is_file()


@pytest.mark.slow
@made
def test_a_log_its_replay_and_their_pages(experts, tmp_path):
    log = tmp_path / "log"
    osel_sim.record(
        task=("metaworld:drawer-open-v3",), policies=("quick", "pensive"), policies_dir=experts, instances=8, action_noise=0.3, workers=1, out=log
    )
    rows, _ = read_rollouts(log)
    assert len(rows) == 16 and all(row.error is None for row in rows)
    success = {name: np.mean([row.success for row in rows if row.policy == name]) for name in ("quick", "pensive")}
    assert success["quick"] > success["pensive"], "half a second before every action is 40 steps of 500"
    osel_sim.replay(log, selectors=["linucb", "random"], seeds=2, no_frontier=True, workers=1, out=tmp_path / "replay")
    for folder in (log, tmp_path / "replay"):
        assert osel_sim.report(folder, scenes=1).page.is_file()


@pytest.mark.slow
@made
def test_demonstrations_of_the_expert(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    out = tmp_path / "data"
    (collected,) = osel_sim.collect(task=("metaworld:drawer-open-v3",), episodes=2, image_size=32, every=4, workers=1, out=out).collected
    assert "2 demonstrations" in collected
    dataset = LeRobotDataset("osel_sim/metaworld_drawer-open-v3", root=out)
    first = dataset[0]
    assert dataset.fps == 20 and first["task"] in load_tasks()["drawer-open-v3"].train
    assert first["action"].shape == (4,) and first["observation.state"].shape == (4,)
    assert first["annotation.actions"].shape == (16,) and first["action"].tolist() == first["annotation.actions"][:4].tolist()
    assert first["annotation.target"].tolist() == [0, 1, -1] and (first["annotation.places.corner2"][:4].abs() < 1).all()
    assert first["observation.images.corner2"].shape == first["observation.images.gripperPOV"].shape == (3, 32, 32)
    with pytest.raises(UsageError, match="is there already: give --resume"):
        osel_sim.collect(task=("metaworld:drawer-open-v3",), episodes=2, out=out)


@made
def test_landmarks_are_where_the_pictures_show_them(drawer):
    drawer.load(find_task("metaworld:drawer-open-v3").instance(0))
    assert drawer.landmark_names == ("object", "goal", "other")
    found = drawer.landmarks(["corner2", "gripperPOV"])
    assert not np.isnan(found["positions"][:2]).any() and np.isnan(found["positions"][2]).all()  # there is no other thing
    (column, row), size = found["corner2"][0], 128
    pixel = drawer.image("corner2", size, size)[int((row + 1) * size / 2), int((column + 1) * size / 2)]
    assert (np.abs(found["corner2"][:2]) < 1).all() and np.ptp(pixel.astype(int)) < 30, "the handle is grey, the table and the drawer are brown"
