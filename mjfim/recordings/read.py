"""A robot's log as a recording: the experiment's `[recording]` table applied to the columns of a file.

Times stay the log's own and nothing is interpolated; only controls are held over rows where they are empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, unknown
from mjfim.model.coordinates import state_components
from mjfim.recordings.angle_units import check_angles
from mjfim.recordings.channels import Channels
from mjfim.recordings.column_units import check_unit, converted, units_of
from mjfim.recordings.formats.read import read_columns
from mjfim.recordings.formats.table import Table
from mjfim.recordings.spec import ColumnSpec, RecordingSpec
from mjfim.recordings.summary import LogSummary, summarize
from mjfim.recordings.validity import (
    SECONDS,
    check_clock,
    check_finite,
    check_held,
    check_measured,
    held,
)
from mjfim.records.recording import Recording

ROUNDING = 1e-9  # [s] by which a time may miss the window


@dataclass(frozen=True, eq=False)
class Log:
    """A recording and how the log looked that it was read from."""

    recording: Recording
    summary: LogSummary


def read_recording(path: Path, channels: Channels) -> Recording:
    """A recording from a log of any format. Raises RecordingError naming file and column."""
    return read_log(path, channels).recording


def read_log(path: Path, channels: Channels) -> Log:
    """A recording and how its log looks. Raises RecordingError naming file and column."""
    spec = channels.spec
    check_spec(channels)
    table = read_columns(path, spec)
    plan = _plan(table, channels)
    t, rows = _window(table, spec)
    check_clock(f"{path}: column {spec.time!r}", t[rows], rows.start, spec.time_unit, spec.gap)
    columns = _columns(table, plan, t, rows, spec)
    dropped, t = len(t) - len(t[rows]), t[rows] - t[rows.start]
    measured = tuple(name for name in plan if not name.startswith("ctrl:"))
    for name in measured:
        check_measured(f"{path}: column {plan[name].column!r}", t, columns[name], spec.gap)
    stated = {name for name, source in plan.items() if source.unit is not None}
    check_angles(str(path), channels.model, t, columns, stated)
    ctrl = np.column_stack([columns[f"ctrl:{name}"][:-1] for name in channels.controls])
    y = np.column_stack([columns[name] for name in measured])
    summary = summarize(
        str(path), t, columns, {name: source.column for name, source in plan.items()}, dropped
    )
    return Log(Recording(t=t, ctrl=ctrl, y=y, outputs=measured, name=str(path)), summary)


def check_spec(channels: Channels) -> None:
    """Raise ExperimentError where [recording.columns] has an unknown key or a unit that does not fit."""
    where, units = f"{channels.source}: recording.columns", units_of(channels.model)
    units.update({f"ctrl:{name}": "any" for name in channels.controls})
    for name, source in channels.spec.sources.items():
        if name not in units:
            raise ExperimentError(f"{where}: {unknown('column', name, units)}")
        check_unit(f"{where}.{name}", source, units[name])


def _plan(table: Table, channels: Channels) -> dict[str, ColumnSpec]:
    """Source of every column of the recording: all controls, then what is measured.

    What the experiment does not name has mjfim's own name; measured columns only where it names none of them.
    """
    stated, own = channels.spec.sources, _own(table, channels)
    controls = [f"ctrl:{name}" for name in channels.controls]
    plan = {name: stated.get(name) or ColumnSpec(column=own.get(name, name)) for name in controls}
    for name in controls:
        table.column(plan[name].column)
    measured = {name: source for name, source in stated.items() if name not in plan}
    if not measured:
        known = {*controls, *channels.measurable}
        for name in table.names:
            if name.startswith(("ctrl:", "qpos:", "qvel:")) and name not in known:
                raise RecordingError(
                    f"{table.source}: {unknown('column', name, ['t', *sorted(known)])}"
                )
        measured = {name: ColumnSpec(column=own[name]) for name in channels.outputs if name in own}
    if not any(name in measured for name in channels.outputs):
        taken = {channels.spec.time, *(s.column for s in plan.values())}
        strays = ", ".join(measured or [c for c in table.names if c not in taken]) or "none"
        raise RecordingError(
            f"{table.source}: no measured column; {unknown('column', strays, channels.outputs)}"
        )
    return {**plan, **measured}


def _own(table: Table, channels: Channels) -> dict[str, str]:
    """Columns of the table by mjfim's names: also those of a bag, and the matrices of a design.npz."""
    names, model = table.names, channels.model
    found = {
        name.replace(kind, q, 1): name
        for kind, q in (("position:", "qpos:"), ("velocity:", "qvel:"))
        for name in names
        if name.startswith(kind)
    }
    state = [c.name for c in state_components(model)]
    wholes = {
        "qpos": state[: model.nq],
        "qvel": state[model.nq :],
        "ctrl": [f"ctrl:{n}" for n in channels.controls],
    }
    stated = channels.spec.sources
    if any(not name.startswith("ctrl:") for name in stated):
        del wholes["qpos"], wholes["qvel"]
    if all(name in stated for name in wholes["ctrl"]):
        del wholes["ctrl"]
    for whole, parts in wholes.items():
        labels = [name for name in names if name == whole or name.startswith(f"{whole}[")]
        if labels and len(labels) != len(parts):
            raise RecordingError(
                f"{table.source}: array {whole!r} has {len(labels)} columns, the model {len(parts)}: {', '.join(parts)}"
            )
        found.update(zip(parts, labels, strict=bool(labels)))
    return {**found, **{name: name for name in names}}


def _window(table: Table, spec: RecordingSpec) -> tuple[Array, slice]:
    """(M,) times [s] of all rows and the rows that are used: from the window's begin to the first time after its end."""
    t = table.column(spec.time) * SECONDS[spec.time_unit]
    if spec.window is None or not len(t):
        return t, slice(0, len(t))
    since = t - t[0]
    reached = since >= spec.window[0] - ROUNDING
    begin = int(np.argmax(reached)) if reached.any() else len(t)
    after = since[begin:] > spec.window[1] + ROUNDING
    end = begin + (int(np.argmax(after)) if after.any() else len(after))
    if end - begin < 1:
        raise RecordingError(
            f"{table.source}: recording.window: no row between {spec.window[0]:g} and {spec.window[1]:g} s; "
            f"the log lasts {t[-1] - t[0]:g} s"
        )
    return t, slice(begin, end)


def _columns(
    table: Table, plan: Mapping[str, ColumnSpec], t: Array, rows: slice, spec: RecordingSpec
) -> dict[str, Array]:
    """Converted columns in the window; controls held where they are empty, from before the window too."""
    columns = {}
    for name, source in plan.items():
        for raw in (source.column, *source.multiply_by):
            check_finite(f"{table.source}: column {raw!r}", table.column(raw)[rows], rows.start)
        values = converted(table, source)
        if name.startswith("ctrl:"):
            values, age = held(t, values)
            where = f"{table.source}: column {source.column!r} (the control {name!r})"
            check_held(where, t[rows][:-1], values[rows][:-1], age[rows][:-1], spec.gap)
        columns[name] = values[rows]
        check_finite(f"{table.source}: column {name!r}", columns[name], rows.start)
    return columns
