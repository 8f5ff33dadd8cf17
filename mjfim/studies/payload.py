"""Identification of an unknown payload on a robot whose own parameters are known.

The payload is a term of the model: a mass at a point of a body, with a rotational inertia that is
equal about all axes (Atkeson, An and Hollerbach 1986 estimate the ten parameters of a load; one
number of inertia is what a short log can tell). What an earlier estimate knows about the robot is
prior knowledge with its covariance, so that the uncertainty of the robot is part of the intervals.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, record, scaled_to_unit_diagonal
from mjfim.errors import ExperimentError, listed, unknown
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import RecordingsLike, recordings_of
from mjfim.experiment.packing import model_of
from mjfim.experiment.parameters import BARYCENTRIC_FIELDS, LOGCHOLESKY_FIELDS
from mjfim.experiment.schema import Experiment, ExperimentLike, experiment_of
from mjfim.experiment.system import System
from mjfim.experiment.system_tables import ParameterSpec
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.honest_covariance import honest_covariance
from mjfim.identification.assessment.report import estimate_from
from mjfim.identification.identify import Callback, fit_task, identify_system
from mjfim.identification.search import FitSearch, FitTask, with_length
from mjfim.model.elements import free_name, identifier, model_length, names_of
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.terms.library import AXES
from mjfim.parallel import one_blas_thread
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.records.estimate import Estimate
from mjfim.records.estimate_parts import PayloadEstimate
from mjfim.records.events import begin_stage, shown_progress
from mjfim.records.trajectory import Recording
from mjfim.studies.first_candidates import PAYLOAD_SHARE
from mjfim.studies.selected_models import selected_experiment

# Kind of the term that is a payload, and the name of the one that is added.
KIND = "payload"

# Fields of the payload, in the order of its parameters.
FIELDS = ("mass", *AXES, "inertia")

# Keys of a parameter that its earlier estimate replaces.
REPLACED_KEYS = ("guess", "prior", "cad_prior", "inertial", "coordinates", "scale")


@record
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
        gone = set(_parameters_of_terms(experiment, loads))
        values["terms"] = {k: v for k, v in values.get("terms", {}).items() if k not in loads}
        parameters = {k: v for k, v in values["parameters"].items() if k not in gone}
        # Values that differ from recording to recording remain a nuisance.
        values["parameters"] = {
            name: {k: v for k, v in table.items() if k != "nuisance" or table.get("per_recording")}
            for name, table in parameters.items()
        }
        hold = tuple(name for name in experiment.fit.hold if name not in gone)
        values["fit"] = {**values.get("fit", {}), "hold": hold}
        bodies = tuple(spec.body or "" for spec in loads.values())
        return cls(values=values, stated=bodies, stated_by=experiment)

    @property
    def shared(self) -> dict[str, list[tuple[str, str | None]]]:
        """Parameters that have one value in all recordings, by table; see `parameters_of`."""
        specs = [(name, self.stated_by.parameters[name]) for name in self.values["parameters"]]
        return {name: parameters_of(name, spec) for name, spec in specs if not spec.per_recording}

    @property
    def experiment(self) -> Experiment:
        """The checked experiment of the robot alone, which needs a parameter."""
        return self.stated_by.restated(self.values)

    def known(self, theta: Mapping[str, float]) -> dict[str, Any]:
        """All tables of the robot's parameters, whose guesses are those of an earlier estimate.

        The ten coordinates of an inertia become ten parameters with a path each. Values that differ
        from recording to recording keep their guesses.

        Args:
            theta: Values by name of the parameter [theta-unit].
        """
        tables = {}
        shared = self.shared
        for name, table in self.values["parameters"].items():
            if name not in shared:
                tables[name] = table
                continue
            kept = {key: value for key, value in table.items() if key not in REPLACED_KEYS}
            low, high = self.stated_by.parameters[name].bounds or (-np.inf, np.inf)
            for parameter, path in shared[name]:
                guess = float(np.clip(theta[parameter], low, high))
                place = {} if path is None else {"target": path}
                tables[parameter] = {**kept, **place, "guess": guess}
        return tables

    def carrier(self, body: str | None) -> str:
        """Name of the body that carries the payload.

        Args:
            body: Its name; None for the one at which the experiment states a payload.

        Raises:
            ExperimentError: There is no such body, or it does not move.
            ModelError: The model cannot be used.
        """
        model = model_of(self.stated_by).model
        moving = [
            name
            for name in names_of(model, "body")
            if model.body_weldid[identifier(model, "body", name)]
        ]
        if body is None:
            if len(set(self.stated)) != 1:
                raise ExperimentError(
                    f"body: name the body that carries the payload; valid: {listed(moving)}"
                )
            body = self.stated[0]

        number = identifier(model, "body", body)
        if number < 0:
            raise ExperimentError(f"body: {unknown('body', body, names_of(model, 'body'))}")
        if model.body_weldid[number] == 0:
            raise ExperimentError(
                f"body: {body!r} does not move, so that a payload has no effect; valid: "
                f"{listed(moving)}"
            )
        return body


def _parameters_of_terms(experiment: Experiment, terms: Iterable[str]) -> Iterator[str]:
    """Names of the tables of parameters that set numbers of some terms.

    Raises:
        ExperimentError: A parameter sets numbers of a term and of the robot.
    """
    prefixes = tuple(f"term/{name}:" for name in terms)
    for name, spec in experiment.parameters.items():
        of_terms = [target.path.startswith(prefixes) for target in spec.all_targets]
        if any(of_terms) and not all(of_terms):
            raise ExperimentError(
                f"{experiment.source}: parameters.{name}: sets numbers of the payload and "
                "of the robot; separate the two"
            )
        if any(of_terms):
            yield name


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
    pairs = zip(INERTIA_PARAMETRISATIONS[kind].names, fields, strict=True)
    return [(f"{name}.{each}", f"body/{spec.inertial}:{field}") for each, field in pairs]


# Density of the uniform cube whose size is assumed where none is stated [kg/m³]: that of water, and
# of MuJoCo's geoms that state no mass.
DENSITY = 1000.0

# Half width of the interval of the inertia over its value up to which recordings determine it.
DETERMINED_SHARE = 0.5

# Share of the half width that the prior alone gives, from which on recordings do not determine a
# coordinate of the centre of mass.
UNDETERMINED_SHARE = 0.5


@record
class KnownRobot:
    """Prior knowledge of a robot's parameters.

    Attributes:
        tables: Tables of its parameters, with guesses from the earlier estimate.
        known: Names of the parameters that the earlier estimate knows with an uncertainty.
        covariance: (k, k) covariance of these.
        held: Names of the parameters that are held.
        source: Words for where the earlier estimate is from.
    """

    tables: dict[str, Any]
    known: tuple[str, ...]
    covariance: Array
    held: tuple[str, ...]
    source: str


@checked
def identify_payload(
    experiment: ExperimentLike,
    recordings: RecordingsLike,
    *,
    body: str | None = None,
    robot: Estimate | None = None,
    without: RecordingsLike = (),
    size: float | None = None,
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Estimate:
    """Estimate mass, centre of mass and rotational inertia of a payload on a known robot.

    `estimate.payload` holds them. Ctrl-C ends the search with the best result so far.

    Args:
        experiment: The robot, with its parameters and noise; a payload in it is the start.
        recordings: Recordings with the payload.
        body: Name of the body that carries it; default: the one where the experiment states a
            payload.
        robot: Earlier estimate of the robot's parameters with this experiment, whose uncertainty
            becomes part of that of the payload. Without it, parameters without `prior` are held.
        without: Recordings of the robot without the payload, from which its parameters are
            estimated first.
        size: Edge of the cube of which the payload has the volume [m]; it gives the rotational
            inertia where the recordings do not determine it. Default: a cube of water.
        callback: Called with every iterate.
        threads: Threads for the engine; default: one per core.
        stop: Token that ends the search with the best result so far.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Returns:
        The estimate of the payload and of the robot's parameters.

    Raises:
        ExperimentError: Something is wrong in the experiment or in the arguments.
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    with shown_progress("identifying the payload", callback, progress) as show:
        stated = experiment_of(experiment)
        prepared = PayloadTask.of(stated, body=body, robot=robot, size=size, threads=threads)
        system = prepared.system()
        loaded, empty = recordings_of(system, recordings), recordings_of(system, without)
        return prepared.identify(loaded, without=empty, callback=show, stop=stop)[0]


