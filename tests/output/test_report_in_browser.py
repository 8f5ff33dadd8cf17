"""Reports in a real browser: nothing is fetched, nothing fails, and every plot is visible.

The browser is a Chromium or Chrome of the machine; without one the tests are skipped.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mjfim.output.page import DESIGNED
from mjfim.output.report import report_of
from mjfim.records.base import ShownRecord
from tests.support import results

pytestmark = pytest.mark.slow

# Names of the program on the systems where it may be installed.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")

# Width and height of the window [CSS pixels]: a laptop, and a phone that shows the dark theme.
WINDOWS = ((1280, 800), (390, 844))

# Time after which the plots must stand [ms].
PATIENCE = 120_000

# Height and width of each plot, and the number of its drawn shapes.
MEASURE_PLOTS = """nodes => nodes.map(node => {
  const box = node.getBoundingClientRect();
  const drawn = '.trace path, .trace text, .annotation text, .heatmaplayer image';
  const shapes = node.querySelectorAll(drawn);
  return [box.width, box.height, shapes.length];
})"""

# Width of each plot [CSS pixels].
WIDTHS = "plots => plots.map(plot => Math.round(plot.getBoundingClientRect().width))"

# Width of the part of the page that is outside the window [CSS pixels].
FIND_WIDE = "document.documentElement.scrollWidth - window.innerWidth"


# Number of tables that have to be scrolled, although they have few columns.
FIND_WIDE_TABLES = """boxes => boxes.filter(box =>
  box.querySelector('thead tr:last-child').cells.length <= 12
  && box.scrollWidth > box.clientWidth + 1).length"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser without a window."""
    program = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if program is None:
        pytest.skip("there is no Chromium or Chrome on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

    with playwright.sync_playwright() as driver:
        try:
            opened = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"{program} does not start: {error}")
        yield opened
        opened.close()


class Viewed:
    """A report in a browser.

    Attributes:
        page: The page.
        faults: Messages of the console, errors, and requests.
    """

    def __init__(self, browser: Any, path: Path, size: tuple[int, int], theme: str) -> None:
        """Open a report and wait for its plots."""
        width, height = size
        self.page = browser.new_page(
            viewport={"width": width, "height": height}, color_scheme=theme
        )
        self.faults: list[str] = []
        self.page.on("console", lambda message: self.faults.append(message.text))
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("request", lambda request: self._note(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("body[data-ready=yes]", timeout=PATIENCE)

    def _note(self, address: str) -> None:
        """Note a request that leaves the file."""
        if not address.startswith(("file:", "data:", "blob:")):
            self.faults.append(address)


def rgb_text(colour: str) -> str:
    """A colour as the browser writes it."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return f"rgb({red}, {green}, {blue})"


def report_file(folder: Path, record: ShownRecord) -> Path:
    """Write a report."""
    path = folder / "report.html"
    path.write_text(report_of([record], ["made up"]), encoding="utf-8")
    return path


@pytest.mark.parametrize("verb", results.MAKERS)
def test_every_plot_is_visible_in_every_window_and_theme(
    verb: str, browser: Any, tmp_path: Path
) -> None:
    """No message, no request, no horizontal scrolling of the page, and no empty plot."""
    view = Viewed(browser, report_file(tmp_path, results.MAKERS[verb]()), WINDOWS[0], "light")
    view.page.eval_on_selector_all("details", "folds => folds.forEach(f => { f.open = true; })")
    view.page.wait_for_selector(".plot:not([data-drawn])", state="detached", timeout=PATIENCE)

    for (width, height), theme in zip(WINDOWS, ("light", "dark"), strict=True):
        view.page.set_viewport_size({"width": width, "height": height})
        view.page.emulate_media(color_scheme=theme)
        background = view.page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background == "rgb(255, 255, 255)") == (theme == "light")

        plots = view.page.eval_on_selector_all(".plot", MEASURE_PLOTS)
        assert plots
        for plot_width, plot_height, shapes in plots:
            assert 200 < plot_width < width
            assert plot_height > 100
            assert shapes > 0
        assert view.page.evaluate(FIND_WIDE) <= 0
        assert view.page.eval_on_selector_all(".scroll", FIND_WIDE_TABLES) == 0
    assert view.faults == []


def test_a_name_in_the_legend_hides_its_curves(browser: Any, tmp_path: Path) -> None:
    """A second click shows them again; a change of the theme keeps them hidden."""
    from playwright.sync_api import expect

    view = Viewed(browser, report_file(tmp_path, results.design()), WINDOWS[0], "light")
    initial = view.page.locator("button", has_text="initial")
    group = view.page.locator(".group", has_text="hinge [rad]", has=initial).first
    group.scroll_into_view_if_needed()
    key = group.locator("button", has_text="initial")
    curves = group.locator(".plot").first.locator(".scatterlayer .trace")
    expect(curves).to_have_count(2)

    key.click()
    expect(curves).to_have_count(1)
    assert key.get_attribute("aria-pressed") == "false"
    view.page.emulate_media(color_scheme="dark")
    expect(curves.locator("path.js-line")).to_have_css("stroke", rgb_text(DESIGNED.colour_on_dark))
    expect(curves).to_have_count(1)
    key.click()
    expect(curves).to_have_count(2)
    assert view.faults == []


def test_a_printed_report_fits_the_paper_and_the_window_again(browser: Any, tmp_path: Path) -> None:
    """Plots have the width of the paper while it is printed; nothing is folded then."""
    view = Viewed(browser, report_file(tmp_path, results.design()), WINDOWS[0], "dark")
    before = view.page.eval_on_selector_all(".plot .main-svg", WIDTHS)
    view.page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert max(view.page.eval_on_selector_all(".plot .main-svg", WIDTHS)) <= 690
    assert view.page.locator("details:not([open])").count() == 0
    view.page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    view.page.wait_for_selector("body:not([data-busy])", timeout=PATIENCE)
    assert view.page.eval_on_selector_all(".plot .main-svg", WIDTHS) == before
    assert view.page.locator("details[open]").count() == 0

    content = view.page.pdf()
    assert content.startswith(b"%PDF")
    assert len(content) > 50_000
    assert view.faults == []
