"""The report in a real browser: every figure drawn, nothing on the console, filters, phone, dark."""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from report_helpers import EVIL, FAR, made_log, made_replay, made_run
from synthetic_log import make_row, write_log

from osel_sim.report import main as report_main

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
ARGUMENTS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync "
    "--disable-dev-shm-usage --window-size=1280,900"
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM or not DRIVER, reason="no browser here: apt-get install chromium chromium-driver"),
]


@pytest.fixture(scope="module")
def driver():
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in ARGUMENTS.split():
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with webdriver.Chrome(options=options, service=Service(DRIVER)) as browser:
        browser.set_page_load_timeout(120)
        yield browser


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    log = made_log(folder / "log")
    made_replay(folder / "replay", log)
    made_run(folder / "run")
    made_table(folder / "table")
    names = ("log", "replay", "run", "table")
    for name in names:
        assert report_main([str(folder / name)]) == 0
    return {name: folder / name / "report.html" for name in names}


def made_table(folder: Path) -> None:
    """A log from elsewhere, without seeds: thirty subjects, graded, cheap."""
    rows, contexts = [], {}
    for number in range(90):
        key = f"question/{number}"
        contexts[key] = np.eye(8)[number % 8] + 0.01 * number
        for policy in ("small", "large"):
            about = {"task": f"a rather long name of the subject {number % 30}", "seed": None, "level": None, "split": None}
            values = {"subgoals": 0.75, "score": -0.0123, "price": 0.04}
            rows.append(make_row(key, policy, success=(number + (policy == "large")) % 3 > 0, **about, **values))
    write_log(folder, rows, contexts)


@pytest.fixture
def show(driver):
    """Opens a page on a desktop or a phone, light or dark, and waits until it is drawn."""

    def opened(page: Path, phone: bool = False, dark: bool = False) -> None:
        size = (
            {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True} if phone else {"width": 1280, "height": 900, "deviceScaleFactor": 1}
        )
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {"mobile": False, **size})
        driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": phone})
        theme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": theme})
        driver.get_log("browser")
        driver.get(page.as_uri())
        wait(driver, "return document.documentElement.dataset.ready === 'true'")

    return opened


def wait(driver, script: str, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not driver.execute_script(script):
        assert time.monotonic() < end, f"still not: {script}; console: {driver.get_log('browser')}"
        time.sleep(0.1)


INK = "getComputedStyle(document.querySelector('#figure-routes .mark-text.role-mark text')).fill"


def blank(driver) -> list[str]:
    """Figures of which some panel has no marks: no curve, dot, cell or bar."""
    return driver.execute_script("""
        const drawn = (plot) => [...plot.querySelectorAll(".role-mark > path, .role-mark > text")].some((mark) => {
            const box = mark.getBBox();
            return mark.getAttribute("fill-opacity") !== "0" && (box.width > 0 || box.height > 0);
        });
        return [...document.querySelectorAll(".plot")].filter((plot) => !drawn(plot)).map((plot) => plot.closest("figure").id);""")


@pytest.mark.parametrize(("phone", "dark"), [(False, False), (True, True)])
def test_a_comparison_is_drawn(driver, show, tmp_path, phone, dark):
    import osel_sim as osel

    made_log(tmp_path / "log")
    page = osel.compare(tmp_path / "log", out=tmp_path / "compared").page
    show(page, phone, dark)
    assert driver.get_log("browser") == []
    driver.execute_script("document.querySelectorAll('details').forEach((fold) => { fold.open = true; })")
    wait(driver, "return document.querySelectorAll('.plot svg, .plot canvas').length >= 2", 20)
    assert blank(driver) == []
    assert driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    assert driver.execute_script("return window.pwned") is None
    assert "points of success" in driver.find_element("id", "verdict").text


@pytest.mark.parametrize("name", ["log", "replay", "run", "table"])
@pytest.mark.parametrize(("phone", "dark"), [(False, False), (True, True)])
def test_everything_is_drawn(driver, pages, show, name, phone, dark):
    show(pages[name], phone, dark)
    assert driver.get_log("browser") == []
    assert blank(driver) == []
    assert driver.execute_script("return document.querySelectorAll('.plot').length") >= 6
    assert driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    background = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert background == ("rgb(23, 27, 33)" if dark else "rgb(255, 255, 255)")
    assert driver.execute_script(f"return {INK}") == ("rgb(232, 236, 241)" if dark else "rgb(28, 36, 48)")
    driver.execute_script("document.querySelectorAll('details').forEach((fold) => { fold.open = true; })")
    # No figure is cut off, none spreads beyond its panel, and no table is wider than its column.
    wait(driver, "return [...document.querySelectorAll('.wide table')].every((table) => table.scrollWidth <= table.parentElement.clientWidth + 1)", 5)
    beyond = """
        const inside = (box, room) => box.right <= room.right + 1 && box.left >= room.left - 1 && box.bottom <= room.bottom + 1;
        return [...document.querySelectorAll(".plot")].flatMap((plot) => {
            const own = plot.querySelector("svg"), room = own.getBoundingClientRect();
            const texts = [...own.querySelectorAll("text")].filter((text) => text.getBoundingClientRect().width > 0 && text.textContent);
            const cut = texts.filter((text) => !inside(text.getBoundingClientRect(), room)).map((text) => text.textContent);
            return [...cut, ...(room.right > plot.parentElement.getBoundingClientRect().right + 1 ? [plot.closest("figure").id] : [])];
        });"""
    assert driver.execute_script(beyond) == []
    # One screen for each fold.
    tall = "return [...document.querySelectorAll('.fold > .inside')].filter((inside) => inside.clientHeight > window.innerHeight).length"
    assert driver.execute_script(tall) == 0


def test_folded_figures_are_printed(driver, pages, show):
    show(pages["replay"])
    folds = driver.execute_script("return document.querySelectorAll('details.fold:not([open])').length")
    assert folds > 10
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert blank(driver) == []
    assert driver.execute_script("return [...document.querySelectorAll('.plot svg')].every((plot) => plot.getBoundingClientRect().height > 40)")
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "screen"})
    driver.execute_script("dispatchEvent(new Event('beforeprint'))")
    assert driver.execute_script("return document.querySelectorAll('details.fold:not([open])').length") == 0
    driver.execute_script("dispatchEvent(new Event('afterprint'))")
    assert driver.execute_script("return document.querySelectorAll('details.fold:not([open])').length") == folds


