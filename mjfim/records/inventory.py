"""Records of what a model offers to an experiment file, and of what a correct file states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from operator import attrgetter, itemgetter
from typing import Any

from mjfim.arrays import Array, record
from mjfim.records.base import Record
from mjfim.records.estimate import ControlLawInLoop
from mjfim.records.rehearsal import LimitRange

# Kinds of entries, the names of the fields of `Inventory` that hold them, and what names an entry.
KINDS: Mapping[str, Callable[[Any], str]] = {
    "parameters": itemgetter(0),
    "outputs": attrgetter("name"),
    "actuators": itemgetter(0),
    "keyframes": attrgetter("name"),
    "limits": attrgetter("path"),
    "terms": attrgetter("kind"),
}


# A number of the model that a parameter can set: parameter path for `target`, value in the model
# [unit], None where the compiled model does not hold it, and unit, which is empty where it has
# none, or where it depends on the model.
ListedParameter = tuple[str, float | None, str]

# An actuator: its name, a column of control tables, what it acts on, for example `joint hinge`, and
# the unit of its control, which is empty where it is not evident from the model.
ListedActuator = tuple[str, str, str]


@record
class ListedOutput(Record):
    """A number that can be measured.

    Attributes:
        name: Name of its column, a key of the table `noise` or a component of such a key.
        source: `state` for positions and velocities, otherwise MuJoCo's name of the sensor's type.
        unit: Its unit; empty where it has none, or where it depends on the model.
        noise: Standard deviation that the MJCF states [unit]; 0 where it states none.
    """

    name: str
    source: str
    unit: str
    noise: float


@record
class ListedKeyframe(Record):
    """A keyframe, a possible initial state.

    Attributes:
        name: Name of the keyframe; empty where it has none, so that no experiment can use it.
        qpos: Positions [m, rad, quaternions as w x y z].
        qvel: Velocities [m/s or rad/s].
        ctrl: Controls [actuator units].
    """

    name: str
    qpos: tuple[float, ...]
    qvel: tuple[float, ...]
    ctrl: tuple[float, ...]


@record
class ListedTerm(Record):
    """A kind of physical term that an experiment file can add to the model.

    Attributes:
        kind: Kind of the term.
        description: One sentence about the physics.
        elements: Elements on which it can act, such as `joint pivot`; `the base` for terms that
            name none.
        fields: Fields with their units, for paths `term/<name>:<field>`.
    """

    kind: str
    description: str
    elements: tuple[str, ...]
    fields: tuple[str, ...]


@record
class Inventory(Record):
    """Everything that an experiment file can name in a model.

    Attributes:
        model: Path of the model file.
        parameters: Numbers that a parameter can set.
        outputs: Numbers that can be measured.
        actuators: Actuators, in the order of the controls.
        keyframes: Keyframes.
        limits: Ranges of the MJCF that a design keeps.
        terms: Physical terms that an experiment file can add.
        remarks: Sentences about elements that cannot be named or whose ranges are not kept.
    """

    model: str
    parameters: tuple[ListedParameter, ...]
    outputs: tuple[ListedOutput, ...]
    actuators: tuple[ListedActuator, ...]
    keyframes: tuple[ListedKeyframe, ...]
    limits: tuple[LimitRange, ...]
    terms: tuple[ListedTerm, ...]
    remarks: tuple[str, ...]

    def selected(self, matches: Callable[[str], bool]) -> Inventory:
        """The entries whose path or name is wanted.

        Args:
            matches: Whether a path or a name is wanted.

        Returns:
            The selection; the remarks stay.
        """
        chosen: dict[str, Any] = {
            kind: tuple(entry for entry in getattr(self, kind) if matches(name_of(entry)))
            for kind, name_of in KINDS.items()
        }
        return replace(self, **chosen)

    def only(self, kind: str) -> Inventory:
        """The entries of one kind.

        Args:
            kind: One of `KINDS`.

        Returns:
            The selection without remarks.
        """
        others: dict[str, Any] = {name: () for name in KINDS if name != kind}
        return replace(self, remarks=(), **others)

    @property
    def count(self) -> int:
        """Number of entries."""
        return sum(len(getattr(self, kind)) for kind in KINDS)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        keys, drives = ("path", "value", "unit"), ("name", "drives", "unit")
        return {
            **super().summary(),
            "parameters": [dict(zip(keys, each, strict=True)) for each in self.parameters],
            "actuators": [dict(zip(drives, each, strict=True)) for each in self.actuators],
        }


@record
class StatedExperiment(Record):
    """Contents of a correct experiment file.

    Attributes:
        source: Path of the experiment file.
        model: Path of the model file.
        rate: Rate of the samples [Hz].
        horizon: Duration of a designed experiment [s]; None where it is not stated.
        parameters: Names of the p unknown parameters.
        units: Their units; may be empty.
        guess: (p,) values for which designs are made [theta-unit].
        bounds: (p, 2) lower and upper bounds of the estimates, infinite without one [theta-unit].
        nuisance: Names of the parameters whose accuracy is not optimised.
        sigma: Standard deviation of the noise of each measured output, a column of recordings
            [unit of the output].
        output_units: Units of the outputs by their names; may be empty.
        controls: Names of the controls.
        limits: The limits of a design, the ranges of the MJCF among them.
        controllers: The control laws, at the guess.
        missing: Keys that `check` and `design` need and that the file does not state.
        warnings: Numbers that are possible but probably not meant, in words.
    """

    source: str
    model: str
    rate: float
    horizon: float | None
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    guess: Array
    bounds: Array
    nuisance: tuple[str, ...]
    sigma: dict[str, float]
    output_units: dict[str, str]
    controls: tuple[str, ...]
    limits: tuple[LimitRange, ...]
    controllers: tuple[ControlLawInLoop, ...]
    missing: tuple[str, ...]
    warnings: tuple[str, ...]

    in_json = (
        "source",
        "model",
        "rate",
        "horizon",
        "parameters",
        "outputs",
        "controls",
        "limits",
        "controllers",
        "missing",
        "warnings",
    )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the measured outputs."""
        return tuple(self.sigma)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON, with a row for each parameter and output."""
        names = ("name", "unit", "guess", "lower", "upper", "nuisance")
        columns = (self.units, self.guess.tolist(), *self.bounds.T.tolist())
        return {
            **super().summary(),
            "parameters": [
                dict(zip(names, (*row, row[0] in self.nuisance), strict=True))
                for row in zip(self.parameters, *columns, strict=True)
            ],
            "outputs": [
                {"name": name, "unit": self.output_units[name], "sigma": sigma}
                for name, sigma in self.sigma.items()
            ],
        }
