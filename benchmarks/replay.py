"""How much quicker than SB3's own loop: PPO with the paper's settings over a logged stream.

    python benchmarks/replay.py [--dim 256] [--decisions 1000] [--seeds 20] [--sb3-seeds 2] [--workers 2]

Both sides make the same decisions on the same contexts and rewards in one run. First one seed after another in this process, one thread each, SB3's
`learn()` and ours in turn for the first few seeds, less the time of five decisions, which is that of making the networks; then ours for all seeds in
`--workers` processes, starting them included, as `python -m osel_sim.replay` does it (on an idle machine; 1 leaves this out). What 20 seeds of 4,000
decisions would take is extrapolated from the time a decision.
The last line is JSON: ratio (one SB3 loop to our processes), ratio_one_thread, decisions a second of each.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from stable_baselines3 import PPO

from osel_sim.analysis.engine import _one_thread, replay_one
from osel_sim.selection.environment import SelectionEnv, table_rounds
from osel_sim.selection.ppo.sb3 import PPOSelector

POLICIES = ("local", "remote")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--dim", type=int, default=256, help="length of a context (default: %(default)s, osel_small's)")
    parser.add_argument("--decisions", type=int, default=1000, help="of a stream (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=20, help="streams of our processes (default: %(default)s)")
    parser.add_argument("--sb3-seeds", type=int, default=2, help="the first so many of them one after another, with SB3 (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes of our side (default: %(default)s)")
    options = parser.parse_args()

    contexts, rewards = stream(options.decisions, options.dim)
    replay_one("ppo", contexts[:10], rewards[:10], POLICIES, 0)  # compile
    sb3(contexts[:10], rewards[:10], 0)
    theirs = ours = 0.0
    with _one_thread():
        for seed in range(options.sb3_seeds):
            theirs += timed(partial(sb3, contexts, rewards, seed)) - timed(partial(sb3, contexts[:5], rewards[:5], seed))
            ours += timed(partial(replay_one, "ppo", contexts, rewards, POLICIES, seed))
            ours -= timed(partial(replay_one, "ppo", contexts[:5], rewards[:5], POLICIES, seed))
    few, all_seeds = options.sb3_seeds * options.decisions, options.seeds * options.decisions
    together = in_processes(options) / all_seeds if options.workers > 1 else ours / few
    print(f"contexts of {options.dim} numbers, {options.decisions} decisions, {options.seeds} seeds, {options.sb3_seeds} of them one after another")
    for name, each in (
        ("SB3's learn(), one thread", theirs / few),
        ("ours, one thread", ours / few),
        (f"ours, {options.workers} processes", together),
    ):
        print(f"{name:26} {1 / each:7.1f} decisions/s; 20 seeds of 4,000 decisions: {20 * 4000 * each / 60:.1f} min")
    figures = {
        "ratio": theirs / few / together,
        "ratio_one_thread": theirs / ours,
        "sb3_decisions_per_second": few / theirs,
        "one_thread_decisions_per_second": few / ours,
        "decisions_per_second": 1 / together,
        "dim": options.dim,
        "workers": options.workers,
    }
    print(json.dumps(figures))


def stream(decisions: int, dim: int):
    """Contexts like an encoder's (length about 1, in clusters) and binary rewards that depend on the cluster."""
    generator = np.random.default_rng(0)
    centres = generator.normal(size=(30, dim)) / np.sqrt(dim)
    cluster = generator.integers(30, size=decisions)
    contexts = (centres[cluster] + 0.2 * generator.normal(size=(decisions, dim)) / np.sqrt(dim)).astype(np.float32)
    return contexts, (generator.random((decisions, 2)) < generator.random((30, 2))[cluster]).astype(float)


def sb3(contexts, rewards, seed: int) -> PPO:
    """The paper's settings in SB3's own loop."""
    env = SelectionEnv(table_rounds(contexts, rewards, in_order=True), POLICIES, contexts.shape[1])
    settings = {key: value for key, value in PPOSelector(POLICIES, 2, 0, layers=(2,)).settings.items() if key not in ("layers", "activation")}
    algorithm = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [768, 512, 128, 64, 16]}, seed=seed, device="cpu", **settings)
    return algorithm.learn(len(contexts))


def in_processes(options: argparse.Namespace) -> float:
    """Seconds that the replays of a log take."""
    from osel_sim.analysis.engine import Setup, replay
    from osel_sim.analysis.log import read_log
    from osel_sim.context.cache import ContextCache
    from osel_sim.formats.rollout_log import Row, write_rollouts
    from osel_sim.selection.reward import RewardWeights

    contexts, rewards = stream(options.decisions, options.dim)
    with TemporaryDirectory() as name:
        folder = Path(name)
        cache = ContextCache(folder, autosave=0)
        rows = []
        plain = {
            "task": "t",
            "seed": None,
            "level": None,
            "split": "test",
            "instruction": "",
            "phrasing": "",
            "target": "",
            "container": "",
            "repeat": 0,
        }
        plain |= {"repeat": 0, "upload": 0.0, "inference": 0.0, "download": 0.0, "motion": 1.0, "calls": 1, "actions": 1, "price": 0.0, "steps": 1}
        for index in range(options.decisions):
            cache.put("made_up@1", f"{index}", contexts[index])
            for column, policy in enumerate(POLICIES):
                won = bool(rewards[index, column])
                rows.append(Row(**plain, instance=f"{index}", policy=policy, success=won, subgoals=float(won), fallback=None, error=None))
        cache.save()
        write_rollouts(folder, rows, {"encoder": "made_up@1"})
        log = read_log(folder)

    return timed(lambda: replay(log, [Setup(RewardWeights(0.0, 0.0))], ["ppo"], range(options.seeds), options.decisions, options.workers))


def timed(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