def test_the_first_screen_has_the_verdict_and_what_goes_where(driver, pages, show):
    for page in pages.values():
        show(page)
        seen = "return [...document.querySelectorAll('#verdict, #routes .plot svg')].map((part) => part.getBoundingClientRect().bottom)"
        bottoms = driver.execute_script(seen)
        assert len(bottoms) == 3 and max(bottoms) < 900
        assert page.stat().st_size < 2_000_000
        words = driver.execute_script("return [...document.querySelectorAll('.plot[role=img]')].map((plot) => plot.getAttribute('aria-label'))")
        assert len(set(words)) == len(words) and all(len(text) > 60 for text in words)


def test_pointing_tells_values_with_their_intervals(driver, pages, show):
    show(pages["log"])

    def tell(selector: str) -> str:
        script = """
            const item = document.querySelector(arguments[0]), box = item.getBoundingClientRect();
            const at = {bubbles: true, clientX: box.left + box.width / 2, clientY: box.top + box.height / 2};
            item.dispatchEvent(new MouseEvent("pointermove", at));
            item.dispatchEvent(new MouseEvent("mousemove", at));
            return document.getElementById("vg-tooltip-element")?.innerText || "";"""
        return driver.execute_script(script, selector)

    words = tell("#figure-routes .plot .mark-text.role-mark text:last-of-type")
    assert FAR in words and "%" in words and "[" in words and "instances" in words
    assert driver.execute_script("return window.pwned === undefined")


def test_a_click_on_a_context_shows_its_episodes(driver, pages, show):
    show(pages["log"])
    driver.execute_script("document.getElementById('figure-contexts').closest('details').open = true")
    click = """
        const dot = document.querySelector("#figure-contexts .mark-symbol.role-mark path");
        dot.scrollIntoView({block: "center", behavior: "instant"});
        const box = dot.getBoundingClientRect();
        return [box.left + box.width / 2, box.top + box.height / 2];"""
    x, y = driver.execute_script(click)
    for kind in ("mousePressed", "mouseReleased"):
        driver.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1})
    wait(driver, "return document.getElementById('detail').open", 5)
    assert "policy" in driver.execute_script("return document.getElementById('detail-body').innerText")
    room = "return [...document.querySelectorAll('#detail .wide')].every((wide) => wide.scrollWidth <= wide.clientWidth + 1)"
    assert driver.execute_script(room)


def test_nothing_is_fetched(driver, pages, show):
    driver.get_log("performance")
    show(pages["replay"])
    requests = [entry["message"] for entry in driver.get_log("performance") if "Network.requestWillBeSent" in entry["message"]]
    assert [request for request in requests if '"url":"http' in request] == []


def test_the_theme_follows_the_system(driver, pages, show):
    show(pages["run"])
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": "dark"}]})
    wait(driver, f"return {INK} === 'rgb(232, 236, 241)'")
    assert driver.get_log("browser") == []


def test_words_from_a_log_are_shown_as_words(driver, pages, show):
    show(pages["log"])
    rows = "[...document.querySelectorAll('#episode-list button .instruction')].map((item) => item.textContent)"
    assert EVIL in driver.execute_script(f"return {rows}")
    assert FAR in driver.execute_script("return [...document.querySelectorAll('.legend button')].map((item) => item.textContent)")
    driver.execute_script("document.querySelector('#episode-list button').click()")
    assert driver.execute_script("return document.getElementById('detail-title').textContent") == EVIL
    assert driver.execute_script("return window.pwned === undefined")
    assert driver.execute_script("return document.querySelector('#detail').open")


