"""A log with moments whose answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from synthetic_log import make_row

from osel_sim.context.cache import ContextCache
from osel_sim.formats.moments import SIGNALS, MomentRow, Seen, write_moments
from osel_sim.formats.rollout_log import write_rollouts

POLICIES = ("local", "remote")
CALLS, STEPS = (4, 8), 100
ENCODER = "made_up@1"


def stuck_log(folder: Path, instances: int = 160, repeats: int = 2, seen: bool = True, seed: int = 0) -> Path:
    """The local policy is stuck in 40% of the episodes, which pictures show (not with `seen` off), and then fails unless the remote one takes over
    before call 4; before call 8 it is too late. Otherwise it succeeds, and so does the remote one, for 20 cents an episode."""
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    rows, moments, pictures, cache = [], list[MomentRow](), [], ContextCache(folder, autosave=0)
    for number in range(instances):
        key = f"task/test/0/{number}"
        cache.put(ENCODER, key, random.normal(size=6).astype(np.float32))
        for first, policy in enumerate(POLICIES):
            for repeat in range(repeats):
                stuck = first == 0 and bool(random.random() < 0.4)
                price = 20.0 * first
                about = {"task": "task", "seed": number, "steps": STEPS, "motion": STEPS / 20.0, "price": price, "calls": 12, "actions": STEPS}
                rows.append(make_row(key, policy, repeat, not stuck, **about))
                for call in CALLS:
                    pictures.append(random.normal(size=8) + np.array([3.0 if stuck == (first == 0) and seen else 0.0] + [0.0] * 7))
                    moments += _ways(key, first, repeat, call, stuck)
    write_rollouts(folder, rows, {"encoder": ENCODER, "policies": list(POLICIES)})
    cache.save()
    about = {"policies": list(POLICIES), "remote": ["remote"], "encoder": ENCODER, "every": 4, "most": 2}
    write_moments(folder, moments, Seen(np.array(pictures, np.float32), np.zeros((len(pictures), len(SIGNALS)))), about)
    return folder


def _ways(key: str, first: int, repeat: int, call: int, stuck: bool) -> list[MomentRow]:
    """Going on, and handing over."""
    step, price = call * 8, 20.0 * first
    going_on = MomentRow(
        key, POLICIES[first], repeat, call, step, None, not stuck, float(not stuck), STEPS, 0.0, 0.0, 0.0, STEPS / 20.0, 12, STEPS, price, price,
        STEPS * first,
    )  # fmt: skip
    if first:
        handed = replace(going_on, second="local", price=0.2 * step, price_first=0.2 * step, remote_steps=step)
    else:
        won = not stuck or call == CALLS[0]
        handed = replace(going_on, second="remote", success=won, subgoals=float(won), price=10.0, remote_steps=STEPS - step)
    return [going_on, handed]
