"""The figure of who drove when: a row an episode, in the colours of the policies."""

from collections.abc import Sequence
from dataclasses import dataclass

import altair as alt

from osel_sim.reporting.charts import SHOWN, Figure, Look, panel
from osel_sim.reporting.palette import LIGHT, colours


@dataclass(frozen=True)
class Part:
    """One policy drove from a control step to another."""

    policy: str
    start: int
    end: int


@dataclass(frozen=True)
class Drive:
    """An episode.

    Attributes:
        about: its tooltip.
        solved: None for an error, which is neither.
        parts: who drove, in order; at least one.
    """

    task: str
    about: str
    solved: bool | None
    parts: tuple[Part, ...]


def parts_of(first: str, handoffs: Sequence[tuple[int, str]], steps: int) -> tuple[Part, ...]:
    """Who drove an episode.

    Args:
        first: the policy that began.
        handoffs: control step and new policy of each, in order.
        steps: of the episode.
    """
    at = [0, *(step for step, _ in handoffs), steps]
    drivers = [first, *(to for _, to in handoffs)]
    return tuple(Part(policy, start, end) for policy, start, end in zip(drivers, at[:-1], at[1:], strict=True))


def who_drove(drives: Sequence[Drive], policies: Sequence[str], caption: str) -> Figure:
    """The figure.

    Args:
        drives: in the order of its rows.
        policies: of the whole page, so that each has its colour there.
        caption: what the episodes are; what the marks mean is added.
    """
    records = []
    for number, one in enumerate(drives):
        solved = {True: "\u2713", False: "\u2717", None: "error"}[one.solved]
        own = {"episode": number, "task": one.task, "about": one.about, "solved": solved}
        for part in one.parts:
            records.append(own | {"name": part.policy, "from": part.start, "to": part.end, "last": part is one.parts[-1]})
    drove = (part.policy for one in drives for part in one.parts)  # a merge may take over that the selector does not choose
    look = Look(colours(list(dict.fromkeys([*policies, *drove]))))
    base = alt.Chart(alt.InlineData(values=records)).transform_filter(SHOWN)
    y = alt.Y("episode:O", title=None, axis=alt.Axis(labels=False, ticks=False, domain=False, grid=False))
    told = [alt.Tooltip("about:N", title="episode"), alt.Tooltip("name:N", title="drives"), alt.Tooltip("from:Q"), alt.Tooltip("to:Q")]
    bars = base.mark_bar(height=7).encode(x=alt.X("from:Q", title="control step"), x2="to:Q", y=y, color=look.color(symbol="square"), tooltip=told)
    marks = base.transform_filter("datum.last").mark_text(align="left", dx=4, fontSize=9, color=LIGHT["muted"]).encode(x="to:Q", y=y, text="solved:N")
    words = (
        base.transform_filter("datum.from == 0")
        .mark_text(align="left", dx=3, fontSize=7, color=LIGHT["surface"])
        .encode(x=alt.value(0), y=y, text="task:N")
    )
    return Figure(
        "timeline",
        "Who drove",
        f"{caption} \u2713 solved, \u2717 not.",
        f"Rows of {len(drives)} episodes in the colours of who drove.",
        [panel("", 9 * max(len(drives), 1), bars, marks, words)],
    )
