"""Units of the numbers of an experiment: those that are stated, and angles that look like degrees.

A number without a unit is in the unit of the model. A number with a unit has been converted when
the file was read; here its unit is compared with that of the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.errors import ExperimentError
from mjfim.experiment.outputs import columns_of_keys
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import NoiseSpec, ParameterSpec, Signal
from mjfim.model.elements import identifier
from mjfim.model.limited_elements import limited_elements
from mjfim.model.loading import ModelSource
from mjfim.model.paths import unit_of
from mjfim.model.units import ANGLE, control_unit, per_second, sensor_unit
from mjfim.recordings.quantities import Quantity, Unit, wrong_unit

# Angles beyond this number of turns look like degrees if they are round in degrees.
TURNS = 2.0
ROUND_DEGREES = 5.0

# Angles beyond one turn look like degrees if only so they are inside the range of their joint.
TURN = 2.0 * np.pi
DEGREE = TURN / 360.0


@dataclass(frozen=True, kw_only=True)
class StatedNumber:
    """One number of an experiment whose unit depends on the model.

    Attributes:
        key: Key of the experiment file.
        value: The number, a `Quantity` where it was stated with a unit.
        units: Units of all the numbers of the model that it states; an empty text where the unit
            does not follow from the model.
        range: Range of the joint in the MJCF; None without one, or where the number is no position.
        is_position: The number is a position, or the control of a servo.
    """

    key: str
    value: float
    units: tuple[str, ...]
    range: tuple[float, float] | None = None
    is_position: bool = False


def require_units(experiment: Experiment, source: ModelSource) -> None:
    """Check every number that is stated with a unit against the model.

    Args:
        experiment: The experiment.
        source: Its model.

    Raises:
        ExperimentError: A number has the unit of another quantity; the message names its key.
    """
    for number in _numbers(experiment, source):
        if not isinstance(number.value, Quantity):
            continue

        fault = wrong_unit(number.value, list(dict.fromkeys(number.units)))
        if fault is not None:
            raise ExperimentError(f"{number.key}: {fault}")


def probable_degrees(experiment: Experiment, source: ModelSource) -> tuple[str, ...]:
    """Find angles in radians that were probably meant in degrees.

    These are plain numbers for positions of hinges and for the controls of their servos that are
    beyond two turns and a multiple of five, or beyond one turn and inside the range of their joint
    only in degrees.

    Args:
        experiment: The experiment.
        source: Its model.

    Returns:
        A sentence for each key, which says how to state the unit.
    """
    found: dict[str, str] = {}
    for number in _numbers(experiment, source):
        if number.is_position and _looks_like_degrees(number):
            value = f"{number.value:g}"
            found.setdefault(
                number.key,
                f"{number.key}: {value} rad are {abs(number.value) / TURN:.3g} turns and look like "
                f'degrees; state "{value} deg" if they are, or "{value} rad" if not',
            )
    return tuple(found.values())


def _looks_like_degrees(number: StatedNumber) -> bool:
    """Whether an angle in radians was probably meant in degrees."""
    angle = abs(number.value)
    is_plain = not isinstance(number.value, Quantity) and np.isfinite(angle)
    if not is_plain or set(number.units) != {ANGLE} or angle <= TURN:
        return False

    if angle > TURNS * TURN and angle % ROUND_DEGREES == 0.0:
        return True
    if number.range is None:
        return False
    low, high = number.range
    return not low <= number.value <= high and low <= number.value * DEGREE <= high


def _numbers(experiment: Experiment, source: ModelSource) -> Iterator[StatedNumber]:
    """All numbers of an experiment whose unit depends on the model."""
    yield from _initial_numbers(experiment, source)
    yield from _limit_numbers(experiment, source)
    yield from _noise_numbers(experiment, source)
    yield from _nuisance_numbers(experiment, source)
    for name, spec in experiment.parameters.items():
        yield from _parameter_numbers(name, spec, source)
    yield from _term_numbers(experiment, source)

    about = experiment.cost.control_about
    yield from _by_name("cost.control_about", about, _control_units(source))

    units = tuple({joint.unit for joint in source.coordinates.scalar_joints})
    boundary = experiment.boundary
    yield StatedNumber(key="boundary.position", value=boundary.position, units=units)
    speeds = tuple(per_second(unit) for unit in units)
    yield StatedNumber(key="boundary.velocity", value=boundary.velocity, units=speeds)


def _by_name(
    key: str,
    stated: Any,
    units: Mapping[str, str],
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> Iterator[StatedNumber]:
    """Numbers of a key: one for all names, or by name one or several.

    Args:
        key: The key.
        stated: One number for all names, a table by name, or None. True states no number.
        units: Unit by name. Unknown names are left out; they are refused elsewhere.
        ranges: Ranges of the positions in the MJCF by name; None if the numbers are no positions.
    """
    if isinstance(stated, float):
        yield StatedNumber(key=key, value=stated, units=tuple(units.values()))
    if not isinstance(stated, Mapping):
        return

    for name, value in stated.items():
        for number in _flat(value):
            if name in units and isinstance(number, float):
                yield StatedNumber(
                    key=f"{key}.{name}",
                    value=number,
                    units=(units[name],),
                    range=None if ranges is None else ranges.get(name),
                    is_position=ranges is not None,
                )


def _flat(value: Any) -> Iterator[Any]:
    """The numbers of a number, of a range, or of several ranges."""
    if not isinstance(value, tuple):
        yield value
        return
    for each in value:
        yield from _flat(each)


def _initial_numbers(experiment: Experiment, source: ModelSource) -> Iterator[StatedNumber]:
    """Numbers of the table `initial`."""
    stated = experiment.initial
    ranges = _joint_ranges(source)

    # Addresses of velocities follow those of the positions. Numbers may be stated for the MJCF
    # alone, without the joints that physical terms add.
    for name, numbers in (("qpos", stated.qpos), ("qvel", stated.qvel)):
        size = {"qpos": "nq", "qvel": "nv"}[name]
        is_plain = len(numbers or ()) == getattr(source.stated.model, size)
        of = source.stated if is_plain else source
        first = 0 if name == "qpos" else of.model.nq
        units = {c.address - first: (c.unit, c.name) for c in of.coordinates.state}
        for i, value in enumerate(numbers or ()):
            unit, column = units.get(i, ("", ""))
            yield StatedNumber(
                key=f"initial.{name}[{i}]",
                value=value,
                units=(unit,),
                range=ranges.get(column.removeprefix("qpos:")),
                is_position=name == "qpos",
            )

    if isinstance(stated.control, Signal):
        units_of_controls = _control_units(source)
        for key in ("amplitude", "offset"):
            yield from _by_name(
                f"initial.control.{key}",
                getattr(stated.control, key),
                units_of_controls,
                _servo_ranges(source),
            )


def _limit_numbers(experiment: Experiment, source: ModelSource) -> Iterator[StatedNumber]:
    """Numbers of the table `limits`."""
    stated, controls = experiment.limits, source.coordinates.controls
    ranges = {"position": _joint_ranges(source), "control": _servo_ranges(source)}
    period = 1.0 / experiment.rate

    for kind, elements in limited_elements(source.model, controls, period).by_kind.items():
        units = {name: element.unit for name, element in elements.items()}

        # A free joint is stated by its name, with the ranges of its coordinates.
        boxes = {name.removesuffix(".x"): units[name] for name in units if name.endswith(".x")}
        key = f"limits.{kind}"
        yield from _by_name(key, getattr(stated, kind), {**boxes, **units}, ranges.get(kind))


def _noise_numbers(experiment: Experiment, source: ModelSource) -> Iterator[StatedNumber]:
    """Numbers of the table `noise`."""
    units = _output_units(source)
    columns = columns_of_keys(source.coordinates)

    for key, stated in experiment.noise.items():
        sigma = stated.sigma if isinstance(stated, NoiseSpec) else stated
        suffix = ".sigma" if isinstance(stated, NoiseSpec) else ""
        names = columns.get(key, [])
        several = isinstance(sigma, tuple)

        for i, value in enumerate(sigma if isinstance(sigma, tuple) else (sigma,)):
            covered = names[i : i + 1] if several else names
            if value is not None:
                yield StatedNumber(
                    key=f"noise.{key}{suffix}",
                    value=value,
                    units=tuple(units[name] for name in covered),
                )


def _nuisance_numbers(experiment: Experiment, source: ModelSource) -> Iterator[StatedNumber]:
    """Numbers of the table `nuisance`."""
    stated = experiment.nuisance
    deviations = {c.name: c.unit for c in source.coordinates.deviations}

    yield from _by_name("nuisance.initial", stated.initial, deviations)
    yield from _by_name("initial.free", experiment.initial.free, deviations)
    yield from _by_name("nuisance.bias", stated.bias, _output_units(source))


def _term_numbers(experiment: Experiment, source: ModelSource) -> Iterator[StatedNumber]:
    """Numbers of the table `terms`."""
    for name, spec in experiment.terms.items():
        for field, value in spec.values.items():
            unit = _unit_of_path(source, f"term/{name}:{field}")
            yield StatedNumber(key=f"terms.{name}.values.{field}", value=value, units=(unit,))


def _parameter_numbers(
    name: str, spec: ParameterSpec, source: ModelSource
) -> Iterator[StatedNumber]:
    """Numbers of one parameter."""
    units = (_parameter_unit(spec, source),)
    low, high = spec.bounds or (None, None)
    values = {
        "guess": (spec.guess,),
        "true": (spec.true,),
        "bounds": (low, high),
        "scale": (spec.scale,),
        "prior": (spec.prior,),
        "wanted": (spec.wanted,),
    }
    for key, numbers in values.items():
        for value in numbers:
            if isinstance(value, float):
                yield StatedNumber(key=f"parameters.{name}.{key}", value=value, units=units)

    for target in spec.targets:
        unit = _unit_of_path(source, target.path)
        key = f"parameters.{name}.targets.offset"
        yield StatedNumber(key=key, value=target.offset, units=(unit,))


def _parameter_unit(spec: ParameterSpec, source: ModelSource) -> str:
    """Unit of a parameter; empty where it follows neither from its target nor from the file."""
    targets = spec.all_targets
    if targets and abs(targets[0].scale) == 1.0:
        return _unit_of_path(source, targets[0].path)

    # The parameter has a unit of its own; only numbers in SI units fit to what was converted.
    try:
        is_si = Unit.parse(spec.unit).factor == 1.0
    except ValueError:
        is_si = False
    return spec.unit if is_si else ""


def _unit_of_path(source: ModelSource, path: str) -> str:
    """Unit of the number that a path names; empty for a wrong path, which is refused elsewhere."""
    try:
        return unit_of(source.model, path, source.terms)
    except ExperimentError:
        return ""


def _output_units(source: ModelSource) -> dict[str, str]:
    """Unit of the noise of everything that can be measured, by name."""
    model, coordinates = source.model, source.coordinates

    # The noise of an orientation is an angle, although its quaternion has no unit.
    units = {c.name: c.unit if c.sigma_factor == 1.0 else ANGLE for c in coordinates.state}
    for number in coordinates.sensors:
        units[number.name] = sensor_unit(model, identifier(model, "sensor", number.sensor))
    return units


def _control_units(source: ModelSource) -> dict[str, str]:
    """Unit of every control by name; empty where it does not follow from the model."""
    model = source.model
    actuators = np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum).tolist()
    names: Sequence[str] = source.coordinates.controls
    return {name: control_unit(model, i) for name, i in zip(names, actuators, strict=True)}


def _joint_ranges(source: ModelSource) -> dict[str, tuple[float, float]]:
    """Ranges of the joints in the MJCF, by name."""
    model = source.model
    return {
        joint.name: (float(model.jnt_range[joint.joint, 0]), float(model.jnt_range[joint.joint, 1]))
        for joint in source.coordinates.scalar_joints
        if model.jnt_limited[joint.joint]
    }


def _servo_ranges(source: ModelSource) -> dict[str, tuple[float, float]]:
    """Ranges of the controls in the MJCF, by name."""
    model = source.model
    return {
        name: (float(model.actuator_ctrlrange[i, 0]), float(model.actuator_ctrlrange[i, 1]))
        for i, name in enumerate(source.coordinates.controls)
        if model.actuator_ctrllimited[i]
    }
