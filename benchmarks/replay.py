"""How quick replays are: PPO against SB3's own loop, what bounds it, `auto`, and all of a replay by its stages.

    python benchmarks/replay.py [--parts ppo bound auto whole] [--decisions 1000] [--sb3-seeds 2] [--seeds 20] [--workers 2] [--log assets/logs/suite]

- `ppo`: both sides make the same decisions on the same contexts and rewards, one seed after another, one thread each, SB3's `learn()` and ours in
  turn, less the time of five decisions, which is that of making the networks; then ours for all seeds in `--workers` processes, starting them
  included, as `python -m osel_sim.replay` does it. What 20 seeds of 4,000 decisions would take is extrapolated from the time a decision.
- `bound`: one epoch of PPO's training on a rollout beside just reading and writing as much memory as its weights and moments are.
- `auto`: one seed of the score half of `--log`, one thread.
- `whole`: `python -m osel_sim.replay --log ... --half score` with every selector, until the first verdict, until all selectors, until the frontier.

Seconds are for an idle machine. On a busy one look at the CPU seconds, which are those of all processes together: two idle cores take half as long.
The last line is JSON: ratio (one SB3 loop to our processes), ratio_one_thread, decisions a second of each, epoch_ms, memory_ms,
auto_decisions_per_second, and of each stage its seconds and cpu_seconds, from the beginning on.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from osel_sim.analysis.engine import replay_one
from osel_sim.analysis.one_thread import one_thread

POLICIES = ("local", "remote")
PARTS = ("ppo", "bound", "auto", "whole")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure (default: all)")
    parser.add_argument("--dim", type=int, default=256, help="length of a context (default: %(default)s, osel_small's)")
    parser.add_argument("--decisions", type=int, default=1000, help="of a stream of PPO's (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=20, help="streams (default: %(default)s)")
    parser.add_argument("--sb3-seeds", type=int, default=2, help="the first so many of them one after another, with SB3 (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes of our side (default: %(default)s)")
    parser.add_argument("--log", type=Path, default=Path("assets/logs/suite"), help="rollout log (default: %(default)s)")
    options = parser.parse_args()
    measures = {"ppo": measure_ppo, "bound": measure_bound, "auto": measure_auto, "whole": measure_whole}
    figures: dict[str, Any] = {"dim": options.dim, "workers": options.workers, "seeds": options.seeds}
    for part in options.parts:
        figures |= measures[part](options)
    print(json.dumps(figures))


def measure_ppo(options: argparse.Namespace) -> dict[str, float]:
    """PPO against SB3's loop."""
    contexts, rewards = stream(options.decisions, options.dim)
    replay_one("ppo", contexts[:10], rewards[:10], POLICIES, 0)  # compile
    sb3(contexts[:10], rewards[:10], 0)
    theirs = ours = 0.0
    with one_thread():
        for seed in range(options.sb3_seeds):
            theirs += own_time(partial(sb3, contexts, rewards, seed)) - own_time(partial(sb3, contexts[:5], rewards[:5], seed))
            ours += own_time(partial(replay_one, "ppo", contexts, rewards, POLICIES, seed))
            ours -= own_time(partial(replay_one, "ppo", contexts[:5], rewards[:5], POLICIES, seed))
    few, all_seeds = options.sb3_seeds * options.decisions, options.seeds * options.decisions
    together = in_processes(options) / all_seeds if options.workers > 1 else ours / few
    print(
        f"PPO: contexts of {options.dim} numbers, {options.decisions} decisions, {options.seeds} seeds, {options.sb3_seeds} of them one after another"
    )
    for name, each in (
        ("SB3's learn(), one thread", theirs / few),
        ("ours, one thread", ours / few),
        (f"ours, {options.workers} processes", together),
    ):
        print(f"{name:26} {1 / each:7.1f} decisions/s; 20 seeds of 4,000 decisions: {20 * 4000 * each / 60:.1f} min")
    return {
        "ratio": theirs / few / together,
        "ratio_one_thread": theirs / ours,
        "sb3_decisions_per_second": few / theirs,
        "one_thread_decisions_per_second": few / ours,
        "decisions_per_second": 1 / together,
    }


