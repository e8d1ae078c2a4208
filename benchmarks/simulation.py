"""How much quicker than stock robosuite: one control step, one image, one whole expert episode with images.

    python benchmarks/simulation.py [--rounds 5] [--size 128]

Both sides run alternately in this one process, with the same robot, table, things and camera sizes; the figures are medians over the rounds.
The last line is JSON: control_step_ratio, image_ratio, episode_ratio.
"""

import argparse
import functools
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.gl import quiet_robosuite
from osel_sim.sim.instance import make_instance

CAMERAS = ("agentview", "wrist")
STOCK_CAMERAS = ("agentview", "robot0_eye_in_hand")
EVERY = 10
"""Our episodes look at every tenth step: policies answer in chunks of actions. Stock renders at every step, as its users do."""


def make_stock(cameras: tuple[str, ...], size: int) -> Any:
    """robosuite's own environment with the things that ours has most in common with: its pick-and-place, all objects on the table."""
    robosuite = quiet_robosuite()
    images = (
        {"use_camera_obs": True, "camera_names": list(cameras), "camera_heights": size, "camera_widths": size}
        if cameras
        else {"use_camera_obs": False}
    )
    env = robosuite.make(
        "PickPlace", robots="Panda", has_renderer=False, has_offscreen_renderer=bool(cameras), control_freq=20, horizon=100_000, ignore_done=True,
        hard_reset=False, **images,
    )  # fmt: skip
    env.reset()
    return env


def timed(function: Callable[[], Any], repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        function()
    return (time.perf_counter() - start) / repeats


def play(step: Callable[[np.ndarray], Any], actions: np.ndarray) -> None:
    for action in actions:
        step(action)


def our_episode(env: TaskEnv, expert: Expert, seed: int, size: int) -> int:
    env.load(make_instance(env.task, seed))
    expert.reset()
    while not env.done:
        if env.steps % EVERY == 0:
            env.observe(CAMERAS, size)
        env.advance(expert.act())
    return env.steps


def stock_episode(env: Any, actions: np.ndarray) -> None:
    """As many steps of the expert's own actions, an observation with images after each."""
    env.reset()
    for action in actions:
        env.step(action)


def expert_actions(env: TaskEnv, expert: Expert, seed: int) -> np.ndarray:
    env.load(make_instance(env.task, seed))
    expert.reset()
    actions = []
    while not env.done:
        actions.append(expert.act())
        env.advance(actions[-1])
    return np.array(actions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--size", type=int, default=128, help="pixels of each camera's image, square")
    options = parser.parse_args()

    ours = TaskEnv("pick_place")
    expert = Expert(ours.world)
    blind, seeing = make_stock((), 0), make_stock(STOCK_CAMERAS, options.size)
    actions = expert_actions(ours, expert, 0)
    ours.load(make_instance(ours.task, 0))
    ours.observe(CAMERAS, options.size)

    figures: dict[str, dict[str, list[float]]] = {name: {"ours": [], "stock": []} for name in ("control step", "image", "episode")}
    rng = np.random.default_rng(0)
    for seed in range(options.rounds):
        moves = rng.uniform(-0.5, 0.5, (60, 7))
        ours.load(make_instance(ours.task, seed))
        blind.reset()
        figures["control step"]["stock"].append(timed(functools.partial(play, blind.step, moves), 1) / len(moves))
        figures["control step"]["ours"].append(timed(functools.partial(play, ours.advance, moves), 1) / len(moves))
        render = lambda: seeing.sim.render(camera_name="agentview", width=options.size, height=options.size)  # noqa: E731
        seeing.sim._render_context_offscreen.gl_ctx.make_current()  # robosuite does so once, and would draw into our context
        figures["image"]["stock"].append(timed(render, 20))
        figures["image"]["ours"].append(timed(lambda: ours.image("agentview", options.size, options.size), 20))
        seeing.sim._render_context_offscreen.gl_ctx.make_current()
        figures["episode"]["stock"].append(timed(lambda: stock_episode(seeing, actions), 1))
        figures["episode"]["ours"].append(timed(lambda seed=seed: our_episode(ours, expert, seed, options.size), 1))

    print(f"{'':14}{'stock':>12}{'osel_sim':>12}{'ratio':>8}    (ms, median of {options.rounds} alternating rounds, images of {options.size} pixels)")
    ratios = {}
    for name, sides in figures.items():
        stock, mine = (statistics.median(sides[side]) * 1e3 for side in ("stock", "ours"))
        ratios[name.replace(" ", "_") + "_ratio"] = round(stock / mine, 2)
        print(f"{name:14}{stock:12.2f}{mine:12.2f}{stock / mine:8.1f}")
    print(json.dumps(ratios))


if __name__ == "__main__":
    main()
