"""Tables of numbers as text: CSV and its dialects, which the first lines of a file tell.

Programs write them with other delimiters than the comma, with decimal commas, comments, a row of
units, or without a header. The body of a file is read by pyarrow, so that a long log costs no more.

A control is read from such a table as well, also from a design.csv.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv

from mjfim import recordings
from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, unknown
from mjfim.recordings.quantities import is_unit

# The head of a file from which its dialect is guessed [bytes], and the part that is used [lines].
HEAD_BYTES = 1 << 16
HEAD_LINES = 100

# Delimiters that are tried, the likeliest first; a space stands for runs of spaces and tabs.
DELIMITERS = (",", ";", "\t", " ")

# How programs write a missing number, beside what pyarrow knows.
MISSING = ("", "-", "--", ".nan", "-.nan", "NAN", "nan(ind)", "-nan(ind)", "None", "none")

# Lines of comments, and the mark of a comment before a header; `%time` is the name of a column.
COMMENT = re.compile(r"\s*(?:#|%|//)")
COMMENT_LINES = re.compile(rb"(?m)^[ \t]*(?:#|%|//).*\n?")
COMMENT_MARK = re.compile(r"\s*(?:#+|//|%(?=\s))\s*")

# Cells that hold a number in another form: calendar and clock times, lists, numbers with a comma.
DATE, CLOCK = r"\d{4}-\d\d-\d\d", r"\d\d:\d\d:\d\d(?:[.,]\d+)?"
STAMP_OR_LIST = re.compile(
    rf"(?:{DATE}[T ])?{CLOCK}(?:Z|[+-]\d\d:?\d\d)?|{DATE}|\[\s*[-+]?\.?\d.*\]|true|false"
)
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")


def read_delimited(path: Path) -> Any:
    """Read a table of numbers that is written as text.

    Args:
        path: The file, packed by gzip if it ends in `.gz`; UTF-8, or UTF-16 with a mark.

    Returns:
        An arrow table. Units are part of the names, as in `q [deg]`; columns without a name are
        called `[0]`, `[1]` and so on, by their place.

    Raises:
        ArrowInvalid, csv.Error, OSError, UnicodeDecodeError: The file is damaged.
    """
    content = gzip.decompress(path.read_bytes()) if path.suffix.lower() == ".gz" else None
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES) if content is None else content[:HEAD_BYTES]
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        content = (path.read_bytes() if content is None else content).decode("utf-16").encode()
        head = content[:HEAD_BYTES]
    if len(head) == HEAD_BYTES:
        head = head.rpartition(b"\n")[0] or head
    names, skipped, delimiter, decimal = _dialect(head.decode("utf-8-sig"))
    if skipped is None:
        return pyarrow.table({name: pyarrow.nulls(0) for name in names})

    missing = pyarrow.csv.ConvertOptions().null_values
    options = {
        "parse_options": pyarrow.csv.ParseOptions(delimiter=delimiter),
        "convert_options": pyarrow.csv.ConvertOptions(
            decimal_point=decimal,
            null_values=[
                f"{before}{word}{after}"
                for word in (*missing, *MISSING)
                for before in ("", " ")
                for after in ("", " ")
            ],
        ),
    }
    # A thread of pyarrow that reads from Python can abort the process at its end.
    source = str(path) if content is None else pyarrow.BufferReader(content)
    lines = pyarrow.csv.ReadOptions(skip_rows=skipped, column_names=names)
    try:
        return pyarrow.csv.read_csv(source, lines, **options)
    except pyarrow.ArrowInvalid:
        # Comments between the rows, and columns that spaces align, are rare: they cost a second go.
        content = path.read_bytes() if content is None else content
        body = b"".join(content.splitlines(keepends=True)[skipped:])
        cleaned = COMMENT_LINES.sub(b"", body)
        if delimiter == " ":
            cleaned = re.sub(rb"(?m)^ | (?=\r?$)", b"", re.sub(rb"[ \t]+", b" ", cleaned))
        if cleaned == body:
            raise
        lines.skip_rows = 0
        return pyarrow.csv.read_csv(pyarrow.BufferReader(cleaned), lines, **options)


def _dialect(head: str) -> tuple[list[str], int | None, str, str]:
    """How a table is written.

    Returns:
        Names of the columns; the number of lines before the first row, or None without one; the
        delimiter; and the sign before the decimals of a number.
    """
    lines = re.split(r"\r\n|\n|\r", head)[:HEAD_LINES]
    kept = [i for i, line in enumerate(lines) if line.strip() and not COMMENT.match(line)]
    tables = {each: {i: _cells(lines[i], each) for i in kept} for each in DELIMITERS}
    delimiter = max(DELIMITERS, key=lambda each: _score(tables[each].values()))
    table = tables[delimiter]
    width = _width(table.values())
    # A delimiter at the end of each row makes one more cell than the header has.
    rows = {
        i: [*cells, ""][:width]
        for i, cells in table.items()
        if len(cells) == width or (len(cells) == width - 1 and cells[-1] and _are_words(cells))
    }
    numeric = [_are_numbers(column) for column in zip(*[*rows.values()][1:], strict=True)]

    # A header is a row of words, or has a word above numbers; a row of units may follow.
    (end, titles), (second, units) = [*rows.items(), (-1, []), (-1, [])][:2]
    above = (n and _are_words([cell]) for n, cell in zip(numeric, titles, strict=False))
    if any(above) or _are_words(titles):
        units = [cell.strip("[]()") for cell in units]
        end = second if _are_words(units) and any(map(is_unit, units)) else end
        units = units if end == second else []
    else:
        # The header may be a comment; lines before the first number tell of something else.
        end = next((i for i, cells in table.items() if not _are_words(cells)), 0) - 1
        remarks = (line for line in reversed(lines[: end + 1]) if COMMENT.match(line))
        named = (_cells(COMMENT_MARK.sub("", line, count=1), delimiter) for line in remarks)
        titles, units = next((cells for cells in named if len(cells) == width), [""] * width), []

    names = [
        (title or f"[{j}]") + (f" [{unit}]" if is_unit(unit) else "")
        for j, (title, unit) in enumerate(zip_longest(titles, units, fillvalue=""))
    ]
    cells_of_rows = [cell for cells in table.values() for cell in cells]
    has_commas = any(map(DECIMAL_COMMA.fullmatch, cells_of_rows))
    is_over = end >= max(kept, default=-1)
    return names, None if is_over else end + 1, delimiter, "," if has_commas else "."


def _cells(line: str, delimiter: str) -> list[str]:
    """Cells of a line without spaces around them."""
    text = line.strip().replace("\t", " ") if delimiter == " " else line
    reader = csv.reader([text], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def _width(rows: Iterable[Sequence[str]]) -> int:
    """Most frequent number of cells in a row."""
    return next((width for width, _ in Counter(map(len, rows)).most_common(1)), 0)


def _score(rows: Collection[Sequence[str]]) -> tuple[float, int]:
    """How well a delimiter fits: the share and the number of cells that are numbers."""
    width = _width(rows)
    filled = [cell for cells in rows if len(cells) == width > 1 for cell in cells if cell]
    count = sum(map(_is_number, filled))
    return (count / len(filled) if filled else -1.0), count


def _is_number(cell: str) -> bool:
    """Whether a cell holds a number, a time, a truth value or a list of numbers."""
    if STAMP_OR_LIST.fullmatch(cell):
        return True
    try:
        return bool(cell) and float(cell.replace(",", ".", 1)) is not None
    except ValueError:
        return False


def _are_words(cells: Sequence[str]) -> bool:
    """Whether cells hold text and no number."""
    filled = [cell for cell in cells if cell not in MISSING]
    return bool(filled) and not any(map(_is_number, filled))


def _are_numbers(cells: Sequence[str]) -> bool:
    """Whether most cells of a column are numbers."""
    filled = [cell for cell in cells if cell not in MISSING]
    return 2 * sum(map(_is_number, filled)) > len(filled)


# Prefixes of the columns that a design.csv has besides the time and the controls.
DESIGN_PREFIXES = ("qpos:", "qvel:", "act:", "gain:")

# Tolerance of rounded time stamps, as a fraction of the sample period.
STAMP_TOLERANCE = 1e-6

# Tolerance of the first and last time of a table [s].
TIME_TOLERANCE = 1e-9


def read_control(
    path: Path, t: Array, dt: float, names: tuple[str, ...], repeat: bool = False
) -> Array:
    """Read a control that is held from each row of a table to the next one.

    Args:
        path: CSV file with the columns `t` [s] and, for each actuator, its name or `ctrl:<name>`;
            also a design.csv.
        t: (N,) sample times [s].
        dt: Sample period [s].
        names: nu names of the actuators.
        repeat: Whether a table that ends before the last sample is repeated.

    Returns:
        (N, nu) control at the sample times [control unit].

    Raises:
        RecordingError: A column is missing or unknown, a number is missing, the times do not
            increase, or the table does not cover the sample times.
    """
    columns = recordings.read_table(path)
    keys = [name if name in columns else f"ctrl:{name}" for name in names]
    _check_columns(path, columns, names, keys)

    # The last row of a design is the final state, which has no control.
    rows = len(columns["t"])
    if f"ctrl:{names[0]}" in keys:
        held = ~np.isnan([columns[key] for key in keys]).all(axis=0)
        rows = np.flatnonzero(held)[-1] + 1 if held.any() else 0
    stamps = _finite(path, columns, ["t"], rows)[:, 0]
    values = _finite(path, columns, keys, rows)
    if len(stamps) < 2 or np.any(np.diff(stamps) <= 0):
        raise RecordingError(
            f"{path}: column 't' must increase from row to row and have at least two rows"
        )

    # The last row is held for the typical period of the table.
    end = stamps[-1] + np.median(np.diff(stamps))
    if repeat:
        t = stamps[0] + np.mod(t - t[0] + STAMP_TOLERANCE * dt, end - stamps[0])
    elif stamps[0] > t[0] + TIME_TOLERANCE or end < t[-1] + dt - TIME_TOLERANCE:
        raise RecordingError(
            f"{path}: too few rows: the table covers t = {stamps[0]:g} ... {end:g} s with "
            f"{len(stamps)} rows, the experiment needs 0 ... {t[-1] + dt:g} s ({len(t)} samples)"
        )
    row = np.searchsorted(stamps, t + STAMP_TOLERANCE * dt, side="right") - 1
    return values[np.clip(row, 0, len(stamps) - 1)]


def _check_columns(
    path: Path, columns: Mapping[str, Array], names: Sequence[str], keys: Sequence[str]
) -> None:
    """Refuse a table that lacks the time or a control, or has a column that means nothing."""
    if "t" not in columns:
        raise RecordingError(f"{path}: column 't' is missing; found: {listed([*columns])}")
    for name, key in zip(names, keys, strict=True):
        if key not in columns:
            raise RecordingError(
                f"{path}: no column for actuator {name!r}; expected columns: t, "
                f"{listed(names)}; found: {listed([*columns])}"
            )
    known = {"t", *names, *keys}
    for column in columns:
        if column not in known and not column.startswith(DESIGN_PREFIXES):
            raise RecordingError(f"{path}: {unknown('column', column, ['t', *names])}")


def _finite(path: Path, table: Mapping[str, Array], names: Sequence[str], rows: int) -> Array:
    """(rows, len(names)) numbers of some columns, all of which must be finite."""
    values = np.array([table[name][:rows] for name in names]).reshape(len(names), rows).T
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise RecordingError(
            f"{path}: column {names[column]!r} holds no finite number in data row {row + 1}"
        )
    return values
