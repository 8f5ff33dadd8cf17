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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.experiment.schema import Experiment
from mjfim.records.trajectory import Recording

# Exponents of length, mass and time of the symbols in the package's units; angles have none.
SYMBOLS = {
    "": (0, 0, 0),
    "1": (0, 0, 0),
    "rad": (0, 0, 0),
    "m": (1, 0, 0),
    "kg": (0, 1, 0),
    "s": (0, 0, 1),
    "Hz": (0, 0, -1),
    "N": (1, 1, -2),
    "Pa": (-1, 1, -2),
}
POWERS = {"²": 2, "³": 3}

# Units of the attributes of MJCF elements, by element; "*" is any element. Q stands for the unit of
# the coordinate of a joint, and F for the unit of the force on it.
ATTRIBUTES: dict[str, dict[str, str]] = {
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

# Attributes whose first number is a time constant where it is positive; negative ones are a
# stiffness and a damping per mass.
SOLVER_REFERENCES = ("solref", "solreflimit", "solreffriction")

# Defaults of MuJoCo that have a unit.
OPTION_DEFAULTS = {"timestep": "0.002", "gravity": "0 0 -9.81"}
JOINT_DEFAULTS = {
    "solreflimit": "0.02 1",
    "solreffriction": "0.02 1",
    "solimplimit": "0.9 0.95 0.001 0.5 2",
}


@dataclass(frozen=True, kw_only=True)
class Units:
    """Factors by which all lengths, masses and times of an experiment are multiplied."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def factor(self, unit: str) -> float:
        """Factor of a quantity with a unit such as `N m s/rad` or `m/s²`."""
        value = 1.0
        above, *below = unit.split("/")
        for sign, part in ((1, above), *((-1, part) for part in below)):
            for symbol in re.split(r"[ ·]+", part.strip()):
                power = POWERS.get(symbol[-1:], 1) * sign
                exponents = SYMBOLS[symbol.rstrip("²³")]
                value *= self._product(tuple(power * e for e in exponents))
        return value

    def of_joint(self, unit: str, coordinate: str) -> float:
        """Factor of a unit with Q and F for the coordinate of a joint and the force on it."""
        force = "N m" if coordinate == "rad" else "N"
        value = 1.0
        above, *below = unit.split("/")
        for sign, part in ((1, above), *((-1, part) for part in below)):
            for symbol in part.split(" "):
                own = {"Q": coordinate, "F": force}.get(symbol, symbol)
                value *= self.factor(own) ** sign
        return value

    def _product(self, exponents: Iterable[int]) -> float:
        """Product of powers of the three factors."""
        length, mass, time = exponents
        return float(self.length**length * self.mass**mass * self.time**time)


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

    def of_output(self, name: str) -> float:
        """Factor of a measured output `qpos:<joint>` or `qvel:<joint>`."""
        kind, joint = name.split(":")
        unit = self.coordinates[joint]
        return self.units.factor(unit if kind == "qpos" else f"{unit}/s")

    def recording(self, recording: Recording) -> Recording:
        """The recording of the rescaled robot that does the same."""
        return replace(
            recording,
            t=recording.t * self.units.time,
            ctrl=recording.ctrl * np.array(list(self.controls.values())),
            y=recording.y * np.array([self.of_output(n) for n in recording.outputs]),
        )


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
        actuator.get("name", ""): units.of_joint(
            ATTRIBUTES[actuator.tag]["ctrlrange"], coordinates[actuator.get("joint", "")]
        )
        for actuator in root.iterfind("actuator/*")
    }

    _state_defaults(root)
    for element in root.iter():
        _rescale_element(element, units, coordinates)
    _rescale_keyframes(root, units, list(coordinates.values()), list(controls.values()))
    (folder / "model.xml").write_text(ElementTree.tostring(root, encoding="unicode"))

    tables = experiment.model_dump(exclude_unset=True)
    scaled = _Tables(units=units, coordinates=coordinates, controls=controls)
    values = scaled.experiment(tables)
    values["model"] = "model.xml"

    rescaled = Experiment(**values, directory=folder, source="rescaled")
    return Rescaled(experiment=rescaled, units=units, coordinates=coordinates, controls=controls)


def _rescale_element(
    element: ElementTree.Element, units: Units, coordinates: Mapping[str, str]
) -> None:
    """Rescale the attributes of one element of an MJCF."""
    joint = element.get("name") if element.tag == "joint" else element.get("joint")
    coordinate = coordinates.get(joint or "", "rad")
    known = {**ATTRIBUTES["*"], **ATTRIBUTES.get(element.tag, {})}

    for attribute, text in element.items():
        if attribute in known:
            factor = units.of_joint(known[attribute], coordinate)
            numbers = [float(word) * factor for word in text.split()]
            element.set(attribute, " ".join(map(repr, numbers)))
        if attribute == "solimplimit":
            numbers = [float(word) for word in text.split()]
            numbers[2] *= units.factor(coordinate)
            element.set(attribute, " ".join(map(repr, numbers)))
        if attribute in SOLVER_REFERENCES:
            first, second = (float(word) for word in text.split())
            if first > 0.0:
                first *= units.time
            else:
                first, second = first / units.time**2, second / units.time
            element.set(attribute, f"{first!r} {second!r}")


def _state_defaults(root: ElementTree.Element) -> None:
    """Write the defaults of MuJoCo that have a unit into a model, so that they can be rescaled."""
    option = root.find("option")
    if option is None:
        option = ElementTree.SubElement(root, "option")
    for attribute, value in OPTION_DEFAULTS.items():
        option.attrib.setdefault(attribute, value)

    for joint in root.iter("joint"):
        for attribute, value in JOINT_DEFAULTS.items():
            joint.attrib.setdefault(attribute, value)
    for geom in root.iterfind("worldbody//geom"):
        geom.attrib.setdefault("solref", "0.02 1")


def _rescale_keyframes(
    root: ElementTree.Element, units: Units, coordinates: list[str], controls: list[float]
) -> None:
    """Rescale the keyframes of a model whose joints are all hinges and slides."""
    factors = {
        "qpos": [units.factor(unit) for unit in coordinates],
        "qvel": [units.factor(f"{unit}/s") for unit in coordinates],
        "ctrl": controls,
    }
    for key in root.iterfind("keyframe/key"):
        for attribute, scales in factors.items():
            numbers = [float(word) for word in key.get(attribute, "").split()]
            if numbers:
                products = [a * b for a, b in zip(numbers, scales, strict=True)]
                key.set(attribute, " ".join(map(repr, products)))


@dataclass(frozen=True, kw_only=True)
class _Tables:
    """Rescales the tables of an experiment, as dictionaries."""

    units: Units
    coordinates: Mapping[str, str]
    controls: Mapping[str, float]

    def experiment(self, tables: dict[str, Any]) -> dict[str, Any]:
        """The tables of the whole experiment."""
        tables = dict(tables)
        time = self.units.time
        for key in ("rate", "measure_rate", "playback_rate"):
            if tables.get(key) is not None:
                tables[key] /= time
        if tables.get("horizon") is not None:
            tables["horizon"] *= time

        tables["noise"] = {n: s * self._output(n) for n, s in tables.get("noise", {}).items()}
        tables["parameters"] = {
            name: self._parameter(spec) for name, spec in tables["parameters"].items()
        }
        for name in ("initial", "cost", "limits", "boundary", "fit", "nuisance"):
            if name in tables:
                tables[name] = getattr(self, f"_{name}")(dict(tables[name]))
        return tables

    def _output(self, name: str) -> float:
        """Factor of a measured output."""
        kind, joint = name.split(":")
        unit = self.coordinates[joint]
        return self.units.factor(unit if kind == "qpos" else f"{unit}/s")

    def _parameter(self, spec: dict[str, Any]) -> dict[str, Any]:
        """The table of one parameter."""
        factor = self.units.factor(spec["unit"])
        scaled = dict(spec)
        for key in ("guess", "true", "prior", "wanted"):
            if scaled.get(key) is not None:
                scaled[key] *= factor
        if isinstance(scaled.get("scale"), float):
            scaled["scale"] *= factor
        if scaled.get("bounds") is not None:
            scaled["bounds"] = tuple(factor * bound for bound in scaled["bounds"])
        return scaled

    def _initial(self, table: dict[str, Any]) -> dict[str, Any]:
        """The initial state and control."""
        units = list(self.coordinates.values())
        for key, suffix in (("qpos", ""), ("qvel", "/s")):
            if table.get(key) is not None:
                factors = [self.units.factor(f"{unit}{suffix}") for unit in units]
                table[key] = tuple(a * b for a, b in zip(table[key], factors, strict=True))

        signal = dict(table["control"])
        for key in ("frequency", "frequency_end"):
            if signal.get(key) is not None:
                signal[key] /= self.units.time
        for key in ("amplitude", "offset"):
            if signal.get(key) is not None:
                signal[key] = self._by_actuator(signal[key], lambda factor: factor)
        return {**table, "control": signal}

    def _by_actuator(self, value: Any, factor: Any) -> dict[str, Any]:
        """Numbers by actuator, rescaled by a function of the factor of its control."""
        table = value if isinstance(value, Mapping) else dict.fromkeys(self.controls, value)
        return {n: _times(v, factor(self.controls[n])) for n, v in table.items()}

    def _by_joint(self, value: Any, unit: str) -> dict[str, Any]:
        """Numbers by joint; Q in the unit is the coordinate of the joint."""
        table = value if isinstance(value, Mapping) else dict.fromkeys(self.coordinates, value)
        return {
            n: _times(v, self.units.of_joint(unit, self.coordinates[n])) for n, v in table.items()
        }

    def _cost(self, table: dict[str, Any]) -> dict[str, Any]:
        """Weights; all terms of the cost are multiplied by the same factor, 1/T."""
        time = self.units.time
        control = table.get("control", 1e-3)
        table["control"] = self._by_actuator(control, lambda factor: (factor * time) ** -2)
        if table.get("control_about") is not None:
            table["control_about"] = self._by_actuator(table["control_about"], lambda f: f)
        if table.get("tracking"):
            table["tracking"] = {
                n: _times(w, (self.units.factor(self.coordinates[n]) * time) ** -2)
                for n, w in table["tracking"].items()
            }
        return table

    def _limits(self, table: dict[str, Any]) -> dict[str, Any]:
        """Hard limits."""
        for key, unit in (("position", "Q"), ("velocity", "Q/s"), ("acceleration", "Q/s²")):
            if table.get(key):
                table[key] = self._by_joint(table[key], unit)
        if table.get("control"):
            table["control"] = self._by_actuator(table["control"], lambda factor: factor)
        if table.get("control_rate"):
            time = self.units.time
            table["control_rate"] = self._by_actuator(table["control_rate"], lambda f: f / time)
        if table.get("force"):
            table["force"] = self._by_actuator(table["force"], lambda factor: factor)
        if table.get("clearance") is not None:
            table["clearance"] *= self.units.length
        if table.get("bandwidth") is not None:
            table["bandwidth"] /= self.units.time
        return table

    def _fit(self, table: dict[str, Any]) -> dict[str, Any]:
        """Lengths of segments and blocks."""
        for key in ("segments", "blocks"):
            if table.get(key) is not None:
                table[key] *= self.units.time
        return table

    def _nuisance(self, table: dict[str, Any]) -> dict[str, Any]:
        """Priors of initial deviations, biases and the delay."""
        for key in ("initial", "bias"):
            if isinstance(table.get(key), Mapping):
                table[key] = {
                    n: p if p is True else p * self._output(n) for n, p in table[key].items()
                }
        if table.get("delay") not in (None, True):
            table["delay"] *= self.units.time
        return table


def _times(value: Any, factor: float) -> Any:
    """A number or a range, multiplied."""
    if isinstance(value, tuple | list):
        return tuple(part * factor for part in value)
    return value * factor
