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


@pytest.mark.parametrize("name", ["log", "replay", "run", "table"])
@pytest.mark.parametrize(("phone", "dark"), [(False, False), (True, True)])
def test_everything_is_drawn(driver, pages, show, name, phone, dark):
    show(pages[name], phone, dark)
    assert driver.get_log("browser") == []
    # Every panel has something in it: curves, points, bars or a map.
    empty = driver.execute_script("""
        const marks = ".scatterlayer .trace path, .scatterlayer .js-line, .barlayer .point path, .heatmaplayer image";
        const plots = [...document.querySelectorAll(".plot")].filter((plot) => !plot.querySelector(marks));
        return plots.map((plot) => plot.getAttribute("aria-label"));""")
    assert empty == []
    assert driver.execute_script("return document.querySelectorAll('.plot').length") >= 6
    assert driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    background = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert background == ("rgb(23, 27, 33)" if dark else "rgb(255, 255, 255)")
    ink = driver.execute_script("return getComputedStyle(document.querySelector('.plot .ytitle, .plot .xtitle')).fill")
    assert ink == ("rgb(232, 236, 241)" if dark else "rgb(28, 36, 48)")


def test_nothing_is_fetched(driver, pages, show):
    driver.get_log("performance")
    show(pages["replay"])
    requests = [entry["message"] for entry in driver.get_log("performance") if "Network.requestWillBeSent" in entry["message"]]
    assert [request for request in requests if '"url":"http' in request] == []


def test_the_theme_follows_the_system(driver, pages, show):
    show(pages["run"])
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": "dark"}]})
    wait(driver, "return getComputedStyle(document.querySelector('.plot .ytitle')).fill === 'rgb(232, 236, 241)'")
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


def test_a_phone_keeps_the_names_of_rows_and_shortens_those_of_a_figure(driver, pages, show):
    show(pages["table"], phone=True)
    left = """
        const table = document.querySelector('#table-policies .wide');
        table.scrollLeft = 200;
        const cells = [...table.querySelectorAll('tbody tr:first-child td')].slice(0, 2);
        return [table.scrollLeft, table.getBoundingClientRect().left,
            ...cells.map((cell) => cell.getBoundingClientRect().left), cells[1].getBoundingClientRect().right];"""
    scrolled, start, first, second, end = driver.execute_script(left)
    assert scrolled > 100 and first == pytest.approx(start + 1, abs=2) and first < second < end < 390 / 2 + start
    names = "return [...document.querySelectorAll('#figure-policies_by_task .plot')].map((plot) => plot.querySelectorAll('.ytick').length)"
    assert driver.execute_script(names) == [31, 31]
    longest = "return Math.max(...[...document.querySelectorAll('#figure-policies_by_task .ytick text')].map((text) => text.textContent.length))"
    assert driver.execute_script(longest) <= 20
    show(pages["table"])
    assert driver.execute_script(longest) > 30


def test_a_live_run_shows_what_was_chosen_first(driver, pages, show):
    show(pages["run"])
    assert driver.execute_script("return document.getElementById('episode-count').textContent") == "40 of 80 episodes"
    assert "error" in driver.execute_script("return [...document.querySelectorAll('#episode-list .chip')].map((chip) => chip.textContent)")


def test_names_in_the_legend_hide_and_show(driver, pages, show):
    show(pages["replay"])
    lines = "document.querySelectorAll('#figure-curves .scatterlayer .js-line').length"
    before = driver.execute_script(f"return {lines}")
    driver.execute_script("document.querySelector('#figure-curves .legend button').click()")
    wait(driver, f"return {lines} < {before}")
    driver.execute_script("document.querySelector('#figure-curves .legend button').click()")
    wait(driver, f"return {lines} === {before}")
    assert driver.get_log("browser") == []
