"""Summaries of results for a terminal: how the work ended, then tables and sentences.

The short form has at most `MAX_LINES` lines: details are left out, and of long tables and lists
only the beginning is shown, and the rows with a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from mjfim.output.summary_parts import (
    Emphasis,
    Paragraph,
    Part,
    Summary,
    SummaryTable,
    capitalised,
)
from mjfim.output.terminal_tables import fold, table_text

# Largest number of lines of the short form. With what a verb says about the duration of its work
# and about its files, the output has less than 25 lines.
MAX_LINES = 20

# Number of rows of results, and of other rows or sentences of each table and list, that the short
# form shows if others can be left out instead.
FEWEST_RESULTS = 10
FEWEST = 2

# Rich style of every emphasis.
STYLES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "bold",
    Emphasis.WEAK: "dim",
    Emphasis.WARNING: "yellow",
    Emphasis.STRONG_WARNING: "bold yellow",
    Emphasis.DERIVED: "cyan",
}

# Emphasis of rows that the short form shows first.
IMPORTANT = (Emphasis.WARNING, Emphasis.STRONG_WARNING, Emphasis.STRONG)


def render(summary: Summary, *, verbose: bool = False) -> SummaryText:
    """Render a summary for a terminal: how the work ended, warnings, tables and sentences.

    Args:
        summary: The summary.
        verbose: True for everything, False for the short form.
    """
    return SummaryText(summary=summary, verbose=verbose)


@dataclass(frozen=True, kw_only=True)
class SummaryText:
    """A summary that is laid out for the width of the terminal which shows it.

    Attributes:
        summary: The summary.
        verbose: True for everything, False for the short form.
    """

    summary: Summary
    verbose: bool

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        rule = "-" if options.ascii_only else "─"
        for line, emphasis in self.lines(options.max_width, rule):
            yield Text(line, style=STYLES[emphasis], no_wrap=True, overflow="ignore")

    def lines(self, width: int, rule: str = "─") -> list[tuple[str, Emphasis]]:
        """Return all lines with their emphasis.

        Args:
            width: Width of the terminal [characters].
            rule: Character of the lines below headings.
        """
        blocks = list(_blocks(self.summary, width, rule, verbose=self.verbose))
        if not self.verbose:
            _shorten(blocks)

        lines: list[tuple[str, Emphasis]] = []
        for block in blocks:
            # The long form has the room for blank lines between its parts.
            if self.verbose and lines and block.is_table:
                lines.append(("", Emphasis.NORMAL))
            lines += block.lines()
        left_out = [block.left_out for block in blocks if block.left_out]
        if left_out:
            sentence = f"Not shown here: {', '.join(left_out)}; --verbose shows everything"
            lines += [(line, Emphasis.WEAK) for line in fold(sentence, width)]
        return lines


@dataclass(kw_only=True)
class _Unit:
    """Lines that are shown together or not at all.

    Attributes:
        lines: The lines.
        emphasis: How strongly they stand out.
    """

    lines: Sequence[str]
    emphasis: Emphasis


@dataclass(kw_only=True)
class _Block:
    """A part of a summary as text.

    Attributes:
        head: Lines before its units, with their emphasis.
        units: Rows or sentences.
        tail: Lines behind its units.
        kind: Word for one unit; empty if nobody misses it.
        hidden: Number of units that are not shown.
        is_table: Whether it is a table or a list with a title.
    """

    head: list[tuple[str, Emphasis]] = field(default_factory=list)
    units: list[_Unit] = field(default_factory=list)
    tail: list[tuple[str, Emphasis]] = field(default_factory=list)
    kind: str = ""
    hidden: int = 0
    is_table: bool = False

    def lines(self) -> Iterator[tuple[str, Emphasis]]:
        """Yield all lines with their emphasis."""
        if self.hidden and not self.units:
            return

        yield from self.head
        for unit in self.units:
            yield from ((line, unit.emphasis) for line in unit.lines)
        yield from self.tail

    @property
    def height(self) -> int:
        """Number of lines."""
        return sum(1 for _ in self.lines())

    @property
    def left_out(self) -> str:
        """What is not shown, in words; empty if all is shown."""
        if not self.hidden or not self.kind:
            return ""
        return f"{self.hidden} {self.kind if self.hidden == 1 else _plural(self.kind)}"

    @property
    def is_explanation(self) -> bool:
        """Whether nobody misses it where there is no room."""
        return not self.kind and bool(self.units)

    def reduce(self) -> None:
        """Leave out the last of the units that do not stand out, or the last of all."""
        plain = [unit for unit in self.units if unit.emphasis not in IMPORTANT]
        self.units.remove((plain or self.units)[-1])
        self.hidden += 1


def _plural(noun: str) -> str:
    """Return the plural of the heading of a column."""
    return f"{noun.removesuffix('y')}ies" if noun.endswith("y") else f"{noun}s"


def _shorten(blocks: Sequence[_Block]) -> None:
    """Leave out units until the short form has few enough lines.

    Explanations go first. The first table, which has the results, keeps its rows longest.
    """
    _reduce([block for block in blocks if block.is_explanation], blocks, fewest=0)

    tables = [block for block in blocks if block.is_table and block.kind != "sentence"]
    results = [block for block in tables[:1] if block.units]
    others = [block for block in blocks if block not in results]
    _reduce(others, blocks, fewest=FEWEST)
    _reduce(results, blocks, fewest=FEWEST_RESULTS)
    _reduce(others, blocks, fewest=1)
    _reduce(results, blocks, fewest=1)
    _reduce(others, blocks, fewest=0)


def _reduce(some: Sequence[_Block], blocks: Sequence[_Block], *, fewest: int) -> None:
    """Leave out units of some blocks, of the highest first, while all blocks are too high.

    Args:
        some: Blocks that may become shorter.
        blocks: All blocks.
        fewest: Number of units that each of them keeps.
    """
    while sum(block.height for block in blocks) + 1 > MAX_LINES:
        reducible = [block for block in some if len(block.units) > fewest]
        if not reducible:
            return
        max(reducible, key=lambda block: block.height).reduce()


def _blocks(summary: Summary, width: int, rule: str, *, verbose: bool) -> Iterator[_Block]:
    """Yield the parts of a summary as text, the important ones first."""
    if summary.outcome:
        sentence = capitalised(summary.outcome)
        yield _Block(head=[(line, summary.emphasis) for line in fold(sentence, width)])

    if summary.warnings:
        sentences = [fold(f"warning: {warning}", width) for warning in summary.warnings]
        units = [_Unit(lines=lines, emphasis=Emphasis.WARNING) for lines in sentences]
        yield _Block(units=units, kind="warning")

    for part in summary.parts:
        if verbose or not part.detail:
            yield _block(part, width, rule, verbose=verbose)


def _block(part: Part, width: int, rule: str, *, verbose: bool) -> _Block:
    """One part of a summary as text."""
    if isinstance(part, SummaryTable):
        return _table(part, width, rule, verbose=verbose)

    if isinstance(part, Paragraph):
        unit = _Unit(lines=fold(part.text, width), emphasis=part.emphasis)

        # Explanations are left out where there is no room for them.
        if part.emphasis is Emphasis.WEAK:
            return _Block(units=[unit])
        return _Block(units=[unit], kind="remark")

    units = [_Unit(lines=_indented(item, width), emphasis=part.emphasis) for item in part.items]
    head = [(line, Emphasis.STRONG) for line in fold(part.title, width)]
    return _Block(head=head, units=units, kind="sentence", is_table=True)


def _indented(item: str, width: int) -> list[str]:
    """An item of a list, with a hanging indentation."""
    return [f"  {line}" for line in fold(item, width - 2)]


def _table(table: SummaryTable, width: int, rule: str, *, verbose: bool) -> _Block:
    """A table as text."""
    text = table_text(table, width, verbose=verbose, rule=rule)
    head = [(line, Emphasis.STRONG) for line in fold(table.title, width) if line]
    head += [(line, Emphasis.WEAK) for line in text.head]
    units = [_Unit(lines=row.lines, emphasis=row.emphasis) for row in text.rows]
    note = fold(table.note, width) if table.note else []
    return _Block(
        head=head,
        units=units,
        tail=[(line, Emphasis.WEAK) for line in note],
        kind=str(table.columns[0].heading) or "row",
        is_table=True,
    )
