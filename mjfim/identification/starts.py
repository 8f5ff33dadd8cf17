"""Starts of a fit besides the stated one: equation of motion, spread values, short segments.

Where the model diverges at the stated start, or where a fit does not explain the recordings, the
search begins elsewhere. Residuals over short segments with free initial states have few local
minima, so that fits over longer and longer segments lead from a poor start to a good one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, listed
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.inverse_dynamics import fit_equations, try_fit_equations
from mjfim.identification.search import FitSearch, of_subset, quick_subset, restart_subset
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.model.parameter_ranges import make_physical
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues
from mjfim.plant.divergence import NO_WARNING, explain_divergence, find_divergence
from mjfim.plant.dynamics import UNSTABLE_LOOP
from mjfim.records.estimate_parts import InverseDynamicsFit
from mjfim.records.events import begin_stage
from mjfim.records.trajectory import Recording

# Number of starts that are spread about a guess, with the guess, and the largest factor between
# them and the guess.
SPREAD_STARTS = 32
LARGEST_FACTOR = 10.0

# Number of spread starts from which a short search is made: those that cost least.
SEARCHED_STARTS = 3

# A short search shows which start leads down.
SHORT_SEARCH = SearchSettings(max_iterations=4, relinearise_at_end=False)

# Number of parts into which a recording is cut for the first fit, at most, and smallest number of
# rows of a segment. Fewer rows tell little besides the free initial state.
MAX_SEGMENTS = 64
MIN_ROWS = 12

# Ratio of the lengths of the segments of one fit and of the fit before it. Segments that are longer
# than the share of a recording are hardly better than the whole one.
LENGTH_RATIO = 4.0
MAX_SHARE = 0.5

# A fit over segments, of which only the neighbourhood is needed.
SEGMENT_SEARCH = SearchSettings(
    max_iterations=12,
    tolerance=0.1,
    relinearise_at_end=False,
    rough_share=0.01,
    stagnant_share=0.01,
)

# Free initial states make an iteration over segments longer than one over whole recordings. All
# fits over segments together take about the time of so many iterations over whole recordings.
ITERATIONS_OF_ALL_SEGMENTS = 45
FEWEST_SEGMENT_ITERATIONS = 3

# A value is a fault of the log if it exceeds the typical magnitude of its column by this factor.
EXTREME_RATIO = 1e6

# Starts instead of that at which the model diverges, in words.
AT_EQUATION = "at a fit to the equation of motion"
AT_SPREAD_START = f"at the best of {SPREAD_STARTS} starts spread about it"


# ---- where a fit begins


@dataclass(frozen=True, kw_only=True, eq=False)
class BegunFit:
    """The searches of a fit, and where they start.

    Attributes:
        search: The searches; the start of their task is that of the fit.
        inverse_dynamics: The fit to the equation of motion, if there was one.
        instead: Where the search begins, in words, if the model diverges at the stated start.
    """

    search: FitSearch
    inverse_dynamics: InverseDynamicsFit | None = None
    instead: str = ""


def begin_fit(search: FitSearch, problem: FitProblem) -> BegunFit:
    """Find a start at which the model does not diverge.

    Raises:
        SimulationDivergedError: The simulation diverges at the start, and no other start is found.
    """
    task = search.task
    is_asked = task.settings.start == "inverse_dynamics"
    if is_asked:
        begin_stage("fitting the equation of motion")
        found = fit_equations(problem.system, problem.recordings, task.start)
        if _is_finite(problem, found.theta):
            return BegunFit(search=_from(search, found.theta), inverse_dynamics=found)
    begin_stage("simulating the segments from the initial guess")
    if _is_finite(problem, task.start):
        return BegunFit(search=search, inverse_dynamics=found if is_asked else None)

    # An extreme value is a fault of the log, for which no start helps. The method of the paper
    # starts where it is told.
    extreme = describe_extreme_value(task.recordings, task.system.channels.control_columns)
    if not extreme and task.method != "newton" and not is_asked:
        for theta, dynamics, words in _other_starts(search, problem):
            if _is_finite(problem, theta):
                begun = _from(search, theta)
                return BegunFit(search=begun, inverse_dynamics=dynamics, instead=words)
    raise divergence_at_start(task, problem, extreme)


def values_of_start(task: FitTask) -> str:
    """The parameters of the stated start and their values, for a message."""
    names = task.system.parameters.names
    return listed([f"{n} = {v:.6g}" for n, v in zip(names, task.start, strict=True)])


def _other_starts(
    search: FitSearch, problem: FitProblem
) -> Iterator[tuple[Array, InverseDynamicsFit | None, str]]:
    """Parameters where the search may begin instead, with words for them."""
    task = search.task
    found = try_fit_equations(problem.system, problem.recordings, task.start)
    if found is not None:
        yield found.theta, found, AT_EQUATION

    # The length of the segments is that of the user where it is stated.
    if task.settings.segment_length is not None:
        part = problem.of_segments(restart_subset(problem))
        theta = _best_spread_start(search, part, task.start)
        if theta is not None:
            yield theta, None, AT_SPREAD_START
        return
    start = start_from_segments(search, problem, spread=True).start
    if start is not None:
        yield problem.theta(start), None, AT_SPREAD_START


def _from(search: FitSearch, theta: Array) -> FitSearch:
    """The searches from parameters theta: (p,) that are near the data."""
    return replace(search, task=replace(search.task, start=np.array(theta)), begins_near=True)


def _is_finite(problem: FitProblem, theta: Array) -> bool:
    """Whether the model does not diverge at parameters theta: (p,), in the quick segments."""
    subset = quick_subset(problem)
    begin = of_subset(problem.begin(theta), subset)
    # The square of an extreme measured value is infinite.
    with np.errstate(over="ignore"):
        return bool(np.isfinite(problem.of_segments(subset).cost(begin)))


def divergence_at_start(task: FitTask, problem: FitProblem, extreme: str) -> Exception:
    """The error that names the start and the probable cause of the divergence.

    Args:
        task: The task, with the stated start.
        problem: Its problem.
        extreme: An extreme value of the recordings, in words; empty without any.
    """
    cause = f"; {extreme}; is it a fault of the log?"
    if not extreme:
        cause = f": {_why_diverged(problem, task.start)}"
    return SimulationDivergedError(
        f"the simulation diverges at the start ({values_of_start(task)}){cause}"
    )


def _why_diverged(problem: FitProblem, theta: Array) -> str:
    """Why the simulation of a segment from its start diverges, as a clause for a message."""
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


def describe_extreme_value(recordings: Sequence[Recording], controls: Sequence[str]) -> str:
    """Describe the most extreme value of the recordings.

    Args:
        recordings: The recordings.
        controls: Names of the columns of the control.

    Returns:
        A clause for a message; empty where no value is extreme.
    """
    worst, description = EXTREME_RATIO, ""
    for recording in recordings:
        names = (*controls, *recording.outputs)
        columns = (*recording.ctrl.T, *recording.y.T)
        for name, values in zip(names, columns, strict=True):
            magnitudes = np.nan_to_num(np.abs(values), posinf=0.0)
            present = magnitudes[magnitudes > 0.0]
            typical = float(np.median(present)) if len(present) else np.inf
            row = int(np.argmax(magnitudes))
            if magnitudes[row] > worst * typical:
                worst = float(magnitudes[row]) / typical
                description = (
                    f"{recording.name}: column {name!r} holds {values[row]:g} in row {row + 1} of "
                    f"the recording (t = {recording.t[row]:g} s), where its typical magnitude is "
                    f"{typical:.3g}"
                )
    return description


# ---- starts that are spread about a guess


def spread_starts(
    parameters: ParameterSet,
    theta: Array,
    held: Sequence[str],
    unphysical: Callable[[Array], Sequence[int]],
    rng: np.random.Generator,
) -> Array:
    """Spread starts about parameters, evenly in each of them.

    Args:
        parameters: The p parameters.
        theta: (p,) parameters about which starts are spread.
        held: Names of parameters that keep their values.
        unphysical: Indices of the parameters of unphysical bodies, by theta.
        rng: Source of random numbers.

    Returns:
        (n, p) starts, the given one first; only this one if nothing can move.
    """
    starts = np.tile(theta, (SPREAD_STARTS, 1))
    moved = ~np.isin(parameters.names, held) & ~np.asarray(parameters.outside_model)
    if not moved.any():
        return starts[:1]
    cube = scipy.stats.qmc.LatinHypercube(int(moved.sum()), rng=rng)
    shifts = 2.0 * cube.random(SPREAD_STARTS - 1) - 1.0
    for shift, j in zip(shifts.T, np.flatnonzero(moved).tolist(), strict=True):
        parameter = parameters.parameters[j]
        if parameter.size == abs(parameter.guess) and theta[j] != 0.0:
            starts[1:, j] *= LARGEST_FACTOR**shift
        else:
            starts[1:, j] += parameters.magnitude[j] * shift
    starts[1:] = np.clip(starts[1:], parameters.lower, parameters.upper)
    for start in starts[1:]:
        make_physical(start, theta, unphysical)
    return starts


def _best_spread_start(search: FitSearch, problem: FitProblem, theta: Array) -> Array | None:
    """(p,) result of short searches from the best of many starts; None where all diverge."""
    system, settings = problem.system, search.task.settings
    rng = np.random.default_rng(settings.seed)
    starts = spread_starts(system.parameters, theta, settings.hold, system.impossible, rng)
    costs = np.array([problem.cost(problem.begin(start)) for start in starts])
    best, least = None, np.inf
    for i in np.argsort(costs)[:SEARCHED_STARTS].tolist():
        if not np.isfinite(costs[i]) or search.interrupted:
            break
        phase = f"start {i + 1} of {len(starts)}"
        found = search.minimise(problem, problem.begin(starts[i]), SHORT_SEARCH, phase)
        if found is not None and found.cost < least:
            best, least = problem.theta(found.unknowns), found.cost
    return best


# ---- fits over longer and longer segments


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentFits:
    """Fits over longer and longer segments.

    Attributes:
        start: Unknowns of the whole recordings at the best of them; None without any.
        lengths: Lengths of the segments [s].
        inverse_dynamics: The fit to the equation of motion at which they began, if they did.
    """

    start: UnknownValues | None = None
    lengths: tuple[float, ...] = ()
    inverse_dynamics: InverseDynamicsFit | None = None


def start_from_segments(
    search: FitSearch,
    problem: FitProblem,
    null_space: NullSpace | None = None,
    *,
    spread: bool = False,
) -> SegmentFits:
    """Fit longer and longer segments, and take the result that costs least over whole recordings.

    Args:
        search: Searches of the identification.
        problem: The problem of the whole recordings.
        null_space: Directions that no recording determines, which are held.
        spread: Begin at the best of many starts instead of a fit to the equation of motion.
    """
    found = SegmentFits()
    best, least = None, np.inf
    theta = np.array(search.task.start)
    lengths = segment_lengths(problem.recordings)
    for length in lengths:
        part = problem.cut(length)
        if part is None or search.interrupted:
            continue
        if null_space is not None:
            part = part.pinned(theta, null_space)
        part = part.of_segments(restart_subset(part))
        if not found.lengths:
            first, dynamics = _first_start(search, part, spread=spread)
            if first is None:
                break
            theta, found = first, replace(found, inverse_dynamics=dynamics)
        settings = replace(
            SEGMENT_SEARCH,
            max_iterations=_iterations(problem, part, len(lengths)),
            lengthens=search.task.settings.loss != "linear",
        )
        begin = part.begin(theta)
        solution = search.minimise(part, begin, settings, f"segments of {length:.2g} s")
        if solution is None:
            continue
        theta = part.theta(solution.unknowns)
        whole = replace(problem.begin(theta), per_recording=solution.unknowns.per_recording)
        found = replace(found, lengths=(*found.lengths, length))
        cost = problem.cost(whole)
        if cost < least:
            best, least = whole, cost
    return replace(found, start=best)


def _first_start(
    search: FitSearch, part: FitProblem, *, spread: bool
) -> tuple[Array | None, InverseDynamicsFit | None]:
    """The start of the fit over the shortest segments; None where every start diverges."""
    start = search.task.start
    if spread:
        return _best_spread_start(search, part, start), None
    found = try_fit_equations(part.system, part.recordings, start)
    if found is not None and part.cost(part.begin(found.theta)) < part.cost(part.begin(start)):
        return found.theta, found
    return start, None


def segment_lengths(recordings: Sequence[AlignedRecording]) -> tuple[float, ...]:
    """Lengths of the segments of successive fits, shortest first [s]."""
    longest = max(float(recording.t[-1]) for recording in recordings)
    period = max(float(recording.t[-1]) / (len(recording.t) - 1) for recording in recordings)
    lengths = []
    length = max(longest / MAX_SEGMENTS, MIN_ROWS * period)
    while length <= MAX_SHARE * longest:
        lengths.append(length)
        length *= LENGTH_RATIO
    return tuple(lengths)


def _iterations(problem: FitProblem, part: FitProblem, count: int) -> int:
    """Largest number of iterations of one of several fits over segments."""
    # Both are linearised by two simulations for each direction and one without a change.
    whole, parts = (
        1 + 2 * (int(each.layout.estimated.sum()) + each.private_count) for each in (problem, part)
    )
    allowed = int(ITERATIONS_OF_ALL_SEGMENTS / count * whole / parts)
    return min(max(allowed, FEWEST_SEGMENT_ITERATIONS), SEGMENT_SEARCH.max_iterations)
