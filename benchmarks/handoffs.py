"""What a monitor costs at a decision point of a real episode: rendering, encoding, looking and deciding.

    python benchmarks/handoffs.py [--monitors value ppo stall] [--points 200] [--learned 2000]

The robot stands on a `press_button` instance and does nothing; a monitor that learns was told of so many made-up decision points before. Times are
CPU time of this process on one thread, so that other work on the machine does not count.

It prints a table in Markdown: the median and the 95% quantile, in milliseconds. The last line is JSON: by monitor both.
"""

import argparse
import json
import time

import numpy as np

from osel_sim.context.encoder import load_encoder
from osel_sim.context.names import DEFAULT_ENCODER
from osel_sim.core.torch_settings import threads
from osel_sim.episodes.handoffs import moved, state_of
from osel_sim.episodes.look import LiveLook
from osel_sim.interface.monitor import Candidate, DecisionPoint, Monitor, Picture, Told, Turn, Watched
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.selection.monitors.registry import make_monitor
from osel_sim.suites.open_tasks import OpenTasks
from osel_sim.suites.registry import select_tasks

CANDIDATES = (Candidate("local_small", False), Candidate("remote_large", True), Candidate("remote_specialist", True))
TASK, MOST_MILLISECONDS = "press_button", 15.0


def teach(monitor: Monitor, picture: Picture, learned: int) -> None:
    """Tell a monitor of so many decision points, ten an episode."""
    chance = np.random.default_rng(0)
    for episode in range(learned // 10):
        monitor.reset("do it", "local_small", (episode,))
        points, turns, driver = [], [], "local_small"
        for call in range(1, 11):
            told = Told((picture + 0.1 * chance.normal(size=picture.shape)).astype(np.float32), (float(chance.random()) / 20,))
            points.append(DecisionPoint(call, 8 * call, 0.4 * call, 0.0, call / 12, driver, "do it", 0.1, 0.05, told))
            turns.append(monitor.drives_on(points[-1]))
            driver = turns[-1].policy
        reward = float(chance.random())
        monitor.learn(Watched(points, turns, Outcome(False, 0.0, 80, Seconds(motion=4.0), 10, 80, 0.0), reward, [reward] * len(points)))


def measure(name: str, points: int, learned: int) -> list[float]:
    """Milliseconds of CPU time at each decision point."""
    (task,) = select_tasks([TASK])
    encoder = load_encoder(DEFAULT_ENCODER)
    env, instance = OpenTasks([task])[TASK], task.instance(0, 0, "test")
    env.load(instance)
    monitor = make_monitor(name, CANDIDATES, encoder.dimension, 0)
    first = LiveLook(env, instance.instruction, encoder, None, lambda policy: None)
    teach(monitor, first.picture(), learned)
    first.change()
    monitor.reset(instance.instruction, "local_small", (learned,))
    taken, state, before = [], state_of(env), first.image
    for call in range(1, points + 1):
        start = time.process_time()
        now = state_of(env)
        look = LiveLook(env, instance.instruction, encoder, before, lambda policy: None)
        numbers = (call, 8 * call, 0.4 * call, 0.0, min(1.0, call / points))
        turn: Turn = monitor.drives_on(DecisionPoint(*numbers, "local_small", instance.instruction, 0.1, moved(state, now), look))
        taken.append(1e3 * (time.process_time() - start))
        turn.check([candidate.name for candidate in CANDIDATES])
        state, before = now, look.image
        for _ in range(8):
            env.advance(env.hold_action())
            if env.done:
                env.load(instance)
    env.close()
    return taken[len(taken) // 10 :]  # the first few compile and allocate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--monitors", nargs="+", default=["value", "ppo", "stall", "disagreement"])
    parser.add_argument("--points", type=int, default=200, help="decision points to measure")
    parser.add_argument("--learned", type=int, default=2000, help="decision points that it was told of before")
    arguments = parser.parse_args()
    figures = {}
    print("| monitor | median ms | 95% quantile ms |\n|---|---|---|")
    with threads(1):
        for name in arguments.monitors:
            taken = measure(name, arguments.points, arguments.learned)
            figures[name] = {"median_ms": float(np.median(taken)), "quantile_ms": float(np.quantile(taken, 0.95))}
            print(f"| `{name}` | {figures[name]['median_ms']:.2f} | {figures[name]['quantile_ms']:.2f} |", flush=True)
    print(f"at most {MOST_MILLISECONDS:g} ms a decision point: {all(one['median_ms'] <= MOST_MILLISECONDS for one in figures.values())}")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
