"""A rollout log, a live run and a replay to report on, small and with words in them that must not become HTML."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from synthetic_log import make_row, write_log

from osel_sim.analysis.log import LoggedOutcomes, read_log
from osel_sim.analysis.oracles import oracles
from osel_sim.analysis.result import build, tables, with_fixed
from osel_sim.analysis.streams import complete_instances
from osel_sim.context.cache import ContextCache
from osel_sim.formats.journal import Decision, Lines
from osel_sim.formats.replay_result import Choices, write_replay
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.selection.reward import RewardWeights, reward

EVIL = "</script><script>window.pwned = 1</script><img src=x onerror='window.pwned = 1'> $x_1$ & <b>bold</b>"
WEIGHTS = RewardWeights(0.1, 0.01)
NEAR, FAR = "near", "far<i>"
RATES = {"mug": (0.9, 0.95), "pan": (0.1, 0.9), "cup": (0.8, 0.2)}
"""Object -> success rates of the local and of the remote policy."""


def made_log(folder: Path, instances: int = 120, repeats: int = 1) -> LoggedOutcomes:
    """Three objects that the context tells apart; the local policy is free, the remote one better on two of them and paid."""
    generator = np.random.default_rng(5)
    rows, contexts = [], {}
    for number in range(instances):
        target = list(RATES)[number % 3]
        key = f"{'kitchen' if number % 2 else 'table'}/test/0/{number}"
        about = {"task": key.partition("/")[0], "seed": number, "target": target, "container": "box", "phrasing": f"train-{number % 4}"}
        about["instruction"] = EVIL if number == 0 else f"put the {target} away, please {number}"
        contexts[key] = 3.0 * np.eye(8)[number % 3] + 0.1 * generator.normal(size=8)
        for policy, rate in zip((NEAR, FAR), RATES[target], strict=True):
            for repeat in range(repeats):
                remote = {"upload": 0.2, "download": 0.1, "price": 4.0} if policy == FAR else {}
                success = bool(generator.random() < rate)
                values = {"motion": float(generator.uniform(2, 6)), "inference": 0.4, "fallback": "deadline" if number == 7 else None}
                rows.append(make_row(key, policy, repeat, success, **about, **values, **remote))
    return read_log(write_log(folder, rows, contexts))


def made_replay(folder: Path, log: LoggedOutcomes, seeds: int = 3) -> Path:
    """A replay of two made-up selectors: one that learns what each object wants, and one that never does."""
    complete, left_out = complete_instances(log, WEIGHTS)
    generator = np.random.default_rng(1)
    order = np.stack([generator.permutation(len(complete)) for _ in range(seeds)]).astype(np.int32)
    wants = np.array([int(RATES[target][1] - 0.1 > RATES[target][0]) for target in complete.labels("target")], np.int8)
    coin = generator.integers(2, size=order.shape).astype(np.int8)
    late = np.arange(order.shape[1]) > 30
    chosen = {"ppo": np.where(late, wants[order], coin).astype(np.int8), "random": coin}
    choices = Choices(complete.keys, complete.policies, order, np.zeros((*order.shape, 2), np.int16), chosen)
    best = oracles(complete, WEIGHTS)
    choices = with_fixed(choices, best)
    result = build(complete, WEIGHTS, None, choices, best, left_out, range(seeds))
    slow, cheap = {"score": [0.9, 0.8, None], "seconds": [5.0, 4.0, None], "price": [3.0, 2.0, None]}, {"score": [0.7, 0.6, 0.5]}
    cheap |= {"seconds": [6.0, 6.0, 6.0], "price": [2.0, 1.0, 0.0]}
    result["frontier"] = {"seeds": 1, "decisions": len(complete)} | {
        axis: {"weights": [0.0, 0.1, 1.0], "selectors": {"ppo": entry}} for axis, entry in (("alpha_time", slow), ("alpha_price", cheap))
    }
    write_replay(folder, result, choices, tables(result))
    return folder


def made_run(folder: Path, decisions: int = 40, counterfactual: bool = True) -> Path:
    """The files that a live run leaves, with one decision that ended in error."""
    folder.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(2)
    journal, others = Lines(folder / "episodes.jsonl"), Lines(folder / "counterfactual.jsonl") if counterfactual else None
    cache = ContextCache(folder, autosave=0)
    for index in range(decisions):
        cache.put("made_up@1", f"table/test/0/{index}", generator.normal(size=6).astype(np.float32))
        outcomes = {policy: _outcome(generator, policy == FAR) for policy in (NEAR, FAR)}
        chosen = FAR if generator.random() < 0.6 else NEAR
        if index == 3:
            outcomes[chosen] |= {"error": "the server died <b>"}
        own = outcomes.pop(chosen)
        about = {
            "task": "table",
            "seed": index,
            "axes": None,
            "phrasing": "train-0",
            "target": "",
            "container": "",
            "level": 0,
            "split": "test",
            "instruction": EVIL if index == 0 else f"do {index}",
        }
        propensities = {NEAR: 0.4, FAR: 0.6}
        decision = Decision(index=index, policy=chosen, propensities=propensities, reward=None, **about, **own)
        value = None if decision.error else reward(decision.outcome, WEIGHTS)
        journal.append(asdict(decision) | {"reward": value})
        if others is not None:
            row = {
                name: {**other, "seconds": vars(other["seconds"]), "reward": reward(Outcome(**other), WEIGHTS)} for name, other in outcomes.items()
            }
            others.append({"index": index, "policies": row})
    cache.save()
    for lines in (journal, others):
        if lines is not None:
            lines.close()
    configuration = {"task": "table", "policies": [NEAR, FAR], "selector": "ppo", "seed": 0, "reward": asdict(WEIGHTS), "encoder": "made_up@1"}
    (folder / "run.json").write_text(json.dumps({"schema_version": 1, "configuration": configuration, "environment": {"versions": {}}}))
    return folder


def _outcome(generator: np.random.Generator, remote: bool) -> dict:
    seconds = Seconds(0.2 * remote, 0.3, 0.1 * remote, float(generator.uniform(2, 6)))
    success = bool(generator.random() < (0.8 if remote else 0.5))
    plain = {"success": success, "subgoals": float(success), "steps": 40, "calls": 2, "actions": 30, "price": 4.0 * remote}
    return {**plain, "seconds": seconds, "fallback": None, "error": None}
