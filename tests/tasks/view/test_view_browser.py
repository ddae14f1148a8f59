"""The page and reports as a visitor has them: a server of its own, a real browser without a window, a pointer that drags.

Ten seconds a server: it starts as a program, as it does for a visitor. The browser is Chromium with its driver, of the
system (Debian: chromium, chromium-driver).
"""

import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pandas as pd
import pytest
import quick
import torch

from swiftwrf import GeometryModel, RssiModel, rssi_room, simulated_room
from swiftwrf.contrib.online import Follower
from swiftwrf.data.writing import write_spectra
from swiftwrf.models.geometry import Plane
from tasks.report import merge
from tasks.update.record import Record

LIBRARIES = ("nicegui", "selenium")
PROGRAMS = ("chromium", "chromedriver")
missing = [name for name in LIBRARIES if find_spec(name) is None] + [
    name for name in PROGRAMS if not shutil.which(name)
]
pytestmark = pytest.mark.skipif(bool(missing), reason=f"needs {' and '.join(missing)}")
ROOT = Path(__file__).parents[3]
WIDTHS, THEMES = (360, 700, 1400), ("light", "dark")
PATIENCE = 60  # [s], for machines that are busy


@pytest.fixture
def serve():
    """Start the page of a run or model and return its address."""
    processes = []

    def start(source: Path) -> str:
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
        command = [sys.executable, "-m", "tasks", "view", str(source), "--port", "0"]
        process = subprocess.Popen(command, cwd=ROOT, env=inherited, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        line = process.stdout.readline()
        assert line.startswith("page: http://127.0.0.1:"), line
        return line.split()[1]

    yield start
    for process in processes:
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) in (0, 130)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    """A browser without a window, for all tests, and the folder of its downloads, which it does not ask the visitor for."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options, folder = webdriver.ChromeOptions(), tmp_path_factory.mktemp("downloads")
    options.binary_location = shutil.which("chromium")
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "hide-scrollbars", "window-size=1400,1037"):
        options.add_argument(f"--{argument}")
    several = "profile.default_content_setting_values.automatic_downloads"
    options.add_experimental_option("prefs", {"download.default_directory": str(folder), several: 1})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    yield driver, folder
    driver.quit()


@pytest.fixture
def browser(serve, chromium):
    """The browser in its own size, which leaves the page before its server ends and has nothing to complain about."""
    driver, _ = chromium
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    yield driver
    complaints = [entry["message"] for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    driver.get("about:blank")
    assert complaints == []


def until(check):
    """Waits for something true, and returns it. An element that the page replaces meanwhile counts as missing."""
    from selenium.common.exceptions import StaleElementReferenceException

    end = time.monotonic() + PATIENCE
    while True:
        with suppress(StaleElementReferenceException):
            if value := check():
                return value
        assert time.monotonic() < end, check
        time.sleep(0.05)


def find(browser, selector):
    return browser.find_element("css selector", selector)


def said(browser, name):
    """Return the text of an element, read in one step, because the page may replace the element."""
    return browser.execute_script("return document.getElementById(arguments[0]).innerText", name)


def shown(browser, name):
    """Return the picture of a chart, None if it has none yet; in one step, too."""
    image = "const image = document.querySelector(arguments[0]);"
    script = f"{image} return image && (image.getAttribute('href') || image.getAttribute('xlink:href'))"
    return browser.execute_script(script, f"#{name} image")


def press(browser, label):
    browser.find_element("xpath", f"//button[.//*[text()='{label}']]").click()


def looks(browser, width, theme):
    """Emulate a window of this width that prefers this theme."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    preference = {"features": [{"name": "prefers-color-scheme", "value": theme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", preference)


def assert_fits(browser, name):
    """Nothing is wider than the window, and this element is to be seen, on a telephone, a tablet and a screen."""
    for theme in THEMES:
        for width in WIDTHS:
            looks(browser, width, theme)
            for part in ("documentElement", "querySelector('.q-layout')"):
                assert browser.execute_script(f"return document.{part}.scrollWidth") <= width, (width, theme)
            assert find(browser, f"#{name} svg").rect["width"] > 0.7 * min(width, 620)


def pointer(browser):
    from selenium.webdriver import ActionChains

    return ActionChains(browser, duration=16)  # [ms] a move


def pressed_at(browser, selector, x, y):
    """Click beside the middle of an element that is searched for first. Return True, which ends `until`."""
    pointer(browser).move_to_element_with_offset(find(browser, selector), x, y).click().perform()
    return True


