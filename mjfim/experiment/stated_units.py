"""Units of the numbers of an experiment: those that are stated, and angles that look like degrees.

Numbers in the file are in the units of the model, or have a unit of their own ("90 deg"). Such a
unit is compared here with the unit that the model gives to the number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import BaseModel

from mjfim.errors import ExperimentError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.signals import columns_of_keys
from mjfim.experiment.system_tables import ParameterSpec
from mjfim.model.elements import identifier
from mjfim.model.limited_elements import LimitedElement, limited_elements
from mjfim.model.loading import ModelSource
from mjfim.model.paths import unit_of
from mjfim.model.units import ANGLE, JOINT_FIELD_UNITS, control_units, per_second, sensor_unit
from mjfim.recordings.quantities import Quantity, Unit, wrong_unit

# Angles beyond TURNS turns look like degrees if they are multiples of ROUND_DEGREES.
TURNS = 2.0
ROUND_DEGREES = 5.0

# One turn and one degree [rad]. Angles beyond one turn look like degrees, too, if they are outside
# the range of their joint or control as radians, and inside as degrees.
TURN = 2.0 * np.pi
DEGREE = TURN / 360.0

# Keys that lead to a number of an experiment, and indices where a key holds a list.
Keys = tuple[Any, ...]
Range = tuple[float, float]


def require_units(experiment: Experiment, source: ModelSource) -> None:
    """Check every number that is stated with a unit against the model.

    Raises:
        ExperimentError: A unit does not fit what the number states.
    """
    units = _Units(experiment, source)
    for keys, number in _numbers(experiment):
        if isinstance(number, Quantity):
            of_model = units.of(keys)
            fault = of_model and wrong_unit(number, list(dict.fromkeys(of_model)))
            if fault:
                raise ExperimentError(f"{_place(keys)}: {fault}")


def probable_degrees(experiment: Experiment, source: ModelSource) -> tuple[str, ...]:
    """Find angles in radians that were probably meant in degrees.

    Returns:
        One sentence for each of them.
    """
    units = _Units(experiment, source)
    found: dict[str, str] = {}
    for keys, number in _numbers(experiment):
        ranges = units.ranges(keys)
        is_angle = ranges is not None and set(units.of(keys) or ()) == {ANGLE}
        if is_angle and _looks_like_degrees(number, ranges):
            value = f"{number:g}"
            found.setdefault(
                _place(keys),
                f"{_place(keys)}: {value} rad are {abs(number) / TURN:.3g} turns and look like "
                f'degrees; state "{value} deg" if they are, or "{value} rad" if not',
            )
    return tuple(found.values())


def _numbers(value: Any, keys: Keys = ()) -> Iterator[tuple[Keys, float]]:
    """Every number of an experiment, with the keys that lead to it."""
    if isinstance(value, float):
        yield keys, value
    items: Any = ()
    if isinstance(value, BaseModel):
        items = value
    elif isinstance(value, (Mapping, tuple)):
        items = value.items() if isinstance(value, Mapping) else enumerate(value)
    for key, inner in items:
        yield from _numbers(inner, (*keys, key))


def _place(keys: Keys) -> str:
    """Name of a number in messages, such as `initial.qpos[1]`; a range has one name."""
    if isinstance(keys[-1], int) and keys[0] != "initial":
        keys = keys[:-1]
    parts = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
    return "".join(parts).removeprefix(".")


def _looks_like_degrees(number: float, ranges: Sequence[Range] | None) -> bool:
    """Whether an angle in radians was probably meant in degrees."""
    angle = abs(number)
    if isinstance(number, Quantity) or not TURN < angle < np.inf:
        return False
    is_round = angle > TURNS * TURN and angle % ROUND_DEGREES == 0.0
    return is_round or any(
        not low <= number <= high and low <= number * DEGREE <= high for low, high in ranges or ()
    )


class _Units:
    """Units that the model gives to the numbers of an experiment."""

    def __init__(self, experiment: Experiment, source: ModelSource) -> None:
        self.experiment = experiment
        self.source = source

    def of(self, keys: Keys) -> tuple[str, ...] | None:
        """Units of all numbers of the model that a number states; None if they do not depend on it.

        A unit is empty where it does not follow from the model.
        """
        for length in (2, 3):
            if (units := self.tables.get(keys[:length])) is not None:
                # A number for all elements, or for the one that a table names. Wrong names are
                # refused elsewhere.
                names = keys[length:]
                if not names:
                    return tuple(units.values())
                return (units[names[0]],) if names[0] in units else None

        found: tuple[str, ...] | None = None
        match keys:
            case ("initial", "qpos" | "qvel", i):
                found = (self._component(keys[1], i)[1],)
            case ("noise", key, *rest):
                columns = columns_of_keys(self.source.coordinates).get(key, [])
                is_one = rest and isinstance(rest[-1], int)
                columns = columns[rest[-1] : rest[-1] + 1] if is_one else columns
                found = None if rest[:1] == ["rate"] else tuple(self.outputs[c] for c in columns)
            case ("parameters", name, "targets", i, "offset"):
                path = self.experiment.parameters[name].targets[i].path
                found = (_unit_of_path(self.source, path),)
            case ("parameters", name, _) | ("parameters", name, "bounds", _):
                found = (_parameter_unit(self.experiment.parameters[name], self.source),)
            case ("terms", name, "values", field):
                found = (_unit_of_path(self.source, f"term/{name}:{field}"),)
            case ("boundary", "position" | "velocity"):
                joints = {joint.unit for joint in self.source.coordinates.scalar_joints}
                is_speed = keys[1] == "velocity"
                found = tuple(per_second(unit) if is_speed else unit for unit in joints)
        return found

    def ranges(self, keys: Keys) -> tuple[Range, ...] | None:
        """Range of a position in the MJCF, if there is one; None for a number of another kind."""
        match keys:
            case ("initial", "qpos", i):
                kind, name = "position", self._component("qpos", i)[0].removeprefix("qpos:")
            case ("limits", "position" | "control" as kind, str(name), *_):
                pass
            case ("initial", "control" as kind, "amplitude" | "offset", str(name)):
                pass
            case _:
                return None
        element = self.elements[kind].get(name)
        # The range of a ball joint is that of an angle, not of a coordinate.
        if element is None or element.count > 1 or element.stated is None:
            return ()
        return (element.stated,)

    def _component(self, kind: str, i: int) -> tuple[str, str]:
        """Name and unit of an entry of `initial.qpos` or `initial.qvel`."""
        # Numbers may be stated for the MJCF alone, without the joints that physical terms add.
        stated = getattr(self.experiment.initial, kind)
        size = "nq" if kind == "qpos" else "nv"
        is_plain = len(stated) == getattr(self.source.stated.model, size)
        source = self.source.stated if is_plain else self.source
        # Addresses of velocities follow those of the positions.
        address = i if kind == "qpos" else source.model.nq + i
        parts = {c.address: (c.name, c.unit) for c in source.coordinates.state}
        return parts.get(address, ("", ""))

    @cached_property
    def elements(self) -> dict[str, dict[str, LimitedElement]]:
        """Elements that the model can limit, by kind and name."""
        controls = self.source.coordinates.controls
        period = 1.0 / self.experiment.rate
        return limited_elements(self.source.model, controls, period).by_kind

    @cached_property
    def tables(self) -> dict[Keys, dict[str, str]]:
        """Units by name for the keys that state one number for all names, or numbers by name."""
        coordinates = self.source.coordinates
        controls = dict(zip(coordinates.controls, control_units(self.source.model), strict=True))
        deviations = {c.name: c.unit for c in coordinates.deviations}
        tables = {
            ("initial", "control", "amplitude"): controls,
            ("initial", "control", "offset"): controls,
            ("cost", "control_about"): controls,
            ("initial", "free"): deviations,
            ("nuisance", "initial"): deviations,
            ("nuisance", "bias"): self.outputs,
        }
        for key, field in (("friction", "frictionloss"), ("armature", "armature")):
            units = JOINT_FIELD_UNITS[field]
            tables["nuisance", key] = {
                joint.name: units[joint.unit] for joint in coordinates.scalar_joints
            }
        for kind, limited in self.elements.items():
            units = {name: element.unit for name, element in limited.items()}
            # A free joint is stated by its name, with the ranges of its coordinates.
            boxes = {name.removesuffix(".x"): units[name] for name in units if name.endswith(".x")}
            tables["limits", kind] = {**boxes, **units}
        return tables

    @cached_property
    def outputs(self) -> dict[str, str]:
        """Unit of the noise of everything that can be measured, by name."""
        model, coordinates = self.source.model, self.source.coordinates
        # The noise of an orientation is an angle, although its quaternion has no unit.
        units = {c.name: c.unit if c.sigma_factor == 1.0 else ANGLE for c in coordinates.state}
        for component in coordinates.sensors:
            sensor = identifier(model, "sensor", component.groups[0])
            units[component.name] = sensor_unit(model, sensor)
        return units


def _parameter_unit(spec: ParameterSpec, source: ModelSource) -> str:
    """Unit of a parameter; empty where it follows neither from its target nor from the file."""
    targets = spec.all_targets
    if targets and abs(targets[0].scale) == 1.0:
        return _unit_of_path(source, targets[0].path)
    # The parameter has a unit of its own. Numbers with a unit are converted to SI units when the
    # file is read, so that they fit a parameter in SI units only.
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
