"""Other starts of a fit than the stated one, and the length of its segments.

`identify` asks for them where the stated start is not enough.

The model may diverge at the stated start, or a fit may not explain the recordings. Then the search
begins at a fit to the equation of motion, or at spread values. Residuals over short segments with
free initial states have few local minima. So fits over longer and longer segments lead from a poor
start to a good one.

Where a model does not explain the data, its estimates depend on the length of the segments. Short
segments show quick effects, and long ones show effects that add up. Fits over several lengths
predict left-out parts of the data, over times of each length. The lengths are compared by the
relative error over all these times, so that times with larger errors do not dominate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.honest_covariance import jackknife_std
from mjfim.identification.assessment.robust_covariance import inverse_root, t_quantile
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.inverse_dynamics import fit_equations, try_fit_equations
from mjfim.identification.left_out import (
    MAX_FOLDS,
    HeldOutLosses,
    LeftOutPart,
    blocks_of,
    fit_without,
    joined_losses,
    left_out_parts,
    losses_of,
    stretches_of,
)
from mjfim.identification.search import FitSearch, FitTask, of_subset, quick_subset, values_of_start
from mjfim.information.null_space import NullSpace
from mjfim.model.parameters import ParameterSet, make_physical
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues
from mjfim.plant.dynamics import NO_WARNING, UNSTABLE_LOOP, explain_divergence, find_divergence
from mjfim.records.estimate import HorizonStudy
from mjfim.records.estimate_parts import InverseDynamicsFit
from mjfim.records.events import begin_stage
from mjfim.records.trajectory import Recording

# Number of starts that are spread about a guess, which is one of them. The factor between a start
# and the guess is at most the second number.
SPREAD_STARTS = 32
LARGEST_FACTOR = 10.0

# Number of starts from which a short search is made: those that cost least.
SEARCHED_STARTS = 3

# Smallest and largest distance of starts on either side of a touch [standard deviations].
NEAR_SCALES = (0.3, 10.0)

# Short search that compares starts.
TRIAL_SEARCH = SearchSettings(max_iterations=4, relinearise_at_end=False)

# Largest number of segments of a recording in the first fit, and smallest number of rows of a
# segment. Fewer rows tell little besides the free initial state.
MAX_SEGMENTS = 64
MIN_ROWS = 12

# Number of samples, and least number of segments, of a fit over segments. They are enough to lead
# near the minimum over all data.
RESTART_SAMPLES = 3_000
MIN_RESTART_SEGMENTS = 12

# Ratio of the lengths of the segments of a fit and of the fit before it, and largest share of a
# recording in a segment. Longer segments are hardly better than the whole recording.
LENGTH_RATIO = 4.0
MAX_SHARE = 0.5

# Search over segments, which only has to end near its minimum.
SEGMENT_SEARCH = SearchSettings(
    max_iterations=12,
    tolerance=0.1,
    relinearise_at_end=False,
    rough_share=0.01,
    stagnant_share=0.01,
)

# Free initial states make an iteration over segments longer than one over whole recordings. All
# fits over segments together take about as long as this number of iterations over whole recordings.
ITERATIONS_OF_ALL_SEGMENTS = 45
FEWEST_SEGMENT_ITERATIONS = 3

# A value is a fault of the log if it exceeds the typical magnitude of its column by this factor.
EXTREME_RATIO = 1e6

# Where the search begins if the model diverges at the stated start, in words.
AT_EQUATION = "at a fit to the equation of motion"
AT_SPREAD_START = f"at the best of {SPREAD_STARTS} starts spread about it"

# Largest number of samples of a fit that is compared with others, and of the predictions over one
# length. Of more data, segments that are spread over them are used.
MAX_SAMPLES = 10_000

# Number of samples of all recordings above which whole recordings are not among the lengths.
MAX_WHOLE_SAMPLES = 50_000

# Share of the mean loss by which predictions have to be worse before a shorter length is chosen.
RELEVANT_SHARE = 0.01

# Smallest number of parts of the data whose scatter tells differences from chance, and the
# probability of a difference by chance.
MIN_PARTS = 3
SIGNIFICANCE = 0.01

# Probability that an interval holds the true value.
CONFIDENCE = 0.95


# ---- where a fit begins


def begin_fit(
    search: FitSearch, problem: FitProblem
) -> tuple[FitSearch, InverseDynamicsFit | None, str]:
    """Find a start at which the model does not diverge.

    Returns:
        The searches from this start, and the fit to the equation of motion at which they begin, or
        None. The text says where they begin if the model diverges at the stated start.

    Raises:
        SimulationDivergedError: The simulation diverges at the start, and no other start is found.
    """
    task, dynamics = search.task, None
    is_asked = task.settings.start == "inverse_dynamics"
    if is_asked:
        begin_stage("fitting the equation of motion")
        dynamics = fit_equations(problem.system, problem.recordings, task.start)
        if _is_finite(problem, dynamics.theta):
            return _begun_at(search, dynamics.theta), dynamics, ""
    begin_stage("simulating the segments from the initial guess")
    if _is_finite(problem, task.start):
        return search, dynamics, ""

    # An extreme value is a fault of the log, for which no start helps. The method of the paper has
    # no other start than the stated one.
    extreme = describe_extreme_value(task.recordings, task.system.channels.control_columns)
    if not extreme and task.method != "newton" and not is_asked:
        for theta, found, words in _other_starts(search, problem):
            if _is_finite(problem, theta):
                return _begun_at(search, theta), found, words
    raise divergence_at_start(task, problem, extreme)


def _other_starts(
    search: FitSearch, problem: FitProblem
) -> Iterator[tuple[Array, InverseDynamicsFit | None, str]]:
    """Other parameters at which the search may begin, each with a text that says where it is."""
    task = search.task
    found = try_fit_equations(problem.system, problem.recordings, task.start)
    if found is not None:
        yield found.theta, found, AT_EQUATION

    # A stated length of the segments is kept. Otherwise, fits over several lengths follow.
    if task.settings.segment_length is not None:
        part = problem.of_segments(problem.spread(RESTART_SAMPLES, MIN_RESTART_SEGMENTS))
        theta = _best_spread_start(search, part, task.start)
        if theta is not None:
            yield theta, None, AT_SPREAD_START
        return
    start = start_from_segments(search, problem, spread=True)[0]
    if start is not None:
        yield problem.theta(start), None, AT_SPREAD_START


def _begun_at(search: FitSearch, theta: Array) -> FitSearch:
    """The searches from parameters theta: (p,) that are near the minimum."""
    return replace(search, task=replace(search.task, start=np.array(theta)), begins_near=True)


def _is_finite(problem: FitProblem, theta: Array) -> bool:
    """Whether the model does not diverge at parameters theta: (p,), in the quick segments."""
    subset = quick_subset(problem)
    begin = of_subset(problem.begin(theta), subset)
    # The square of an extreme measured value is infinite.
    with np.errstate(over="ignore"):
        return bool(np.isfinite(problem.of_segments(subset).cost(begin)))


def divergence_at_start(task: FitTask, problem: FitProblem, extreme: str) -> Exception:
    """The error that names the stated start and the probable cause of the divergence.

    Args:
        task: The task.
        problem: Its problem.
        extreme: The text of `describe_extreme_value`.
    """
    cause = f"; {extreme}; is it a fault of the log?"
    if not extreme:
        cause = f": {_why_diverged(problem, task.start)}"
    return SimulationDivergedError(
        f"the simulation diverges at the start ({values_of_start(task)}){cause}"
    )


def _why_diverged(problem: FitProblem, theta: Array) -> str:
    """Cause of the divergence of a segment from its start, as a clause for a message."""
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
    """Spread starts about given values, evenly in each parameter.

    Args:
        parameters: The p parameters.
        theta: (p,) given values.
        held: Names of parameters that keep their values.
        unphysical: Gives the indices of the parameters of unphysical bodies at a theta.
        rng: Source of random numbers.

    Returns:
        (n, p) starts, the given one first; only this one if all parameters keep their values.
    """
    moved = ~np.isin(parameters.names, held) & ~np.asarray(parameters.outside_model)
    if not moved.any():
        return theta[None]
    cube = scipy.stats.qmc.LatinHypercube(np.count_nonzero(moved), rng=rng)
    shifts = np.zeros((SPREAD_STARTS, len(theta)))
    shifts[1:, moved] = 2.0 * cube.random(SPREAD_STARTS - 1) - 1.0

    # A parameter whose magnitude is that of its guess is a scalar, which keeps its sign.
    magnitude = parameters.magnitude
    is_scaled = (magnitude == np.abs(parameters.guess)) & (theta != 0.0)
    starts = np.where(is_scaled, theta * LARGEST_FACTOR**shifts, theta + magnitude * shifts)
    starts[1:] = np.clip(starts[1:], parameters.lower, parameters.upper)
    for start in starts[1:]:
        make_physical(start, theta, unphysical)
    return starts


def _best_spread_start(search: FitSearch, problem: FitProblem, theta: Array) -> Array | None:
    """(p,) best parameters after short searches from spread starts; None where all diverge."""
    system, settings = problem.system, search.task.settings
    rng = np.random.default_rng(settings.seed)
    starts = spread_starts(system.parameters, theta, settings.hold, system.impossible, rng)
    begins = [problem.begin(start) for start in starts]
    best = _best_after_trials(search, problem, begins, f"of {len(starts)}", np.inf)
    return None if best is None else problem.theta(best)


def start_beyond_stops(search: FitSearch, fit: FitResult) -> UnknownValues | None:
    """The best of many starts near a fit whose motion touches stops or contacts.

    Where a touch comes or goes, the residuals jump, and a search ends at the jump. Starts on both
    sides are drawn from the covariance of the fit, at several scales.

    Args:
        search: Searches of the identification.
        fit: The fit.

    Returns:
        The best unknowns after short searches; None where none cost less than the fit.
    """
    problem, solution = fit.problem, fit.solution
    condensed = solution.condensed
    root = inverse_root(condensed.information())
    rng = np.random.default_rng(search.task.settings.seed)
    size = np.sqrt(max(fit.quality.chi2 / fit.quality.dof, 1.0))
    begins = []
    for scale in size * np.geomspace(*NEAR_SCALES, SPREAD_STARTS):
        common = scale * root @ rng.standard_normal(root.shape[1])
        step = condensed.step_to(common, 0.0, condensed.column_norms)
        begins.append(problem.moved(solution.unknowns, step, 1.0))
    return _best_after_trials(search, problem, begins, "near stops", solution.cost)


def _best_after_trials(
    search: FitSearch,
    problem: FitProblem,
    begins: Sequence[UnknownValues],
    place: str,
    least: float,
) -> UnknownValues | None:
    """The best unknowns after short searches from the starts that cost least.

    Args:
        search: Searches of the identification.
        problem: The problem.
        begins: Unknowns at the starts.
        place: End of the name of each search in events.
        least: Cost that the best unknowns have to stay below; otherwise, the result is None.
    """
    costs = [problem.cost(begin) for begin in begins]
    best: UnknownValues | None = None
    for i in np.argsort(costs)[:SEARCHED_STARTS].tolist():
        if not np.isfinite(costs[i]) or search.interrupted:
            break
        found = search.minimise(problem, begins[i], TRIAL_SEARCH, f"start {i + 1} {place}")
        if found is not None and found.cost < least:
            best, least = found.unknowns, found.cost
    return best


# ---- fits over longer and longer segments


def start_from_segments(
    search: FitSearch,
    problem: FitProblem,
    null_space: NullSpace | None = None,
    *,
    spread: bool,
) -> tuple[UnknownValues | None, tuple[float, ...], InverseDynamicsFit | None]:
    """Fit longer and longer segments, and take the result with the least cost of whole recordings.

    Args:
        search: Searches of the identification.
        problem: The problem of the whole recordings.
        null_space: Directions that no recording determines, which are held.
        spread: Begin at the best spread start instead of a fit to the equation of motion.

    Returns:
        Unknowns of the whole recordings at the best result, or None; the lengths of the segments
        [s]; and the fit to the equation of motion at which the fits began, or None.
    """
    used: list[float] = []
    best, least, dynamics = None, np.inf, None
    theta = np.array(search.task.start)
    lengths = segment_lengths(problem.recordings)
    for length, cut in _problems_by_length(problem, RESTART_SAMPLES, MIN_RESTART_SEGMENTS):
        if search.interrupted:
            break
        part = cut if null_space is None else cut.pinned(theta, null_space)
        if not used:
            first, dynamics = _first_start(search, part, spread=spread)
            if first is None:
                break
            theta = first

        # Two simulations for each direction and one without a change linearise a problem.
        directions = [int(each.estimated.sum()) + each.private_count for each in (problem, part)]
        whole_time, part_time = (1 + 2 * count for count in directions)
        allowed = int(ITERATIONS_OF_ALL_SEGMENTS / len(lengths) * whole_time / part_time)
        settings = replace(
            SEGMENT_SEARCH,
            max_iterations=min(
                max(allowed, FEWEST_SEGMENT_ITERATIONS), SEGMENT_SEARCH.max_iterations
            ),
            lengthens=search.task.settings.loss != "linear",
        )
        begin = part.begin(theta)
        solution = search.minimise(part, begin, settings, f"segments of {length:.2g} s")
        if solution is None:
            continue
        theta = part.theta(solution.unknowns)
        whole = replace(problem.begin(theta), per_recording=solution.unknowns.per_recording)
        used.append(length)
        cost = problem.cost(whole)
        if cost < least:
            best, least = whole, cost
    return best, tuple(used), dynamics


def _first_start(
    search: FitSearch, part: FitProblem, *, spread: bool
) -> tuple[Array | None, InverseDynamicsFit | None]:
    """The start of the fits over segments, with its fit to the equation of motion, if there is one.

    It is None where every spread start diverges.
    """
    start = search.task.start
    if spread:
        return _best_spread_start(search, part, start), None
    found = try_fit_equations(part.system, part.recordings, start)
    if found is not None and part.cost(part.begin(found.theta)) < part.cost(part.begin(start)):
        return found.theta, found
    return start, None


def _problems_by_length(
    problem: FitProblem, samples: int, least: int
) -> Iterator[tuple[float, FitProblem]]:
    """Lengths of segments [s], shortest first, and problems of such segments over all data.

    Args:
        problem: The problem of the whole recordings.
        samples: Largest number of samples of a problem, approximately.
        least: Least number of its segments, if the recordings have so many.
    """
    for length in segment_lengths(problem.recordings):
        part = problem.cut(length)
        if part is not None:
            yield length, part.of_segments(part.spread(samples, least))


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


# ---- the length of the segments


def choose_length(
    search: FitSearch, problem: FitProblem, whole: FitResult
) -> tuple[HorizonStudy, float | None, Array] | None:
    """Compare lengths of segments by predictions of left-out data, and choose one.

    Args:
        search: Searches of the identification.
        problem: The problem of whole recordings, with the noise of their fit.
        whole: The fit over whole recordings.

    Returns:
        The comparison; the chosen length [s], or None for whole recordings; and the (p,) estimate
        over it. None if fewer than two lengths can be compared, if a parameter moves the initial
        state, or after a request to stop.
    """
    system = search.task.system
    if system.plant.initial_state_derivative.any():
        return None
    tried: list[tuple[float | None, FitProblem]] = [
        (length, part.pinned(search.task.start, whole.null_space))
        for length, part in _problems_by_length(problem, MAX_SAMPLES, MAX_FOLDS)
    ]
    if problem.sample_count <= MAX_WHOLE_SAMPLES:
        tried.append((None, problem.of_segments(problem.spread(MAX_SAMPLES, MAX_FOLDS))))
    parts = _parts_to_leave_out(problem)
    compared = []
    for number, (length, part) in enumerate(tried):
        begin_stage("comparing lengths of the segments", number, len(tried))
        found = _estimates_over(search, whole, length, part, parts)
        if search.interrupted:
            return None
        if found is not None:
            compared.append((length, part, found))
    if len(compared) < 2:
        return None
    lengths, problems, fits = zip(*compared, strict=True)

    # Losses of each fit over the segments of each fit.
    blocks, budget = blocks_of(parts), search.budget
    losses = [
        [
            joined_losses(
                [
                    losses_of(each, theta, part, blocks, system.noise.sigma, budget)
                    for part, theta in zip(parts, fit[1:], strict=True)
                ]
            )
            for each in problems
        ]
        for fit in fits
    ]
    if search.interrupted:
        return None
    chosen = _chosen(losses)
    longest = max(float(recording.t[-1]) for recording in problem.recordings)
    differences = [fit - fits[chosen] for fit in fits]
    study = HorizonStudy(
        lengths=np.array([longest if length is None else length for length in lengths]),
        errors=np.array([[each.error for each in row] for row in losses]),
        chosen=chosen,
        is_whole=lengths[-1] is None,
        parameters=system.parameters.names,
        units=tuple(system.units),
        theta=np.array([fit[0] for fit in fits]),
        half_widths=np.array([_half_width(fit[1:], CONFIDENCE) for fit in fits]),
        # Whether estimates differ by more than the scatter of their differences explains.
        is_apart=np.array(
            [
                (np.abs(each[0]) > _half_width(each[1:], 1.0 - SIGNIFICANCE))
                & (len(parts) >= MIN_PARTS)
                for each in differences
            ]
        ),
    )
    return study, lengths[chosen], fits[chosen][0]


def _estimates_over(
    search: FitSearch,
    whole: FitResult,
    length: float | None,
    problem: FitProblem,
    parts: Sequence[LeftOutPart],
) -> Array | None:
    """(K+1, p) estimates over segments of a length: from all data, and without each of K parts.

    None where a simulation diverges.
    """
    name = "whole recordings" if length is None else f"segments of {length:.2g} s"
    begin = search.with_initial_states(problem, problem.begin(whole.theta))
    try:
        weighted, solution = search.solve(
            problem, begin, f"comparison, {name}", is_only_compared=True
        )
    except SimulationDivergedError:
        return None
    estimates = [weighted.theta(solution.unknowns)]
    for part in parts:
        others = fit_without(weighted, search.budget, solution=solution, part=part)
        if others is None:
            return None
        estimates.append(weighted.theta(others))
    return np.array(estimates)


def _parts_to_leave_out(problem: FitProblem) -> tuple[LeftOutPart, ...]:
    """Parts of the data that are left out: groups of many recordings, or stretches of few ones."""
    count = len(problem.recordings)
    if count >= MAX_FOLDS:
        return tuple(left_out_parts(problem))

    parts: list[LeftOutPart] = []
    for i, recording in enumerate(problem.recordings):
        bounds = np.linspace(0.0, float(recording.t[-1]), -(-MAX_FOLDS // count) + 1)
        parts += stretches_of(recording.name, i, bounds[:-1].tolist())
    return tuple(parts)


def _chosen(losses: Sequence[Sequence[HeldOutLosses]]) -> int:
    """Index of the longest segments whose predictions are not clearly worse than the best.

    Args:
        losses: Losses of each fit over each horizon.
    """
    # Losses over all horizons are relative to the smallest mean loss over each horizon.
    least = [
        min(each.error**2 for each in over_horizon if np.isfinite(each.error))
        for over_horizon in zip(*losses, strict=True)
    ]
    scales = np.maximum(least, np.finfo(float).tiny)
    joined = [
        HeldOutLosses(
            losses=np.concatenate([each.losses / s for each, s in zip(row, scales, strict=True)]),
            counts=np.concatenate([each.counts for each in row]),
            parts=np.concatenate([each.parts for each in row]),
            estimates=row[0].estimates,
        )
        for row in losses
    ]
    best = min(joined, key=lambda each: each.error)
    relevant = RELEVANT_SHARE * best.error**2
    return max(
        i
        for i, each in enumerate(joined)
        if not (each.is_clearly_above(best) and each.reduction(best)[0] > relevant)
    )


def _half_width(without: Array, confidence: float) -> Array:
    """(p,) half widths of intervals by the jackknife over K parts; NaN with fewer than two.

    Args:
        without: (K, p) values without each part.
        confidence: Probability that an interval holds the true value.
    """
    if len(without) < 2:
        return np.full(without.shape[1], np.nan)
    return t_quantile(len(without) - 1, confidence) * jackknife_std(without)
