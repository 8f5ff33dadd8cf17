"""Summaries of results for a terminal: how the work ended, then tables and sentences.

The short form has at most `MAX_LINES` lines: details are left out. Where this is not enough, long
sentences and wide tables lose the parts that can be spared, and of long tables and lists only the
beginning is shown, and the rows with a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from mjfim.output.condensed import condensed
from mjfim.output.summary_parts import (
    Emphasis,
    Paragraph,
    Part,
    Summary,
    SummaryTable,
    capitalised,
)
from mjfim.output.terminal_tables import INDENTATION, fold, table_text

# Largest number of lines of the short form. With what a verb says about the duration of its work
# and about its files, the output has less than 25 lines.
MAX_LINES = 20

# Number of rows of results, and of other rows or sentences of each table and list, that the short
# form shows if others can be left out instead.
FEWEST_RESULTS = 10
FEWEST = 2

# Largest number of lines of a sentence where there is no room.
MAX_SENTENCE_LINES = 2

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
        layout = _Layout(width=width, rule=rule, verbose=self.verbose)
        blocks = list(_blocks(self.summary, layout))
        if not self.verbose:
            _leave_out_explanations(blocks, width)

            # Sentences lose their remarks, and tables their least columns, before rows are missing.
            if not _fits(blocks, width):
                blocks = list(_blocks(self.summary, replace(layout, narrow=True)))
                _leave_out_explanations(blocks, width)
            _shorten(blocks, width)

        lines: list[tuple[str, Emphasis]] = []
        for block in blocks:
            # The long form has the room for blank lines between its parts.
            if self.verbose and lines and block.is_table:
                lines.append(("", Emphasis.NORMAL))
            lines += block.lines()
        lines += [(line, Emphasis.WEAK) for line in _closing(blocks, width)]
        return lines


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """How a summary is laid out.

    Attributes:
        width: Width of the terminal [characters].
        rule: Character of the lines below headings.
        verbose: True for everything.
        narrow: Whether sentences and tables lose the parts that can be spared.
    """

    width: int
    rule: str
    verbose: bool
    narrow: bool = False

    def sentence(self, text: str, width: int) -> str:
        """A sentence, without the parts that can be spared where there is no room.

        Args:
            text: The sentence.
            width: Width of its lines [characters].
        """
        return condensed(text, width, MAX_SENTENCE_LINES) if self.narrow else text


@dataclass(kw_only=True)
class _Unit:
    """Lines that are shown together or not at all.

    Attributes:
        lines: The lines.
        emphasis: How strongly they stand out.
        is_whole: Whether no part of a sentence is left out.
    """

    lines: Sequence[str]
    emphasis: Emphasis
    is_whole: bool = True


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
        hidden_columns: Headings of columns that are not shown.
        is_whole: Whether no part of a sentence before its units is left out.
    """

    head: list[tuple[str, Emphasis]] = field(default_factory=list)
    units: list[_Unit] = field(default_factory=list)
    tail: list[tuple[str, Emphasis]] = field(default_factory=list)
    kind: str = ""
    hidden: int = 0
    is_table: bool = False
    hidden_columns: Sequence[str] = ()
    is_whole: bool = True

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
    def is_shortened(self) -> bool:
        """Whether a part of a sentence is left out."""
        return not (self.is_whole and all(unit.is_whole for unit in self.units))

    @property
    def is_derived(self) -> bool:
        """Whether it holds results that are computed from the rows of a table."""
        return any(unit.emphasis is Emphasis.DERIVED for unit in self.units)

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


def _leave_out_explanations(blocks: Sequence[_Block], width: int) -> None:
    """Leave out explanations while the short form has too many lines."""
    _reduce([block for block in blocks if block.is_explanation], blocks, width, fewest=0)


def _shorten(blocks: Sequence[_Block], width: int) -> None:
    """Leave out units until the short form has few enough lines.

    The first table, which has the results, keeps its rows longest; a warning and a row of every
    other table stay nearly as long.
    """
    tables = [block for block in blocks if block.is_table and block.kind != "sentence"]
    results = [block for block in tables[:1] if block.units]
    others = [block for block in blocks if block not in results]
    remarks = [
        block for block in others if block.kind in ("sentence", "remark") and not block.is_derived
    ]
    _reduce(others, blocks, width, fewest=FEWEST)
    _reduce(results, blocks, width, fewest=FEWEST_RESULTS)
    _reduce(others, blocks, width, fewest=1)
    _reduce(remarks, blocks, width, fewest=0)
    _reduce(results, blocks, width, fewest=1)
    _reduce(others, blocks, width, fewest=0)


