"""Suites of others: a toy suite, installed as a package, does everything that ours does."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import osel_sim
from osel_sim.core.errors import ContentError, DataError, MissingPackageError, UnknownNameError, UsageError
from osel_sim.episodes.drivers import Drivers, choose_policies, left_out
from osel_sim.episodes.live import LiveOptions, LiveRun
from osel_sim.episodes.loop import Driver, Subscriber, run_episode
from osel_sim.episodes.run_subscribers import RunSubscriber, TimingFile
from osel_sim.episodes.start import Start
from osel_sim.episodes.watching import RunMonitor
from osel_sim.formats.conventions import Conventions
from osel_sim.formats.journal import read_journal
from osel_sim.formats.policy_file import load_policy_file
from osel_sim.formats.rollout_log import DECLARED, read_rollouts
from osel_sim.interface.call import Call
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.monitor import Candidate
from osel_sim.interface.specification import specification
from osel_sim.interface.suite import Task
from osel_sim.policy.environment_fit import misfits
from osel_sim.policy.registry import session_factory
from osel_sim.selection.monitors.registry import make_monitor
from osel_sim.selection.registry import make_selector
from osel_sim.selection.reward import RewardWeights
from osel_sim.suites.base import BaseEnvironment
from osel_sim.suites.check import SuiteError, check_task
from osel_sim.suites.registry import common_specification, find_task, known_axes, select_tasks

TOY = Path(__file__).parent / "toy_suite"
POLICIES = TOY / "policies"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder into which the toy suite is installed."""
    target = tmp_path_factory.mktemp("toy")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target", str(target), str(TOY)]
    subprocess.run(pip, check=True, timeout=300)
    return target


@pytest.fixture(scope="module", autouse=True)
def _toy_is_importable(installed):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(installed))
        yield


# -- names -------------------------------------------------------------------------------------------------------------


def test_tasks_are_named_with_their_suite_and_ours_without():
    assert [task.name for task in select_tasks(["toy:all"])] == ["toy:reach", "toy:hurry"]
    assert [task.name for task in select_tasks(["lift", "toy:tag:easy", "toy:reach", "osel_sim:stack"])] == ["lift", "toy:reach", "stack"]
    assert all(":" not in task.name for task in select_tasks(["all", "tag:short"]))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("toy:reech", r"unknown task 'toy:reech': did you mean 'toy:reach'\?"),
        ("tou:reach", r"unknown suite 'tou': did you mean 'toy'\?"),
        ("toy:tag:esy", r"unknown tag 'esy': did you mean 'easy'\?"),
        ("lifft", r"unknown task 'lifft': did you mean 'lift'\?"),
    ],
)
def test_unknown_names_get_the_nearest(name, message):
    with pytest.raises(UnknownNameError, match=message):
        select_tasks([name])


def write_suite(folder: Path, module: str) -> str:
    """A package with one suite, whose name is given."""
    name = f"broken_{folder.name}"
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (folder / f"{name}.py").write_text(module.replace("NAME", name))
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[osel_sim.suites]\n{name} = {name}:Broken\n")
    return name


