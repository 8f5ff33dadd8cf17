"""One experiment in other units of length, mass and time, to test that no result depends on units.

A robot that is a thousand times longer, heavier or slower obeys the same equations with other
numbers. MuJoCo computes with these numbers alone, so a rescaled experiment is also the same
experiment in other units (millimetres, grams, milliseconds). Angles keep their unit.

Factors that are powers of two change only the exponents of floating-point numbers. What differs
there, apart from linear algebra that mixes units, comes from a constant that is not relative.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.experiment.schema import Experiment
from mjfim.records.trajectory import Recording

POWERS = {"": 1, "²": 2, "³": 3}

# Units of the attributes of MJCF elements, by element; "*" is any element. Q stands for the unit of
# the coordinate of a joint, and F for the unit of the force on it.
ATTRIBUTES = {
    "*": {"pos": "m", "fromto": "m", "mass": "kg", "margin": "m", "gap": "m"},
    "option": {"timestep": "s", "gravity": "m/s²", "wind": "m/s", "density": "kg/m³"},
    "inertial": {"diaginertia": "kg m²", "fullinertia": "kg m²"},
    "geom": {"size": "m", "density": "kg/m³"},
    "site": {"size": "m"},
    "joint": {
        "range": "Q",
        "ref": "Q",
        "springref": "Q",
        "damping": "F s/Q",
        "armature": "F s²/Q",
        "stiffness": "F/Q",
        "frictionloss": "F",
        "actuatorfrcrange": "F",
    },
    "motor": {"ctrlrange": "F", "forcerange": "F"},
    "position": {"ctrlrange": "Q", "forcerange": "F", "kp": "F/Q", "kv": "F s/Q"},
    "jointpos": {"noise": "Q"},
    "jointvel": {"noise": "Q/s"},
    "actuatorfrc": {"noise": "F"},
}

# Units of the numbers of an experiment, by key. Q is the unit of the coordinate of the joint that
# a key names, U that of the control of the actuator. All terms of the cost have the unit 1/s.
KEYS = {
    "rate": "Hz",
    "measure_rate": "Hz",
    "playback_rate": "Hz",
    "horizon": "s",
    "noise": "output",
    "initial.qpos": "positions",
    "initial.qvel": "velocities",
    "initial.control.frequency": "Hz",
    "initial.control.frequency_end": "Hz",
    "initial.control.amplitude": "U",
    "initial.control.offset": "U",
    "cost.control": "1/U² s²",
    "cost.control_about": "U",
    "cost.tracking": "1/Q² s²",
    "limits.position": "Q",
    "limits.velocity": "Q/s",
    "limits.acceleration": "Q/s²",
    "limits.control": "U",
    "limits.control_rate": "U/s",
    "limits.force": "U",
    "limits.clearance": "m",
    "limits.bandwidth": "Hz",
    "fit.segments": "s",
    "fit.blocks": "s",
    "nuisance.initial": "output",
    "nuisance.bias": "output",
    "nuisance.delay": "s",
}

# Keys of a parameter whose numbers have its unit.
OF_PARAMETER = ("guess", "true", "prior", "wanted", "scale", "bounds")

# Attributes whose first number is a time constant where it is positive; negative ones are a
# stiffness and a damping per mass.
SOLVER_REFERENCES = ("solref", "solreflimit", "solreffriction")

# Defaults of MuJoCo that have a unit, by element.
DEFAULTS = {
    "option": {"timestep": "0.002", "gravity": "0 0 -9.81"},
    "worldbody//joint": {
        "solreflimit": "0.02 1",
        "solreffriction": "0.02 1",
        "solimplimit": "0.9 0.95 0.001 0.5 2",
    },
    "worldbody//geom": {"solref": "0.02 1"},
}


@dataclass(frozen=True, kw_only=True)
class Units:
    """Factors by which all lengths, masses and times of an experiment are multiplied."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def factor(self, unit: str, coordinate: str = "rad", control: float = 1.0) -> float:
        """Factor of a quantity with a unit such as `N m s/rad`, `m/s²` or `F s/Q`.

        Args:
            unit: The unit.
            coordinate: Unit of the coordinate Q of a joint, "m" or "rad".
            control: Factor of the control U of an actuator.
        """
        force = self.mass * self.length / self.time**2
        sizes = {
            "m": self.length,
            "kg": self.mass,
            "s": self.time,
            "Hz": 1.0 / self.time,
            "rad": 1.0,
            "N": force,
            "Pa": force / self.length**2,
            "U": control,
        }
        sizes["Q"] = sizes[coordinate]
        sizes["F"] = force if coordinate == "m" else force * self.length
        value, sign = 1.0, 1
        for symbol, power in re.findall(r"([A-Za-z]+|/)([²³]?)", unit):
            if symbol == "/":
                sign = -1
            else:
                value *= sizes[symbol] ** (sign * POWERS[power])
        return value


