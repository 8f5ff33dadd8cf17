"""Conversion of a log's column to the model's unit.

With the names of `ColumnSpec`, a column of the recording is

    value = (scale * unit * raw + offset) * product of the columns `multiply_by`          (1)

Signs are restored and counter wraps are removed from the raw numbers before; jumps by whole turns
are removed from the values.
"""

from __future__ import annotations

from typing import Any, get_args

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, unknown
from mjfim.model.coordinates import sensor_columns, state_components
from mjfim.model.elements import identifier, names_of
from mjfim.model.units import sensor_unit
from mjfim.quantities import TURN, Unit, units_like
from mjfim.recordings.formats.table import Table
from mjfim.recordings.spec import ColumnSpec, LogUnit

# Factor that converts each unit of a log to the model's unit.
UNIT_FACTORS = {unit: Unit.parse(unit).factor for unit in get_args(LogUnit)}

# Units of a log that fit to each unit of the model.
VALID_UNITS = {
    unit: [name for name in UNIT_FACTORS if name in units_like(unit)]
    for unit in ("rad", "rad/s", "m", "m/s")
}

# Sensors that measure an angle or a length, depending on the actuator; any unit is accepted.
SENSORS_OF_ANY_UNIT = (
    mujoco.mjtSensor.mjSENS_ACTUATORPOS,
    mujoco.mjtSensor.mjSENS_ACTUATORVEL,
    mujoco.mjtSensor.mjSENS_USER,
)


def units_of(model: Any) -> dict[str, str]:
    """Find the model's unit of everything that can be measured.

    Args:
        model: The compiled MuJoCo model.

    Returns:
        Unit by column name; `any` if all units of an angle, a length and their rates are possible,
        `none` if the quantity has no unit.
    """
    units = {component.name: component.unit or "none" for component in state_components(model)}

    for name in names_of(model, "sensor"):
        unit = _sensor_unit(model, identifier(model, "sensor", name))
        units.update(dict.fromkeys(sensor_columns(model, name), unit))

    return units


def _sensor_unit(model: Any, sensor: int) -> str:
    """Unit of a sensor by its number, with the values of `units_of`."""
    if mujoco.mjtSensor(int(model.sensor_type[sensor])) in SENSORS_OF_ANY_UNIT:
        return "any"
    return sensor_unit(model, sensor) or "none"


def check_unit(where: str, spec: ColumnSpec, unit: str) -> None:
    """Refuse a stated unit that does not fit the quantity that a column measures.

    Args:
        where: File and key, for messages.
        spec: The stated rule.
        unit: Unit of the model, with the values of `units_of`.

    Raises:
        ExperimentError: The unit does not fit, or a quantity that is not an angle is unwrapped.
    """
    valid = list(UNIT_FACTORS) if unit == "any" else VALID_UNITS.get(unit, [])
    if spec.unit is not None and spec.unit not in valid:
        raise ExperimentError(
            f"{where}.unit: {unknown('unit', spec.unit, valid)}; use scale for any other unit"
        )

    if spec.unwrap and unit not in ("rad", "any"):
        raise ExperimentError(
            f"{where}.unwrap: only an angle jumps by whole turns; use period for a counter"
        )


def convert(table: Table, spec: ColumnSpec) -> Array:
    """Compute one column of a recording by equation (1).

    Args:
        table: The log.
        spec: The rule of the column.

    Returns:
        (M,) values in the model's unit, NaN where empty.

    Raises:
        RecordingError: A column of the log is missing, or holds numbers that the rule excludes.
    """
    raw = table.column(spec.column)
    if spec.signed is not None:
        raw = _signed(table, spec.column, raw, spec.signed)
    if spec.period is not None:
        raw = _unwrapped(raw, spec.period)

    # Without a conversion the values stay bit by bit unchanged, and infinite values stay infinite.
    factor = spec.scale * (1.0 if spec.unit is None else UNIT_FACTORS[spec.unit])
    value = raw if factor == 1.0 and spec.offset == 0.0 else factor * raw + spec.offset

    if spec.unwrap:
        value = _unwrapped(value, TURN)
    for name in spec.multiply_by:
        value = value * table.column(name)
    return np.asarray(value)


def _signed(table: Table, name: str, raw: Array, bits: int) -> Array:
    """(M,) signed integers of bits from their two's complement raw: (M,).

    Numbers that are already negative stay unchanged.
    """
    half = 2.0 ** (bits - 1)

    outside = (raw < -half) | (raw >= 2.0 * half)
    invalid = np.isfinite(raw) & (outside | (raw != np.rint(raw)))
    if invalid.any():
        row = int(np.argmax(invalid))
        raise RecordingError(
            f"{table.source}: column {name!r} holds {raw[row]:g} in data row {row + 1}, which is "
            f"not an integer of {bits} bits"
        )

    return np.asarray(np.where(raw >= half, raw - 2.0 * half, raw))


def _unwrapped(raw: Array, period: float) -> Array:
    """(M,) numbers without jumps of more than half a period, also across empty rows."""
    present = np.isfinite(raw)
    unwrapped = np.array(raw)
    unwrapped[present] = np.unwrap(raw[present], period=period)
    return unwrapped
