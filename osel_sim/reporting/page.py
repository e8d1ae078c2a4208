"""One self-contained HTML page from figures, tables and words, with the figures' PNG and SVG and the tables' CSV beside it."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from osel_sim.core.files import write_bytes
from osel_sim.core.shown import all_shown, shown
from osel_sim.reporting.charts import Figure, to_images
from osel_sim.reporting.html_tables import Table, to_csv, to_parts
from osel_sim.reporting.palette import DARK, LIGHT
from osel_sim.reporting.vega import vega_script

PAGE, FIGURES, TABLES = "report.html", "figures", "tables"
Block = str | Figure | Table


@dataclass(frozen=True)
class Tile:
    """One number of the verdict."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Verdict:
    """What the page says first.

    Attributes:
        headline: the answer.
        sentences: why, and how much is at stake.
    """

    headline: str
    sentences: Sequence[str]
    tiles: Sequence[Tile] = ()
    tone: Literal["good", "neutral", "bad"] = "neutral"


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        name: its anchor.
        blocks: paragraphs, figures and tables in their order.
    """

    name: str
    title: str
    blocks: Sequence[Block]

    @property
    def named_blocks(self) -> Iterator[tuple[str, Block]]:
        """Each block with its kind: text, figure, table."""
        for block in self.blocks:
            yield "text" if isinstance(block, str) else "figure" if isinstance(block, Figure) else "table", block


@dataclass(frozen=True)
class Episodes:
    """The list of episodes.

    Attributes:
        note: which they are.
        data: what report.js reads: policies, instances, episodes by column, videos.
    """

    note: str
    data: Mapping[str, Any]


@dataclass(frozen=True)
class Page:
    """All the page says.

    Attributes:
        kind: what it reports on: a replay, a live run, a rollout log.
        facts: what it was made from.
        routes: what goes where; it stands below the verdict, all else folds.
    """

    kind: str
    title: str
    verdict: Verdict
    sections: Sequence[Section]
    facts: Sequence[tuple[str, str]]
    episodes: Episodes | None = None
    routes: Figure | None = None
    figures: Sequence[Figure] = field(init=False)
    tables: Sequence[Table] = field(init=False)

    def __post_init__(self) -> None:
        blocks = [*([self.routes] if self.routes else []), *(block for section in self.sections for block in section.blocks)]
        object.__setattr__(self, "figures", tuple(block for block in blocks if isinstance(block, Figure)))
        object.__setattr__(self, "tables", tuple(block for block in blocks if isinstance(block, Table)))


@dataclass(frozen=True)
class Live:
    """What is said on a page that grows.

    Attributes:
        version: a browser that has another one loads the page again.
        film: address of the last film, or empty.
        words: what that shows.
        decisions: how many there are so far.
        over: no more will come.
    """

    version: int
    film: str = ""
    words: str = ""
    decisions: int = 0
    over: bool = False


def write_page(page: Page, folder: Path) -> Path:
    """Write `figures/`, `tables/` and last `report.html` into a folder. Each file appears at once or not at all, and none if one cannot be made."""
    files = {f"{FIGURES}/{figure.name}.{ending}": image for figure in page.figures for ending, image in to_images(figure).items()}
    files |= {f"{TABLES}/{table.name}.csv": to_csv(table).encode() for table in page.tables}
    files[PAGE] = to_html(page).encode()
    for name, content in files.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, content)
    return folder / PAGE


def to_html(page: Page, live: Live | None = None) -> str:
    """The page. Words from logs are escaped by the template, numbers and names for the script by `_embedded`.

    Args:
        live: of a page that is served while it grows.
    """
    from markupsafe import Markup

    data = {
        "palette": {"light": LIGHT, "dark": DARK},
        "figures": {figure.name: figure.spec for figure in page.figures},
        "episodes": page.episodes.data if page.episodes else None,
    }
    return _rendered("report.html.j2", page=page, parts=to_parts, live=live, vega=Markup(vega_script()), data=Markup(_embedded(data)))


def waiting_html(folder: Path, live: Live, problem: str = "") -> str:
    """What is shown of a live run that has made no decision yet, or cannot be read."""
    return _rendered("waiting.html.j2", folder=str(folder), live=live, problem=problem)


def _rendered(name: str, **values: Any) -> str:
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    template = resources.files("osel_sim.reporting") / "template"
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, finalize=_finalize)
    environment.filters["shown"] = shown
    files = {"css": "report.css", "script": "report.js", "live_script": "live.js"}
    own = {key: Markup((template / file).read_text(encoding="utf-8")) for key, file in files.items()}
    return environment.from_string((template / name).read_text(encoding="utf-8")).render(light=LIGHT, dark=DARK, **own, **values)


def _finalize(value: Any) -> Any:
    """What the template puts in: texts as they may be shown; style, script and data are the page's own."""
    return shown(value) if type(value) is str else value


def _embedded(data: Mapping[str, Any]) -> str:
    """JSON that cannot end the script element it stands in, whatever is in it; its texts as they may be shown."""
    text = json.dumps(all_shown(data), allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