@dataclass(frozen=True, kw_only=True)
class Rescaled:
    """An experiment in other units, beside the factors of what it names.

    Attributes:
        experiment: The rescaled experiment.
        units: The factors of length, mass and time.
        coordinates: Unit of the coordinate of each joint by its name, "m" or "rad".
        controls: Factor of the control of each actuator by its name.
    """

    experiment: Experiment
    units: Units
    coordinates: Mapping[str, str]
    controls: Mapping[str, float]

    def factor(self, unit: str, name: str) -> float:
        """Factor of the unit of a number that stands under the name of a joint or an actuator."""
        if unit == "output":
            kind, name = name.split(":")
            unit = "Q" if kind == "qpos" else "Q/s"
        coordinate = self.coordinates.get(name, "rad")
        return self.units.factor(unit, coordinate, self.controls.get(name, 1.0))

    def recording(self, recording: Recording) -> Recording:
        """The recording of the rescaled robot that does the same."""
        return replace(
            recording,
            t=recording.t * self.units.time,
            ctrl=recording.ctrl * np.array(list(self.controls.values())),
            y=recording.y * np.array([self.factor("output", n) for n in recording.outputs]),
        )

    def tables(self, tables: Mapping[str, Any], above: str = "") -> dict[str, Any]:
        """The tables of an experiment, rescaled by `KEYS`."""
        found = dict(tables)
        for key, value in tables.items():
            unit = KEYS.get(f"{above}{key}")
            if unit in ("positions", "velocities"):
                kind = "qpos" if unit == "positions" else "qvel"
                names = [f"{kind}:{joint}" for joint in self.coordinates]
                pairs = zip(names, value or (), strict=False)
                found[key] = value and tuple(self.scaled(v, "output", n) for n, v in pairs)
            elif unit is not None:
                # A number that stands for all actuators or joints is stated for each of them.
                named = {"U": self.controls, "Q": self.coordinates}
                names = next((named[letter] for letter in "UQ" if letter in unit), {})
                if names and not isinstance(value, Mapping):
                    value = dict.fromkeys(names, value)
                found[key] = self.scaled(value, unit)
            elif isinstance(value, Mapping):
                found[key] = self.tables(value, f"{above}{key}.")
        return found

    def scaled(self, value: Any, unit: str, name: str = "") -> Any:
        """Numbers, ranges and tables by name, multiplied."""
        if isinstance(value, Mapping):
            return {n: self.scaled(v, unit, n) for n, v in value.items()}
        if isinstance(value, tuple | list):
            return tuple(self.scaled(v, unit, name) for v in value)
        if value is None or isinstance(value, bool | str):
            return value
        return value * self.factor(unit, name)


def rescale(experiment: Experiment, units: Units, folder: Path) -> Rescaled:
    """Write the model of an experiment in other units into a folder, and rescale its tables.

    Args:
        experiment: The experiment; noise and limits by name, control as a table of numbers or a
            generated signal, every parameter with a unit.
        units: The factors of length, mass and time.
        folder: Where the rescaled model is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    root = ElementTree.parse(experiment.directory / experiment.model).getroot()
    coordinates = {
        joint.get("name", ""): "m" if joint.get("type") == "slide" else "rad"
        for joint in root.iter("joint")
    }
    controls = {
        actuator.get("name", ""): units.factor(
            ATTRIBUTES[actuator.tag]["ctrlrange"], coordinates[actuator.get("joint", "")]
        )
        for actuator in root.iterfind("actuator/*")
    }
    rescaled = Rescaled(
        experiment=experiment, units=units, coordinates=coordinates, controls=controls
    )

    if root.find("option") is None:
        ElementTree.SubElement(root, "option")
    for place, defaults in DEFAULTS.items():
        for element in root.iterfind(place):
            element.attrib.update({**defaults, **element.attrib})
    for element in root.iter():
        _rescale_element(element, rescaled)
    (folder / "model.xml").write_text(ElementTree.tostring(root, encoding="unicode"))

    tables = experiment.model_dump(exclude_unset=True)
    parameters = {
        name: {
            key: rescaled.scaled(value, spec["unit"]) if key in OF_PARAMETER else value
            for key, value in spec.items()
        }
        for name, spec in tables.pop("parameters").items()
    }
    tables["cost"] = {"control": 1e-3, **tables.get("cost", {})}
    values = {**rescaled.tables(tables), "parameters": parameters, "model": "model.xml"}
    return replace(rescaled, experiment=Experiment(**values, directory=folder, source="rescaled"))


def _rescale_element(element: ElementTree.Element, rescaled: Rescaled) -> None:
    """Rescale the attributes of one element of an MJCF."""
    units = rescaled.units
    joint = element.get("name") if element.tag == "joint" else element.get("joint")
    coordinate = rescaled.coordinates.get(joint or "", "rad")
    known = {**ATTRIBUTES["*"], **ATTRIBUTES.get(element.tag, {})}
    of_key = {
        "qpos": [units.factor("Q", unit) for unit in rescaled.coordinates.values()],
        "qvel": [units.factor("Q/s", unit) for unit in rescaled.coordinates.values()],
        "ctrl": list(rescaled.controls.values()),
    }

    for attribute, text in element.items():
        if attribute in known:
            factors = np.array(units.factor(known[attribute], coordinate))
        elif attribute == "solimplimit":
            factors = np.array([1.0, 1.0, units.factor(coordinate), 1.0, 1.0])
        elif attribute in SOLVER_REFERENCES:
            is_time = float(text.split()[0]) > 0.0
            factors = np.array([units.time, 1.0] if is_time else [units.time**-2, 1 / units.time])
        elif element.tag == "key" and attribute in of_key:
            factors = np.array(of_key[attribute])
        else:
            continue
        numbers = np.array([float(word) for word in text.split()]) * factors
        element.set(attribute, " ".join(map(repr, numbers.tolist())))
