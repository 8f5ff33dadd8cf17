"""A fit of parameters to the equation of motion along measured motions (inverse dynamics).

The residuals are the forces that the measured motion needs, less those of the actuators (IDIM-LS;
Gautier, Janot & Vandanjon, A new closed-loop output error method for parameter identification of
robot dynamics, IEEE T-CST 2013; Leboutet et al., Inertial parameter identification in robotics: a
survey, Appl. Sci. 2021). They are linear in the barycentric inertias of the bodies and in damping,
friction, armature and gains, so that one linearisation is enough for these, from any start. Each
equation is weighted by its own residuals, of which large ones count less. No motion is simulated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.errors import ExperimentError, MjfimError, RecordingError, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording, align, on_grid_of
from mjfim.identification.assessment.residual_tests import whiteness_of
from mjfim.identification.inverse_dynamics.equations import MotionEquations
from mjfim.identification.inverse_dynamics.forces import measured_forces
from mjfim.identification.inverse_dynamics.search import EquationSearch, FoundEquations
from mjfim.parallel import one_blas_thread
from mjfim.records.estimate_parts import EquationFit, InverseDynamicsFit
from mjfim.records.trajectory import Recording

# Largest number of averages of an equation that a record holds.
SHOWN_ROWS = 1500

# Smallest number of rows that is enough for a fit, over the number of its parameters.
ROWS_PER_PARAMETER = 4.0


def inverse_dynamics(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    start: Array | None = None,
    threads: int | None = None,
) -> InverseDynamicsFit:
    """Fit parameters to the equation of motion along the measured motions.

    It needs the position or velocity of every degree of freedom, and the forces of the actuators,
    measured or by the model from the control in the log. It finds linear parameters from any start,
    in a small part of the time of `identify`. Noise in velocities and accelerations biases it more,
    and `identify` is the better estimator where a simulation follows the motion.

    Args:
        experiment: Model, parameters and noise; nothing else needs to be stated.
        recordings: Recordings to which the parameters are fitted.
        start: (p,) parameters at which the fit starts; default: the guess.
        threads: Threads for the engine; default: one per core.

    Returns:
        The fit.

    Raises:
        ExperimentError: Something is wrong in the experiment or in the arguments.
        RecordingError: A recording cannot be used; a degree of freedom was not measured.
    """
    system = System.resolve(experiment, threads=threads)
    if not recordings:
        raise RecordingError("inverse_dynamics needs at least one recording")

    begun = system.parameters.guess if start is None else np.asarray(start, dtype=np.float64)
    if begun.shape != system.parameters.guess.shape:
        raise ExperimentError(
            f"start: {begun.shape} numbers; expected one per parameter: "
            f"{listed(system.parameters.names)}"
        )
    system = on_grid_of(system, recordings)
    with one_blas_thread():
        return fit_equations(system, [align(system, each) for each in recordings], begun)


def fit_equations(
    system: System, recordings: Sequence[AlignedRecording], start: Array
) -> InverseDynamicsFit:
    """Fit the parameters of a system to the equation of motion along recordings.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        start: (p,) parameters at which the fit starts [theta-unit].

    Returns:
        The fit.

    Raises:
        ExperimentError: Control laws compute controls, and a force of such an actuator was not
            measured.
        RecordingError: A degree of freedom was not measured, or too little can be used.
    """
    forces, laws = measured_forces(system, recordings), system.laws
    system = system.without_laws()

    begun, steps = time.perf_counter(), system.plant.engine_steps
    parameters = system.parameters
    start = np.clip(start, parameters.lower, parameters.upper)
    equations = MotionEquations.of(system, recordings, start, forces=forces, laws=laws)
    search = EquationSearch.of(system, equations, start)
    _require_rows(search, recordings)

    found = search.run()
    taken = equations.model.system.plant.engine_steps + system.plant.engine_steps - steps
    return replace(
        _record(search, found, recordings), seconds=time.perf_counter() - begun, steps=taken
    )


def try_fit_equations(
    system: System, recordings: Sequence[AlignedRecording], start: Array
) -> InverseDynamicsFit | None:
    """The fit of `fit_equations` as a start that nobody asked for; None where it is of no use.

    It is not possible without measured motions, and without any force of actuators the equation of
    motion shows ratios of inertias and other forces only: small inertias make its residuals small.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        start: (p,) parameters at which the fit starts [theta-unit].
    """
    try:
        found = fit_equations(system, recordings, start)
    except (MjfimError, np.linalg.LinAlgError):
        return None
    has_forces = any(each.measured.any() for each in found.degrees_of_freedom)
    return found if has_forces else None


def _require_rows(search: EquationSearch, recordings: Sequence[AlignedRecording]) -> None:
    """Raise RecordingError where the equations have too few rows."""
    rows, count = len(search.of_row), len(search.active)
    if not count:
        raise RecordingError(
            f"{recordings[0].name}: the equation of motion contains none of the parameters; "
            'remove fit.start = "inverse_dynamics"'
        )
    if rows < ROWS_PER_PARAMETER * count:
        raise RecordingError(
            f"{recordings[0].name}: the equation of motion has only {rows} rows for {count} "
            "parameters; rows near gaps, stops and contacts do not count: use longer recordings, "
            'or fit.start = "measured"'
        )


# ---- record


def _record(
    search: EquationSearch, found: FoundEquations, recordings: Sequence[AlignedRecording]
) -> InverseDynamicsFit:
    """The record of a solution, without its time."""
    parameters = search.parameters
    longest = int(np.argmax([recording.t[-1] for recording in recordings]))
    fits = tuple(_equation_fits(search, found, longest))
    times = {fit.name: fit.correlation for fit in fits}
    correlation = np.array([times.get(each.name, 1.0) for each in search.equations.equations])
    covariance, unknown, determined, condition = search.accuracy(found, correlation)

    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    without_prior = [j for j in unknown if parameters.parameters[j].prior is None]
    std[without_prior] = np.inf
    absent = np.setdiff1d(np.arange(len(parameters)), [*search.active, *unknown])
    std[absent] = np.nan
    status = f"converged after {found.count} linearisations"
    if found.count == 1:
        status = "converged: the equation of motion is linear in the parameters"
    if not found.success:
        status = "not converged: no step lowers the residuals of the equation of motion any more"
    return InverseDynamicsFit(
        parameters=parameters.names,
        units=tuple(parameter.unit for parameter in parameters.parameters),
        theta=search.coordinates.theta(found.x),
        std=std,
        covariance=covariance,
        start=search.coordinates.theta(search.start),
        equations=fits,
        determined=determined,
        undetermined=tuple(parameters.names[j] for j in unknown),
        absent=tuple(parameters.names[j] for j in absent),
        condition=condition,
        iterations=found.count,
        success=found.success,
        status=status,
        recording=recordings[longest].name,
        sizes=parameters.magnitude,
    )


def _equation_fits(
    search: EquationSearch, found: FoundEquations, shown: int
) -> Iterator[EquationFit]:
    """The fits of all equations that have rows, with the series of one recording."""
    equations, rows = search.equations, found.rows
    recording, times = equations.recording_of_row, equations.times
    for i, equation in enumerate(equations.equations):
        own = np.flatnonzero(search.of_row == i)
        if not len(own):
            continue
        residual = rows.residual[own] * found.weights[own]
        parts = [residual[recording[own] == k] for k in np.unique(recording[own])]
        drawn = own[recording[own] == shown]
        drawn = drawn[evenly_spread_indices(len(drawn), SHOWN_ROWS)]
        parts_of_force = rows.measured[own], rows.inertial[own]
        yield EquationFit(
            name=equation.name,
            unit=equation.unit,
            residual=float(np.sqrt(np.mean(rows.residual[own] ** 2))),
            size=max(float(np.sqrt(np.mean(part**2))) for part in parts_of_force),
            rows=len(own),
            cutoff=equations.cutoff(i),
            sigma=float(found.sigma[i]),
            correlation=max(whiteness_of(equation.name, parts).time, 1.0),
            t=times[drawn],
            measured=rows.measured[drawn],
            explained=rows.explained[drawn],
        )
