"""Reader of a control from a CSV table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, unknown
from mjfim.recordings import formats

# Prefixes of the columns that a design.csv has besides the time and the controls.
DESIGN_PREFIXES = ("qpos:", "qvel:", "act:", "gain:", "note:")

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
    columns = formats.read_table(path)
    stamps, values = _columns_of_control(path, columns, names)
    _check_values(path, stamps, values)

    # The last row is held for the typical period of the table.
    period = float(np.median(np.diff(stamps)))
    end = stamps[-1] + period

    if repeat:
        t = stamps[0] + np.mod(t - t[0] + STAMP_TOLERANCE * dt, end - stamps[0])
    elif stamps[0] > t[0] + TIME_TOLERANCE or end < t[-1] + dt - TIME_TOLERANCE:
        raise RecordingError(
            f"{path}: too few rows: the table covers t = {stamps[0]:g} ... {end:g} s with "
            f"{len(stamps)} rows, the experiment needs 0 ... {t[-1] + dt:g} s ({len(t)} samples)"
        )

    row = np.searchsorted(stamps, t + STAMP_TOLERANCE * dt, side="right") - 1
    return np.asarray(values[np.clip(row, 0, len(stamps) - 1)])


def _columns_of_control(
    path: Path, columns: Mapping[str, Array], names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Times: (M,) and controls: (M, nu) of a table with a control, or of a design.csv."""
    if "t" not in columns:
        raise RecordingError(f"{path}: column 't' is missing; found: {listed([*columns])}")

    keys = [name if name in columns else f"ctrl:{name}" for name in names]
    for name, key in zip(names, keys, strict=True):
        if key not in columns:
            raise RecordingError(
                f"{path}: no column for actuator {name!r}; expected columns: t, "
                f"{listed(names)}; found: {listed([*columns])}"
            )

    known = {"t", *names, *(f"ctrl:{name}" for name in names)}
    for column in columns:
        if column not in known and not column.startswith(DESIGN_PREFIXES):
            raise RecordingError(f"{path}: {unknown('column', column, ['t', *names])}")

    stamps = columns["t"]
    values = np.column_stack([columns[key] for key in keys])

    # The last row of a design is the final state, which has no control.
    if f"ctrl:{names[0]}" in columns:
        while len(values) and np.isnan(values[-1]).all():
            stamps, values = stamps[:-1], values[:-1]
    return stamps, values


def _check_values(path: Path, stamps: Array, values: Array) -> None:
    """Refuse times: (M,) that do not increase, and numbers that are not finite. values: (M, nu)."""
    finite = np.isfinite(stamps) & np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite)) + 1
        raise RecordingError(
            f"{path}: NaN or infinite value in data row {row}; every row must be finite"
        )

    if len(stamps) < 2 or np.any(np.diff(stamps) <= 0):
        raise RecordingError(
            f"{path}: column 't' must increase from row to row and have at least two rows"
        )
