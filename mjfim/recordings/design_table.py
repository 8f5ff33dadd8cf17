"""Read the design.csv that a robot plays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjfim.errors import RecordingError
from mjfim.model.coordinates import gain_names, state_names
from mjfim.recordings.channels import Channels
from mjfim.recordings.formats.read import read_table
from mjfim.records.playback import Playback


def read_playback(path: Path, channels: Channels) -> Playback:
    """design.csv as it was written, at whatever rate. Raises RecordingError naming file and column."""
    table = read_table(path)
    controls = tuple(f"ctrl:{name}" for name in channels.controls)
    wanted = (
        "t",
        *state_names(channels.model),
        *controls,
        *gain_names(channels.model, channels.controls),
    )
    missing = next((name for name in wanted if name not in table), None)
    if missing is not None:
        raise RecordingError(
            f"{path}: column {missing!r} is missing; it is no design.csv of this model"
        )
    t = table["t"]
    if len(t) < 3:
        raise RecordingError(f"{path}: too few rows ({len(t)}); a playback needs at least 3")
    period = (t[-1] - t[0]) / (len(t) - 1)
    timestep = float(channels.model.opt.timestep)
    steps = round(period / timestep)
    if steps < 1 or not np.abs(
        t - np.arange(len(t)) * steps * timestep
    ).max() <= 1e-6 * timestep * len(t):
        raise RecordingError(
            f"{path}: column 't' does not go from 0 in equal periods of whole timesteps ({timestep:g} s)"
        )
    parts = []
    for names, rows in (
        (state_names(channels.model), None),
        (controls, -1),
        (gain_names(channels.model, channels.controls), -1),
    ):
        values = np.column_stack([table[name][:rows] for name in names])
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise RecordingError(
                f"{path}: column {names[column]!r} has no number in data row {row + 1}"
            )
        parts.append(values)
    state, ctrl, gain = parts
    return Playback(
        t=np.arange(len(t)) * (steps * timestep),
        state=state,
        ctrl=ctrl,
        gain=gain.reshape(len(ctrl), len(controls), -1),
    )
