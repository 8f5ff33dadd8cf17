"""The start of a fit: the stated one, or one at which the model does not diverge.

A fit to the equation of motion compares forces, not motions, and so needs no start from which the
model can be simulated. It is the start where the user asks for it, and where the model diverges at
the stated one. Where it is not possible, fits over short segments from starts spread about the
stated one lead to another one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, listed
from mjfim.identification.extreme_values import describe_extreme_value
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.inverse_dynamics import fit_equations, try_fit_equations
from mjfim.identification.searches import FitSearch
from mjfim.identification.segment_fits import start_from_segments
from mjfim.identification.spread_starts import SPREAD_STARTS, best_spread_start
from mjfim.identification.subsets import of_subset, quick_subset, restart_subset
from mjfim.identification.task import FitTask
from mjfim.optimize.levenberg_marquardt import completed
from mjfim.plant.divergence import NO_WARNING, explain_divergence, find_divergence
from mjfim.plant.plant import UNSTABLE_LOOP
from mjfim.records.events import begin_stage
from mjfim.records.inverse_dynamics import InverseDynamicsFit

# Starts instead of that at which the model diverges, in words.
AT_EQUATION = "at a fit to the equation of motion"
AT_SPREAD_START = f"at the best of {SPREAD_STARTS} starts spread about it"


@dataclass(frozen=True, kw_only=True, eq=False)
class BegunFit:
    """The searches of a fit, and where they start.

    Attributes:
        search: The searches, from a start at which the model does not diverge.
        inverse_dynamics: The fit to the equation of motion at which they start; None where they
            start at the stated parameters.
        instead: Where they start instead of the stated start, at which the model diverges, in
            words; empty where it does not diverge there.
    """

    search: FitSearch
    inverse_dynamics: InverseDynamicsFit | None = None
    instead: str = ""


def begin_fit(search: FitSearch, problem: FitProblem) -> BegunFit:
    """Find a start at which the model does not diverge.

    Parameters that the equation of motion does not contain keep their start.

    Args:
        search: The searches from the stated start.
        problem: The problem of all recordings.

    Returns:
        The searches from the start that was found.

    Raises:
        RecordingError: A degree of freedom was not measured, although `fit.start` needs it.
        SimulationDivergedError: The model diverges at the start, and there is no better one.
    """
    if search.task.settings.start == "inverse_dynamics":
        return _begun_by_dynamics(search, problem)

    begin_stage("simulating the segments from the initial guess")
    if _is_finite(problem, search.task.start):
        return BegunFit(search=search)

    # An extreme value is a fault of the log, for which no start helps. The method of the paper
    # starts where it is told.
    task = search.task
    extreme = describe_extreme_value(task.recordings, task.system.channels.control_columns)
    if not extreme and task.method != "newton":
        begun = _begun_elsewhere(search, problem)
        if begun is not None:
            return begun
    raise _divergence(task, problem, extreme)


def values_of_start(task: FitTask) -> str:
    """The parameters of the stated start and their values, for a message.

    Args:
        task: The task.

    Returns:
        Names and values, separated by commas.
    """
    names = task.system.parameters.names
    return listed([f"{n} = {v:.6g}" for n, v in zip(names, task.start, strict=True)])


def _begun_by_dynamics(search: FitSearch, problem: FitProblem) -> BegunFit:
    """The searches from a fit to the equation of motion, for which the user asked.

    They start at the stated parameters where the model diverges at this fit.
    """
    begin_stage("fitting the equation of motion")
    task = search.task
    found = fit_equations(problem.system, problem.recordings, task.start)

    begin_stage("simulating the segments from the fit to the equation of motion")
    if _is_finite(problem, found.theta):
        return BegunFit(search=_from(search, found.theta), inverse_dynamics=found)
    if _is_finite(problem, task.start):
        return BegunFit(search=search, inverse_dynamics=found)
    extreme = describe_extreme_value(task.recordings, task.system.channels.control_columns)
    raise _divergence(task, problem, extreme)


def _begun_elsewhere(search: FitSearch, problem: FitProblem) -> BegunFit | None:
    """The searches from another start than that at which the model diverges; None without any."""
    task = search.task
    found = try_fit_equations(problem.system, problem.recordings, task.start)
    if found is not None and _is_finite(problem, found.theta):
        begun = _from(search, found.theta)
        return BegunFit(search=begun, inverse_dynamics=found, instead=AT_EQUATION)

    # The length of the segments is that of the user where it is stated.
    if task.settings.segment_length is not None:
        part = problem.of_segments(restart_subset(problem))
        theta = completed(partial(best_spread_start, search, part, task.start))
    else:
        start = start_from_segments(search, problem, spread=True).start
        theta = None if start is None else problem.theta(start)
    if theta is None or not _is_finite(problem, theta):
        return None
    return BegunFit(search=_from(search, theta), instead=AT_SPREAD_START)


def _from(search: FitSearch, theta: Array) -> FitSearch:
    """The searches from parameters theta: (p,), which a fit to the equation of motion found."""
    return replace(search, task=replace(search.task, start=np.array(theta)), begins_near=True)


def _is_finite(problem: FitProblem, theta: Array) -> bool:
    """Whether the model does not diverge at parameters theta: (p,), in the quick segments."""
    subset = quick_subset(problem)
    begin = of_subset(problem.begin(theta), subset)

    # The square of an extreme measured value is infinite.
    with np.errstate(over="ignore"):
        return bool(np.isfinite(completed(partial(problem.of_segments(subset).cost, begin))))


def _divergence(task: FitTask, problem: FitProblem, extreme: str) -> SimulationDivergedError:
    """The error that names the start and the probable cause of the divergence.

    Args:
        task: The task.
        problem: The problem of all recordings.
        extreme: Clause about an extreme value of the recordings; empty where there is none.
    """
    why = "" if extreme else _why_diverged(problem, task.start)
    cause = f"; {extreme}; is it a fault of the log?" if extreme else f": {why}"
    return SimulationDivergedError(
        f"the simulation diverges at the start ({values_of_start(task)}){cause}"
    )


def _why_diverged(problem: FitProblem, theta: Array) -> str:
    """Why the simulation of a segment from its start diverges, as a clause for a message.

    Args:
        problem: Problem with the segments.
        theta: (p,) parameters [theta-unit].
    """
    plant = problem.system.plant
    if plant.laws is not None:
        return UNSTABLE_LOOP
    model = plant.model(theta)
    substeps = plant.simulator.substeps

    for segment in problem.segments:
        end = segment.begin + segment.samples
        ctrl = problem.recordings[segment.recording].ctrl[segment.begin : end]
        if find_divergence(model, segment.start, ctrl, substeps) is not None:
            return explain_divergence(model, segment.start, ctrl, substeps)
    return NO_WARNING
