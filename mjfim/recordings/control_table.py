"""Readers of a control from a CSV table, and of a design.csv, which is played on a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mjfim import recordings
from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, unknown
from mjfim.model.coordinates import gain_names, state_names
from mjfim.recordings.channels import Channels
from mjfim.records.trajectory import Playback

# Prefixes of the columns that a design.csv has besides the time and the controls.
DESIGN_PREFIXES = ("qpos:", "qvel:", "act:", "gain:", "note:")

# Tolerance of rounded time stamps, as a fraction of the sample period; per row of a design.csv as a
# fraction of a timestep.
STAMP_TOLERANCE = 1e-6

# Tolerance of the first and last time of a table [s].
TIME_TOLERANCE = 1e-9

# Smallest number of rows of a playback.
MIN_ROWS = 3


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
        rows = int(np.flatnonzero(held)[-1]) + 1 if held.any() else 0
    stamps = _finite(path, columns, ["t"], rows)[:, 0]
    values = _finite(path, columns, keys, rows)
    if len(stamps) < 2 or np.any(np.diff(stamps) <= 0):
        raise RecordingError(
            f"{path}: column 't' must increase from row to row and have at least two rows"
        )

    # The last row is held for the typical period of the table.
    end = stamps[-1] + float(np.median(np.diff(stamps)))
    if repeat:
        t = stamps[0] + np.mod(t - t[0] + STAMP_TOLERANCE * dt, end - stamps[0])
    elif stamps[0] > t[0] + TIME_TOLERANCE or end < t[-1] + dt - TIME_TOLERANCE:
        raise RecordingError(
            f"{path}: too few rows: the table covers t = {stamps[0]:g} ... {end:g} s with "
            f"{len(stamps)} rows, the experiment needs 0 ... {t[-1] + dt:g} s ({len(t)} samples)"
        )
    row = np.searchsorted(stamps, t + STAMP_TOLERANCE * dt, side="right") - 1
    return np.asarray(values[np.clip(row, 0, len(stamps) - 1)])


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


def read_playback(path: Path, channels: Channels) -> Playback:
    """Read a design.csv at the rate at which it was written.

    Args:
        path: The file.
        channels: The signals of the experiment to which the design belongs.

    Returns:
        States, controls and gains of every row.

    Raises:
        RecordingError: A column or a number is missing, or the times are not equally spaced.
    """
    table = recordings.read_table(path)
    states = state_names(channels.model)
    controls = channels.control_columns
    gains = gain_names(channels.model, channels.controls)
    for name in ("t", *states, *controls, *gains):
        if name not in table:
            raise RecordingError(
                f"{path}: column {name!r} is missing; the file is not a design.csv of this model"
            )

    # The last row is the final state, which has neither control nor gain.
    t = _grid(path, table["t"], float(channels.model.opt.timestep))
    state = _finite(path, table, states, len(t))
    ctrl = _finite(path, table, controls, len(t) - 1)
    gain = _finite(path, table, gains, len(t) - 1)

    # Gains have one column for each deviation of the state; without controls there are none.
    nx = 2 * channels.model.nv + channels.model.na
    return Playback(t=t, state=state, ctrl=ctrl, gain=gain.reshape(len(ctrl), len(controls), nx))


def _grid(path: Path, t: Array, timestep: float) -> Array:
    """(M+1,) times of the rows without rounding [s]; the period is a whole number of timesteps."""
    if len(t) < MIN_ROWS:
        raise RecordingError(
            f"{path}: too few rows ({len(t)}); a playback needs at least {MIN_ROWS}"
        )
    period = (t[-1] - t[0]) / (len(t) - 1)
    steps = round(period / timestep)
    grid = np.arange(len(t)) * (steps * timestep)
    # The comparison is negated so that NaN is refused, too.
    if steps < 1 or not np.abs(t - grid).max() <= STAMP_TOLERANCE * timestep * len(t):
        raise RecordingError(
            f"{path}: column 't' must begin at 0 and increase by equal periods, each a whole "
            f"number of timesteps ({timestep:g} s)"
        )
    return np.asarray(grid)


def _finite(path: Path, table: Mapping[str, Array], names: Sequence[str], rows: int) -> Array:
    """(rows, len(names)) numbers of some columns, all of which must be finite."""
    values = np.array([table[name][:rows] for name in names]).reshape(len(names), rows).T
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise RecordingError(
            f"{path}: column {names[column]!r} holds no finite number in data row {row + 1}"
        )
    return values
