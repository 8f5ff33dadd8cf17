"""Pages fit into terminals of 80 and 120 columns: nothing is cut, the short form is short."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from rich.cells import cell_len

from mjfim.output.page import Emphasis, Listing, Row, Table, Text
from mjfim.output.pages import page_of
from mjfim.output.terminal import MAX_LINES
from tests.support import results
from tests.support.pages import page_with, printed

LONG = ("left_forearm_and_hand_with_gripper_mass_0", "b" * 60, "wrist")
WARNING = "not smooth: two difference steps disagree by 2.6 %; the design is unreliable " * 2
verbs = pytest.mark.parametrize("verb", results.MAKERS)
widths = pytest.mark.parametrize("width", [40, 80, 120])


def letters(text: str) -> str:
    """A text without spaces and line breaks, because sentences and names may be folded."""
    return "".join(text.split())


@verbs
@widths
@pytest.mark.parametrize("verbose", [False, True])
def test_nothing_is_cut(verb: str, width: int, verbose: bool) -> None:
    names = {"name": LONG[0]} if verb in ("design", "identify", "rehearse") else {}
    page = page_of(results.MAKERS[verb](parameters=LONG, **names))
    text = printed(page, width, verbose=verbose)
    assert max(map(cell_len, text.splitlines())) <= width
    assert letters(text).startswith(letters(page.verdict.sentence)[1:], 1)
    assert not page.next_steps or letters(f"Next: {page.next_steps[0]}") in letters(text)
    assert "…" not in text
    for table in page.tables if verbose else ():
        assert {len(row.cells) for row in table.rows} <= {len(table.columns)}
        assert set(table.spare) - {"at bound"} <= set(table.columns)
        cells = [
            cell for row in table.rows for k, cell in enumerate(row.cells) if not table.is_left(k)
        ]
        assert [cell for cell in cells if letters(cell) not in letters(text)] == []


@verbs
@pytest.mark.parametrize("width", [80, 120])
def test_the_short_form_fits_on_a_screen(verb: str, width: int) -> None:
    lines = printed(page_of(results.MAKERS[verb]()), width).splitlines()
    assert 0 < len(lines) <= MAX_LINES + 4


def rows_table(count: int, **changes: object) -> Table:
    rows = tuple(Row((f"p{k}", str(k))) for k in range(count))
    return replace(Table(title="Values", columns=("parameter", "value"), rows=rows), **changes)


def test_rows_with_a_warning_stay_and_a_line_says_what_is_missing() -> None:
    table = rows_table(60)
    table = replace(table, rows=(*table.rows[:-1], Row(("odd", "1"), Emphasis.WARNING)))
    lines = printed(page_with(table), 80).splitlines()
    assert len(lines) <= MAX_LINES
    assert any(line.startswith("odd") for line in lines)
    left = 60 - sum(line.startswith(("p", "odd")) for line in lines[3:])
    assert lines[-1].startswith(f"Not shown here: {left} rows and sentences; --verbose")


def test_explanations_are_left_out_before_results_and_details_always() -> None:
    parts = (
        Text("words " * 100, Emphasis.WEAK),
        rows_table(MAX_LINES - 6),
        rows_table(3, title="Details", detail=True),
    )
    text = printed(page_with(*parts), 80)
    assert f"p{MAX_LINES - 7}" in text and "words" not in text and "Details" not in text
    long = printed(page_with(*parts), 80, verbose=True)
    assert "words" in long and "Details" in long


@pytest.mark.parametrize("make", [Listing, None])
def test_lists_and_further_tables_keep_their_first_rows(
    make: Callable[[str, tuple[str, ...]], Listing] | None,
) -> None:
    further = rows_table(20, title="Further")
    if make is not None:
        further = make("Further", tuple(f"p{k}: {WARNING}" for k in range(20)))
    lines = printed(page_with(rows_table(10), further), 80).splitlines()
    assert sum("p0" in line for line in lines) == 2
    assert any(line.startswith("p9") for line in lines)


def test_spare_columns_go_first_where_there_is_no_room() -> None:
    row = Row(("a name that is long enough", *("123456789" for _ in range(6))))
    columns = ("name", *(f"column{k}" for k in range(6)))
    table = Table(title="", columns=columns, rows=(row,), spare=("column1", "column5"))
    assert "column5" in printed(page_with(table), 120)
    narrow = printed(page_with(table), 84)
    assert "column5" not in narrow and "column1" in narrow
    # Where even this is not enough, each row is a paragraph.
    narrowest = printed(page_with(table), 40)
    assert "column0 123456789, column2" in " ".join(narrowest.split())


def test_cells_are_folded_and_aligned_by_their_width_on_the_screen() -> None:
    rows = (Row(("関節 of the left arm", "1.5")), Row(("x", "-10")))
    table = Table(title="", columns=("name", "value"), rows=rows)
    assert printed(page_with(table), 20, verbose=True).splitlines()[-5:] == [
        "name           value",
        "─" * 20,
        "関節 of the      1.5",
        "left arm",
        "x                -10",
    ]
