"""The task of an identification, and its searches for the parameters.

A search runs over a subset of the data, from several starts, or over all data. `identify`, the
restarts in `starts` and the studies of models choose among them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Literal

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices, record
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError, listed, unknown
from mjfim.experiment.system import System
from mjfim.experiment.task_tables import FitSpec
from mjfim.identification.assessment.residual_tests import RELEVANT_SIZE_RATIO
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.segment_simulation import SAMPLES_FOR_ONE_SIDED
from mjfim.identification.segments import (
    SIGMA_PER_MEDIAN,
    OtherBegin,
    begins_elsewhere,
    spread_over_data,
)
from mjfim.model.parameters import sample_parameters
from mjfim.optimize.levenberg_marquardt import (
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.parallel.budget import Budget, StopReason
from mjfim.plant.outputs import Noise
from mjfim.records.events import FitEvent, begin_stage
from mjfim.records.trajectory import Recording

# Method of the search. `least_squares` is Levenberg-Marquardt inside the bounds; `newton` is the
# paper's Newton-Raphson iteration without bounds.
Method = Literal["least_squares", "newton"]

# Largest difference of two times that count as the same [mean sample periods]. Copies of a log in
# other formats have rounded times.
CLOCK_TOLERANCE = 0.01


@record
class FitTask:
    """Everything that an identification needs.

    It contains no horizon, no cost and no initial control, which only a design needs.

    Attributes:
        system: Model, parameters, outputs, noise and plant.
        recordings: Recordings to which the parameters are fitted.
        held_out: Recordings that are predicted, not fitted.
        method: Method of the search.
        start: (p,) parameters at which the search starts, inside the bounds if the method has any
            [theta-unit].
        elsewhere: Recordings that do not begin at the stated initial state.
        predicts_whole: Whether held-out recordings are predicted as a whole, although segments are
            fitted.
    """

    system: System
    recordings: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    method: Method
    start: Array
    elsewhere: tuple[OtherBegin, ...] = ()
    predicts_whole: bool = False

    @classmethod
    def of(
        cls,
        system: System,
        recordings: Sequence[Recording],
        *,
        method: Method = "least_squares",
        start: Array | None = None,
        held_out: Sequence[Recording] = (),
    ) -> FitTask:
        """The task of fitting the parameters of a resolved system.

        Args:
            system: Model, parameters, outputs and noise.
            recordings: Recordings to which the parameters are fitted.
            method: Method of the search.
            start: (p,) parameters at which the search starts; default: the guess.
            held_out: Recordings that are predicted, not fitted.

        Returns:
            The task.

        Raises:
            ExperimentError: Something is wrong in the arguments; the message names it.
            RecordingError: Two recordings hold the same data.
        """
        settings = system.experiment.fit
        if settings.noise == "estimated" and system.noise.correlated:
            raise ExperimentError(
                f'{system.experiment.source}: fit.noise = "estimated" assumes uncorrelated '
                "outputs; remove `correlated`"
            )

        _require_holdable(system, settings.hold)
        refuse_same_data(recordings, held_out)
        elsewhere = begins_elsewhere(system, [*recordings, *held_out])
        if elsewhere:
            # The fit can reach another initial state only if all its components are free.
            experiment, components = system.experiment, system.source.coordinates.deviations
            free = {component.name: (-np.inf, np.inf) for component in components}
            initial = experiment.initial.model_copy(update={"free": free})
            experiment = experiment.model_copy(update={"initial": initial})
            system = replace(system, experiment=experiment)
        return cls(
            system=system,
            recordings=tuple(recordings),
            held_out=tuple(held_out),
            method=method,
            start=_start(system, method, start),
            elsewhere=elsewhere,
        )

    @property
    def settings(self) -> FitSpec:
        """The table `[fit]` of the experiment."""
        return self.system.experiment.fit

    @property
    def noise_is_stated(self) -> bool:
        """True for the noise of the experiment; False where it is estimated from the residuals."""
        return self.settings.noise == "stated"

    def problem(self) -> FitProblem:
        """The least-squares problem of the recordings.

        Raises:
            RecordingError: There is no recording, or one cannot be used.
        """
        problem = FitProblem.of(self.system, self.recordings)
        problem = replace(problem, bounded=self.method != "newton")
        seconds = self.settings.seconds
        if seconds is None:
            return problem
        return problem.of_segments(problem.spread(round(seconds / problem.system.dt), 1))


def values_of_start(task: FitTask) -> str:
    """The parameters of the stated start and their values, for a message."""
    names = task.system.parameters.names
    return listed([f"{n} = {v:.6g}" for n, v in zip(names, task.start, strict=True)])


def with_length(
    task: FitTask, length: float | Literal["whole"] | None, seconds: float | None = None
) -> FitTask:
    """The task of fitting segments of a length.

    Args:
        task: The task.
        length: The length [s], or "whole"; None for a length that the fit chooses.
        seconds: Total length of the segments that are fitted [s]; None for the one of the task.
    """
    seconds = seconds or task.settings.seconds
    settings = task.settings.model_copy(update={"segments": length, "seconds": seconds})
    experiment = task.system.experiment.model_copy(update={"fit": settings})
    return replace(task, system=replace(task.system, experiment=experiment))


def refuse_same_data(fitted: Sequence[Recording], held_out: Sequence[Recording]) -> None:
    """Raise RecordingError where a recording occurs twice, whatever its name is."""
    for (i, one), (j, other) in combinations(enumerate([*fitted, *held_out]), 2):
        if not _same_data(one, other):
            continue
        consequence = "it would count twice; give it once"
        if i < len(fitted) <= j:
            consequence = "a fitted recording says nothing about predictions; hold out another one"
        fault = f"{other.name} holds the same data as {one.name}"
        if one.name == other.name:
            fault = f"{one.name} is given twice"
        raise RecordingError(f"{fault}: {consequence}")


def _same_data(one: Recording, other: Recording) -> bool:
    """Whether two recordings have equal values at the same times since their begin."""
    if one.outputs != other.outputs or len(one.t) != len(other.t) or not len(one.t):
        return False
    # Most recordings differ in their first row, which is quick to compare.
    for rows in (slice(0, 1), slice(None)):
        if not np.array_equal(one.y[rows], other.y[rows], equal_nan=True):
            return False
    if not np.array_equal(one.ctrl, other.ctrl, equal_nan=True):
        return False
    difference = (one.t - one.t[0]) - (other.t - other.t[0])
    period = (one.t[-1] - one.t[0]) / len(one.t)
    return bool(np.abs(difference).max() <= CLOCK_TOLERANCE * period)


def _require_holdable(system: System, names: Sequence[str]) -> None:
    """Raise ExperimentError where one of the named parameters cannot be held.

    Parameters with a value for each recording and deviations of the initial state cannot.
    """
    parameters = system.parameters
    source = system.experiment.source
    for name in names:
        if name not in parameters.names:
            raise ExperimentError(
                f"{source}: fit.hold: {unknown('parameter', name, parameters.names)}"
            )
        if parameters.recording_specific[parameters.names.index(name)]:
            raise ExperimentError(
                f"{source}: fit.hold: {name} differs from recording to recording; remove it from "
                "the table of nuisance parameters instead"
            )

    if len(set(names)) == len(parameters):
        raise ExperimentError(f"{source}: fit.hold: all parameters are held; leave one out")


def _start(system: System, method: Method, start: Array | None) -> Array:
    """(p,) parameters at which the search starts; the guess where none are given."""
    parameters = system.parameters
    theta = system.theta_of("start", start)
    if method == "least_squares":
        theta = np.clip(theta, parameters.lower, parameters.upper)
    return theta


# Settings of the paper's Newton-Raphson iteration.
NEWTON = SearchSettings(max_iterations=50, tolerance=1e-5, damped=False)

# Length of a step below which the search over all data has converged [standard deviations]. With
# much data, every linearisation takes long, and the limit is larger.
FINAL_TOLERANCE = 1e-3
FINAL_TOLERANCE_OF_MUCH_DATA = 1e-2

# Number of samples that one linearisation with two-sided differences simulates, from which on there
# is much data.
SAMPLES_OF_MUCH_DATA = SAMPLES_FOR_ONE_SIDED

# Length of a step at which the search over the first data ends [standard deviations]. Closer to the
# minimum, few data are fitted at the expense of the others.
FIRST_TOLERANCE = 0.1

# Decrease of the cost, as a share of it, below which a step is the last one of a search
# (`SearchSettings.rough_share`): over the first data, and where the stated noise is only the first
# guess.
FIRST_ROUGH_SHARE = 1e-2
ROUGH_SHARE = 0.1

# This share for a first search whose cost shows a clear misfit: searches from other starts follow.
MISSED_ROUGH_SHARE = 0.02

# This share where the predictions of a fit are only compared with those of others.
COMPARED_ROUGH_SHARE = 1e-4

# A search from a random start, or for initial states at given parameters.
SHORT_SEARCH = SearchSettings(max_iterations=8, tolerance=1e-2, relinearise_at_end=False)
INITIAL_STATES = replace(SHORT_SEARCH, tolerance=0.1, rough_share=0.01)

# Iterations for the initial states of all segments, after theta was found on a subset of them. The
# first part of each segment is enough for them; this is its share.
INITIAL_STATE_ITERATIONS = 2
INITIAL_STATE_SHARE = 0.2

# Largest number of times that the noise is estimated. Where its standard deviations change by less
# than the first share, the next search ends at the minimum. No search follows a change below the
# second share.
MAX_NOISE_ROUNDS = 10
NEAR_NOISE = 0.02
NOISE_TOLERANCE = 5e-4

# Smallest estimated standard deviation, as a share of the stated one.
MIN_NOISE_SHARE = 1e-3

# Factors by which the differences for derivatives are longer where the residuals are rough, and
# number of iterations with them.
LONGER_DIFFERENCES = (100.0, 1000.0)
ROUGH_ITERATIONS = 15

# Number of samples of a subset of segments that is quick to simulate.
QUICK_SAMPLES = 40_000

# Share of the data on which the search begins, and the least numbers of samples and segments in it.
# With fewer data, the search begins on the segments that are quick to simulate.
FIRST_SHARE = 0.25
MIN_FIRST_SAMPLES = 2_000
MIN_FIRST_SEGMENTS = 3


# ---- subsets of the segments


def quick_subset(problem: FitProblem) -> np.ndarray:
    """Indices of segments that are quick to simulate, evenly spread over the data."""
    count = len(problem.segments)
    wanted = max(QUICK_SAMPLES * count // problem.sample_count, 1)
    return evenly_spread_indices(count, wanted)


def first_subset(problem: FitProblem) -> np.ndarray:
    """Indices of the segments on which the search begins, evenly spread over the data."""
    quick = quick_subset(problem)
    count = len(problem.segments)
    wanted = max(int(FIRST_SHARE * count), MIN_FIRST_SEGMENTS)
    enough = FIRST_SHARE * problem.sample_count >= MIN_FIRST_SAMPLES
    if not enough or 2 * wanted > count:
        return quick
    return spread_over_data(count, min(wanted, len(quick)))


def of_subset(at: UnknownValues, subset: np.ndarray) -> UnknownValues:
    """The unknowns of some segments."""
    return replace(at, private=at.private[subset])


# ---- searches


def _from_start(problem: FitProblem, budget: Budget, *, begin: UnknownValues) -> Solution | None:
    """Search for a while from one start, in a worker; None where the simulation diverges there."""
    return minimise(problem, begin, SHORT_SEARCH, budget)


@dataclass(frozen=True, kw_only=True, eq=False)
class FitSearch:
    """Searches of one identification, which share a budget and report their iterations.

    Attributes:
        task: Task of the identification.
        budget: Budget of all searches; its token ends them.
        callback: Called after each iteration; None for no calls.
        begins_near: Whether searches over all data begin near their minimum.
    """

    task: FitTask
    budget: Budget
    callback: Callable[[FitEvent], None] | None = None
    begins_near: bool = False

    @property
    def interrupted(self) -> bool:
        """True after a request to stop."""
        return self.budget.stop.requested

    def minimise(
        self, problem: FitProblem, begin: UnknownValues, settings: SearchSettings, phase: str
    ) -> Solution | None:
        """Search for a minimum, and report the iterations; None where the start diverges."""

        def report(iteration: int, cost: float, step: float) -> None:
            """Report one iteration as an event."""
            if self.callback is not None:
                self.callback(FitEvent(phase=phase, iteration=iteration, cost=cost, step=step))

        return minimise(problem, begin, settings, self.budget, report)

    def solve(
        self,
        problem: FitProblem,
        begin: UnknownValues,
        phase: str = "all data",
        *,
        is_only_compared: bool = False,
        is_first: bool = False,
        cost_to_beat: float = np.inf,
    ) -> tuple[FitProblem, Solution]:
        """Search over all data.

        Args:
            problem: The problem, with the stated noise.
            begin: Unknowns at the begin.
            phase: Name of the search in events.
            is_only_compared: Whether the fit is only compared with others: few digits are enough.
            is_first: Whether searches from other starts follow where the fit misses the data. With
                much data, it then ends near its minimum, and `converged` continues it.
            cost_to_beat: Cost of another fit with the stated noise. A search that cannot reach a
                lower cost ends early.

        Returns:
            The problem, weighted with the noise of the fit, and the solution.

        Raises:
            SimulationDivergedError: The simulation diverges at the begin.
        """
        settings = self._settings(problem)
        if is_only_compared:
            settings = replace(
                settings,
                tolerance=FIRST_TOLERANCE,
                rough_share=COMPARED_ROUGH_SHARE,
                stagnant_share=COMPARED_ROUGH_SHARE,
            )
        if self.task.noise_is_stated:
            settings = replace(settings, cost_to_beat=cost_to_beat)
            if is_first and self._has_much_data(problem):
                dof = problem.value_count - problem.unknown_count
                least = 0.5 * dof * RELEVANT_SIZE_RATIO**2 / (1.0 - 2.0 * MISSED_ROUGH_SHARE)
                settings = replace(settings, rough_share=MISSED_ROUGH_SHARE, rough_above=least)
            return problem, self._minimise_or_raise(problem, begin, settings, phase)

        # The stated noise is only the first guess, so the first search ends near its minimum. The
        # noise of its residuals weights the next search. Each search ends near its minimum until
        # the noise hardly changes.
        rough = replace(settings, relinearise_at_end=False, rough_share=ROUGH_SHARE)
        solution = self._minimise_or_raise(problem, begin, rough, phase)
        complete, rough = (replace(each, begins_near=True) for each in (settings, rough))
        is_complete = False
        for number in range(MAX_NOISE_ROUNDS):
            if self.interrupted and not solution.interrupted:
                status = f"{StopReason.REQUESTED.value}; the best estimate so far"
                solution = replace(solution, success=False, interrupted=True, status=status)
            if solution.interrupted:
                break
            sigma = self._residual_sigma(problem, solution.unknowns)
            change = np.abs(sigma / problem.noise.sigma - 1.0).max()
            if is_complete and change < NOISE_TOLERANCE:
                break
            is_complete = bool(change < NEAR_NOISE) or number == MAX_NOISE_ROUNDS - 1
            noise = Noise(covariance=np.diag(sigma**2), strides=problem.noise.strides)
            reweighted = problem.with_noise(noise)
            found = self.minimise(
                reweighted,
                solution.unknowns,
                complete if is_complete else rough,
                f"{phase}, noise estimated",
            )
            if found is None:
                status = "stopped: the simulation diverges next to the estimate"
                return problem, replace(solution, success=False, status=status)
            problem, solution = reweighted, _continued(solution, found)
        return problem, solution

    def best_start(self, problem: FitProblem, begin: UnknownValues) -> UnknownValues:
        """Find where the search over all data begins, by searches on a subset of them.

        Args:
            problem: The problem of all data.
            begin: Unknowns at the stated start.

        Raises:
            SimulationDivergedError: The simulation diverges at the stated start.
        """
        subset = first_subset(problem)
        part = problem.of_segments(subset)
        starts = self.task.settings.starts
        is_whole = len(subset) == len(problem.segments)

        # Initial states are estimated first; otherwise theta would compensate for their errors.
        placed = self.with_initial_states(part, of_subset(begin, subset))
        if is_whole and starts == 1:
            return placed

        # The costs of several starts are comparable only if all searches come near their minimum.
        rough_share = 0.0
        if starts == 1:
            rough_share = FIRST_ROUGH_SHARE if self.task.noise_is_stated else ROUGH_SHARE
        settings = self._settings_of_part(part, rough_share)
        found = [self._minimise_or_raise(part, placed, settings, "part of the data")]
        found += self._from_random_starts(part)
        best = min(found, key=lambda solution: solution.cost).unknowns
        if is_whole:
            return best

        # The other segments may diverge at the theta that suits the subset, or contradict it.
        private = np.array(begin.private)
        private[subset] = best.private
        whole = replace(best, private=private)
        if self.interrupted:
            return whole
        candidates = [self._with_quick_initial_states(problem, each) for each in (whole, begin)]
        return min(candidates, key=problem.cost)

    def better_start(
        self, problem: FitProblem, begin: UnknownValues, beaten: UnknownValues
    ) -> UnknownValues | None:
        """Improve another start on a subset of the data, before the search over all of them.

        Args:
            problem: The problem of all data, with the noise of both starts.
            begin: Unknowns at the start.
            beaten: The unknowns whose cost the improved start has to stay below.

        Returns:
            The improved start; None where it costs more on the subset, or diverges there.
        """
        subset = first_subset(problem)
        if len(subset) == len(problem.segments):
            return self.with_initial_states(problem, begin)
        part = problem.of_segments(subset)
        placed = self.with_initial_states(part, of_subset(begin, subset))
        cost_to_beat = part.cost(of_subset(beaten, subset))
        settings = self._settings_of_part(part, FIRST_ROUGH_SHARE)
        settings = replace(settings, cost_to_beat=cost_to_beat)
        found = self.minimise(part, placed, settings, "again part of the data")
        if found is None or found.cost >= cost_to_beat:
            return None
        at = found.unknowns
        begin = replace(begin, theta=at.theta, per_recording=at.per_recording)
        return self._with_quick_initial_states(problem, begin)

    def _with_quick_initial_states(
        self, problem: FitProblem, begin: UnknownValues
    ) -> UnknownValues:
        """Unknowns with initial states improved on the first part of each segment alone."""
        return self.with_initial_states(
            problem.of_first_parts(INITIAL_STATE_SHARE), begin, INITIAL_STATE_ITERATIONS
        )

    def with_initial_states(
        self,
        problem: FitProblem,
        begin: UnknownValues,
        iterations: int = INITIAL_STATES.max_iterations,
    ) -> UnknownValues:
        """Unknowns with measured initial states improved for the given theta."""
        if not problem.free_starts or self.interrupted:
            return begin
        settings = replace(INITIAL_STATES, max_iterations=iterations)
        found = self.minimise(problem.with_shared_held(), begin, settings, "initial states")
        return begin if found is None else found.unknowns

    def converged(self, problem: FitProblem, solution: Solution) -> tuple[FitProblem, Solution]:
        """Continue a search that ended near its minimum, or because no step lowered the cost.

        Contacts and dry friction make residuals rough. Longer differences average over that.

        Returns:
            The problem of the last search and its solution; the given ones where the search had
            converged, or where longer differences lead nowhere.
        """
        if solution.rough and not self.interrupted:
            settings = replace(self._settings(problem), begins_near=True)
            found = self.minimise(problem, solution.unknowns, settings, "all data")
            solution = solution if found is None else _continued(solution, found)
        for factor in LONGER_DIFFERENCES:
            if not solution.stuck or self.task.method == "newton" or self.interrupted:
                break
            longer = problem.with_longer_differences(factor)
            settings = replace(self._settings(longer), max_iterations=ROUGH_ITERATIONS)
            found = self.minimise(
                longer, solution.unknowns, settings, "all data, longer differences"
            )
            if found is None:
                break
            found = _continued(solution, found)
            if found.success:
                return longer, found

            # The lower cost counts, but not its linearisation by longer differences.
            is_lower = found.cost < solution.cost
            condensed = problem.condense(found.unknowns) if is_lower else None
            if condensed is not None:
                solution = replace(found, condensed=condensed)
        return problem, solution

    def _minimise_or_raise(
        self, problem: FitProblem, begin: UnknownValues, settings: SearchSettings, phase: str
    ) -> Solution:
        """Search for a minimum; SimulationDivergedError where the start diverges."""
        found = self.minimise(problem, begin, settings, phase)
        if found is None:
            raise SimulationDivergedError(
                f"the simulation diverges next to the start of the fit ({phase})"
            )
        return found

    def _settings(self, problem: FitProblem) -> SearchSettings:
        """Settings of a search that ends at the minimum."""
        if self.task.method == "newton":
            return NEWTON
        has_much_data = self._has_much_data(problem)
        return SearchSettings(
            max_iterations=self.task.settings.max_iterations,
            tolerance=FINAL_TOLERANCE_OF_MUCH_DATA if has_much_data else FINAL_TOLERANCE,
            relinearise_at_end=not has_much_data,
            curved_rows=problem.curved_rows,
            begins_near=self.begins_near,
            in_true_deviations=True,
            lengthens=self.task.settings.loss != "linear",
        )

    def _has_much_data(self, problem: FitProblem) -> bool:
        """Whether one linearisation of a problem takes long."""
        samples = problem.sample_count * 2 * len(self.task.system.parameters)
        return samples >= SAMPLES_OF_MUCH_DATA or self.task.settings.seconds is not None

    def _settings_of_part(self, part: FitProblem, rough_share: float) -> SearchSettings:
        """Settings of a search over a part of the data, before the search over all of them."""
        return replace(
            self._settings(part),
            tolerance=FIRST_TOLERANCE,
            relinearise_at_end=False,
            rough_share=rough_share,
        )

    def _from_random_starts(self, problem: FitProblem) -> list[Solution]:
        """Solutions of short searches from random parameters, without those that diverge."""
        settings, system = self.task.settings, self.task.system
        if settings.starts == 1 or self.interrupted:
            return []
        # The first sample is the stated start, which was searched before.
        samples = sample_parameters(
            system.parameters,
            self.task.start,
            settings.starts,
            settings.seed,
            system.impossible,
            "fit.starts",
        )
        works = [partial(_from_start, begin=problem.begin(theta)) for theta in samples[1:]]
        searched = []
        for number, solution in enumerate(problem.of_whole(works, self.budget), start=1):
            begin_stage("searching from random starts", number, len(works))
            if solution is not None:
                searched.append(solution)
        return searched

    def _residual_sigma(self, problem: FitProblem, at: UnknownValues) -> Array:
        """(ny,) standard deviations of the residuals [y-unit]; a robust loss ignores outliers.

        The problem's noise stays where the simulation diverges or an output has no values.
        """
        sigma = np.array(problem.noise.sigma)
        smallest = MIN_NOISE_SHARE * self.task.system.noise.sigma
        # The fit makes residuals smaller than the noise.
        count = problem.value_count
        correction = np.sqrt(count / max(count - problem.unknown_count, 1))
        for j, errors in enumerate(problem.errors_at(at) or ()):
            if len(errors):
                spread = correction * np.sqrt(np.mean(errors**2))
                if self.task.settings.loss != "linear":
                    spread = SIGMA_PER_MEDIAN * np.median(np.abs(errors))
                sigma[j] = max(float(spread), smallest[j])
        return sigma


def _continued(first: Solution, found: Solution) -> Solution:
    """The second of two searches, with the iterations of the first one, at whose end it began."""
    return replace(found, iterations=first.iterations + found.iterations)
