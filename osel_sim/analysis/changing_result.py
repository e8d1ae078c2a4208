"""What a replay of changing streams came to: around each change, against a selector that began anew there and against one that knew."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.changing_replay import NOBODY, WAYS, ChangingLog, Way
from osel_sim.analysis.log import Array, mean_over_repeats
from osel_sim.analysis.oracles import predictable_oracle
from osel_sim.analysis.stream_changes import Span
from osel_sim.analysis.streamed import Units, over_units
from osel_sim.analysis.streams import LeftOut
from osel_sim.analysis.units import units_of
from osel_sim.formats.replay_result import CHANGES, CHANGING_VERSION, Choices
from osel_sim.selection.registry import is_recommended

SOON = 200
"""What comes right after a change is counted over so many decisions, or up to the next change."""
LATELY = 25
"""A policy's share is looked at over so many decisions, and all seeds; likewise the reward, in curves."""
FAIR = 0.5
"""A newcomer has its fair share when it has this part of what it has in the end under the selector that knew."""
POINTS = 120
"""Of a curve."""

Chosen = Mapping[Way, NDArray[np.int16]]


def build_changes(
    material: ChangingLog, chosen: Mapping[str, Chosen], left_out: LeftOut, preset: str | None, folder: Mapping[str, Any]
) -> tuple[dict[str, Any], Choices]:
    """What `replay.json` and `choices.npz` hold of a replay whose streams change.

    Args:
        chosen: as `replay_changing` gives it.
        folder: more about the log.

    Returns:
        log, reward, seeds, decisions, selectors (what each received over the whole stream), oracles (none: they differ from span to span), verdict
        (its headline and sentences), and `changes`: window, lately, fair, events, spans (from, to, changes in words, policies, best_single, oracle,
        always: policy -> mean reward), selectors: name -> spans (of each after a change: for every way mean reward, success, cents and shares, and
        the differences soon after the change and over all of it) and newcomers; and curves.
    """
    units, spans = units_of(material.log), material.timeline.spans
    tables = {span.start: material.means(span) for span in spans}
    oracle = {span.start: _oracle(material, span, tables[span.start]) for span in spans}
    about = [_about(material, span, tables[span.start], oracle[span.start]) for span in spans]
    found = {name: _selector(material, ways, tables, oracle, units) for name, ways in chosen.items()}
    log = material.log
    through = {name: ways["through"] for name, ways in chosen.items()}
    choices = Choices(log.keys, log.policies, material.streams.order, material.streams.repeats, through)
    result = {
        "schema_version": CHANGING_VERSION,
        "log": {
            **{"folder": str(log.source), "tasks": sorted(set(log.labels("task"))), "instances": len(log), "units": int(units.max()) + 1},
            **{"left_out": asdict(left_out), "policies": list(log.policies), "repeats": log.repeats, "encoder": log.encoder, **folder},
        },
        "reward": {"preset": preset, **asdict(material.setup.weights)},
        "seeds": list(material.seeds),
        "decisions": material.timeline.decisions,
        "selectors": {name: _whole(material, ways, tables, units) | _kind(name) for name, ways in chosen.items()},
        **{"oracles": {}, "paired": [], "frontier": None},
        CHANGES: {
            **{"window": SOON, "lately": LATELY, "fair": FAIR},
            "events": [asdict(change) | {"words": change.words} for change in material.timeline.changes],
            "spans": about,
            "selectors": found,
            "curves": {name: _curves(material, ways, tables) for name, ways in chosen.items()},
        },
    }
    return result | {"verdict": verdict(result)}, choices


def verdict(result: Mapping[str, Any]) -> dict[str, Any]:
    """In words, of the selector that we recommend where it is there, else of the one that received most."""
    entries = result["selectors"]
    if not entries:
        return {"headline": "No selector was replayed", "sentences": [], "text": "No selector was replayed.", "selector": None}
    name = next((name for name in entries if is_recommended(name)), None) or max(entries, key=lambda name: float(entries[name]["mean_reward"]))
    own, sentences = result[CHANGES]["selectors"][name], list[str]()
    for entry in own["spans"]:
        soon = entry["soon"]
        knew, afresh = (f"{soon[key]['mean']:+.3f}{_ends_words(soon[key]['ci95'])}" for key in ("against_knew", "against_afresh"))
        since = f"In the {soon['decisions']} decisions after {' and '.join(entry['changes'])}"
        against = f"{knew} against one that knew, {afresh} against one begun afresh"
        sentences.append(f"{since}, {name} receives {soon['mean_reward']:.3f} a decision: {against}.")
    arrivals = [_arrival(name, newcomer) for newcomer in own["newcomers"]]
    headline = arrivals[0] if arrivals else f"{name} receives {entries[name]['mean_reward']:.3f} a decision in streams that change"
    sentences = [f"{words}." for words in arrivals[1:]] + sentences
    return {"headline": headline, "sentences": sentences, "text": " ".join([f"{headline}.", *sentences]), "selector": name}