def _fits(blocks: Sequence[_Block], width: int) -> bool:
    """Whether the short form has few enough lines, with those about what is not shown."""
    height = sum(block.height for block in blocks)
    return height + len(_closing(blocks, width)) <= MAX_LINES


def _closing(blocks: Sequence[_Block], width: int) -> list[str]:
    """Lines that say what is not shown; none where all is shown."""
    hidden: dict[str, int] = {}
    for block in blocks:
        if block.kind and block.hidden:
            hidden[block.kind] = hidden.get(block.kind, 0) + block.hidden
    left_out = [
        f"{count} {kind if count == 1 else _plural(kind)}" for kind, count in hidden.items()
    ]

    headings = [each for block in blocks if block.units for each in block.hidden_columns]
    if headings:
        word = "column" if len(headings) == 1 else "columns"
        left_out.append(f"{word} {', '.join(headings)}")
    if any(block.is_shortened for block in blocks):
        left_out.append("ends of sentences")
    if not left_out:
        return []
    return fold(f"Not shown here: {', '.join(left_out)}; --verbose shows everything", width)


def _reduce(some: Sequence[_Block], blocks: Sequence[_Block], width: int, *, fewest: int) -> None:
    """Leave out units of some blocks, of the highest first, while all blocks are too high.

    Args:
        some: Blocks that may become shorter.
        blocks: All blocks.
        width: Width of the terminal [characters].
        fewest: Number of units that each of them keeps.
    """
    while not _fits(blocks, width):
        reducible = [block for block in some if len(block.units) > fewest]
        if not reducible:
            return
        max(reducible, key=lambda block: block.height).reduce()


def _blocks(summary: Summary, layout: _Layout) -> Iterator[_Block]:
    """Yield the parts of a summary as text, the important ones first."""
    width = layout.width
    if summary.outcome:
        sentence = capitalised(summary.outcome)
        shown = layout.sentence(sentence, width)
        head = [(line, summary.emphasis) for line in fold(shown, width)]
        yield _Block(head=head, is_whole=shown == sentence)

    if summary.warnings:
        sentences = [f"warning: {warning}" for warning in summary.warnings]
        units = [_sentence(each, Emphasis.WARNING, layout, width) for each in sentences]
        yield _Block(units=units, kind="warning")

    for part in summary.parts:
        if layout.verbose or not part.detail:
            yield _block(part, layout)


def _sentence(text: str, emphasis: Emphasis, layout: _Layout, width: int) -> _Unit:
    """A sentence as lines of a width [characters]."""
    shown = layout.sentence(text, width)
    return _Unit(lines=fold(shown, width), emphasis=emphasis, is_whole=shown == text)


def _block(part: Part, layout: _Layout) -> _Block:
    """One part of a summary as text."""
    if isinstance(part, SummaryTable):
        return _table(part, layout)

    width = layout.width
    if isinstance(part, Paragraph):
        unit = _sentence(part.text, part.emphasis, layout, width)

        # Explanations are left out where there is no room for them.
        if part.emphasis is Emphasis.WEAK:
            return _Block(units=[unit])
        return _Block(units=[unit], kind="remark")

    units = [_item(item, part.emphasis, layout) for item in part.items]
    head = [(line, Emphasis.STRONG) for line in fold(part.title, width)]
    return _Block(head=head, units=units, kind="sentence", is_table=True)


def _item(text: str, emphasis: Emphasis, layout: _Layout) -> _Unit:
    """An item of a list, with a hanging indentation."""
    unit = _sentence(text, emphasis, layout, layout.width - len(INDENTATION))
    unit.lines = [f"{INDENTATION}{line}" for line in unit.lines]
    return unit


def _table(table: SummaryTable, layout: _Layout) -> _Block:
    """A table as text."""
    width = layout.width
    text = table_text(table, width, verbose=layout.verbose, rule=layout.rule, narrow=layout.narrow)
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
        hidden_columns=text.left_out,
    )
