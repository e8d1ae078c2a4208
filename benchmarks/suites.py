"""How much quicker than stock Meta-World: one picture, one episode with pictures; and what a process of its own costs.

    python -m osel_sim.suites install metaworld
    python benchmarks/suites.py [--parts frame episode hosted] [--task drawer-open-v3] [--rounds 5] [--steps 80] [--size 128]

Stock is what Meta-World's and LeRobot's users have: `metaworld`'s environment with `render_mode="rgb_array"`, a picture after every step. Ours looks
at every 8th step, since policies answer in chunks. Both run alternately on the same packages in this one process, with the same actions; figures are
medians over the rounds. `hosted` is the same episode of ours in a host process: the median over 20 pairs a round, one here and one there in turn.
The last line is JSON: metaworld_frame_ratio, metaworld_episode_ratio, hosted_slowdown (1.1: 10% slower than in this process).
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from osel_sim.interface.environment import Environment
from osel_sim.sim.gl import choose_backend
from osel_sim.suites.environments import environment
from osel_sim.suites.hosted import HostedEnvironment, host_of
from osel_sim.suites.registry import find_task

CAMERA, EVERY = "corner2", 8
PARTS = ("frame", "episode", "hosted")
PAIRS = 20
"""Episodes of ours and of the host a round."""


def make_stock(task: str, size: int) -> Any:
    """Meta-World's own environment, set up as LeRobot does."""
    from metaworld.env_dict import ENV_CLS_MAP

    env = ENV_CLS_MAP[task](render_mode="rgb_array", camera_name=CAMERA, width=size, height=size)
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    env.model.camera(CAMERA).pos = [0.75, 0.075, 0.7]
    env.seed(0)
    return env


def seconds(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def stock_picture(env: Any) -> Any:
    env.mujoco_renderer._get_viewer("rgb_array").make_context_current()  # it does so once only, and would draw into our context from then on
    return env.render()


def stock_episode(env: Any, actions: np.ndarray) -> None:
    env.reset()
    for action in actions:
        env.step(action)
        stock_picture(env)


def our_episode(env: Environment, instance: Any, actions: np.ndarray, size: int) -> None:
    env.load(instance)
    look = [CAMERA], size
    for start in range(0, len(actions), EVERY):
        env.observe(*look)
        chunk = actions[start : start + EVERY]
        if isinstance(env, HostedEnvironment):  # as the episode loop does
            if start + EVERY < len(actions):
                env.advance_and_look(chunk, *look)
            else:
                env.advance_chunk(chunk)
        else:
            for action in chunk:
                env.advance(action)


def pair(here: Callable[[], Any], there: Callable[[], Any], here_first: bool) -> tuple[float, float]:
    """Seconds here and there, one after the other."""
    if here_first:
        return seconds(here), seconds(there)
    later = seconds(there)
    return seconds(here), later


def measure(options: argparse.Namespace) -> tuple[dict[str, list[float]], list[tuple[float, float]]]:
    """Seconds of each kind, and of pairs of episodes here and in the host."""
    place = environment("metaworld")
    place.require("metaworld")
    choose_backend()
    hosted = HostedEnvironment(host_of("metaworld", "metaworld"), options.task)
    sys.path.append(str(place.packages))  # last: what is installed here stays what it is
    task = find_task(f"metaworld:{options.task}")
    ours, stock, instance = task.open(), make_stock(options.task, options.size), task.instance(0)
    # Actions at random do nothing in particular, and so never end the episode early.
    actions = np.random.default_rng(0).uniform(-1, 1, (options.steps, 4)).astype(np.float32)
    for env in (ours, hosted):
        our_episode(env, instance, actions, options.size)
    stock.reset()
    stock_picture(stock)
    found: dict[str, list[float]] = {}
    pairs: list[tuple[float, float]] = []

    def time_of(name: str, function: Callable[[], Any]) -> None:
        found.setdefault(name, []).append(seconds(function))

    for _ in range(options.rounds):
        if "frame" in options.parts:
            time_of("stock frame", lambda: stock_picture(stock))
            time_of("our frame", lambda: ours.image(CAMERA, options.size, options.size))
        if "episode" in options.parts:
            time_of("stock episode", lambda: stock_episode(stock, actions))
            time_of("our episode", lambda: our_episode(ours, instance, actions, options.size))
        if "hosted" in options.parts:  # short, next to each other and in turn: what else the machine does meets both
            here, there = ((lambda env=env: our_episode(env, instance, actions, options.size)) for env in (ours, hosted))
            pairs += [pair(here, there, number % 2 == 0) for number in range(PAIRS)]
    return found, pairs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="drawer-open-v3")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure (default: all)")
    options = parser.parse_args()
    found, pairs = measure(options)
    median = {name: statistics.median(values) for name, values in found.items()}
    for name, value in median.items():
        print(f"{name:15} {1e3 * value:9.1f} ms")
    ratios = {f"metaworld_{part}_ratio": median[f"stock {part}"] / median[f"our {part}"] for part in ("frame", "episode") if part in options.parts}
    if pairs:
        for name, times in zip(("episode here", "episode in host"), zip(*pairs, strict=True), strict=True):
            print(f"{name:15} {1e3 * statistics.median(times):9.1f} ms")
        lower, middle, upper = statistics.quantiles((there / here for here, there in pairs), n=4)
        print(f"{len(pairs)} pairs: {middle:.3f} times as long in the host, half of them {lower:.2f} to {upper:.2f}")
        ratios["hosted_slowdown"] = middle
    print(json.dumps({name: round(value, 2) for name, value in ratios.items()}))


if __name__ == "__main__":
    main()