def measure_bound(options: argparse.Namespace) -> dict[str, float]:
    """One epoch on a rollout, and one pass over memory of the size of what it changes: the least of some hundred, in turn."""
    from osel_sim.core.compiled import njit
    from osel_sim.selection.ppo.compiled import FastPPO
    from osel_sim.selection.registry import make_selector

    @njit(fastmath=True)
    def touch(weights, first, second):  # type: ignore[no-untyped-def]
        for j in range(len(weights)):
            weights[j] = np.float32(1.0001) * weights[j]
            first[j] = np.float32(0.9999) * first[j]
            second[j] = np.float32(0.9999) * second[j]

    contexts, rewards = stream(5, options.dim)
    selector = make_selector("ppo", POLICIES, options.dim, 0, target_kl=None)
    network = FastPPO(selector)
    towers = [network.actor[:3], network.critic[:3]]
    epochs, memory = [], []
    for _ in range(40):
        epochs.append(own_time(partial(FastPPO(selector).run, contexts, rewards)) / 10)
        memory.append(own_time(lambda: [touch(*tower) for tower in towers]))
    size = sum(array.nbytes for tower in towers for array in tower)
    epoch, pass_over = min(epochs[1:]), min(memory[1:])
    print(f"one epoch of PPO on a rollout: {1e3 * epoch:.2f} ms; reading and writing its {size / 1e6:.0f} MB once: {1e3 * pass_over:.2f} ms")
    return {"epoch_ms": 1e3 * epoch, "memory_ms": 1e3 * pass_over}


def measure_auto(options: argparse.Namespace) -> dict[str, float]:
    """`auto` on the policies of a log."""
    from osel_sim.analysis.log import read_log
    from osel_sim.analysis.streams import complete_instances, draw_streams
    from osel_sim.selection.reward import RewardWeights

    weights = RewardWeights(0.2, 0.01)
    log = read_log(options.log)
    log, _ = complete_instances(log.take(log.half("score")), weights)
    streams = draw_streams(log.rewards(weights), [0])
    contexts, rewards = log.contexts[streams.order[0]], streams.rewards(log.rewards(weights), 0)
    told = {"expected_costs": log.expected_costs(weights)} | ({} if log.skills is None else {"skills": log.skills})
    with one_thread():
        replay_one("auto", contexts[:50], rewards[:50], log.policies, 0, **told)
        seconds = own_time(lambda: replay_one("auto", contexts, rewards, log.policies, 0, **told))
    print(f"auto: {len(log) / seconds:.0f} decisions/s, {len(log)} of them between {len(log.policies)} policies")
    return {"auto_decisions_per_second": len(log) / seconds}


def measure_whole(options: argparse.Namespace) -> dict[str, float]:
    """All of a replay, by its stages."""
    import psutil

    from osel_sim.api.replay import replay
    from osel_sim.api.results import ReplayResult

    process, figures, begun = psutil.Process(), dict[str, float](), time.perf_counter()

    def cpu() -> float:
        running = [child.cpu_times() for child in process.children(recursive=True)]
        own = process.cpu_times()
        return float(sum(times.user + times.system for times in running) + own.user + own.system + own.children_user + own.children_system)

    before = cpu()

    def tell(result: ReplayResult) -> None:
        stage = "verdict" if len(result.pending) > 1 else "selectors" if result.pending else "everything"
        figures[f"{stage}_seconds"], figures[f"{stage}_cpu_seconds"] = time.perf_counter() - begun, cpu() - before
        print(f"{stage} after {figures[f'{stage}_seconds']:.0f} s, {figures[f'{stage}_cpu_seconds']:.0f} CPU s", flush=True)

    with TemporaryDirectory() as folder:
        replay(options.log, half="score", seeds=options.seeds, workers=options.workers, out=Path(folder) / "replay", on_result=tell)
    return figures


def stream(decisions: int, dim: int):
    """Contexts like an encoder's (length about 1, in clusters) and binary rewards that depend on the cluster."""
    generator = np.random.default_rng(0)
    centres = generator.normal(size=(30, dim)) / np.sqrt(dim)
    cluster = generator.integers(30, size=decisions)
    contexts = (centres[cluster] + 0.2 * generator.normal(size=(decisions, dim)) / np.sqrt(dim)).astype(np.float32)
    return contexts, (generator.random((decisions, 2)) < generator.random((30, 2))[cluster]).astype(float)


def sb3(contexts, rewards, seed: int):
    """The paper's settings in SB3's own loop."""
    from stable_baselines3 import PPO

    from osel_sim.selection.environment import SelectionEnv, table_rounds
    from osel_sim.selection.ppo.sb3 import PPOSelector

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


def timed(function: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    start = clock()
    function()
    return clock() - start


def own_time(function: Callable[[], object]) -> float:
    """CPU seconds of this process, one thread of which works: what others do on the machine counts little."""
    return timed(function, time.process_time)


if __name__ == "__main__":
    main()