def test_filters(driver, pages, show):
    show(pages["log"])

    def choose(name: str, value: str) -> None:
        script = "const box = document.getElementById(arguments[0]); box.value = arguments[1]; box.dispatchEvent(new Event('input', {bubbles: true}))"
        driver.execute_script(script, f"filter-{name}", value)

    def count() -> str:
        return driver.execute_script("return document.getElementById('episode-count').textContent")

    assert count() == "240 of 240 episodes"
    choose("policy", FAR)
    assert count() == "120 of 240 episodes"
    choose("task", "kitchen")
    assert count() == "60 of 240 episodes"
    choose("target", "pan")
    assert count() == "20 of 240 episodes"
    choose("outcome", "success")
    found = int(count().split()[0])
    choose("outcome", "failure")
    assert found + int(count().split()[0]) == 20 and found > 10
    for name in ("policy", "task", "target", "outcome"):
        choose(name, "")
    choose("outcome", "fallback")
    assert count() == "2 of 240 episodes"
    choose("outcome", "")
    choose("text", "the MUG")
    assert count() == "78 of 240 episodes"
    assert len(driver.execute_script("return document.querySelectorAll('#episode-list button')")) == 40
    driver.execute_script("document.getElementById('episode-more').click()")
    assert len(driver.execute_script("return document.querySelectorAll('#episode-list button')")) == 78
    assert not driver.execute_script("return document.getElementById('episode-more').checkVisibility()")


def test_a_filter_offers_what_there_is_and_says_when_nothing_fits(driver, pages, show):
    outcomes = "return [...document.getElementById('filter-outcome').options].map((option) => option.value)"
    show(pages["table"])
    assert driver.execute_script(outcomes) == ["", "success", "failure"]
    script = "const box = document.getElementById('filter-text'); box.value = 'zzz'; box.dispatchEvent(new Event('input'));"
    driver.execute_script(script)
    assert driver.execute_script("return document.getElementById('episode-list').textContent") == "No episode fits."
    assert not driver.execute_script("return document.getElementById('episode-more').checkVisibility()")
    show(pages["log"])
    assert driver.execute_script(outcomes) == ["", "success", "failure", "fallback"]


def test_an_episode_tells_its_grades_and_how_to_get_a_picture(driver, pages, show):
    def detail(name: str) -> str:
        show(pages[name])
        driver.execute_script("document.querySelector('#episode-list button').click()")
        return driver.execute_script("return document.getElementById('detail-body').innerText")

    words = detail("table")
    assert "subgoals 75%" in words and "score \u22120.0123" in words and "0.0400 cents" in words
    assert "--scenes" not in words  # nothing can draw it
    words = detail("log")
    assert "--scenes N" in words and "subgoals" not in words


def test_a_phone_shows_tables_as_cards_and_shortens_the_names_of_rows(driver, pages, show):
    cells = (
        "return [...document.querySelectorAll('#table-policies tbody tr:first-child td')].map((cell) => [cell.dataset.label, cell.innerText.trim()])"
    )
    longest = "return Math.max(...[...document.querySelectorAll('#figure-policies_by_task svg text')].map((text) => text.textContent.length))"
    show(pages["table"], phone=True)
    driver.execute_script("document.querySelectorAll('details').forEach((fold) => { fold.open = true; })")
    wait(driver, "return document.querySelector('#table-policies .wide').classList.contains('stacked')", 5)
    assert dict(driver.execute_script(cells)).items() >= {"policy": "small", "price (cents)": "0.0400"}.items()
    assert driver.execute_script(longest) <= 20
    driver.execute_script("document.querySelector('#episode-list button').click()")
    assert driver.execute_script("return [...document.querySelectorAll('#detail .wide')].every((wide) => wide.scrollWidth <= wide.clientWidth + 1)")
    show(pages["table"])
    assert driver.execute_script(longest) > 30


def test_intervals_of_a_table_are_there_when_asked_for(driver, pages, show):
    show(pages["log"])
    driver.execute_script("document.querySelector('#table-policies').closest('details').open = true")
    text = "return document.querySelector('#table-policies tbody tr').innerText"
    assert "[" not in driver.execute_script(text)
    assert "95% interval [" in driver.execute_script("return document.querySelector('#table-policies td[title]').title")
    driver.execute_script("document.querySelector('#table-policies').parentElement.querySelector('.intervals input').click()")
    assert "[" in driver.execute_script(text)


def test_a_live_run_shows_what_was_chosen_first(driver, pages, show):
    show(pages["run"])
    assert driver.execute_script("return document.getElementById('episode-count').textContent") == "40 of 80 episodes"
    assert "error" in driver.execute_script("return [...document.querySelectorAll('#episode-list .chip')].map((chip) => chip.textContent)")


def test_names_in_the_legend_hide_and_show(driver, pages, show):
    show(pages["replay"])
    driver.execute_script("document.getElementById('figure-curves').closest('details').open = true")
    lines = "document.querySelectorAll('#figure-curves .mark-line path').length"
    before = driver.execute_script(f"return {lines}")
    driver.execute_script("document.querySelector('#figure-curves .legend button').click()")
    wait(driver, f"return {lines} < {before}")
    driver.execute_script("document.querySelector('#figure-curves .legend button').click()")
    wait(driver, f"return {lines} === {before}")
    assert driver.get_log("browser") == []
