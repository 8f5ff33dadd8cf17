"""Extended models, and their least-squares problems at the solution of the stated one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.known_activations import KnownActivations
from mjfim.identification.segments import Segment
from mjfim.model.coordinates import state_names, tangent_names
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.trajectory import Recording


def extended_system(
    system: System, parameters: dict[str, Any], terms: dict[str, Any]
) -> System | None:
    """The system with further parameters and terms; None where the model cannot have them.

    Args:
        system: The system.
        parameters: Tables of the further parameters by name.
        terms: Tables of the library of terms by name.
    """
    try:
        return System.resolve(
            system.experiment.replace(parameters=parameters, terms=terms),
            threads=system.threads,
            source=system.source,
        )
    except (ExperimentError, ModelError):
        return None


def extended_problem(
    problem: FitProblem,
    recordings: Sequence[Recording],
    at: UnknownValues,
    extended: System,
    *,
    differentiated_by: Collection[str],
) -> tuple[FitProblem, UnknownValues]:
    """The problem of an extended system, and the solution of the stated one in it.

    Rows, noise and initial states are those of the stated problem. New parameters have their
    guesses, new coordinates are at rest, and new activations follow from the recordings.

    Args:
        problem: The problem of some segments of the stated system.
        recordings: All recordings.
        at: Its solution.
        extended: The extended system, which has all parameters of the stated one.
        differentiated_by: Names of the parameters by which it is differentiated, for which their
            difference steps are calibrated.

    Returns:
        The problem and its unknowns.
    """
    stated, names = problem.system.parameters.names, extended.parameters.names
    theta = np.array(extended.parameters.guess)
    theta[[names.index(name) for name in stated]] = at.theta

    # The rows are those of the solution; a delay as a parameter would let the segments begin
    # earlier.
    wider = FitProblem.of(extended, recordings, calibrated=differentiated_by)
    simulation = replace(wider.simulation, segments=_extended_segments(problem, wider))
    wider = replace(
        wider,
        simulation=simulation,
        masks=problem.masks,
        noise=problem.noise,
        difference_step=problem.difference_step,
        central=problem.central,
    )
    private = _extended_private(problem, wider, at)
    return wider, replace(at, theta=theta, private=private)


def _extended_segments(problem: FitProblem, wider: FitProblem) -> tuple[Segment, ...]:
    """The segments of a problem with initial states of the extended model."""
    system = wider.system
    space, known = system.space, KnownActivations.of(system)
    stated, names = state_names(problem.system.model), state_names(system.model)
    if stated == names:
        return problem.segments

    common = [names.index(name) for name in stated]
    first = space.nq + space.nv
    added = [k for k, address in enumerate(known.addresses) if first + address not in common]
    places = [first + known.addresses[k] for k in added]

    segments = []
    for segment in problem.segments:
        start = np.array(system.plant.nominal_initial_state)
        start[common] = segment.start
        _, qvel, _ = space.split(start)
        recording = wider.recordings[segment.recording]
        values = known.at(recording, np.array([segment.begin]), qvel[None])[0]
        start[places] = values[added]
        segments.append(replace(segment, start=start))
    return tuple(segments)


def _extended_private(problem: FitProblem, wider: FitProblem, at: UnknownValues) -> Array:
    """(P, n) private unknowns of the extended model; those of new coordinates are zero."""
    before, after = _private_names(problem), _private_names(wider)
    if before == after:
        return at.private

    private = np.zeros((len(at.private), len(after)))
    private[:, [after.index(name) for name in before]] = at.private
    return private


def new_private_columns(problem: FitProblem, wider: FitProblem) -> list[int]:
    """Private unknowns of the extended problem that the stated one does not have.

    They are initial states of new coordinates.

    Args:
        problem: The stated problem.
        wider: The extended problem.

    Returns:
        Their columns among the private unknowns of the extended problem.
    """
    known = _private_names(problem)
    return [column for column, name in enumerate(_private_names(wider)) if name not in known]


def _private_names(problem: FitProblem) -> list[str]:
    """Names of the private unknowns of a segment."""
    if not problem.layout.free_starts:
        return [problem.system.parameters.names[i] for i in problem.layout.private]
    names = np.array(tangent_names(problem.system.model))
    directions = problem.simulation.start_directions
    return [str(names[np.flatnonzero(column)[0]]) for column in directions.T]