def opened(browser, address, name, label):
    """Return the page once this label has text."""
    browser.get(address)
    until(lambda: browser.find_elements("id", name) and said(browser, label))
    return find(browser, f"#{name}")


def follows_the_pointer(browser, plan):
    """The spectrum changes while the moving end is dragged, before it is released."""
    where, spectrum = said(browser, "where"), shown(browser, "synthesized")
    drag = pointer(browser).move_to_element_with_offset(plan, -100, 0).click_and_hold()
    for _ in range(15):
        drag.move_by_offset(6, 0)
    drag.perform()
    until(lambda: shown(browser, "synthesized") != spectrum)
    assert "ms" in said(browser, "frame")
    pointer(browser).release().perform()
    until(lambda: said(browser, "where") != where)


def has_views_models_and_keys(browser):
    from selenium.webdriver.common.keys import Keys

    rectangular = until(lambda: shown(browser, "measured"))
    # the component may draw its options after their data came, if the browser is slow
    browser.execute_script("for (const element of Object.values(mounted_app.$refs)) element.update_chart?.()")
    assert shown(browser, "measured") == rectangular
    press(browser, "polar")
    until(lambda: shown(browser, "measured") not in (None, rectangular))
    assert find(browser, "#deviation").is_displayed()
    find(browser, ".q-select").click()
    until(lambda: browser.find_elements("css selector", ".q-item"))
    browser.find_elements("css selector", ".q-item")[1].click()  # a model that does not know its deviation
    until(lambda: not find(browser, "#deviation").is_displayed())
    until(lambda: pressed_at(browser, "#plan", 20, 10))
    for key in (Keys.ARROW_RIGHT, Keys.ARROW_UP, Keys.PAGE_UP):
        before = said(browser, "where")
        pointer(browser).send_keys(key).perform()
        until(lambda before=before: said(browser, "where") != before)


