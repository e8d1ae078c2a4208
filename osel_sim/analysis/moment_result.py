"""What a table of moments says: start selectors and monitors compared, at equal duty, against oracles, and whether to hand over."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.equal_duty import blind_arms, random_arm
from osel_sim.analysis.estimate import Estimate, mean_of
from osel_sim.analysis.handovers import Handovers, never
from osel_sim.analysis.log import Array
from osel_sim.analysis.moment_arms import FIXED, Part, Starts, Values, values_of
from osel_sim.analysis.moment_log import MomentLog
from osel_sim.analysis.moment_oracles import Oracles, gains_at, oracles_of
from osel_sim.analysis.moment_timeline import timeline
from osel_sim.analysis.moment_verdict import verdict
from osel_sim.analysis.units import units_of
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.paired import holm, sign_flip_midp

NEVER = "never"
FEWEST, SMALL = 10, 0.005
"""A share of the gap to an oracle needs so many instances with repeats, and a gap that is larger."""
BLIND = "blind"
"""Monitors that do not look; their duty is nobody's to match."""


@dataclass(frozen=True)
class Question:
    """What is compared.

    Attributes:
        starts: how first policies are chosen.
        part: which instances are scored, and by which others is learned.
        margin: a gain in reward that is not worth a monitor.
    """

    starts: Starts
    part: Part
    margin: float


def study(log: MomentLog, weights: RewardWeights, monitors: Mapping[str, Handovers], question: Question) -> dict[str, Any]:
    """Everything that `moments.json` holds.

    Args:
        monitors: name -> handovers (N, P, R, M, P), of the scored instances; `never` is added.
    """
    scored = question.part.scored
    monitors = {NEVER: never(log), **monitors}
    units = units_of(log.whole)[scored]
    arms: list[dict[str, Any]] = []
    values: dict[tuple[str, str], Values] = {}
    for name, handovers in monitors.items():
        starts = question.starts.fixed(log) | question.starts.chosen(log, handovers, weights, question.part)
        for start, share in starts.items():
            values[start, name] = found = _scored(values_of(log, share, handovers, weights), scored)
            arms.append({"start": start, "monitor": name, **_measured(found, units)})
    here = log.take(scored)
    for arm in arms:
        own, alone = values[arm["start"], arm["monitor"]], values[arm["start"], NEVER]
        if arm["monitor"] != NEVER:
            arm |= _against(own, alone, units)
            if not arm["monitor"].startswith(BLIND):
                arm["equal_duty"] = _equal_duty(here, arm, own, weights, units)
    _correct(arms)
    found_oracles = oracles_of(here, weights)
    result = {
        "policies": list(log.policies),
        "remote": [name for name, remote in zip(log.policies, log.remote, strict=True) if remote],
        "calls": list(log.calls),
        "instances": int(scored.sum()),
        "learned_from": int(question.part.shown.sum()),
        "seeds": len(question.starts.seeds),
        "reward": asdict(weights),
        "margin": question.margin,
        "arms": arms,
        "oracles": _oracles(log, found_oracles, arms, values),
        "gains": [asdict(gain) for gain in gains_at(here, weights, units)],
    }
    result["verdict"] = said = verdict(result)
    shown = said["monitor"] or NEVER
    result["timeline"] = timeline(here, values[said["start"], shown].share, monitors[shown][scored])
    return result


def _scored(values: Values, scored: NDArray[np.bool_]) -> Values:
    measures = {name: own[scored] for name, own in values.measures.items()}
    rest = {name: getattr(values, name)[scored] for name in ("share", "reward", "lost", "recovered", "won", "harmed")}
    return Values(measures=measures, **rest)


def _measured(values: Values, units: NDArray[np.int64]) -> dict[str, Any]:
    """One arm's numbers."""
    steps = float(np.nansum(values.measures["steps"]))
    return {
        "reward": _json(mean_of(values.reward, units)),
        "success": _json(mean_of(values.measures["success"], units)),
        "price": _json(mean_of(values.measures["price"], units)),
        "seconds": _json(mean_of(values.measures["seconds"], units)),
        "duty": float(np.nansum(values.measures["remote_steps"])) / steps if steps else 0.0,
        "recovered": _ratio(values.recovered, values.lost),
        "harmed": _ratio(values.harmed, values.won),
        "first": np.nanmean(values.share, axis=0).tolist(),
    }