@record
class PayloadTask:
    """A robot, what is known of it, and where its payload is.

    Attributes:
        robot: The experiment of the robot.
        body: Name of the body that carries the payload.
        earlier: Earlier estimate of the robot, or None.
        size: Edge of the cube of which the payload has the volume [m], or None.
        threads: Threads for the engine, or None.
        source: Words for where the earlier estimate is from.
    """

    robot: RobotExperiment
    body: str
    earlier: Estimate | None
    size: float | None
    threads: int | None
    source: str

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        *,
        body: str | None = None,
        robot: Estimate | None = None,
        size: float | None = None,
        threads: int | None = None,
        source: str = "the earlier estimate",
    ) -> PayloadTask:
        """Check what is stated. See `identify_payload` for the arguments.

        Raises:
            ExperimentError: The body cannot carry a payload, or the earlier estimate is one of
                other parameters.
            ModelError: The model cannot be used.
        """
        if size is not None and not (np.isfinite(size) and size > 0.0):
            raise ExperimentError(f"size: {size!r}: give a positive length in metres")
        if robot is not None and robot.selection is not None:
            experiment = selected_experiment(experiment, robot.selection)
        stated = RobotExperiment.of(experiment)
        task = cls(
            robot=stated,
            body=stated.carrier(body),
            earlier=robot,
            size=size,
            threads=threads,
            source=source,
        )
        known = task.robot_names if robot is None else robot.parameters
        lacking = [name for name in task.robot_names if name not in known]
        if lacking:
            raise ExperimentError(
                f"{source} lacks the robot's {listed(lacking)} of {experiment.source}; it has "
                f"{listed(known)}. Identify the robot with this experiment"
            )
        return task

    @cached_property
    def term(self) -> str:
        """Name of the term, which no element of the model has."""
        bodies = names_of(model_of(self.robot.stated_by).model, "body")
        return free_name(KIND, {*bodies, *self.robot.values["terms"]})

    @cached_property
    def names(self) -> dict[str, str]:
        """Names of the parameters of the payload, by field."""
        used = self.robot.values["parameters"]
        return {field: free_name(f"payload_{field}", used) for field in FIELDS}

    @cached_property
    def start(self) -> tuple[float, list[float], float]:
        """Mass [kg] and centre of mass in the frame of the body [m] at which a search starts.

        The last number is the length of the robot [m], which bounds the centre of mass loosely.
        """
        model = model_of(self.robot.stated_by).model
        number = identifier(model, "body", self.body)
        mass = PAYLOAD_SHARE * float(model.body_subtreemass[model.body_weldid[number]])
        return mass, model.body_ipos[number].tolist(), model_length(model)

    def system(self, known: KnownRobot | None = None) -> System:
        """The robot with the payload.

        Args:
            known: What is known of the robot; default: what its experiment and the earlier
                estimate state.
        """
        return self._system(known or self.known_robot(), self._payload_tables())

    def identify(
        self,
        recordings: Sequence[Recording],
        *,
        without: Sequence[Recording] = (),
        callback: Callback | None = None,
        stop: StopToken | None = None,
    ) -> tuple[Estimate, System]:
        """The estimate of the payload, and the robot with it. See `identify_payload`.

        Raises:
            RecordingError: A recording cannot be used.
            SimulationDivergedError: The model diverges at the start.
        """
        begun = time.perf_counter()
        with one_blas_thread(), stop_on_interrupt(stop) as token:
            known = self.known_robot()
            if without:
                known = self._known_after(known, without, callback, token)

            # First with any inertia, which needs to be known only where recordings show it.
            begin_stage("fitting the payload")
            budget = Budget(stop=token)
            task = FitTask.of(self.system(known), recordings)
            search = FitSearch(task=task, budget=budget, callback=callback)
            fit, edge = fit_task(search), None
            if not self._determines_inertia(fit) and not token.requested:
                fit, edge = self._with_assumed_inertia(known, fit, search)
            estimate = estimate_from(fit, budget, refuted=())

        system = fit.task.system
        found = replace(
            estimate,
            payload=self._payload(estimate, known, edge),
            seconds=time.perf_counter() - begun,
            steps=system.plant.engine_steps,
        )
        return found, system

    # ---- the robot

    def known_robot(self) -> KnownRobot:
        """Prior knowledge of the experiment and of the earlier estimate about the robot.

        Without an estimate, parameters with a stated prior are known by it, and the others are
        held.
        """
        if self.earlier is not None:
            system = System.resolve(self.robot.experiment, threads=self.threads)
            covariance = honest_covariance(system.parameters, self.earlier)
            return self._known_from(self.earlier, covariance)

        held = list(self.robot.values["fit"]["hold"])
        for name, parameters in self.robot.shared.items():
            if self.robot.stated_by.parameters[name].prior is None:
                held += [each for each, _ in parameters]
        return KnownRobot(
            tables=dict(self.robot.values["parameters"]),
            known=(),
            covariance=np.zeros((0, 0)),
            held=tuple(dict.fromkeys(held)),
            source="",
        )

    def _known_from(self, estimate: Estimate, covariance: Array) -> KnownRobot:
        """Prior knowledge from an estimate of the robot.

        Args:
            estimate: The estimate.
            covariance: (p, p) its honest covariance [products of theta-units].
        """
        names = self.robot_names
        index = np.array([estimate.parameters.index(name) for name in names], dtype=int)
        variance = np.diag(covariance)[index]
        is_known = np.isfinite(variance) & (variance > 0.0)
        chosen = index[is_known]
        theta = dict(zip(estimate.parameters, estimate.theta.tolist(), strict=True))
        known = tuple(name for name, flag in zip(names, is_known, strict=True) if flag)
        return KnownRobot(
            tables=self.robot.known(theta),
            known=known,
            covariance=covariance[np.ix_(chosen, chosen)],
            held=tuple(name for name in names if name not in known),
            source=self.source,
        )

    def _known_after(
        self,
        known: KnownRobot,
        without: Sequence[Recording],
        callback: Callback | None,
        token: StopToken,
    ) -> KnownRobot:
        """Prior knowledge of the robot after recordings without the payload.

        Args:
            known: What is known before; without an earlier estimate, nothing but stated priors.
            without: Recordings of the robot without the payload.
            callback: Called with every iterate.
            token: Token that ends the search.
        """
        if self.earlier is None:
            known = replace(known, held=self.robot.values["fit"]["hold"])
        begin_stage("fitting the robot without the payload")
        system = self._system(known, {})
        estimate = identify_system(system, without, callback=callback, stop=token)
        found = self._known_from(estimate, honest_covariance(system.parameters, estimate))
        return replace(found, source="the recordings without the payload")

    @property
    def robot_names(self) -> tuple[str, ...]:
        """Names of the robot's parameters that have one value in all recordings."""
        return tuple(name for each in self.robot.shared.values() for name, _ in each)

    # ---- the robot with its payload

    def _system(self, known: KnownRobot, payload: dict[str, Any]) -> System:
        """The robot with what is known of it, and with the tables of a payload, if any."""
        tables = known.tables
        if payload:
            tables = {name: {**table, "nuisance": True} for name, table in tables.items()}
        values = {**self.robot.values, "parameters": {**payload, **tables}}
        values["fit"] = {**self.robot.values["fit"], "hold": known.held}
        if payload:
            term = {"kind": KIND, "body": self.body}
            values["terms"] = {**self.robot.values["terms"], self.term: term}

        system = System.resolve(self.robot.stated_by.restated(values), threads=self.threads)
        if not known.known:
            return system
        parameters = system.parameters
        rows = np.zeros((len(known.known), len(parameters)))
        columns = [parameters.names.index(name) for name in known.known]
        rows[:, columns] = _whitening(known.covariance)
        return replace(system, parameters=replace(parameters, earlier_rows=rows))

    def _payload_tables(
        self, guess: float | None = None, inertia: float | None = None
    ) -> dict[str, Any]:
        """Tables of the parameters of the payload.

        Args:
            guess: Mass at which the search starts [kg]; None: from the robot's sizes.
            inertia: Assumed rotational inertia, known to as much [kg m²]; None where it is free.
        """
        mass, centre, length = self.start
        inertia_of_cube = mass * self._edge(mass) ** 2 / 6.0
        start = {"mass": mass if guess is None else guess, "inertia": inertia_of_cube}
        start |= zip(AXES, centre, strict=True)
        tables = {}
        for field, name in self.names.items():
            table = {"target": f"term/{self.term}:{field}", "guess": start[field]}
            if field in AXES:
                table["prior"] = length
            if field == "inertia" and inertia is not None:
                table |= {"guess": inertia, "prior": inertia, "nuisance": True}
            tables[name] = table
        return tables

    def _edge(self, mass: float) -> float:
        """Edge of the uniform cube with the volume of a payload of a mass [kg]: stated or water."""
        return self.size if self.size is not None else float(np.cbrt(mass / DENSITY))

    def _determines_inertia(self, fit: FitResult) -> bool:
        j = fit.task.system.parameters.names.index(self.names["inertia"])
        value = float(fit.theta[j])
        half_width = np.abs(fit.accuracy.interval[j] - value).max()
        is_known = np.isfinite(fit.accuracy.std[j]) and value > 0.0
        return bool(is_known and half_width <= DETERMINED_SHARE * value)

    def _plausible_mass(self, fit: FitResult, j: int) -> float:
        """Mass of the payload, parameter j of a fit, not too small for its interval [kg]."""
        high = float(fit.accuracy.interval[j, 1])
        mass = max(float(fit.theta[j]), 0.5 * high if np.isfinite(high) else 0.0)
        return mass or self.start[0]

    def _with_assumed_inertia(
        self, known: KnownRobot, fit: FitResult, search: FitSearch
    ) -> tuple[FitResult, float]:
        """The fit with the rotational inertia of a uniform cube, and the edge of the cube [m].

        The inertia has a prior as wide as itself, so that the intervals contain what it may be.

        Args:
            known: What is known of the robot.
            fit: The fit with any inertia.
            search: Its search.
        """
        names = fit.task.system.parameters.names
        of_mass, of_inertia = (names.index(self.names[field]) for field in ("mass", "inertia"))
        mass = self._plausible_mass(fit, of_mass)
        edge = self._edge(mass)
        start = np.array(fit.theta)
        start[of_inertia] = mass * edge**2 / 6.0
        begin_stage("fitting the payload with the inertia of a uniform cube")
        tables = self._payload_tables(*start[[of_mass, of_inertia]].tolist())
        task = FitTask.of(self._system(known, tables), search.task.recordings)

        # The length of the segments may be chosen already; the comparison of lengths still holds.
        if fit.horizons is not None:
            task = with_length(task, fit.task.settings.segments or "whole")
        found = fit_task(replace(search, task=replace(task, start=start)), checks_log=False)

        # Nominal is the model at which the whole search began.
        return (
            replace(
                found,
                task=replace(found.task, start=search.task.start),
                horizons=fit.horizons or found.horizons,
            ),
            edge,
        )

    def _payload(
        self, estimate: Estimate, known: KnownRobot, edge: float | None
    ) -> PayloadEstimate:
        """The payload of an estimate."""
        index = {field: estimate.parameters.index(name) for field, name in self.names.items()}
        axes = [index[axis] for axis in AXES]
        half_widths = 0.5 * np.diff(estimate.interval[axes], axis=1).ravel()
        is_determined = half_widths < UNDETERMINED_SHARE * NORMAL_95 * self.start[2]
        return PayloadEstimate(
            body=self.body,
            mass=float(estimate.theta[index["mass"]]),
            mass_interval=estimate.interval[index["mass"]],
            centre=estimate.theta[axes],
            centre_interval=estimate.interval[axes],
            undetermined=tuple(
                axis for axis, flag in zip(AXES, is_determined, strict=True) if not flag
            ),
            inertia=float(estimate.theta[index["inertia"]]),
            inertia_interval=estimate.interval[index["inertia"]],
            edge=edge,
            known=known.known,
            held=known.held,
            source=known.source,
        )


def _whitening(covariance: Array) -> Array:
    """(k, k) rows R with `R.T @ R` the inverse of a covariance, of which some may be rounded off.

    The eigenvalues are those of the correlation, so that they do not depend on units.

    Args:
        covariance: (k, k) covariance with positive variances.
    """
    correlation, std = scaled_to_unit_diagonal(covariance)
    values, vectors = np.linalg.eigh(correlation)

    # Rounding may make the smallest eigenvalues of a nearly singular correlation negative.
    smallest = len(values) * np.finfo(np.float64).eps * values[-1]
    weights = 1.0 / np.sqrt(np.maximum(values, smallest))
    return np.asarray((weights[:, None] * vectors.T) / std)