def serves_nothing_else(address):
    for path in ("config.json", "metrics.json", "..%2f..%2fetc/passwd", "docs", "openapi.json", "static/"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{address}/{path}")
    # nor answers to a name that somebody else lets point to this machine
    request = urllib.request.Request(address, headers={"Host": "elsewhere.example"})
    with pytest.raises(urllib.error.HTTPError, match="400"):
        urllib.request.urlopen(request)


def test_page_of_spectra(browser, serve, aoa_run):
    address = serve(aoa_run)
    serves_nothing_else(address)
    plan = opened(browser, address, "plan", "where")
    follows_the_pointer(browser, plan)
    has_views_models_and_keys(browser)
    assert_fits(browser, "plan")


def test_paths_of_a_room_are_drawn(browser, serve, tmp_path):
    walls = [Plane((1.0, 0.0, 0.0), 6.0, -0.6), Plane((0.0, 0.0, -1.0), 0.0, -0.6)]
    GeometryModel.of_planes(simulated_room(n=10), walls).save(tmp_path / "room.safetensors")
    opened(browser, serve(tmp_path / "room.safetensors"), "plan", "where")
    drawn = "return [...document.querySelectorAll('#plan path')].map(path => path.getAttribute('d')).join()"
    before = browser.execute_script(drawn)
    find(browser, "#paths").click()
    until(lambda: browser.execute_script(drawn) != before)


def test_page_of_a_locator(browser, chromium, serve, locate_run):
    """Maps of RSSI as of a run of RSSI, and posteriors."""
    plan = opened(browser, serve(locate_run), "map", "sentence")

    def point(x, y):
        """Move the pointer and return the text about its position. A busy page may need more than one move."""
        pointer(browser).move_to_element_with_offset(plan, x, y).perform()
        return said(browser, "here")

    until(lambda: "% of the measured area" in said(browser, "sentence"))  # coverage is shown first
    first = until(lambda: "dBm" in point(30, 20) and said(browser, "here"))
    until(lambda: point(-120, 80) != first)
    sentences = {"RSSI": "Predicted RSSI", "best receiver": "highest prediction", "uncertainty": "interval"}
    for kind, sentence in sentences.items():
        press(browser, kind)
        until(lambda sentence=sentence: sentence in said(browser, "sentence"))
        until(lambda kind=kind: ("receiver01" in said(browser, "best")) == (kind == "best receiver"))  # its legend
    press(browser, "SVG")
    press(browser, "CSV")
    file = until(lambda: next(chromium[1].glob("*.csv"), None))
    until(lambda: next(chromium[1].glob("*.svg"), None))
    assert set(pd.read_csv(file)["receiver"]) == {"receiver01"}
    press(browser, "posterior")
    shown = until(lambda: "median at" in said(browser, "sentence") and said(browser, "sentence"))
    until(lambda: pressed_at(browser, "#map", 150, 60) and said(browser, "sentence") != shown)
    until(lambda: "median at" in said(browser, "sentence"))
    press(browser, "expected error")
    until(lambda: "simulated rows" in said(browser, "sentence"))
    until(lambda: "expected position error" in point(0, 0))
    assert_fits(browser, "map")


def test_page_of_a_followed_run_grows_without_reloading(browser, serve, tmp_path):
    data, folder = rssi_room(n=70), tmp_path / "live"
    folder.mkdir()
    follower, record = Follower(RssiModel().fit(data.subset(torch.arange(60)))), Record("source", "dB")
    (folder / "config.json").write_text('{"task": "update"}')
    record.write(folder)

    def learn(i, **changes):
        step = replace(follower.step(data.subset(torch.tensor([i]))), **changes)
        record.append(folder, record.add(i, step))

    opened(browser, serve(folder), "rows", "sentence")
    assert said(browser, "sentence") == "no measurement yet"
    browser.execute_script("window.not_reloaded = true")
    learn(60)
    until(lambda: "1 measurement learnt" in said(browser, "sentence"))
    before = find(browser, "#changes").get_attribute("innerHTML")
    for i in range(61, 66):
        learn(i, alarms=("hall weaker everywhere",) if i == 63 else ())
    until(lambda: "6 measurements learnt" in said(browser, "sentence"))
    assert "Change at measurement 63: hall weaker everywhere." in said(browser, "sentence")
    assert len(browser.find_elements("css selector", "#rows tbody tr")) == 6
    assert find(browser, "#changes").get_attribute("innerHTML") != before
    assert find(browser, "#error svg").is_displayed()
    assert browser.execute_script("return window.not_reloaded")
    assert_fits(browser, "changes")
    browser.save_screenshot(str(tmp_path / "followed.png"))


# reports: widths from a phone to a desktop, light and dark


TOLERANCE_PX = 1.5
BEYOND = """
const wide = document.documentElement.clientWidth, found = [];
for (const one of document.querySelectorAll('body *')) {
  if (one.closest('svg') || one.closest('.scroll') || one.closest('details:not([open])')) continue;
  if (![...one.childNodes].some(node => node.nodeType === 3 && node.textContent.trim())) continue;
  const box = one.getBoundingClientRect();
  if (box.width && (box.left < -arguments[0] || box.right > wide + arguments[0])) found.push(one.textContent.trim());
}
for (const svg of document.querySelectorAll('figure svg')) {
  if (svg.closest('details:not([open])')) continue;
  const frame = svg.getBoundingClientRect();
  for (const text of svg.querySelectorAll('g[id*="-text_"]')) {
    const box = text.getBoundingClientRect();
    if (box.width && (box.left < frame.left - arguments[0] || box.right > frame.right + arguments[0] ||
        box.top < frame.top - arguments[0] || box.bottom > frame.bottom + arguments[0])) found.push(text.id);
  }
}
return found;
"""


def fits(browser, address):
    """Open a report in every width and theme."""
    browser.get(address)
    browser.execute_script("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert len(browser.find_elements("css selector", "nav a")) <= 6
    assert not browser.execute_script(
        "return [...document.querySelectorAll('figure svg')].filter(svg => !svg.querySelector('title')).length"
    )
    for theme in THEMES:
        for width in WIDTHS:
            looks(browser, width, theme)
            assert browser.execute_script("return document.documentElement.scrollWidth") <= width, (width, theme)
            assert browser.execute_script(BEYOND, TOLERANCE_PX) == [], (width, theme)


def test_reports(browser, aoa_run, rssi_run, room, tmp_path):
    for run in (aoa_run, rssi_run):
        fits(browser, (run / "report.html").as_uri())
    merge([rssi_run, rssi_run], tmp_path / "both")
    fits(browser, (tmp_path / "both" / "report.html").as_uri())
    browser.get((tmp_path / "both" / "report.html").as_uri())
    first = browser.find_element("css selector", ".first").text
    assert "1: the simulated floor, random split" in first
    assert "2: the simulated floor, random split" in first
    (tmp_path / "data").mkdir()
    write_spectra(room, tmp_path / "data")
    assert quick.run("inspect", tmp_path / "data", "--out", tmp_path / "inspection", drawn=True) == 0
    fits(browser, (tmp_path / "inspection" / "report.html").as_uri())
