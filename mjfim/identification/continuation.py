"""Restart of a fit from fits over short segments: continuation in the length of the segments.

A simulation over a whole recording accumulates the effect of wrong parameters until it is out of
step with the measured motion. The cost has then many local minima, and a search from a guess that
is a few percent wrong may end in one of them. Over short segments, whose initial states are free,
the simulation stays close to the measured motion, and the search finds the neighbourhood of the
true parameters from far away. Longer and longer segments then lead to the minimum of the whole
recordings, which is the most accurate one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_quality import FitQuality, fit_quality
from mjfim.identification.inverse_dynamics import try_fit_equations
from mjfim.identification.residual_tests import misfit_reasons
from mjfim.identification.searches import FitSearch
from mjfim.identification.subsets import restart_subset
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.optimize.levenberg_marquardt import (
    InterruptedPassError,
    SearchSettings,
    Solution,
    UnknownValues,
)
from mjfim.records.estimate import Restart
from mjfim.records.inverse_dynamics import InverseDynamicsFit

# Number of parts into which a recording is cut for the first fit, at most.
MAX_SEGMENTS = 64

# Smallest number of rows of a segment. Fewer rows tell little besides the free initial state.
MIN_ROWS = 12

# Ratio of the lengths of the segments of one fit and of the fit before it.
LENGTH_RATIO = 4.0

# Segments that are longer than this share of a recording are hardly better than the whole one.
MAX_SHARE = 0.5

# Iterations of a fit over segments, and of the fit over whole recordings after it, unless this one
# has found a lower cost by then. They bound the time of a restart.
SEGMENT_ITERATIONS = 12
RESTART_ITERATIONS = 25

# Free initial states make an iteration over segments longer than one over whole recordings. All
# fits over segments together take about the time of so many iterations over whole recordings.
ITERATIONS_OF_ALL_SEGMENTS = 45
FEWEST_SEGMENT_ITERATIONS = 3

# Length of a step [standard deviations], and decrease of the cost as a share of it, at which a fit
# over segments ends; only its neighbourhood is needed.
SEGMENT_TOLERANCE = 0.1
SEGMENT_ROUGH_SHARE = 0.03

# Difference of two costs that is not relevant. A step to the minimum that is 0.14 standard
# deviations long lowers the cost by this much.
SAME_COST = 1e-2

# Singular values of directions below this value count as zero; those of a direction are 1 at most.
SMALLEST_DIRECTION = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class WholeFit:
    """A fit over whole recordings.

    Attributes:
        problem: The least-squares problem with the noise of the fit.
        solution: Its solution.
        quality: Quality of the fit.
        restart: How it was repeated from fits over segments; None where it was not.
        inverse_dynamics: The fit to the equation of motion at which these began, or None.
    """

    problem: FitProblem
    solution: Solution
    quality: FitQuality
    restart: Restart | None = None
    inverse_dynamics: InverseDynamicsFit | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _SegmentFits:
    """Fits over longer and longer segments.

    Attributes:
        start: Unknowns of the whole recordings to which they led; None where all of them diverge.
        lengths: Lengths of the segments [s]; none where no such fit is possible.
        inverse_dynamics: The fit to the equation of motion at which they began; None where they
            began at the start.
    """

    start: UnknownValues | None
    lengths: tuple[float, ...]
    inverse_dynamics: InverseDynamicsFit | None


def continued_fit(
    search: FitSearch,
    problem: FitProblem,
    first: tuple[FitProblem, Solution],
    null_space: NullSpace,
) -> WholeFit:
    """Repeat a doubtful fit from fits over segments, and keep the result with the lower cost.

    A search that then is stuck, because the residuals are rough, goes on with longer differences.

    A fit is doubtful if it does not explain the recordings, or, where this cannot be tested because
    the noise is estimated, if it ended without convergence. Nothing is repeated where the user
    states the length of the segments, and with the method `newton`.

    Args:
        search: The searches of the identification.
        problem: The problem before its noise was estimated.
        first: The problem with the noise of the first fit, and its solution.
        null_space: Combinations of parameters that the fit holds.

    Returns:
        The better one of the two fits.

    Raises:
        SimulationDivergedError: The simulation diverges at the solution of the first fit.
    """
    kept = _better_of_two(search, problem, first, null_space)
    found = search.over_roughness(kept.problem, kept.solution)
    if found[1] is kept.solution:
        return kept
    return replace(kept, problem=found[0], solution=found[1], quality=fit_quality(*found))


def _better_of_two(
    search: FitSearch,
    problem: FitProblem,
    first: tuple[FitProblem, Solution],
    null_space: NullSpace,
) -> WholeFit:
    """The first fit, or its repetition from fits over segments if that costs less."""
    task = search.task
    begun = WholeFit(problem=first[0], solution=first[1], quality=fit_quality(*first))
    stated = task.settings.segment_length is not None or task.method == "newton"
    if stated or search.interrupted() or not is_doubtful(task, begun):
        return begun

    segments = _start_from_segments(search, problem, null_space)
    if not segments.lengths:
        return begun

    start = segments.start
    again = None if start is None else _repeated(search, problem, start, begun)
    return _better(begun, again, segments)


def is_doubtful(task: FitTask, fit: WholeFit) -> bool:
    """Whether a fit may have ended in a local minimum, or before a minimum.

    Residuals that agree with the stated noise leave no lower minimum that matters.

    Args:
        task: The task of the fit.
        fit: The fit.
    """
    quality = fit.quality
    untested = not fit.solution.success and not task.noise_is_stated
    if untested or quality.unexplained:
        return True

    reasons = misfit_reasons(
        quality.chi2, quality.dof, task.noise_is_stated, quality.whiteness, missing=()
    )
    return bool(reasons)


def _start_from_segments(
    search: FitSearch, problem: FitProblem, null_space: NullSpace
) -> _SegmentFits:
    """Unknowns of the whole recordings from fits over longer and longer segments.

    The first fit begins at the start, or at a fit to the equation of motion where that costs less,
    and each other one at the result of the one before. The unknowns are those at which the whole
    recordings cost least.
    """
    best, best_cost, dynamics = None, np.inf, None
    lengths: list[float] = []
    task = search.task
    system = _free_system(task.system)
    if system is None:
        return _SegmentFits(start=None, lengths=(), inverse_dynamics=None)

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
        part = part.pinned(theta[places], _of_parameters(null_space, places))
        if not lengths:
            dynamics = _cheaper_dynamics(search, problem, part, places)
            theta = theta if dynamics is None else np.array(dynamics.theta)
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
    return _SegmentFits(start=best, lengths=tuple(lengths), inverse_dynamics=dynamics)


def _cheaper_dynamics(
    search: FitSearch, problem: FitProblem, part: FitProblem, places: np.ndarray
) -> InverseDynamicsFit | None:
    """A fit to the equation of motion where segments cost less at it than at the start; else None.

    Args:
        search: The searches of the identification.
        problem: The problem of the whole recordings.
        part: The problem of short segments.
        places: Places of its parameters in theta.
    """
    start = search.task.start
    found = try_fit_equations(problem.system, problem.recordings, start)
    if found is None:
        return None

    some = part.of_segments(restart_subset(part))
    try:
        cost, stated = (some.cost(some.begin(theta[places])) for theta in (found.theta, start))
    except InterruptedPassError:
        return None
    return found if cost < stated else None


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
    try:
        part = FitProblem.of(replace(system, experiment=experiment), task.recordings)
    except RecordingError:
        return None

    # Workers then receive no recording twice.
    part = replace(part, workers=problem.workers)
    if part.system.dt != problem.system.dt:
        return part
    return replace(part, simulation=replace(part.simulation, recordings=problem.recordings))


def _of_parameters(null_space: NullSpace, places: np.ndarray) -> NullSpace:
    """Directions of the null space among some of the parameters."""
    directions = null_space.directions[places]
    if len(directions) == len(null_space.directions):
        return null_space

    U, sizes, _ = np.linalg.svd(directions, full_matrices=False)
    return replace(null_space, directions=U[:, sizes > SMALLEST_DIRECTION])


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


def _repeated(
    search: FitSearch, problem: FitProblem, start: UnknownValues, first: WholeFit
) -> WholeFit | None:
    """A fit over whole recordings from a start; None where it diverges, or is stopped at its begin.

    It goes on beyond some iterations only if its cost is lower than that of the first fit by then.
    """
    try:
        begin: UnknownValues | None = start
        if search.task.noise_is_stated:
            begin = search.improved_on_part(problem, start, first.solution.unknowns)
        if begin is None:
            return None

        placed = search.with_initial_states(problem, begin)
        found = search.solve(
            problem,
            placed,
            "again all data",
            RESTART_ITERATIONS,
            cost_to_beat=first.solution.cost,
        )
        solution = found[1]
        ends_early = solution.success or solution.iterations < RESTART_ITERATIONS
        if not ends_early and _cost(first, solution) < first.solution.cost:
            found = search.solve(problem, found[1].unknowns, "again all data")
        return WholeFit(problem=found[0], solution=found[1], quality=fit_quality(*found))
    except (SimulationDivergedError, InterruptedPassError):
        return None


def _cost(first: WholeFit, solution: Solution) -> float:
    """Cost of a solution with the noise of the first fit, so that it can be compared with it."""
    return first.problem.cost(solution.unknowns)


def _better(first: WholeFit, again: WholeFit | None, segments: _SegmentFits) -> WholeFit:
    """The fit with the lower cost, and of two equal ones that which has converged."""
    restart = Restart(
        lengths=segments.lengths,
        cost_before=first.solution.cost,
        cost=first.solution.cost,
        by_dynamics=segments.inverse_dynamics is not None,
    )
    first = replace(first, inverse_dynamics=segments.inverse_dynamics)
    if again is None:
        return replace(first, restart=restart)

    cost = _cost(first, again.solution)
    fall = first.solution.cost - cost
    converges = again.solution.success and not first.solution.success
    if fall > SAME_COST or (converges and fall > -SAME_COST):
        again = replace(again, inverse_dynamics=segments.inverse_dynamics)
        return replace(again, restart=replace(restart, cost=cost))
    return replace(first, restart=restart)