def _arrival(name: str, newcomer: Mapping[str, Any]) -> str:
    policy, share, after = newcomer["policy"], newcomer["late_share"], newcomer["decisions"]
    if share <= 0.0:
        return f"{name} would not choose {policy} had it known it from the beginning, so there is no fair share for it"
    fair = f"its fair share, {100 * FAIR * share:.0f}% of the decisions"
    if after["through"] is None:
        return f"{name} does not give {policy} {fair}, in the {newcomer['of']} after it joins"
    soon = f"{after['through']} decisions after it joins" if after["through"] else "as soon as it joins"
    began = {None: f"not in the {newcomer['of']} that there are", 0: "at once"}.get(after["afresh"], f"after {after['afresh']}")
    return f"{name} gives {policy} {fair}, {soon} (one begun afresh: {began})"


def _ends_words(ends: Sequence[float] | None) -> str:
    return f" [{ends[0]:+.3f}, {ends[1]:+.3f}]" if ends else ""


def _kind(name: str) -> dict[str, str]:
    return {"kind": "random" if name == "random" else "learner"}


def _oracle(material: ChangingLog, span: Span, table: Array) -> Array:
    """(N,) reward of the policy that a router names, trained on all outcomes of other instances, as they are in a span, of the policies there."""
    columns = span.columns
    if len(columns) == 1:
        return np.asarray(table[:, columns[0]], np.float64)
    return predictable_oracle(material.log.only([material.policies[column] for column in columns]), table[:, columns])[0]


def _about(material: ChangingLog, span: Span, table: Array, oracle: Array) -> dict[str, Any]:
    """What could be had in a span, over the instances of all streams in it."""
    order = material.streams.order[:, span.decisions]
    always = {material.policies[column]: float(table[order, column].mean()) for column in span.columns}
    best = max(always, key=lambda policy: always[policy])
    return {
        **{"from": span.start, "to": span.stop, "changes": [change.words for change in span.changes], "policies": list(always)},
        **{"best_single": {"policy": best, "mean_reward": always[best]}, "oracle": float(oracle[order].mean()), "always": always},
    }


def _received(table: Array, order: NDArray[np.int32], chosen: NDArray[np.int16]) -> Array:
    """What was received, (S, n); NaN where nobody decided."""
    values = table[order, np.maximum(chosen, 0).astype(np.int64)]
    return np.where(chosen == NOBODY, np.nan, values)


def _selector(material: ChangingLog, ways: Chosen, tables: Mapping[int, Array], oracle: Mapping[int, Array], units: Units) -> dict[str, Any]:
    spans, newcomers = [], []
    for span in material.timeline.spans[1:]:
        table, order = tables[span.start], material.streams.order[:, span.decisions]
        received = {way: _received(table, order, ways[way][:, span.decisions]) for way in WAYS}
        best = oracle[span.start][order]
        entry: dict[str, Any] = {"from": span.start, "to": span.stop, "changes": [change.words for change in span.changes]}
        for part, decisions in (("soon", min(SOON, span.stop - span.start)), ("whole", span.stop - span.start)):
            until = slice(None, decisions)
            entry[part] = {"decisions": decisions, "mean_reward": float(received["through"][:, until].mean())}
            entry[part] |= {f"mean_reward_{way}": float(received[way][:, until].mean()) for way in WAYS[1:]}
            for key, other in (("against_knew", received["knew"]), ("against_afresh", received["afresh"]), ("against_oracle", best)):
                entry[part][key] = _difference((received["through"] - other)[:, until], order[:, until], units)
        entry["ways"] = {way: _measured(material, span, ways[way][:, span.decisions]) for way in WAYS}
        spans.append(entry)
        newcomers += [_newcomer(material, ways, span, change.policy) for change in span.changes if change.kind == "join"]
    return {"spans": spans, "newcomers": newcomers}


def _difference(values: Array, order: NDArray[np.int32], units: Units) -> dict[str, Any]:
    """Mean of what one received more than another, a decision and in all, with a 95 % interval over units of the former."""
    found = over_units(values, order, units)
    ends = None if found is None or found.units < 2 else list(found.interval())
    return {"mean": float(values.mean()), "ci95": ends, "sum": float(values.sum(axis=1).mean())}


