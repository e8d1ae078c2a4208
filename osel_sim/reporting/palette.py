"""Colours of the report, light and dark. Charts are written in those of the light theme; the page shows each by its name, in either theme.

Policies, and after them selectors, take `c0` to `c17` in their order. The eighteen were chosen by a search for the largest distance (in Oklab, as
seen with normal, protanopic and deuteranopic eyes) from one another, from the outcomes' colours and from ink, at a contrast of 3:1 with the page.
Outcomes have `good`, `bad` and two tints that nothing else has. What is written in `ink`, `muted`, `link`, `good` or `bad` has 4.5:1, WCAG's AA.
"""

from collections.abc import Sequence

LIGHT = {
    **{"ink": "#1c2430", "muted": "#56626d", "grid": "#e1e5ea", "surface": "#ffffff", "raised": "#f6f8fa", "link": "#24508f"},
    **{"good": "#00693f", "bad": "#cf2a45", "good_local": "#3fae7f", "good_remote": "#a8dcc2"},
    **{"c0": "#3a56ba", "c1": "#d07f4d", "c2": "#b64c9b", "c3": "#1d9fbb", "c4": "#687000", "c5": "#7e88fb"},
    **{"c6": "#750f07", "c7": "#a67c1f", "c8": "#10a86b", "c9": "#421b5e", "c10": "#775adb", "c11": "#821e77"},
    **{"c12": "#46512a", "c13": "#213e5b", "c14": "#5f9082", "c15": "#532b30", "c16": "#f85a88", "c17": "#755180"},
}
DARK = {
    **{"ink": "#e8ecf1", "muted": "#9aa6b2", "grid": "#2f3741", "surface": "#171b21", "raised": "#1e242c", "link": "#8fbcff"},
    **{"good": "#84e8b6", "bad": "#ff6f80", "good_local": "#4d9c78", "good_remote": "#2f5d49"},
    **{"c0": "#579dff", "c1": "#fa920e", "c2": "#feb0e6", "c3": "#04deff", "c4": "#d9e604", "c5": "#746df6"},
    **{"c6": "#d74f00", "c7": "#e9c07b", "c8": "#36a064", "c9": "#ad50ce", "c10": "#b8a2e1", "c11": "#9d6e96"},
    **{"c12": "#e1e58d", "c13": "#7091c0", "c14": "#71c6b9", "c15": "#f1a1a2", "c16": "#cb8197", "c17": "#cd76e1"},
}
CATEGORIES = sum(name[0] == "c" and name[1:].isdigit() for name in LIGHT)


def colours(names: Sequence[str]) -> dict[str, str]:
    """The name of a colour of its own for each name, in their order; they repeat after eighteen."""
    return {name: f"c{index % CATEGORIES}" for index, name in enumerate(names)}