def test_a_missing_package_is_named_with_the_command_that_gets_it(tmp_path, monkeypatch):
    name = write_suite(
        tmp_path,
        "from osel_sim.interface.suite import SuiteSpec, TaskInfo\n"
        "class Broken:\n"
        "    spec = SuiteSpec('NAME', 'Needs what is not there', install='pip install broken[simulator]')\n"
        "    tasks = {'one': TaskInfo('One', 10, '1')}\n"
        "    def open(self, task):\n"
        "        import no_such_simulator.core\n",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    needs = rf"suite '{name}' needs the package 'no_such_simulator', which is not installed: pip install broken\[simulator\]"
    with pytest.raises(MissingPackageError, match=needs):
        find_task(f"{name}:one").open()


@pytest.mark.parametrize(
    ("module", "error", "message"),
    [
        ("import no_such_simulator\n", MissingPackageError, "needs the package 'no_such_simulator'.*pip install no_such_simulator"),
        ("Broken = 3\n", UsageError, ":Broken makes no suite"),
        ("from toy_suite import Toy as Broken\n", UsageError, "makes one that calls itself 'toy'"),
    ],
)
def test_a_suite_that_cannot_be_loaded_says_why(module, error, message, tmp_path, monkeypatch):
    name = write_suite(tmp_path, module)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(error, match=message):
        find_task(f"{name}:one")


def test_other_suites_have_their_own_robot():
    assert find_task("lift", robot="UR5e").robot == "UR5e" and find_task("lift").specification.robot == "Panda"
    assert find_task("lift", robot="UR5e").instance(0).key == "lift/test/0/0-UR5e"
    with pytest.raises(UsageError, match="suite 'toy' has its own robot: leave --robot out"):
        find_task("toy:reach", robot="UR5e")


def test_what_a_suite_does_not_have_is_refused_by_name():
    task = find_task("toy:reach")
    for arguments, message in (
        ({"level": 1}, "unknown level 1, known: 0"),
        ({"split": "held_out"}, "unknown split 'held_out'.*known: test, train, validation"),
        ({"axes": {"camera": 2}}, "'toy:reach' does not allow the axis 'camera'; it allows: none"),
        ({"seed": -1}, "a seed must be 0 or more"),
    ):
        with pytest.raises(UsageError, match=message):
            task.instance(**{"seed": 0, **arguments})
    assert known_axes([task]) == [] and "camera" in known_axes([task, find_task("lift")])


# -- what a suite promises ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["toy:reach", pytest.param("lift", marks=pytest.mark.slow)])
def test_a_suite_keeps_what_it_promises(name):
    check_task(find_task(name))


def test_what_the_documentation_shows_is_a_suite():
    import toy_suite

    blocks = re.findall(r"```python\n(.*?)```", (TOY.parents[1] / "docs" / "suites.md").read_text(), re.DOTALL)
    shown = dict(vars(toy_suite))
    for block in blocks:
        exec(block, shown)
    assert len(blocks) == 4 and shown["Toy"] is not toy_suite.Toy
    check_task(Task(shown["Toy"](), "reach"))


def test_a_suite_that_forgets_nothing_is_found_out(monkeypatch):
    import toy_suite

    def start_anywhere(self, instance):
        self.gym.reset(options={"goal": instance.target})

    monkeypatch.setattr(toy_suite.ReachEnvironment, "start", start_anywhere)
    with pytest.raises(SuiteError, match="the same actions led elsewhere the second time"):
        check_task(find_task("toy:reach"))


@pytest.mark.parametrize(("told", "message"), [(lambda env: "same", "must tell the instances of two seeds apart"), (lambda env: 7, "must be text")])
def test_a_scene_that_is_not_told_from_others_is_found_out(monkeypatch, told, message):
    import toy_suite

    monkeypatch.setattr(toy_suite.ReachEnvironment, "scene_digest", told, raising=False)
    with pytest.raises(SuiteError, match=message):
        check_task(find_task("toy:reach"))


def test_a_state_of_another_size_than_promised_is_refused(monkeypatch):
    import toy_suite

    monkeypatch.setattr(toy_suite.ReachEnvironment, "state", lambda self: {"position": [1.0, 2.0, 3.0]})
    with pytest.raises(UsageError, match="promises 2 numbers of state 'position' and gives 3"):
        check_task(find_task("toy:reach"))


def test_a_specification_survives_json():
    spec = replace(find_task("toy:reach").specification, control_hz=7.5, horizon=9)
    again = EnvironmentSpec.from_dict(json.loads(json.dumps(spec.to_dict())))
    assert again == spec and (again.name, again.horizon, again.robot, again.expert) == ("toy", 9, "point", True)
    with pytest.raises(UsageError, match="not the specification of an environment"):
        EnvironmentSpec.from_dict({"name": "toy"})


def test_a_wrong_specification_is_refused():
    for arguments in ({"names": ("x", "x")}, {"gripper": "hand"}, {"low": (-1.0,)}, {"high": (-2.0, 1.0)}, {"gripper_convention": "closed_one"}):
        with pytest.raises(UsageError):
            ActionSpec(**{"names": ("x", "y"), "low": (-1.0, -1.0), "high": (1.0, 1.0), **arguments})
    with pytest.raises(UsageError, match="context_camera must be one of its cameras"):
        replace(specification(), context_camera="top")


def test_only_environments_that_policies_cannot_tell_apart_are_mixed():
    assert common_specification(select_tasks(["toy:all"])).name == "toy"
    assert common_specification(select_tasks(["lift", "stack"])) == specification()
    with pytest.raises(UsageError, match="toy:reach and lift cannot be mixed"):
        common_specification(select_tasks(["toy:reach", "lift"]))


# -- policies ----------------------------------------------------------------------------------------------------------


def test_a_policy_is_checked_against_the_environment_before_it_is_loaded():
    toy = find_task("toy:reach").specification
    with pytest.raises(ContentError, match=r"local_small\.toml: observation\.cameras: unknown camera 'agentview': the environment of toy has top"):
        choose_policies(["local_small"], toy)
    with pytest.raises(ContentError, match=r"toy_greedy\.toml: observation\.cameras: .*the environment of osel_sim has agentview, wrist"):
        choose_policies(["toy_greedy"], specification(), POLICIES)
    with pytest.raises(UsageError, match=r"no policy there is drives in the environment of toy, such as .*local_small"):
        choose_policies(None, toy)


def test_without_names_policies_of_other_suites_are_left_out():
    toy = find_task("toy:reach").specification
    assert [spec.name for spec in choose_policies(None, toy, POLICIES)] == ["toy_greedy", "toy_reader"]
    assert "local_small" in left_out(toy, POLICIES)
    assert set(left_out(specification(), POLICIES)) == {"toy_greedy", "toy_reader", "metaworld_large", "metaworld_small"}


@pytest.mark.parametrize(
    ("conventions", "key", "problem"),
    [
        ({"columns": (0, 1, 2)}, "mapping.columns", "actions of 2 numbers (x, y), the policy gives 3: [0, 1, 2]"),
        ({"scale": (2.0, 2.0, 2.0)}, "mapping.scale", "has 2 motions, the policy gives 3 factors"),
        ({"gripper": "open_one"}, "mapping.gripper", "has no gripper, the policy's is 'open_one'"),
        (
            {"state_parts": ("positon",)},
            "mapping.state_parts",
            "unknown part 'positon': did you mean 'position'? the environment of toy has position",
        ),
    ],
)
def test_conventions_are_checked_against_the_environment(conventions, key, problem):
    spec = replace(load_policy_file(POLICIES / "toy_greedy.toml"), mapping=Conventions(**conventions))
    ((found, words),) = misfits(spec, find_task("toy:reach").specification)
    assert found == key and problem in words


@pytest.mark.parametrize(("arguments", "works"), [("spec, environment", True), ("spec", True), ("", False), ("spec, environment, more", False)])
def test_a_kind_is_told_what_it_drives_if_it_wants_to_know(arguments, works, tmp_path, monkeypatch):
    info = tmp_path / "old-1.0.dist-info"
    info.mkdir()
    name = f"policies_with_{len(arguments)}"
    (tmp_path / f"{name}.py").write_text(f"def load({arguments}):\n    return lambda: None\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: old\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[osel_sim.policies]\nold = {name}:load\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    spec, environment = replace(load_policy_file(POLICIES / "toy_greedy.toml"), kind="old"), find_task("toy:reach").specification
    if works:
        assert session_factory(spec, environment)() is None
        return
    with pytest.raises(UsageError, match=r"kind 'old': its entry point must be a function load\(spec, environment\)"):
        session_factory(spec, environment)


def test_quaternions_are_computed_of_an_axis_angle_and_not_known_without():
    spec = load_policy_file(POLICIES / "toy_greedy.toml")
    wants = replace(spec, cameras=("wrist",), mapping=Conventions(state_parts=("quaternion", "gripper")))
    assert not list(misfits(wants, specification()))
    assert [key for key, _ in misfits(replace(wants, cameras=("top",)), find_task("toy:reach").specification)] == ["mapping.state_parts"] * 2


# -- episodes ----------------------------------------------------------------------------------------------------------


class Eastwards:
    """A caller whose chunks go east at full speed, two components and twelve steps, after so many seconds."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def reset(self, instruction, seed):
        pass

    def call(self, observation):
        chunk = np.zeros((12, 2), np.float32)
        chunk[:, 0] = 1.0
        return Call(chunk, inference=self.seconds)

    def close(self):
        pass


class Logged(BaseEnvironment):
    """An environment of two motions and a gripper that notes its actions, and how often it was told to act."""

    def __init__(self, horizon: int = 20) -> None:
        spec = EnvironmentSpec("logged", 10, ActionSpec(("x", "hand", "y"), (-2.0, 0.0, -1.0), (2.0, 1.0, 1.0), gripper="hand"), {}, ("top",), "top")
        super().__init__(spec, horizon)

    def start(self, instance):
        self.made, self.messages = [], 0

    def act(self, action):
        self.made.append(action)
        self.messages += 1
        return False

    def render(self, camera):
        return np.zeros((8, 8, 3), np.uint8)


class LoggedInChunks(Logged):
    def advance_chunk(self, actions):
        before, messages = self.steps, self.messages
        for action in actions:
            if not self.done:
                self.advance(action)
        self.messages = messages + 1
        return self.steps - before


def drive(env, seconds=0.0, noise=0.0, execute=4, remote=None, subscribers=()):
    spec = load_policy_file(POLICIES / f"toy_{'reader' if remote else 'greedy'}.toml")
    spec = replace(spec, execute=execute, remote=replace(spec.remote, mode=remote) if remote else None)
    instance = find_task("toy:reach").instance(3)
    env.load(instance)
    return run_episode(env, instance, Driver(spec, Widened(seconds, env.specification.action.dimension)), subscribers=subscribers, action_noise=noise)


class Widened(Eastwards):
    """The same, with as many components as wanted."""

    def __init__(self, seconds, dimension):
        super().__init__(seconds)
        self.dimension = dimension

    def call(self, observation):
        call = super().call(observation)
        return replace(call, actions=np.repeat(call.actions[:, :1], self.dimension, axis=1))


def test_the_virtual_clock_runs_at_the_environments_rate():
    env = Logged()
    outcome = drive(env, seconds=0.25, remote="blocking")
    still = [not action.any() for action in env.made]
    assert still == [True] * 3 + [False] * 4 + [True] * 3 + [False] * 4 + [True] * 3 + [False] * 3  # 0.25 s are 3 steps at 10 Hz
    assert (outcome.steps, outcome.actions, outcome.seconds.motion) == (20, 11, 2.0)


def test_noise_is_on_motions_only_scaled_by_their_range_and_within_bounds():
    env = Logged(horizon=400)
    drive(env, noise=0.3)
    made = np.array(env.made)
    assert (made[:, 1] == 1.0).all()
    assert made[:, 2].max() == 1.0 and made[:, 2].std() > 0.1
    inside = made[:, 0][made[:, 0] < 2.0] - 1.0
    assert inside.std() == pytest.approx(0.6, abs=0.1)


@pytest.mark.parametrize("mode", [None, "blocking", "async"])
def test_chunks_sent_at_once_are_the_same_episode(mode):
    one, several = Logged(), LoggedInChunks()
    outcomes = [drive(env, 0.25 if mode else 0.0, 0.2, 4, mode) for env in (one, several)]
    assert outcomes[0] == outcomes[1]
    assert np.array_equal(one.made, several.made)
    assert several.messages < len(several.made) / 2


class Looking(Eastwards):
    """The same, noting at which control steps the images it is shown were taken."""

    def __init__(self, seconds):
        super().__init__(seconds)
        self.seen = []

    def call(self, observation):
        self.seen.append(observation["observation.images.top"][:, 0, 0, 0].tolist())
        return replace(super().call(observation), actions=np.ones((12, 3), np.float32))


@pytest.mark.parametrize(
    ("mode", "execute", "calls"), [(None, 4, [0, 4, 8, 12, 16]), (None, 1, [*range(20)]), ("blocking", 4, [0, 7, 14]), ("async", 2, None)]
)
@pytest.mark.parametrize("kind", [Logged, LoggedInChunks])
def test_a_policy_with_a_history_sees_the_steps_before_the_call(kind, mode, execute, calls):
    class Counted(kind):
        def render(self, camera):
            return np.full((64, 64, 3), self.steps, np.uint8)

    env, caller = Counted(), Looking(0.25 if mode else 0.0)
    spec = load_policy_file(POLICIES / f"toy_{'reader' if mode else 'greedy'}.toml")
    spec = replace(spec, execute=execute, history=3, cameras=("top",), remote=replace(spec.remote, mode=mode) if mode else None)
    instance = find_task("toy:reach").instance(3)
    env.load(instance)
    run_episode(env, instance, Driver(spec, caller))
    called = [window[-1] for window in caller.seen]
    assert caller.seen == [[max(0, step - 2), max(0, step - 1), step] for step in called]
    assert called == calls if calls else called == sorted({*called}) and len(called) > 3


def test_whoever_watches_steps_sees_all_of_them():
    class Steps(Subscriber):
        seen = 0

        def on_step(self, frame):
            Steps.seen += 1

    env = LoggedInChunks()
    drive(env, subscribers=[Steps()])
    assert Steps.seen == env.messages == 20


def test_without_snapshots_an_instance_is_loaded_again():
    env, instance = find_task("toy:reach").open(), find_task("toy:reach").instance(5)
    start = Start(env, instance)
    before = env.observe(["top"], 64)
    env.advance(np.ones(2, np.float32))
    start.again()
    after = env.observe(["top"], 64)
    assert env.steps == 0 and all(np.array_equal(before[key], after[key]) for key in before)
    with pytest.raises(UsageError, match="has no snapshots"):
        env.snapshot()


# -- live runs and their subscribers -----------------------------------------------------------------------------------


class Colour:
    """An encoder that needs no weights."""

    name = identity = "colour"
    dimension, image_size = 3, 32

    def encode(self, images, instruction):
        return np.array([float(word in instruction) for word in ("red", "green", "blue")], np.float32)


class Told(RunSubscriber):
    """Notes what it is told; fails at a decision."""

    def __init__(self, fails_at=None):
        self.fails_at, self.heard = fails_at, []

    def on_start(self, run):
        self.heard.append(("start", len(run.decisions), run.rewards.shape))

    def on_instance(self, index):
        self.heard.append(("instance", index))

    def on_choice(self, index, policy):
        self.heard.append(("choice", index))

    def watch(self, index, policy, chosen):
        self.heard.append(("episode", index, chosen))
        return []

    def on_decision(self, decision, rewards):
        self.heard.append(("decision", decision.index, len(rewards)))
        if decision.index == self.fails_at:
            raise OSError("the disk is full")

    def on_end(self, run):
        self.heard.append(("end", (run.folder / "contexts.npz").exists()))

    def close(self):
        self.heard.append(("close",))


def live(folder: Path, drivers: Drivers, subscriber: RunSubscriber) -> LiveRun:
    folder.mkdir(exist_ok=True)
    selector = make_selector("random", ["toy_greedy", "scripted_expert"], 3, 0)
    options = LiveOptions(0, RewardWeights(0.1, 0.0), counterfactual=True)
    return LiveRun(folder, select_tasks(["toy:all"]), Colour(), drivers, selector, options, [subscriber])


def test_subscribers_are_told_of_a_run_and_one_that_fails_leaves_it_whole(tmp_path):
    toy = find_task("toy:reach").specification
    with Drivers(choose_policies(["toy_greedy", "scripted_expert"], toy, POLICIES), toy) as drivers:
        whole = Told()
        live(tmp_path / "whole", drivers, whole).run(3)
        cut = Told(fails_at=1)
        with pytest.raises(OSError, match="the disk is full"):
            live(tmp_path / "cut", drivers, cut).run(3)
        again, resumed = Told(), live(tmp_path / "cut", drivers, Told())
        resumed.subscribers = [again]
        resumed.replay()
        resumed.run(3)
    decided = [("instance", 0), ("choice", 0), ("episode", 0, True), ("episode", 0, False), ("decision", 0, 2)]
    assert whole.heard[:6] == [("start", 0, (0, 2)), *decided] and whole.heard[-2:] == [("end", True), ("close",)]
    assert cut.heard[-2:] == [("decision", 1, 2), ("close",)]
    assert again.heard[0] == ("start", 1, (1, 2)) and ("instance", 0) not in again.heard
    for name in ("episodes.jsonl", "counterfactual.jsonl", "contexts.npz"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()
    decisions = read_journal(tmp_path / "whole" / "episodes.jsonl")
    assert {decision.task for decision in decisions} <= {"toy:reach", "toy:hurry"}


def watched(folder: Path, drivers: Drivers, name: str, subscriber: RunSubscriber) -> LiveRun:
    folder.mkdir(exist_ok=True)
    names, weights = ["toy_greedy", "scripted_expert"], RewardWeights(0.1, 0.0)
    monitor = make_monitor(name, [Candidate("toy_greedy", False), Candidate("scripted_expert", True)], 3, 0)
    options = LiveOptions(0, weights, counterfactual=True)
    run_monitor = RunMonitor(monitor, names, 1, Colour(), weights)
    return LiveRun(
        folder, select_tasks(["toy:all"]), Colour(), drivers, make_selector("random", names, 3, 0), options, [TimingFile(), subscriber], run_monitor
    )


@pytest.mark.parametrize("name", ["value:9", "random:0.5", "ppo", "disagreement:0.1"])
def test_a_run_with_a_monitor_that_was_cut_off_goes_on_to_the_same_bytes(name, tmp_path):
    toy = find_task("toy:reach").specification
    files = ("episodes.jsonl", "points.jsonl", "counterfactual.jsonl", "contexts.npz")
    with Drivers(choose_policies(["toy_greedy", "scripted_expert"], toy, POLICIES), toy) as drivers:
        whole = watched(tmp_path / "whole", drivers, name, Told())
        whole.run(12)
        with pytest.raises(OSError, match="the disk is full"):
            watched(tmp_path / "cut", drivers, name, Told(fails_at=7)).run(12)
        assert (tmp_path / "cut" / "points.jsonl").read_bytes().count(b"\n") == 8  # written before the decision, which is made again
        resumed = watched(tmp_path / "cut", drivers, name, Told())
        resumed.replay()
        resumed.run(12)
        for file in files:
            assert (tmp_path / "whole" / file).read_bytes() == (tmp_path / "cut" / file).read_bytes(), file
        assert resumed.alone == whole.alone and len(whole.alone) == 12
        told = [decision.monitored for decision in read_journal(tmp_path / "whole" / "episodes.jsonl")]
        assert any(one.handoffs for one in told) or name == "disagreement:0.1"
        for one, decision in zip(told, whole.decisions, strict=True):
            assert sum(driving.steps for driving in one.by_policy.values()) == decision.steps
        damaged = (tmp_path / "cut" / "points.jsonl").read_text().replace('"why": "', '"why": "not ', 1)
        (tmp_path / "cut" / "points.jsonl").write_text(damaged)
        with pytest.raises(DataError, match="is not what was written"):
            watched(tmp_path / "cut", drivers, name, Told())


@pytest.mark.slow
def test_from_python_a_run_of_another_suite_is_watched_and_driven_by_an_object_at_hand(tmp_path):
    class East:
        def reset(self, instruction):
            self.seen = set()

        def act(self, observation):
            self.seen |= observation.keys()
            return np.ones((30, 2), np.float32)

    east, told = East(), Told()
    names = [east, "scripted_expert"]
    result = osel_sim.run(task="toy:reach", policies=names, selector="fixed:east", episodes=2, out=tmp_path / "run", subscribers=[told])
    assert east.seen == {"observation.images.top", "observation.state", "task"}
    assert [decision.policy for decision in result.journal] == ["east"] * 2 and result.page is not None and result.page.is_file()
    assert [event for event in told.heard if event[0] == "decision"] == [("decision", 0, 1), ("decision", 1, 1)]


# -- commands ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def execute(installed, tmp_path_factory):
    """Run a command with the toy suite installed; its output."""
    home = tmp_path_factory.mktemp("home")

    def run(name: str, *arguments: object, code: int = 0) -> str:
        path = os.pathsep.join([str(installed), *filter(None, [os.environ.get("PYTHONPATH")])])
        done = subprocess.run(
            [sys.executable, "-m", f"osel_sim.{name}", *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            cwd=home,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout + done.stderr

    run.home = home
    return run


def test_the_listing_has_its_tasks(execute):
    found = json.loads(execute("run", "--list", "--json"))
    (suite,) = [suite for suite in found["suites"] if suite["name"] == "toy"]
    assert [task["name"] for task in suite["tasks"]] == ["toy:reach", "toy:hurry"]
    assert "pick_place" in [task["name"] for task in found["tasks"]]


@pytest.mark.slow
def test_demonstrations_of_another_suites_expert(execute):
    flags = ["--task", "toy:reach", "--episodes", 2, "--workers", 1, "--image-size", 32, "--out", "demonstrations"]
    assert "unknown camera 'wrist': known: top" in execute("collect", *flags, "--camera", "wrist", code=2)
    assert "2 demonstrations" in execute("collect", *flags)
    side = json.loads((execute.home / "demonstrations" / "meta" / "osel_sim.json").read_text())
    assert side["task"] == "toy:reach" and side["seeds"] == 2 and side["failed_seeds"] == []
    assert "is complete" in execute("collect", *flags, "--resume")


@pytest.mark.slow
def test_it_runs_with_a_local_and_a_served_policy(execute):
    flags = ["--task", "toy:all", "--policies-dir", POLICIES, "--selector", "auto", "--counterfactual", "--out", "run"]
    printed = execute("run", *flags, "--episodes", 4, "--video", 1)
    assert "not made for the environment of toy, and left out: local_small" in printed and "report.html shows it" in printed
    folder = execute.home / "run"
    decisions = read_journal(folder / "episodes.jsonl")
    configuration = json.loads((folder / "run.json").read_text())
    assert all(decision.error is None and decision.task in ("toy:reach", "toy:hurry") for decision in decisions)
    assert configuration["configuration"]["content"]["task toy:reach"] == "1"
    assert configuration["environment"]["gl"] == "none" and configuration["environment"]["versions"]["toy-suite"] == "1.0"
    others = [json.loads(line)["policies"] for line in (folder / "counterfactual.jsonl").read_text().splitlines()]
    outcomes = [outcome for row in others for name, outcome in row.items() if name == "toy_reader"]
    outcomes += [vars(decision.outcome) for decision in decisions if decision.policy == "toy_reader"]
    assert len(outcomes) == 4 and all(outcome["price"] > 0 for outcome in outcomes)
    assert len(list((folder / "videos").glob("*.mp4"))) == 1
    execute("run", *flags, "--episodes", 6, code=2)  # --resume is missing
    execute("report", "run", "--scenes", 2)


@pytest.mark.slow
def test_it_records_replays_and_reports(execute):
    flags = ["--task", "toy:reach", "--instances", 8, "--repeats", 2, "--policies-dir", POLICIES]
    execute("record", *flags, "--policies", "toy_greedy", "toy_reader", "scripted_expert", "--out", "log")
    rows, metadata = read_rollouts(execute.home / "log")
    assert len(rows) == 48 and {row.task for row in rows} == {"toy:reach"} and rows[0].instance == "toy:reach/test/0/0"
    assert all(row.error is None for row in rows) and all(row.success for row in rows if row.policy == "scripted_expert")
    assert metadata[DECLARED] == {"toy_greedy": ["toy:hurry"], "toy_reader": ["toy:reach", "toy:hurry"]}
    success = {name: np.mean([row.success for row in rows if row.policy == name]) for name in ("toy_greedy", "toy_reader")}
    assert success["toy_reader"] > success["toy_greedy"] + 0.3
    execute("replay", "log", "--selectors", "auto", "random", "--seeds", 2, "--no-frontier", "--workers", 1, "--out", "replay")
    assert json.loads((execute.home / "replay" / "replay.json").read_text())["log"]["tasks"] == ["toy:reach"]
    execute("report", "replay", "--scenes", 2)
    execute("report", "log", "--scenes", 1)
    assert (execute.home / "log" / "report.html").stat().st_size > 100_000


@pytest.mark.slow
def test_the_doctor_and_the_gallery_know_it(execute):
    printed = execute("doctor", "--policy", POLICIES / "toy_reader.toml", "--task", "toy:reach", "--seed", 1)
    assert "camera top, 64 x 64 pixels" in printed and "position:" in printed
    execute("gallery", "--task", "toy:all", "--size", 64, "--out", "sheet.png")
    assert "unknown camera 'wrist': known: top" in execute("gallery", "--task", "toy:reach", "--camera", "wrist", "--out", "x.png", code=2)


def test_lerobots_evaluator_gets_its_tasks_too():
    from lerobot.envs.utils import NEW_ROLLOUT_OPTION

    from osel_sim.suites.lerobot_env import OselSimEnv

    config = OselSimEnv(task="toy:reach,toy:hurry", image_size=32)
    assert config.fps == 10 and set(config.features) == {"action", "observation.state", "observation.images.top"}
    for name, group in config.create_envs(2).items():
        (envs,) = group.values()
        observation, _ = envs.reset(seed=[3, 4], options={NEW_ROLLOUT_OPTION: True})
        assert observation["pixels"]["top"].shape == (2, 32, 32, 3) and observation["agent_pos"].shape == (2, 2)
        assert envs.call("task") == (name, name) and all(text.startswith("move") for text in envs.call("task_description"))
        for _ in range(envs.call("_max_episode_steps")[0]):
            ended = envs.step(np.ones((2, 2), np.float32))
        assert (ended[2] | ended[3]).all() and "is_success" in ended[4]
        envs.close()
    with pytest.raises(UsageError, match="cannot be mixed"):
        OselSimEnv(task="toy:reach,lift")
