"""The verdict as a page shows it."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from osel_sim.reporting.page import Tile, Verdict

TONES: Mapping[str, Literal["good", "neutral"]] = {"route": "good", "do_not_route": "neutral", "not_enough_data": "neutral"}


def gain_tiles(found: Mapping[str, Any]) -> list[Tile]:
    """What the selector has over the best single policy; none where no selector was tested.

    Args:
        found: as `osel_sim.analysis.verdict.verdict` returns it.
    """
    stake = found["stake"]
    if not stake.get("selector"):
        return []
    return [
        Tile(f"{stake['selector']} over it", _signed(stake["gain"]), f"reward a decision, {_between(stake['gain_bounds'])}"),
        Tile("in the last quarter", _signed(stake["gain_late"]), f"reward a decision, once it has learned, {_between(stake['gain_late_bounds'])}"),
    ]


def shown_verdict(found: Mapping[str, Any], first: Sequence[str] = (), tiles: Sequence[Tile] = ()) -> Verdict:
    """The verdict of a log or a run that was replayed for its page.

    Args:
        found: as `osel_sim.analysis.answer.answer` returns it.
        first: sentences that stand before its own, as one paragraph.
        tiles: that stand before its own.
    """
    how = f"Found by showing its instances to {found['stake']['selector']} in {found['orders']} random orders, as osel_sim.replay does."
    *own, last = found["sentences"]
    paragraphs = [*([" ".join(first)] if first else []), *own, f"{last} {how}"]
    return Verdict(found["headline"], paragraphs, [*tiles, *gain_tiles(found)], TONES[found["decision"]])


def _between(ends: Sequence[float | None]) -> str:
    return "too few to say more" if None in ends else f"bounds [{ends[0]:.3f}, {ends[1]:.3f}]".replace("-", "\u2212")


def _signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "\u2212")
