"""Summaries of results for a terminal: rich tables and sentences."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from mjfim.output.summary_parts import Emphasis, Listing, Paragraph, Part, Summary, SummaryTable

# Rich style of every emphasis.
STYLES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "bold",
    Emphasis.WEAK: "dim",
    Emphasis.WARNING: "yellow",
    Emphasis.STRONG_WARNING: "bold yellow",
    Emphasis.DERIVED: "cyan",
}


def render(summary: Summary) -> RenderableType:
    """Render a summary for a terminal: tables and sentences, how the work ended, warnings.

    Details are left out.

    Args:
        summary: The summary.
    """
    parts = [_rendered(part) for part in summary.parts if not _is_detail(part)]
    if summary.outcome:
        parts.append(Text(summary.outcome))
    parts += [Text(f"warning: {warning}", style="yellow") for warning in summary.warnings]
    return Group(*parts)


def _is_detail(part: Part) -> bool:
    """Return whether a short form leaves a part out."""
    return not isinstance(part, Listing) and part.detail


def _rendered(part: Part) -> RenderableType:
    """Render one part of a summary."""
    if isinstance(part, SummaryTable):
        return _table(part)
    if isinstance(part, Paragraph):
        return Text(part.text, style=STYLES[part.emphasis])

    lines = [Text(part.title, style="bold")]
    for item in part.items:
        indented = item.replace("\n", "\n  ")
        lines.append(Text(f"  {indented}", style=STYLES[part.emphasis]))
    return Group(*lines)


def _table(table: SummaryTable) -> Table:
    """Render a table."""
    rendered = Table(title=Text(table.title, style="table.title"), title_justify="left")
    for column in table.columns:
        rendered.add_column(
            Text(str(column.heading)),
            justify="left" if column.left else "right",
            no_wrap=table.unbroken and not column.left,
        )
    for row in table.rows:
        cells = [Text(str(cell)) for cell in row.cells]
        rendered.add_row(*cells, style=STYLES[row.emphasis])

    if table.note:
        rendered.caption = Text(table.note, style="table.caption")
        rendered.caption_justify = "left"
    return rendered
