"""Experiments about an unknown payload: the robot's own, and the one that adds the payload."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.errors import ExperimentError, listed, unknown
from mjfim.experiment.packing import model_of
from mjfim.experiment.parameters import BARYCENTRIC_FIELDS, LOGCHOLESKY_FIELDS
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import ParameterSpec
from mjfim.model.elements import identifier, model_length, names_of
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.terms.library import AXES
from mjfim.studies.first_experiment.candidates import PAYLOAD_SHARE

# Kind of the term that is a payload, and the name of the one that is added.
KIND = "payload"

# Fields of the payload, in the order of its parameters.
FIELDS = ("mass", *AXES, "inertia")

# Keys of a parameter that its earlier estimate replaces.
REPLACED_KEYS = ("guess", "prior", "cad_prior", "inertial", "coordinates", "scale")


@dataclass(frozen=True, kw_only=True, eq=False)
class PayloadPlace:
    """Place at which a payload is fixed, and sizes of the robot from which its search starts.

    Attributes:
        body: Name of the body that carries it.
        term: Name of the term, which no element of the model has.
        names: Names of its parameters, by field.
        mass: Mass at which the search starts [kg].
        centre: (3,) centre of mass at which it starts, in the frame of the body [m].
        length: Length of the robot, which bounds the centre of mass loosely [m].
    """

    body: str
    term: str
    names: Mapping[str, str]
    mass: float
    centre: tuple[float, ...]
    length: float


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotExperiment:
    """The experiment of a robot without its payload.

    Attributes:
        values: Keys and tables of the experiment, which may state no parameter.
        stated: Bodies at which the experiment states a payload.
        stated_by: The experiment as the user states it.
    """

    values: Mapping[str, Any]
    stated: tuple[str, ...]
    stated_by: Experiment

    @classmethod
    def of(cls, experiment: Experiment) -> RobotExperiment:
        """Leave out the payloads that an experiment states, and their parameters.

        A payload is stated where the experiment was made to design the excitation.

        Args:
            experiment: The experiment.

        Raises:
            ExperimentError: A parameter sets numbers of the payload and of the robot.
        """
        values = experiment.model_dump(exclude_unset=True)
        loads = {name: spec for name, spec in experiment.terms.items() if spec.kind == KIND}
        prefixes = tuple(f"term/{name}:" for name in loads)

        gone = set()
        for name, spec in experiment.parameters.items():
            of_load = [target.path.startswith(prefixes) for target in spec.all_targets]
            if loads and any(of_load):
                if not all(of_load):
                    raise ExperimentError(
                        f"{experiment.source}: parameters.{name}: sets numbers of the payload and "
                        "of the robot; separate the two"
                    )
                gone.add(name)

        values["terms"] = {k: v for k, v in values.get("terms", {}).items() if k not in loads}
        parameters = {k: v for k, v in values["parameters"].items() if k not in gone}
        values["parameters"] = {name: _of_interest(table) for name, table in parameters.items()}
        fit = dict(values.get("fit", {}))
        fit["hold"] = tuple(name for name in fit.get("hold", ()) if name not in gone)
        values["fit"] = fit
        bodies = tuple(spec.body or "" for spec in loads.values())
        return cls(values=values, stated=bodies, stated_by=experiment)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the robot's tables of parameters."""
        return tuple(self.values["parameters"])

    @property
    def experiment(self) -> Experiment:
        """The checked experiment of the robot alone, which needs a parameter."""
        return self.stated_by.restated(self.values)

    def known(self, names: tuple[str, ...], theta: Mapping[str, float]) -> dict[str, Any]:
        """Tables of parameters whose guesses are those of an earlier estimate.

        The ten coordinates of an inertia become ten parameters with a path each.

        Args:
            names: Names of the tables that the estimate knows.
            theta: Values by name of the parameter [theta-unit].

        Returns:
            All tables of the robot's parameters.
        """
        tables: dict[str, Any] = {}
        for name, table in self.values["parameters"].items():
            spec = self.stated_by.parameters[name]
            if name not in names:
                tables[name] = table
                continue
            kept = {key: value for key, value in table.items() if key not in REPLACED_KEYS}
            for parameter, path in parameters_of(name, spec):
                low, high = spec.bounds or (-np.inf, np.inf)
                guess = float(np.clip(theta[parameter], low, high))
                place = {} if path is None else {"target": path}
                tables[parameter] = {**kept, **place, "guess": guess}
        return tables

    def place(self, body: str | None) -> PayloadPlace:
        """Find the body that carries the payload.

        Args:
            body: Its name; None for the one at which the experiment states a payload.

        Raises:
            ExperimentError: There is no such body, or it does not move.
            ModelError: The model cannot be used.
        """
        model = model_of(self.stated_by).model
        if body is None:
            if len(set(self.stated)) != 1:
                raise ExperimentError(
                    "body: name the body that carries the payload; valid: "
                    f"{listed(_carriers(model))}"
                )
            (body,) = set(self.stated)

        number = identifier(model, "body", body)
        if number < 0:
            raise ExperimentError(f"body: {unknown('body', body, names_of(model, 'body'))}")
        group = int(model.body_weldid[number])
        if group == 0:
            raise ExperimentError(
                f"body: {body!r} does not move, so that a payload has no effect; valid: "
                f"{listed(_carriers(model))}"
            )

        taken = {*names_of(model, "body"), *self.values["terms"]}
        term = _free(KIND, taken)
        used = set(self.values["parameters"])
        names = {field: _free(f"payload_{field}", used) for field in FIELDS}
        return PayloadPlace(
            body=body,
            term=term,
            names=names,
            mass=PAYLOAD_SHARE * float(model.body_subtreemass[group]),
            centre=tuple(model.body_ipos[number].tolist()),
            length=model_length(model),
        )


def parameters_of(name: str, spec: ParameterSpec) -> list[tuple[str, str | None]]:
    """Names of the parameters of a table, each with a path where the table states none.

    Args:
        name: Name of the table.
        spec: The table.
    """
    if spec.inertial is None:
        return [(name, None)]

    kind = spec.coordinates or "logcholesky"
    fields = BARYCENTRIC_FIELDS if kind == "barycentric" else LOGCHOLESKY_FIELDS
    coordinates = INERTIA_PARAMETRISATIONS[kind].names
    pairs = zip(coordinates, fields, strict=True)
    return [(f"{name}.{each}", f"body/{spec.inertial}:{field}") for each, field in pairs]


def _of_interest(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table of a robot's parameter, which is no nuisance where the robot itself is identified.

    Values that differ from recording to recording always are.
    """
    if table.get("per_recording"):
        return dict(table)
    return {key: value for key, value in table.items() if key != "nuisance"}


def _carriers(model: Any) -> list[str]:
    """Names of the bodies that move."""
    return [
        name
        for name in names_of(model, "body")
        if int(model.body_weldid[identifier(model, "body", name)])
    ]


def _free(name: str, taken: set[str]) -> str:
    """A name that is not taken: `name`, or `name_2` and so on."""
    found, number = name, 2
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    return found