def _measured(material: ChangingLog, span: Span, chosen: NDArray[np.int16]) -> dict[str, Any]:
    """Success, cents and shares of what was chosen in a span."""
    log, order, columns = material.log, material.streams.order[:, span.decisions], np.maximum(chosen, 0).astype(np.int64)
    success = mean_over_repeats(log.success)[order, span.source[columns]]
    price = mean_over_repeats(log.price)[order, columns] * span.factor[columns]
    shares = {policy: float((chosen == column).mean()) for column, policy in enumerate(log.policies) if span.available[column]}
    return {"success_rate": _mean(success), "mean_price": _mean(price), "shares": shares}


def _newcomer(material: ChangingLog, ways: Chosen, span: Span, policy: str) -> dict[str, Any]:
    """How many decisions it took until a policy that joined had its fair share."""
    column, count = material.policies.index(policy), span.stop - span.start
    share = {way: (ways[way][:, span.decisions] == column).mean(axis=0) for way in WAYS}
    late = float((ways["knew"][:, span.decisions][:, 3 * count // 4 :] == column).mean())
    return {
        **{"policy": policy, "at": span.start, "of": count, "late_share": late, "fair_share": FAIR * late},
        "decisions": {way: _until(share[way], FAIR * late) if late > 0.0 else None for way in WAYS},
    }


def _lately(values: Array) -> Array:
    """Mean of the latest so many, or of all where they are fewer, up to each place."""
    sums = np.concatenate([[0.0], values.cumsum()])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - LATELY, 0)
    return np.asarray((sums[ends] - sums[starts]) / (ends - starts), np.float64)


def _until(share: Array, fair: float) -> int | None:
    """Decisions (n,) before the first so many that have a mean share as large."""
    lately = _lately(share)[min(LATELY, len(share)) - 1 :]
    reached = np.flatnonzero(lately >= fair)
    return int(reached[0]) if len(reached) else None


def _whole(material: ChangingLog, ways: Chosen, tables: Mapping[int, Array], units: Units) -> dict[str, Any]:
    """What a selector received over the whole stream."""
    received = _stream(material, ways["through"], tables)
    found = over_units(received, material.streams.order, units)
    parts = [(span, _measured(material, span, ways["through"][:, span.decisions])) for span in material.timeline.spans]
    weights = [(span.stop - span.start) / material.timeline.decisions for span, _ in parts]

    def overall(key: str) -> float | None:
        values = [part[key] for _, part in parts]
        return None if None in values else float(np.dot(values, weights))

    shares = {policy: float((ways["through"] == column).mean()) for column, policy in enumerate(material.policies)}
    ends = None if found is None or found.units < 2 else list(found.interval())
    named = {"success_rate": overall("success_rate"), "mean_price": overall("mean_price"), "shares": shares}
    return {"mean_reward": float(received.mean()), "ci95": ends, **named}


def _stream(material: ChangingLog, chosen: NDArray[np.int16], tables: Mapping[int, Array]) -> Array:
    """What was received in every decision, (S, T)."""
    order = material.streams.order
    parts = [_received(tables[span.start], order[:, span.decisions], chosen[:, span.decisions]) for span in material.timeline.spans]
    return np.concatenate(parts, axis=1)


def _curves(material: ChangingLog, ways: Chosen, tables: Mapping[int, Array]) -> dict[str, Any]:
    """Reward lately of every way, and the share of every policy that joins; None where a way makes no decision."""
    at = np.unique(np.linspace(0, material.timeline.decisions - 1, POINTS).round().astype(np.int64))
    rewards = {way: _smooth(_stream(material, ways[way], tables).mean(axis=0), material) for way in WAYS}
    joined = dict.fromkeys(change.policy for change in material.timeline.changes if change.kind == "join")
    shares = {policy: {way: _smooth(_share(ways[way], material.policies.index(policy)), material) for way in WAYS} for policy in joined}
    return {
        "decision": at.tolist(),
        "reward": {way: _json(values[at]) for way, values in rewards.items()},
        "share": {policy: {way: _json(values[at]) for way, values in own.items()} for policy, own in shares.items()},
    }


def _share(chosen: NDArray[np.int16], column: int) -> Array:
    """(T,) over seeds; NaN where nobody decided."""
    return np.where((chosen == NOBODY).all(axis=0), np.nan, (chosen == column).mean(axis=0))


def _smooth(values: Array, material: ChangingLog) -> Array:
    """Lately, within each span: a change shows at once."""
    return np.concatenate([_lately(values[span.decisions]) for span in material.timeline.spans])


def _json(values: Array) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None
