"""Logs that were read, in tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.output.summary_parts import Cell, Quantity, Row, Summary, SummaryTable, columns
from mjfim.recordings.summary import ColumnSummary, LogSummary

# Jitter of a log below this fraction of the sample period is round-off of the time stamps.
JITTER_ROUND_OFF = 1e-6


def describe_logs(logs: Sequence[LogSummary]) -> Summary:
    """Describe what was read: the clock of every log, then the range of its columns.

    Args:
        logs: Summaries of the logs.
    """
    rows = [
        Row(
            cells=(
                log.file,
                f"{log.rows:,}",
                Quantity(value=log.duration, digits=4, suffix=" s"),
                Quantity(value=log.rate, digits=5, suffix=" Hz"),
                _jitter(log),
                Quantity(value=1e3 * log.longest_step, digits=3, suffix=" ms"),
                f"{log.dropped:,} rows" if log.dropped else "-",
            )
        )
        for log in logs
    ]
    clocks = SummaryTable(
        key="clocks",
        title="Logs that were read",
        columns=columns("log", "rows", "time", "rate", "jitter", "longest gap", "rejected"),
        rows=tuple(rows),
    )

    # Columns of the same name in several logs share a row.
    by_name: dict[str, list[ColumnSummary]] = {}
    for log in logs:
        for column in log.columns:
            by_name.setdefault(column.name, []).append(column)
    ranges = SummaryTable(
        key="ranges",
        title="Range of each column over all logs",
        columns=columns(
            "column", "from", "smallest", "largest", "resolution", "empty", left=["from"]
        ),
        rows=tuple(Row(cells=_range_cells(found)) for found in by_name.values()),
    )
    return Summary(title="", outcome="", parts=(clocks, ranges))


def _jitter(log: LogSummary) -> Cell:
    """Return the jitter of a log [ms]; "-" if it is only round-off of the time stamps."""
    if log.jitter_std * log.rate < JITTER_ROUND_OFF:
        return "-"
    return Quantity(value=1e3 * log.jitter_std, digits=2, suffix=" ms")


def _range_cells(found: Sequence[ColumnSummary]) -> tuple[Cell, ...]:
    """Return the cells of one column over all logs."""
    smallest = float(np.nanmin([column.minimum for column in found]))
    largest = float(np.nanmax([column.maximum for column in found]))
    resolutions = [column.resolution for column in found if column.resolution > 0.0]
    empty = float(np.mean([column.empty_share for column in found]))
    return (
        found[0].name,
        found[0].source,
        Quantity(value=smallest, digits=4),
        Quantity(value=largest, digits=4),
        Quantity(value=min(resolutions, default=0.0), digits=2),
        f"{100 * empty:.0f} %" if empty else "-",
    )
