"""Summary of a log: its clock, and the range and resolution of its columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array

# Differences below this fraction of the column's largest value are rounding errors.
ROUNDING = 1e-12


@dataclass(frozen=True, kw_only=True)
class ColumnSummary:
    """Range and resolution of one column of a recording, in the model's unit.

    Attributes:
        name: Name of the column in the recording.
        source: Name of the column in the log.
        minimum: Smallest value, NaN if the column is empty.
        maximum: Largest value, NaN if the column is empty.
        empty_share: Share of the rows that are empty, 0 to 1.
        resolution: Smallest difference between two different values, 0 if all values are equal.
    """

    name: str
    source: str
    minimum: float
    maximum: float
    empty_share: float
    resolution: float


@dataclass(frozen=True, kw_only=True)
class LogSummary:
    """Clock and columns of one log.

    Attributes:
        file: The log.
        rows: Number of rows inside the window.
        duration: Time from the first to the last row [s].
        rate: Inverse of the median step [Hz].
        jitter_std: Standard deviation of the steps about their median [s].
        longest_step: Longest step [s].
        dropped: Number of rows outside the window.
        columns: Summary of each column of the recording.
    """

    file: str
    rows: int
    duration: float
    rate: float
    jitter_std: float
    longest_step: float
    dropped: int
    columns: tuple[ColumnSummary, ...]


def summarize(
    file: str, t: Array, columns: Mapping[str, Array], sources: Mapping[str, str], dropped: int
) -> LogSummary:
    """Summarize a log.

    Args:
        file: The log.
        t: (M,) times inside the window [s], M > 1.
        columns: (M,) values by name of the recording's column, NaN where empty.
        sources: Name of the log's column, by name of the recording's column.
        dropped: Number of rows outside the window.

    Returns:
        The summary.
    """
    steps = np.diff(t)
    median = float(np.median(steps))

    return LogSummary(
        file=file,
        rows=len(t),
        duration=float(t[-1] - t[0]),
        rate=1.0 / median,
        jitter_std=float(steps.std()),
        longest_step=float(steps.max()),
        dropped=dropped,
        columns=tuple(_column(name, sources[name], values) for name, values in columns.items()),
    )


def _column(name: str, source: str, values: Array) -> ColumnSummary:
    """Summary of one column; values: (M,), NaN where empty."""
    present = np.sort(values[np.isfinite(values)])

    differences = np.diff(present)
    rounding = ROUNDING * np.abs(present[[0, -1]]).max()
    differences = differences[differences > rounding]

    return ColumnSummary(
        name=name,
        source=source,
        minimum=float(present[0]),
        maximum=float(present[-1]),
        empty_share=1.0 - len(present) / len(values),
        resolution=float(differences.min()) if len(differences) else 0.0,
    )
