"""An episode with its moments, on the real simulator: each way on is, to the bit, what a monitor that hands over there comes to."""

from dataclasses import replace

import numpy as np
import pytest
from test_episode import HORIZON, Numbered
from test_handoffs import Fleet, fleet, handoffs

from osel_sim.core import content
from osel_sim.episodes.loop import run_episode
from osel_sim.episodes.moments import Cuts, MomentRunner
from osel_sim.formats.moments import SIGNALS
from osel_sim.formats.task_file import load_task_file
from osel_sim.interface.monitor import Candidate
from osel_sim.selection.monitors.registry import make_monitor
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.instance import make_instance


class Colours:
    """The mean colour of a picture."""

    name, identity, dimension, image_size = "colours", "colours@1", 3, 32

    def encode(self, images, instruction):
        return np.mean([image.mean(axis=(0, 1)) for image in images], axis=0).astype(np.float32)


@pytest.fixture(scope="module")
def env():
    env = TaskEnv(replace(load_task_file(content.find("tasks", "pick_place")), horizon=HORIZON))
    yield env
    env.close()


@pytest.fixture(scope="module")
def drivers() -> Fleet:
    return fleet(small=Numbered(), blocking=Numbered(inference=0.2))


@pytest.fixture(scope="module")
def instance(env):
    return make_instance(env.task, 3)


@pytest.mark.parametrize("first", ["small", "blocking"])
def test_each_way_on_is_what_a_blind_monitor_comes_to(env, drivers, instance, first):
    env.load(instance)
    runner = MomentRunner(drivers, tuple(drivers), Cuts(1, 2), Colours(), action_noise=0.1)
    outcome, moments = runner.run(env, instance, first, HORIZON)
    second = next(name for name in drivers if name != first)
    assert [(row.call, row.second) for row in moments.rows] == [(1, None), (1, second), (2, None), (2, second)]
    env.load(instance)
    assert outcome == run_episode(env, instance, drivers[first], action_noise=0.1)
    candidates = [Candidate(name, name != "small") for name in drivers]
    for row in moments.rows:
        monitor = make_monitor(f"blind:{row.call}:{second}" if row.second else "never", candidates, 3, seed=0)
        monitor.reset(instance.instruction, first, (0,))
        env.load(instance)
        live = run_episode(env, instance, drivers[first], handoffs=handoffs(drivers, monitor), action_noise=0.1)
        assert row.outcome == replace(live, monitored=None)
        assert live.monitored is not None
        assert row.price_first == live.monitored.by_policy[first].price
        assert row.remote_steps / row.steps == live.monitored.duty_steps
        assert row.step == (live.monitored.handoffs[0].step if row.second else row.step)
    assert moments.pictures.shape == (2, 3) and not np.array_equal(*moments.pictures)
    change = moments.signals[:, SIGNALS.index("change")]
    assert np.isnan(change[0]) and change[1] > 0.0, "nothing was looked at before the first"
