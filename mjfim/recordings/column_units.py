"""What one column of a log becomes: counters and signs undone, units, scales, factors. Formula (1):

value = (scale * unit * raw + offset) * product of the columns `multiply_by`
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, unknown
from mjfim.model.coordinates import state_components
from mjfim.model.paths import names_of
from mjfim.recordings.formats.table import Table
from mjfim.recordings.spec import ColumnSpec

TURN = 2.0 * np.pi
FACTORS = {
    "rad": {"rad": 1.0, "deg": TURN / 360.0, "rev": TURN},
    "rad/s": {"rad/s": 1.0, "deg/s": TURN / 360.0, "rev/s": TURN, "rpm": TURN / 60.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3},
}


EVERY = {unit: factor for table in FACTORS.values() for unit, factor in table.items()}
SENSORS = {
    mujoco.mjtSensor.mjSENS_GYRO: "rad/s",
    mujoco.mjtSensor.mjSENS_BALLANGVEL: "rad/s",
    mujoco.mjtSensor.mjSENS_FRAMEANGVEL: "rad/s",
    mujoco.mjtSensor.mjSENS_VELOCIMETER: "m/s",
    mujoco.mjtSensor.mjSENS_FRAMELINVEL: "m/s",
    mujoco.mjtSensor.mjSENS_SUBTREELINVEL: "m/s",
    mujoco.mjtSensor.mjSENS_TENDONVEL: "m/s",
    mujoco.mjtSensor.mjSENS_FRAMEPOS: "m",
    mujoco.mjtSensor.mjSENS_SUBTREECOM: "m",
    mujoco.mjtSensor.mjSENS_RANGEFINDER: "m",
    mujoco.mjtSensor.mjSENS_TENDONPOS: "m",
}


OPEN = (
    mujoco.mjtSensor.mjSENS_ACTUATORPOS,
    mujoco.mjtSensor.mjSENS_ACTUATORVEL,
    mujoco.mjtSensor.mjSENS_USER,
)


def units_of(model: Any) -> dict[str, str]:
    """The model's unit of everything that can be measured by column: rad, rad/s, m, m/s; `any` or `none` of them."""
    units = {c.name: c.unit or "none" for c in state_components(model)}
    for name in names_of(model, "sensor"):
        sensor = model.sensor(name)
        kind = mujoco.mjtSensor(int(sensor.type[0]))
        unit = "any" if kind in OPEN else SENSORS.get(kind, "none")
        if kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
            slide = int(model.jnt_type[int(sensor.objid[0])]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
            unit = ("m" if slide else "rad") + (
                "" if kind == mujoco.mjtSensor.mjSENS_JOINTPOS else "/s"
            )
        width = int(sensor.dim[0])
        units.update(
            dict.fromkeys([name] if width == 1 else [f"{name}[{i}]" for i in range(width)], unit)
        )
    return units


def check_unit(where: str, spec: ColumnSpec, unit: str) -> None:
    """Raise ExperimentError where a column's unit is not one of what it stands for. unit: the model's, as in `units_of`"""
    fitting = list(EVERY) if unit == "any" else list(FACTORS.get(unit, {}))
    if spec.unit is not None and spec.unit not in fitting:
        raise ExperimentError(
            f"{where}.unit: {unknown('unit', spec.unit, fitting)}; for others there is scale"
        )
    if spec.unwrap and unit not in ("rad", "any"):
        raise ExperimentError(
            f"{where}.unwrap: only angles jump by whole turns; a counter has a period"
        )


def converted(table: Table, spec: ColumnSpec) -> Array:
    """(M,) by formula (1). Raises RecordingError where a column is missing, or has numbers that cannot be."""
    raw = table.column(spec.column)
    if spec.signed is not None:
        raw = _signed(table, spec.column, raw, spec.signed)
    if spec.period is not None:
        raw = _unwrapped(raw, spec.period)
    factor = spec.scale * (1.0 if spec.unit is None else EVERY[spec.unit])
    value = raw if factor == 1.0 and spec.offset == 0.0 else factor * raw + spec.offset
    if spec.unwrap:
        value = _unwrapped(value, TURN)
    for name in spec.multiply_by:
        value = value * table.column(name)
    return np.asarray(value)


def _signed(table: Table, name: str, raw: Array, bits: int) -> Array:
    """Two's complement of whole numbers; those that have their sign already keep it."""
    half = 2.0 ** (bits - 1)
    wrong = np.isfinite(raw) & ((raw < -half) | (raw >= 2.0 * half) | (raw != np.rint(raw)))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise RecordingError(
            f"{table.source}: column {name!r} holds {raw[row]:g} in data row {row + 1}, which is no integer of {bits} bits"
        )
    return np.asarray(np.where(raw >= half, raw - 2.0 * half, raw))


def _unwrapped(raw: Array, period: float) -> Array:
    """Without jumps of more than half a period, over holes too."""
    there = np.isfinite(raw)
    whole = np.array(raw)
    whole[there] = np.unwrap(raw[there], period=period)
    return whole
