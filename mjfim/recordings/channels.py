"""The signals that a log of an experiment may hold, and how to read them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import mujoco

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, unknown
from mjfim.model.control_laws import ControlLaws
from mjfim.model.coordinates import (
    measurable_columns,
    sensor_columns,
    state_components,
    unknown_coordinate,
)
from mjfim.model.elements import identifier, names_of
from mjfim.model.units import sensor_unit
from mjfim.recordings.quantities import Unit, units_like
from mjfim.recordings.section import LAW_PREFIXES, LogUnit, RecordingSpec

# Factor that converts each unit of a log to the model's unit.
UNIT_FACTORS = {unit: Unit.parse(unit).factor for unit in get_args(LogUnit)}

# Units of a log that fit to each unit of the model.
VALID_UNITS = {
    unit: [name for name in UNIT_FACTORS if name in units_like(unit)]
    for unit in ("rad", "rad/s", "m", "m/s")
}

# Unit of what measures an angle or a length, depending on the model; every unit is accepted.
ANY = "any"
SENSORS_OF_ANY_UNIT = (
    mujoco.mjtSensor.mjSENS_ACTUATORPOS,
    mujoco.mjtSensor.mjSENS_ACTUATORVEL,
    mujoco.mjtSensor.mjSENS_USER,
)


@record
class Channels:
    """Signals of an experiment by name, and everything else that is needed to read and check a log.

    Attributes:
        model: The compiled MuJoCo model (`mujoco.MjModel`) at its nominal parameters.
        controls: nu names of the controls, in the order of the model's actuators.
        laws: Control laws, which read other columns instead of controls; None without any.
        outputs: Names of the m outputs that the experiment measures.
        sigma: (m,) standard deviations of the outputs' measurement noise [output unit].
        spec: The `[recording]` table of the experiment file.
        source: Name of the experiment file, for messages.
    """

    model: Any
    controls: tuple[str, ...]
    laws: ControlLaws | None
    outputs: tuple[str, ...]
    sigma: Array
    spec: RecordingSpec
    source: str

    @property
    def control_columns(self) -> tuple[str, ...]:
        """Columns of a recording that drive a simulation.

        They are the controls, `ctrl:<actuator>`, or what a law reads, `reference:<actuator>`.
        """
        if self.laws is not None:
            return self.laws.columns
        return tuple(f"ctrl:{name}" for name in self.controls)

    @property
    def measurable(self) -> tuple[str, ...]:
        """Column names of everything that can be measured: components of the state, and sensors."""
        return measurable_columns(self.model)


# ---- checks of the table `[recording]` against the model


def check_spec(channels: Channels) -> None:
    """Check the table `[recording]` against the model.

    Raises:
        ExperimentError: A column does not exist in the model, or has a unit that does not fit.
    """
    where = f"{channels.source}: recording.columns"
    units = units_of(channels)
    for name in channels.spec.columns:
        if name not in units:
            require_law(where, name, channels)
            raise ExperimentError(f"{where}: {unknown_coordinate('column', name, list(units))}")

    for name, source in channels.spec.sources.items():
        unit = units[name]
        valid = list(UNIT_FACTORS) if unit == ANY else VALID_UNITS.get(unit, [])
        if source.unit is not None and source.unit not in valid:
            raise ExperimentError(
                f"{where}.{name}.unit: {unknown('unit', source.unit, valid)}; use scale for any "
                "other unit"
            )
        if source.unwrap and unit not in ("rad", ANY):
            raise ExperimentError(
                f"{where}.{name}.unwrap: only an angle jumps by whole turns; use period for a "
                "counter"
            )
    for name in channels.spec.constants:
        if name not in channels.control_columns:
            raise ExperimentError(
                f"{where}.{name}: a number is the value of a constant control, and this is a "
                "measured column; state the name of the column in the log"
            )


def units_of(channels: Channels) -> dict[str, str]:
    """Unit in the model of every column that a recording may hold; `ANY` where it is not known.

    Args:
        channels: The signals of the experiment.
    """
    model = channels.model
    units = {component.name: component.unit for component in state_components(model)}
    for name in names_of(model, "sensor"):
        number = identifier(model, "sensor", name)
        of_any_unit = mujoco.mjtSensor(model.sensor_type[number]) in SENSORS_OF_ANY_UNIT
        unit = ANY if of_any_unit else sensor_unit(model, number)
        units.update(dict.fromkeys(sensor_columns(model, name), unit))

    units.update(dict.fromkeys(channels.control_columns, ANY))
    inputs = () if channels.laws is None else channels.laws.inputs
    return units | {name: unit for name, unit, _ in inputs if unit in VALID_UNITS}


# ---- columns that control laws read in place of controls


def require_law(where: str | Path, name: str, channels: Channels) -> None:
    """Explain the column of a control law that the experiment does not have as it is named.

    Args:
        where: Place of the name, for messages.
        name: Name of a column, which no signal of the experiment has.
        channels: The signals of the experiment.

    Raises:
        ExperimentError: The name is that of a control or of an input of a law.
    """
    quantity, _, actuator = name.partition(":")
    laws = () if channels.laws is None else tuple(law.actuator for law in channels.laws.laws)
    if quantity == "ctrl" and actuator in laws:
        raise ExperimentError(
            f"{where}: {name!r}: [controllers.{actuator}] computes this control; remove the column "
            "or the table. A torque or current that was measured is an output: measure a sensor, "
            "such as <actuatorfrc>, and state its name"
        )
    if f"{quantity}:" not in LAW_PREFIXES or actuator not in channels.controls:
        return
    if actuator not in laws:
        raise ExperimentError(
            f"{where}: {name!r}: the experiment file states no law for this actuator, so that its "
            f"control is read from 'ctrl:{actuator}'; state the law in [controllers.{actuator}]"
        )
    value = '"column"' if quantity == "reference_velocity" else "true"
    raise ExperimentError(
        f"{where}: {name!r}: the law of this actuator does not read it; state {quantity} = {value} "
        f"in [controllers.{actuator}]"
    )
