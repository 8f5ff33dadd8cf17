"""Results as a notebook shows them: HTML, figures, and the names of figures."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import pytest
from matplotlib.figure import Figure

from mjfim.errors import MjfimError
from mjfim.output.folders import write_pictures
from mjfim.output.manifest import OutputGuard, claimed
from mjfim.output.page import Emphasis, Listing, PictureFormat, Row, Table, Text
from mjfim.output.pages import page_of
from mjfim.output.panels import Picture
from mjfim.output.plots.pictures import Pictures
from mjfim.output.report import STYLES, template
from tests.support import results
from tests.support.pages import page_with

# Many figures are drawn: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

# A name that would change a page, if it were not escaped.
HOSTILE = "<script>alert('θ')</script> & \"m\""


verbs = pytest.mark.parametrize("verb", results.MAKERS)


def texts(html: str) -> list[str]:
    """Return all texts of well-formed HTML."""
    return list(ElementTree.fromstring(html).itertext())


@verbs
def test_the_html_is_well_formed_and_has_all_cells(verb: str) -> None:
    record = results.MAKERS[verb]()
    html = record._repr_html_()
    cells = {cell for table in page_of(record).tables for row in table.rows for cell in row.cells}
    shown = {text.replace("\N{NO-BREAK SPACE}", " ") for text in texts(html)}
    assert cells - {""} <= shown
    assert "nan" not in html and "None" not in html


@verbs
def test_a_figure_is_drawn_and_shown_as_png(verb: str) -> None:
    figure = results.MAKERS[verb]().plot()
    assert isinstance(figure, Figure)
    png, options = figure._repr_png_()  # type: ignore[attr-defined]
    assert png.startswith(b"\x89PNG")
    assert 300.0 < options["width"] < 1800.0


def test_a_campaign_before_its_first_round_is_shown_in_words() -> None:
    begun = results.campaign(rounds=())
    assert "Campaign of designs and recordings" in texts(begun._repr_html_())
    assert begun.pictures == ()
    with pytest.raises(MjfimError, match="no results yet"):
        begun.plot()


def test_every_part_of_a_page_is_escaped() -> None:
    table = Table(
        title=HOSTILE,
        columns=(HOSTILE,),
        rows=(Row((HOSTILE,), Emphasis.WARNING),),
        note=HOSTILE,
    )
    parts = (
        table,
        replace(table, detail=True),
        Text(HOSTILE, Emphasis.STRONG),
        Listing(HOSTILE, (f"{HOSTILE}\nsecond line",)),
        Listing(HOSTILE, (HOSTILE,), code=True),
        Text("use `a<b` or ` alone"),
    )
    page = replace(page_with(*parts, verdict=HOSTILE), kind=HOSTILE, warnings=(HOSTILE,))
    html = template("notebook.html.j2").render(page=page, styles=STYLES)
    found = texts(html)
    assert "<script" not in html
    assert found.count(HOSTILE) == 15
    assert f"Warning: {HOSTILE}" in found
    assert "<code>a&lt;b</code> or ` alone" in html


# ---- formats of pictures


@pytest.mark.parametrize(
    ("ending", "start"),
    [
        ("png", b"\x89PNG"),
        ("svg", b"<?xml"),
        ("pdf", b"%PDF"),
    ],
)
def test_plot_writes_the_format_that_the_file_names(
    ending: str, start: bytes, tmp_path: Path
) -> None:
    rehearsal = results.rehearsal()
    file = tmp_path / f"picture.{ending}"
    rehearsal.plot(file=file)
    first = file.read_bytes()
    assert first.startswith(start)

    # A file holds no time and no random names.
    rehearsal.plot(file=file)
    assert file.read_bytes() == first


def test_pictures_of_an_earlier_run_in_another_format_are_removed(tmp_path: Path) -> None:
    """A file of the user with such a name remains."""
    pictures: Pictures = {"limits": partial(Picture, title="", panels=())}
    for chosen in (PictureFormat.PNG, PictureFormat.SVG):
        (tmp_path / "limits.pdf").write_text("of the user", encoding="utf-8")
        guard = OutputGuard([], force=False)
        with claimed(tmp_path, guard, exclusive=True):
            write_pictures(tmp_path, pictures, chosen)
    found = {file.name for file in tmp_path.glob("limits*")}
    assert found == {"limits.svg", "limits.pdf"}
