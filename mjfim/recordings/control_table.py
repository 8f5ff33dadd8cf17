"""Read a control from a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, unknown
from mjfim.recordings.formats.read import read_table

OF_DESIGN = ("qpos:", "qvel:", "act:", "gain:")  # what a design.csv holds beside t and the control


def read_control(
    path: Path, t: Array, dt: float, names: tuple[str, ...], repeat: bool = False
) -> Array:
    """(N, nu) control at times t: (N,), held between rows. Columns: t and each actuator's name (`ctrl:` optional).

    repeat: where the table ends early, it begins again
    """
    columns = read_table(path)
    if "t" not in columns:
        raise RecordingError(f"{path}: column 't' is missing; found: {', '.join(columns)}")
    chosen = []
    for name in names:
        key = name if name in columns else f"ctrl:{name}"
        if key not in columns:
            raise RecordingError(
                f"{path}: no column for actuator {name!r}; wanted columns: t, {', '.join(names)}; found: {', '.join(columns)}"
            )
        chosen.append(columns[key])
    stamps, values = columns["t"], np.column_stack(chosen)
    if "ctrl:" + names[0] in columns:  # a design: its last row has no control
        while len(values) and np.isnan(values[-1]).all():
            stamps, values = stamps[:-1], values[:-1]
    known = {"t", *names, *(f"ctrl:{n}" for n in names)}
    strays = [c for c in columns if c not in known and not c.startswith(OF_DESIGN)]
    if strays:
        raise RecordingError(f"{path}: {unknown('column', strays[0], ['t', *names])}")
    if not np.isfinite(values).all() or not np.isfinite(stamps).all():
        bad = int(np.argmax(~np.isfinite(np.column_stack([stamps, values])).all(axis=1)))
        raise RecordingError(
            f"{path}: NaN or infinite value in data row {bad + 1}; every row must be finite"
        )
    if len(stamps) < 2 or np.any(np.diff(stamps) <= 0):
        raise RecordingError(
            f"{path}: column 't' must increase from row to row and have at least two rows"
        )
    period = float(np.median(np.diff(stamps)))
    if repeat:
        t = stamps[0] + np.mod(t - t[0] + 1e-6 * dt, stamps[-1] + period - stamps[0])
    elif stamps[0] > t[0] + 1e-9 or stamps[-1] + period < t[-1] + dt - 1e-9:
        raise RecordingError(
            f"{path}: too few rows: the table covers t = {stamps[0]:g} ... {stamps[-1] + period:g} s with {len(stamps)} rows, "
            f"the experiment needs 0 ... {t[-1] + dt:g} s ({len(t)} samples)"
        )
    row = np.clip(np.searchsorted(stamps, t + 1e-6 * dt, side="right") - 1, 0, len(stamps) - 1)
    return np.asarray(values[row])
