"""Draw docs/rendering.png: the same moment in `fast` quality (what policies and contexts see) and in `full` quality (what videos show).

python examples/render_quality.py [--out docs/rendering.png] [--seed 7]
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance

SIZE = 384


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/rendering.png"))
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args()
    env = TaskEnv("pick_place")
    env.load(make_instance(env.task, options.seed))
    expert = Expert(env.world)
    while env.subgoal_fraction < 0.75:
        env.advance(expert.act())
    rows = []
    for camera in ("agentview", "wrist"):
        images = []
        for quality in ("fast", "full"):
            env.image(camera, SIZE, SIZE, quality)
            start = time.perf_counter()
            image = env.image(camera, SIZE, SIZE, quality).copy()
            label = f"{camera}, {quality}: {1e3 * (time.perf_counter() - start):.0f} ms"
            cv2.putText(image, label, (10, SIZE - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(image, label, (10, SIZE - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
            images.append(image)
        rows.append(np.concatenate(images, axis=1))
    cv2.imwrite(str(options.out), np.concatenate(rows, axis=0)[..., ::-1])
    print(f"{options.out}: {env.instance.instruction!r}")


if __name__ == "__main__":
    main()
