"""Reader of a design.csv, the table that a controller applies to a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.model.coordinates import gain_names, state_names
from mjfim.recordings import formats
from mjfim.recordings.channels import Channels
from mjfim.records.trajectory import Playback

# Smallest number of rows of a playback.
MIN_ROWS = 3

# Largest deviation of the time stamps from the grid, per row, as a fraction of a timestep.
STAMP_TOLERANCE = 1e-6


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
    table = formats.read_table(path)
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
    state = _stacked(path, table, states, len(t))
    ctrl = _stacked(path, table, controls, len(t) - 1)
    gain = _stacked(path, table, gains, len(t) - 1)

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


def _stacked(path: Path, table: Mapping[str, Array], names: Sequence[str], rows: int) -> Array:
    """(rows, len(names)) numbers of some columns, all of which must be finite."""
    if not names:
        return np.zeros((rows, 0))
    values = np.column_stack([table[name][:rows] for name in names])

    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise RecordingError(
            f"{path}: column {names[column]!r} holds no finite number in data row {row + 1}"
        )
    return values
