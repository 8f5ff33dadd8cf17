"""Fits over short segments, and then over longer and longer ones, that lead to a start.

Over short segments, whose initial states are free, the simulation stays close to the measured
motion also where the parameters are far off. Such fits need a start too. It is the stated one, a
fit to the equation of motion where that costs less, or the best of many starts that are spread
about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.inverse_dynamics import try_fit_equations
from mjfim.identification.searches import FitSearch
from mjfim.identification.spread_starts import SPREAD_STARTS, best_spread_start
from mjfim.identification.subsets import restart_subset
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.optimize.levenberg_marquardt import (
    InterruptedPassError,
    SearchSettings,
    UnknownValues,
)
from mjfim.records.inverse_dynamics import InverseDynamicsFit

# Number of parts into which a recording is cut for the first fit, at most.
MAX_SEGMENTS = 64

# Smallest number of rows of a segment. Fewer rows tell little besides the free initial state.
MIN_ROWS = 12

# Ratio of the lengths of the segments of one fit and of the fit before it.
LENGTH_RATIO = 4.0

# Segments that are longer than this share of a recording are hardly better than the whole one.
MAX_SHARE = 0.5

# Iterations of a fit over segments. They bound the time of a restart.
SEGMENT_ITERATIONS = 12

# Free initial states make an iteration over segments longer than one over whole recordings. All
# fits over segments together take about the time of so many iterations over whole recordings.
ITERATIONS_OF_ALL_SEGMENTS = 45
FEWEST_SEGMENT_ITERATIONS = 3

# Length of a step [standard deviations], and decrease of the cost as a share of it, at which a fit
# over segments ends; only its neighbourhood is needed.
SEGMENT_TOLERANCE = 0.1
SEGMENT_ROUGH_SHARE = 0.01

# Singular values of directions below this value count as zero; those of a direction are 1 at most.
SMALLEST_DIRECTION = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentFits:
    """Fits over longer and longer segments.

    Attributes:
        start: Unknowns of the whole recordings to which they led; None where all of them diverge.
        lengths: Lengths of the segments [s]; none where no such fit is possible.
        inverse_dynamics: The fit to the equation of motion at which they began; None where they
            began at the start.
        starts: Number of spread starts from the best of which they began; 1 without any.
    """

    start: UnknownValues | None
    lengths: tuple[float, ...]
    inverse_dynamics: InverseDynamicsFit | None = None
    starts: int = 1


def start_from_segments(
    search: FitSearch,
    problem: FitProblem,
    null_space: NullSpace | None = None,
    *,
    spread: bool = False,
) -> SegmentFits:
    """Unknowns of the whole recordings from fits over longer and longer segments.

    The first fit begins at the start, or at a fit to the equation of motion where that costs less,
    and each other one at the result of the one before. The unknowns are those at which the whole
    recordings cost least.

    Args:
        search: The searches of the identification.
        problem: The problem of the whole recordings.
        null_space: Combinations of parameters that are held; None for none.
        spread: True to begin at the best one of many starts that are spread about the start.

    Returns:
        The fits.
    """
    best, best_cost, dynamics = None, np.inf, None
    lengths: list[float] = []
    task = search.task
    system = _free_system(task.system)
    if system is None:
        return SegmentFits(start=None, lengths=())

    # Parameters that move the stated initial state are no unknowns of the segments.
    names = task.system.parameters.names
    places = np.array([names.index(name) for name in system.parameters.names], dtype=np.intp)
    theta = np.array(task.start)

    all_lengths = segment_lengths(problem.recordings)
    for length in all_lengths:
        if search.interrupted():
            break
        part = problem_of_segments(problem, task, system, length)
        if part is None:
            continue
        part = _pinned(part, theta[places], null_space, places)
        if not lengths:
            first = _first_start(search, problem, part, places, spread=spread)
            if first is None:
                break
            theta, dynamics = np.array(first.theta), first.inverse_dynamics
        iterations = _iterations(problem, part, len(all_lengths))
        found = _fit_segments(search, part, theta[places], length, iterations)
        if found is None:
            continue

        lengths.append(length)
        theta[places] = part.theta(found)
        unknowns = _of_whole(problem, theta, (part, found, places))
        try:
            cost = problem.cost(unknowns)
        except InterruptedPassError:
            break
        if cost < best_cost:
            best, best_cost = unknowns, cost
    return SegmentFits(
        start=best,
        lengths=tuple(lengths),
        inverse_dynamics=dynamics,
        starts=SPREAD_STARTS if spread else 1,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _FirstStart:
    """The start of the fit over the shortest segments.

    Attributes:
        theta: (p,) parameters [theta-unit].
        inverse_dynamics: The fit to the equation of motion that gave them, or None.
    """

    theta: Array
    inverse_dynamics: InverseDynamicsFit | None = None


def _first_start(
    search: FitSearch, problem: FitProblem, part: FitProblem, places: np.ndarray, *, spread: bool
) -> _FirstStart | None:
    """The start of the fit over the shortest segments.

    It is the best one of the spread starts, if asked for; otherwise a fit to the equation of motion
    where segments cost less at it than at the stated start.

    Args:
        search: The searches of the identification.
        problem: The problem of the whole recordings.
        part: The problem of short segments.
        places: Places of its parameters in theta.
        spread: Whether to spread starts.

    Returns:
        The start; None where the model diverges at all spread starts, or after a request to stop.
    """
    start = search.task.start
    some = part.of_segments(restart_subset(part))
    try:
        if spread:
            best = best_spread_start(search, some, start[places])
            if best is None:
                return None
            theta = np.array(start)
            theta[places] = best
            return _FirstStart(theta=theta)

        found = try_fit_equations(problem.system, problem.recordings, start)
        if found is None:
            return _FirstStart(theta=start)
        cost, stated = (some.cost(some.begin(theta[places])) for theta in (found.theta, start))
    except InterruptedPassError:
        return None
    if cost < stated:
        return _FirstStart(theta=found.theta, inverse_dynamics=found)
    return _FirstStart(theta=start)


def segment_lengths(recordings: Sequence[AlignedRecording]) -> tuple[float, ...]:
    """Lengths of the segments of successive fits, shortest first [s].

    They are shares of the longest recording; the shortest segments have enough rows.

    Args:
        recordings: The recordings.

    Returns:
        The lengths; none where the recordings are too short to be cut.
    """
    longest = max(float(recording.t[-1]) for recording in recordings)
    period = max(float(recording.t[-1]) / (len(recording.t) - 1) for recording in recordings)

    lengths = []
    length = max(longest / MAX_SEGMENTS, MIN_ROWS * period)
    while length <= MAX_SHARE * longest:
        lengths.append(length)
        length *= LENGTH_RATIO
    return tuple(lengths)


def _free_system(system: System) -> System | None:
    """The system without parameters that move the initial state, which is free in segments.

    None where no other parameter of interest remains.
    """
    parameters = system.parameters
    by_theta = parameters.initial_state_derivative(system.space.nx)
    moving = {parameters.names[j] for j in np.flatnonzero(by_theta.any(axis=0))}
    if not moving:
        return system

    experiment = system.experiment
    tables = {name: spec for name, spec in experiment.parameters.items() if name not in moving}
    nuisance = experiment.nuisance.model_copy(update={"initial": None})
    remaining = experiment.model_copy(update={"parameters": tables, "nuisance": nuisance})
    try:
        found = System.resolve(remaining, threads=system.threads, source=system.source)
    except ExperimentError:
        return None
    return found.released(system.nominal_initial_state)


def problem_of_segments(
    problem: FitProblem, task: FitTask, system: System, length: float
) -> FitProblem | None:
    """The problem of segments of a length; it shares workers and recordings with the whole ones.

    Args:
        problem: The problem of the whole recordings.
        task: The task of the fit.
        system: The system, without parameters that move the initial state.
        length: The length [s].

    Returns:
        The problem; None where a recording cannot be cut so.
    """
    fit = system.experiment.fit.model_copy(update={"segments": length})
    experiment = system.experiment.model_copy(update={"fit": fit})
    is_same_model = system is task.system
    try:
        part = FitProblem.of(
            replace(system, experiment=experiment),
            task.recordings,
            calibrated=() if is_same_model else None,
        )
    except RecordingError:
        return None

    # Workers then receive no recording twice.
    part = replace(part, workers=problem.workers)
    if part.system.dt != problem.system.dt:
        return part
    simulation = replace(part.simulation, recordings=problem.recordings)

    # The difference steps of the whole recordings suit the same model over segments.
    if is_same_model:
        plant = problem.system.plant
        simulation = replace(simulation, system=replace(simulation.system, plant=plant))
    return replace(part, simulation=simulation)


def _pinned(
    part: FitProblem, theta: Array, null_space: NullSpace | None, places: np.ndarray
) -> FitProblem:
    """A problem of segments with the directions held that no recording determines.

    Args:
        part: The problem.
        theta: (p,) its parameters, at which they are held.
        null_space: Directions of the parameters of the whole recordings; None for none.
        places: Places of the parameters of the segments among these.
    """
    if null_space is None:
        return part
    directions = null_space.directions[places]
    if len(directions) == len(null_space.directions):
        return part.pinned(theta, null_space)

    U, sizes, _ = np.linalg.svd(directions, full_matrices=False)
    return part.pinned(theta, replace(null_space, directions=U[:, sizes > SMALLEST_DIRECTION]))


def _iterations(problem: FitProblem, part: FitProblem, count: int) -> int:
    """Largest number of iterations of one of several fits over segments.

    Args:
        problem: The problem of the whole recordings.
        part: The problem of the segments.
        count: Number of fits over segments.
    """
    # Both are linearised by two simulations for each direction and one without a change.
    whole, parts = (
        1 + 2 * (int(each.layout.estimated.sum()) + each.simulation.private_count)
        for each in (problem, part)
    )
    allowed = int(ITERATIONS_OF_ALL_SEGMENTS / count * whole / parts)
    return min(max(allowed, FEWEST_SEGMENT_ITERATIONS), SEGMENT_ITERATIONS)


def _fit_segments(
    search: FitSearch, part: FitProblem, theta: Array, length: float, iterations: int
) -> UnknownValues | None:
    """Unknowns of a fit over some segments of a length [s].

    None where it diverges at its start, or is stopped there.
    """
    some = part.of_segments(restart_subset(part))
    settings = SearchSettings(
        max_iterations=iterations,
        tolerance=SEGMENT_TOLERANCE,
        relinearise_at_end=False,
        rough_share=SEGMENT_ROUGH_SHARE,
        stagnant_share=SEGMENT_ROUGH_SHARE,
        lengthens=search.task.settings.loss != "linear",
    )
    phase = f"segments of {length:.2g} s"
    try:
        found = search.minimise(some, some.begin(theta), settings, phase)
    except InterruptedPassError:
        return None
    return None if found is None else found.unknowns


def _of_whole(
    problem: FitProblem, theta: Array, fit: tuple[FitProblem, UnknownValues, np.ndarray]
) -> UnknownValues:
    """Unknowns of the whole recordings at the result of a fit over segments.

    Args:
        problem: The problem of the whole recordings.
        theta: (p,) parameters [theta-unit].
        fit: Problem and unknowns of the segments, and the places of their parameters in theta.
    """
    part, found, places = fit
    begin = problem.begin(theta)

    # Parameters with a value for each recording keep these values.
    per_recording = np.array(begin.per_recording)
    columns = problem.layout.per_recording.tolist()
    for i, place in enumerate(places[part.layout.per_recording].tolist()):
        per_recording[:, columns.index(place)] = found.per_recording[:, i]
    return replace(begin, per_recording=per_recording)
