"""Draw docs/episode.png: one episode of a policy as a strip of frames with its instruction.

python examples/episode_strip.py [--policy local_small] [--seed 3] [--out docs/episode.png]
"""

import argparse
import dataclasses
from pathlib import Path

import cv2
import numpy as np

from osel_sim.episodes.loop import Driver, Frame, Subscriber, run_episode
from osel_sim.formats import library
from osel_sim.policy.local import LocalCaller
from osel_sim.policy.registry import make_policy
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.instance import make_instance

FRAMES, SIZE = 5, 300


class Camera(Subscriber):
    """Keeps a picture of every fourth step."""

    def __init__(self) -> None:
        self.images: list[tuple[int, np.ndarray]] = []

    def on_start(self, frame: Frame) -> None:
        self.on_step(frame)

    def on_step(self, frame: Frame) -> None:
        if frame.steps % 4 == 0:
            self.images.append((frame.steps, frame.env.image("agentview", SIZE, SIZE, "full").copy()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="local_small")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("docs/episode.png"))
    options = parser.parse_args()
    spec = dataclasses.replace(library.load_policy(options.policy), remote=None)  # driven here, without a network
    env, camera = TaskEnv("pick_place"), Camera()
    instance = make_instance(env.task, options.seed)
    env.load(instance)
    driver = Driver(spec, LocalCaller(make_policy(spec, env.specification), spec, env.specification))
    outcome = run_episode(env, instance, driver, subscribers=[camera])
    chosen = [camera.images[index] for index in np.linspace(0, len(camera.images) - 1, FRAMES).round().astype(int)]
    for steps, image in chosen:
        cv2.putText(image, f"step {steps}", (8, SIZE - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (20, 20, 20), 1, cv2.LINE_AA)
    strip = np.concatenate([image for _, image in chosen], axis=1)
    title = np.full((34, strip.shape[1], 3), 255, np.uint8)
    cv2.putText(title, f'"{instance.instruction}"  ({options.policy})', (10, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.62, (20, 20, 20), 1, cv2.LINE_AA)
    cv2.imwrite(str(options.out), np.concatenate([title, strip], axis=0)[..., ::-1])
    print(f"{options.out}: {instance.instruction!r}, success {outcome.success}, {outcome.steps} steps")


if __name__ == "__main__":
    main()
