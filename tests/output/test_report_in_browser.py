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


def viewed(browser: Any, folder: Path, theme: str, *verbs: str) -> tuple[Any, list[str]]:
    """A report in a browser with its plots, and messages of the console, errors and requests."""
    path = folder / "report.html"
    records = [results.MAKERS[verb]() for verb in verbs]
    path.write_text(report_of(records, verbs), encoding="utf-8")
    width, height = WINDOWS[0]
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=theme)
    faults: list[str] = []
    page.on("console", lambda message: faults.append(message.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: faults.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_selector("body[data-ready=yes]", timeout=PATIENCE)
    return page, faults


def left(faults: list[str]) -> list[str]:
    """The faults, without requests that stay in the file."""
    return [fault for fault in faults if not fault.startswith(("file:", "data:", "blob:"))]


def test_every_plot_is_visible_in_every_window_and_theme(browser: Any, tmp_path: Path) -> None:
    """No message, no request, no horizontal scrolling of the page, and no empty plot.

    One report holds the results of all verbs, because the library of the plots loads slowly.
    """
    page, faults = viewed(browser, tmp_path, "light", *results.MAKERS)
    assert page.locator("main:has(.plot)").count() == len(results.MAKERS)
    page.eval_on_selector_all("details", "folds => folds.forEach(f => { f.open = true; })")
    page.wait_for_selector(".plot:not([data-drawn])", state="detached", timeout=PATIENCE)

    for (width, height), theme in zip(WINDOWS, ("light", "dark"), strict=True):
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=theme)
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background == "rgb(255, 255, 255)") == (theme == "light")

        plots = page.eval_on_selector_all(".plot", MEASURE_PLOTS)
        for plot_width, plot_height, shapes in plots:
            assert 200 < plot_width < width
            assert plot_height > 100
            assert shapes > 0
        assert page.evaluate(FIND_WIDE) <= 0
        assert page.eval_on_selector_all(".scroll", FIND_WIDE_TABLES) == 0
    assert left(faults) == []


def test_a_name_in_the_legend_hides_its_curves(browser: Any, tmp_path: Path) -> None:
    """A second click shows them again; a change of the theme keeps them hidden."""
    from playwright.sync_api import expect

    page, faults = viewed(browser, tmp_path, "light", "design")
    initial = page.locator("button", has_text="initial")
    group = page.locator(".group", has_text="hinge [rad]", has=initial).first
    group.scroll_into_view_if_needed()
    key = group.locator("button", has_text="initial")
    curves = group.locator(".plot").first.locator(".scatterlayer .trace")
    expect(curves).to_have_count(2)

    key.click()
    expect(curves).to_have_count(1)
    assert key.get_attribute("aria-pressed") == "false"
    page.emulate_media(color_scheme="dark")
    # The browser writes a colour as three numbers.
    red, green, blue = bytes.fromhex(DESIGNED.colour_on_dark.removeprefix("#"))
    stroke = f"rgb({red}, {green}, {blue})"
    expect(curves.locator("path.js-line")).to_have_css("stroke", stroke)
    expect(curves).to_have_count(1)
    key.click()
    expect(curves).to_have_count(2)
    assert left(faults) == []


def test_a_printed_report_fits_the_paper_and_the_window_again(browser: Any, tmp_path: Path) -> None:
    """Plots have the width of the paper while it is printed; nothing is folded then."""
    page, faults = viewed(browser, tmp_path, "dark", "design")
    before = page.eval_on_selector_all(".plot .main-svg", WIDTHS)
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert max(page.eval_on_selector_all(".plot .main-svg", WIDTHS)) <= 690
    assert page.locator("details:not([open])").count() == 0
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    page.wait_for_selector("body:not([data-busy])", timeout=PATIENCE)
    assert page.eval_on_selector_all(".plot .main-svg", WIDTHS) == before
    assert page.locator("details[open]").count() == 0

    content = page.pdf()
    assert content.startswith(b"%PDF")
    assert len(content) > 50_000
    assert left(faults) == []
