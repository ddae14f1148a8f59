"""Reports in a real browser: widths from a phone to a desktop, light and dark."""

import shutil
from importlib.util import find_spec

import pytest
import quick
from test_view_browser import PROGRAMS, THEMES, WIDTHS, chromium, looks

from swiftwrf.data.writing import write_spectra
from tasks.report import merge

missing = [name for name in ("selenium",) if find_spec(name) is None]
missing += [name for name in PROGRAMS if not shutil.which(name)]
pytestmark = pytest.mark.skipif(bool(missing), reason=f"needs {' and '.join(missing)}")
MIN_CONTRAST = 3.0
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
FAINT = """
const light = colour => {
  const [r, g, b] = colour.match(/[\\d.]+/g).slice(0, 3).map(x => x / 255)
    .map(x => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const paper = light(getComputedStyle(document.body).backgroundColor), found = new Set();
for (const path of document.querySelectorAll('figure svg g[id*="-line2d_"] > path[clip-path]')) {
  const stroke = getComputedStyle(path).stroke;
  if (!stroke.startsWith('rgb') || path.closest('g[id*="matplotlib.axis"]')) continue;
  const [low, high] = [light(stroke), paper].sort((a, b) => a - b);
  if ((high + 0.05) / (low + 0.05) < arguments[0]) found.add(stroke);
}
return [...found];
"""


@pytest.fixture(scope="module")
def browser():
    """A browser for all reports."""
    with chromium("--hide-scrollbars") as driver:
        yield driver


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
        assert browser.execute_script(FAINT, MIN_CONTRAST) == [], theme


def test_reports_of_angles(browser, aoa_run):
    fits(browser, (aoa_run / "report.html").as_uri())


def test_reports_of_rssi(browser, rssi_run, tmp_path):
    fits(browser, (rssi_run / "report.html").as_uri())
    merge([rssi_run, rssi_run], tmp_path / "both")
    fits(browser, (tmp_path / "both" / "report.html").as_uri())
    browser.get((tmp_path / "both" / "report.html").as_uri())
    first = browser.find_element("css selector", ".first").text
    assert "1: the simulated floor, random split" in first
    assert "2: the simulated floor, random split" in first


def test_reports_of_files(browser, room, tmp_path):
    (tmp_path / "data").mkdir()
    write_spectra(room, tmp_path / "data")
    assert quick.run("inspect", tmp_path / "data", "--out", tmp_path / "inspection", drawn=True) == 0
    fits(browser, (tmp_path / "inspection" / "report.html").as_uri())
