"""How a log looks, in plain numbers: its clock and its columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array

ROUNDING = 1e-12  # of the largest value: closer ones are one value, computed twice


@dataclass(frozen=True)
class ColumnSummary:
    """One column of a recording, in the model's unit.

    source: column of the log;  minimum, maximum: NaN where it is empty;  empty_share: share of the rows, 0 ... 1
    resolution: least difference between two values that differ, 0 where none do
    """

    name: str
    source: str
    minimum: float
    maximum: float
    empty_share: float
    resolution: float


@dataclass(frozen=True)
class LogSummary:
    """One log as it was read.

    duration [s];  rate: [Hz] from the median step;  jitter_std, jitter_max: [s] of the steps about their median
    longest_step: [s] longest step;  dropped: rows outside the window
    """

    file: str
    rows: int
    duration: float
    rate: float
    jitter_std: float
    jitter_max: float
    longest_step: float
    dropped: int
    columns: tuple[ColumnSummary, ...]


def summarize(
    file: str, t: Array, columns: Mapping[str, Array], sources: Mapping[str, str], dropped: int
) -> LogSummary:
    """t: (M,) [s], M > 1;  columns: (M,) each by name;  sources: what they are called in the log"""
    steps = np.diff(t)
    median = float(np.median(steps))
    off = steps - median
    return LogSummary(
        file,
        len(t),
        float(t[-1] - t[0]),
        1.0 / median,
        float(off.std()),
        float(np.abs(off).max()),
        float(steps.max()),
        dropped,
        tuple(_column(name, sources[name], values) for name, values in columns.items()),
    )


def _column(name: str, source: str, values: Array) -> ColumnSummary:
    there = np.sort(values[np.isfinite(values)])
    empty = 1.0 - len(there) / len(values)
    if not len(there):
        return ColumnSummary(name, source, float("nan"), float("nan"), empty, 0.0)
    apart = np.diff(there)
    apart = apart[apart > ROUNDING * np.abs(there[[0, -1]]).max()]
    return ColumnSummary(
        name,
        source,
        float(there[0]),
        float(there[-1]),
        empty,
        float(apart.min()) if len(apart) else 0.0,
    )