def _against(own: Values, alone: Values, units: NDArray[np.int64]) -> dict[str, Any]:
    """An arm against the same start without a monitor, paired over instances."""
    success = own.measures["success"] - alone.measures["success"]
    known = success[np.isfinite(success)]
    apart = own.reward - alone.reward
    reward = apart[np.isfinite(apart)]
    return {
        "gain": _json(mean_of(apart, units)),
        "gain_success": _json(mean_of(success, units)),
        "gain_price": _json(mean_of(own.measures["price"] - alone.measures["price"], units)),
        "p": sign_flip_midp(known) if known.size else 1.0,
        "p_reward": sign_flip_midp(reward) if reward.size else 1.0,
        "gained_instances": int((known > 1e-9).sum()),
        "lost_instances": int((known < -1e-9).sum()),
    }


def _correct(arms: Sequence[dict[str, Any]]) -> None:
    """Holm's correction of the tests of each start selector, those of success and those of reward."""
    for start in dict.fromkeys(arm["start"] for arm in arms):
        own = [arm for arm in arms if arm["start"] == start and "p" in arm]
        for name in ("p", "p_reward"):
            for arm, corrected in zip(own, holm([arm[name] for arm in own]), strict=True):
                arm[f"{name}_holm"] = corrected


def _equal_duty(here: MomentLog, arm: Mapping[str, Any], own: Values, weights: RewardWeights, units: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Blind and random handovers from the same starts at the monitor's duty, on the scored instances."""
    chance = random_arm(here, arm["duty"], own.share)
    result = []
    for other in [*blind_arms(here, arm["duty"], own.share), *([] if chance is None else [chance])]:
        values = values_of(here, own.share, other.handovers, weights)
        result.append({"name": other.name, **_measured(values, units), "ahead": _json(mean_of(own.reward - values.reward, units))})
    return result


def _oracles(log: MomentLog, found: Oracles, arms: Sequence[dict[str, Any]], values: Mapping[tuple[str, str], Values]) -> dict[str, Any] | None:
    """Oracles on the scored instances with repeats, and how far each arm comes from the best single policy to them; None without repeats."""
    if not found.repeated.any():
        return None
    rows = found.repeated
    single = max((arm["start"] for arm in arms if arm["start"].startswith(FIXED)), key=lambda start: float(np.nanmean(values[start, NEVER].reward)))
    base = values[single, NEVER].reward[rows]
    gap = _json(mean_of(found.when[rows] - base))
    for arm in arms:
        own = values[arm["start"], arm["monitor"]].reward[rows]
        arm["of_gap"] = _share(own, base, found.when[rows])
        arm["over_once"] = _json(mean_of(own - found.once[rows]))
    names = log.policies
    chosen = {
        names[first] if at < 0 else f"{names[first]}, {names[second]} before call {log.calls[at]}": count
        for (first, at, second), count in sorted(found.chosen.items(), key=lambda item: -item[1])
    }
    return {
        "instances": int(rows.sum()),
        "single": single.removeprefix(FIXED),
        "single_reward": float(np.nanmean(base)),
        "once": _json(mean_of(found.once[rows])),
        "when": _json(mean_of(found.when[rows])),
        "when_over_once": _json(mean_of(found.when[rows] - found.once[rows])),
        "gap": gap,
        "hindsight_once": float(np.nanmean(found.hindsight_once)),
        "hindsight_when": float(np.nanmean(found.hindsight_when)),
        "chosen": chosen,
    }


def _share(own: Array, base: Array, oracle: Array) -> float | None:
    """Share of the gap from the best single policy to an oracle; None where there is no gap to speak of."""
    gap = float(np.nanmean(oracle - base))
    return float(np.nanmean(own - base)) / gap if gap > SMALL and len(oracle) >= FEWEST else None


def _ratio(part: Array, whole: Array) -> float | None:
    total = float(np.nansum(whole))
    return float(np.nansum(part)) / total if total > 1e-9 else None


def _json(estimate: Estimate | None) -> list[float] | None:
    """Value, low and high."""
    return None if estimate is None else [estimate.value, estimate.low, estimate.high]
