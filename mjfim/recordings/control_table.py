"""Reader of a control from a CSV table, also from a design.csv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mjfim import recordings
from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, unknown

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
