"""Searches of one identification: over a subset, from several starts, and over all data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopReason
from mjfim.errors import SimulationDivergedError
from mjfim.identification.estimated_noise import EstimatedNoiseProblem
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.next_step import next_step_on_part
from mjfim.identification.segment_simulation import SAMPLES_FOR_ONE_SIDED
from mjfim.identification.subsets import first_subset, of_subset
from mjfim.identification.task import FitTask
from mjfim.model.parameter_samples import sample_parameters
from mjfim.optimize.levenberg_marquardt import (
    InterruptedPassError,
    IterationReport,
    Problem,
    SearchSettings,
    Solution,
    UnknownValues,
    completed,
    minimise,
)
from mjfim.plant.noise import Noise
from mjfim.records.events import FitEvent, begin_stage

# Settings of the paper's Newton-Raphson iteration.
NEWTON = SearchSettings(max_iterations=50, tolerance=1e-5, damped=False)

# Length of a step [standard deviations] below which the search over all data has converged.
FINAL_TOLERANCE = 1e-3

# Length of a step [standard deviations] below which the search over a large amount of data has
# converged. It is looser, because every linearisation takes long.
FINAL_TOLERANCE_OF_MUCH_DATA = 1e-2

# Number of samples that one linearisation simulates, with two-sided differences, above which the
# amount of data is large.
SAMPLES_OF_MUCH_DATA = SAMPLES_FOR_ONE_SIDED

# Length of a step [standard deviations] at which the search over the first data ends. They tell
# less than all data, so that their minimum is not needed to more digits.
FIRST_TOLERANCE = 0.1

# Iterations of a short search: from a random start, or for the initial states of a subset.
SHORT_SEARCH_ITERATIONS = 8

# Length of a step [standard deviations] at which a search from a random start ends.
SHORT_SEARCH_TOLERANCE = 1e-2

# Iterations of the initial states of all segments, after theta was found on a subset of them.
INITIAL_STATE_ITERATIONS = 2

# Share of each segment, at its begin, on which these initial states are improved.
INITIAL_STATE_SHARE = 0.2

# Length of a step [standard deviations] at which initial states count as found.
INITIAL_STATE_TOLERANCE = 0.1

# Decrease of the cost, as a share of it, that a last step of initial states may bring: where theta
# is wrong, they cannot explain the data.
INITIAL_STATE_ROUGH_SHARE = 0.01

# Decrease of the cost, as a share of it, that a last step over the first data may still bring, and
# that share where the stated noise is estimated afterwards.
FIRST_ROUGH_SHARE = 1e-3
ROUGH_SHARE = 0.1

# Decrease of the cost, as a share of it, that a last step may bring where another start is improved
# on a part of the data.
IMPROVED_ROUGH_SHARE = 1e-2

# Decrease of the cost, as a share of it, that a last step may bring in a fit to much data that is
# judged before it goes on: another start may lead to a lower minimum. The first share shows whether
# a fit clearly misses the data, the second one whether it misses them at all.
CLEAR_ROUGH_SHARE = 2e-2
JUDGED_ROUGH_SHARE = 1e-3

# Decrease of the cost, as a share of it, that a last step may bring in a fit that is only compared
# with others by its predictions. They differ by far more.
COMPARED_ROUGH_SHARE = 1e-4

# Largest number of times that the noise of a robust fit is estimated and the parameters are fitted
# again.
MAX_NOISE_ROUNDS = 10

# Relative change of an estimated standard deviation below which it has converged.
NOISE_TOLERANCE = 0.01

# Factors by which the differences of the derivatives are longer where the residuals are rough.
LONGER_DIFFERENCES = (100.0, 1000.0)

# Iterations of a search with longer differences.
ROUGH_ITERATIONS = 15

# Smallest estimated standard deviation, as a share of the stated one.
MIN_NOISE_SHARE = 1e-3

# Standard deviation of normal noise over its median absolute value.
SIGMA_PER_MEDIAN = 1.4826

Callback = Callable[[FitEvent], None]


def _short_search(
    problem: FitProblem, budget: Budget, *, begin: UnknownValues, settings: SearchSettings
) -> Solution | None:
    """Search from one start; None where the simulation diverges there."""
    return minimise(problem, begin, settings, budget)


def _without_neighbourhood(solution: Solution) -> Solution:
    """A solution beside which the simulation diverges, so that no search goes on from there."""
    status = "stopped: the simulation diverges next to the estimate"
    return replace(solution, success=False, status=status)


def _interrupted(solution: Solution) -> Solution:
    """A solution near the minimum, after a request to stop before the search has converged."""
    status = f"{StopReason.REQUESTED.value}; the best estimate so far"
    return replace(solution, success=False, interrupted=True, status=status)


def _after(first: Solution, found: Solution) -> Solution:
    """A solution with the iterates of the search at whose end its own search began before them."""
    return replace(found, iterates=(*first.iterates, *found.iterates[1:]))


@dataclass(frozen=True, kw_only=True, eq=False)
class FitSearch:
    """Searches of one identification, which share a budget and report their iterations.

    Attributes:
        task: System, recordings and settings.
        budget: Budget whose token ends all searches.
        callback: Called with every iterate, or None.
        begins_near: Whether the start of the task is near the minimum, as a fit to the equation of
            motion is.
    """

    task: FitTask
    budget: Budget
    callback: Callback | None
    begins_near: bool = False

    def interrupted(self) -> bool:
        """True after a request to stop."""
        return self.budget.stop.requested

    def best_start(self, problem: FitProblem, begin: UnknownValues) -> UnknownValues:
        """Find where the search over all data begins.

        This is the best result of short searches on a subset of the segments, or the stated start
        where all segments together cost less there.

        Args:
            problem: Problem of all segments.
            begin: Unknowns at the stated start.

        Returns:
            Unknowns of all segments. After a request to stop, initial states are improved only in
            the segments of `first_subset`.

        Raises:
            InterruptedPassError: A request to stop ended the first pass over the subset.
        """
        subset = first_subset(problem)
        starts = self.task.settings.starts
        part = problem.of_segments(subset)
        is_whole = len(part.segments) == len(problem.segments)

        # Initial states are estimated first; otherwise theta would compensate for their errors.
        placed = self.with_initial_states(part, of_subset(begin, subset))
        if is_whole and starts == 1:
            return placed

        settings = self._settings_of_part(problem)
        found = [self._minimise(part, placed, settings, "part of the data")]
        found += self._from_random_starts(part, starts)
        best = min(found, key=lambda solution: solution.cost).unknowns
        if is_whole:
            return best

        # The initial states of the other segments are the measured ones, improved for the theta
        # that was found. The first part of a segment is enough for that.
        private = np.array(begin.private)
        private[subset] = best.private
        whole = replace(best, private=private)
        found_of_all = self.with_begun_states(problem, whole)
        if self.interrupted():
            return whole

        # The other segments may diverge at the theta that suits the subset, or contradict it.
        try:
            is_better = problem.cost(found_of_all) < problem.cost(begin)
        except InterruptedPassError:
            return whole
        if is_better:
            return found_of_all
        return self.with_begun_states(problem, begin)

    def improved_on_part(
        self, problem: FitProblem, begin: UnknownValues, beaten: UnknownValues
    ) -> UnknownValues | None:
        """Improve a start on a part of the data, if it leads to a lower cost there than a solution.

        Args:
            problem: Problem of all segments, with the stated noise.
            begin: Unknowns of all segments at the start.
            beaten: Unknowns of all segments at the solution.

        Returns:
            The start with improved parameters, unchanged where no smaller part is searched; None
            where the part costs more than at the solution, or diverges.

        Raises:
            InterruptedPassError: A request to stop ended the first pass over the part.
        """
        subset = first_subset(problem)
        if len(subset) == len(problem.segments):
            return begin

        part = problem.of_segments(subset)
        placed = self.with_initial_states(part, of_subset(begin, subset))
        cost_to_beat = part.cost(of_subset(beaten, subset))
        settings = replace(
            self._settings_of_part(problem),
            rough_share=IMPROVED_ROUGH_SHARE,
            cost_to_beat=cost_to_beat,
        )
        found = self.minimise(part, placed, settings, "again part of the data")
        if found is None or found.cost >= cost_to_beat:
            return None
        return replace(
            begin, theta=found.unknowns.theta, per_recording=found.unknowns.per_recording
        )

    def _settings_of_part(self, problem: FitProblem) -> SearchSettings:
        """Settings of a search over a part of the data, before the search over all of them."""
        # Costs of several starts can be compared only if all searches come close to their minimum.
        rough_share = 0.0
        if self.task.settings.starts == 1:
            rough_share = FIRST_ROUGH_SHARE if self.task.noise_is_stated else ROUGH_SHARE
        return replace(
            self._final_settings(problem),
            tolerance=FIRST_TOLERANCE,
            relinearise_at_end=False,
            rough_share=rough_share,
            next_step_length=None,
        )

    def solve(
        self,
        problem: FitProblem,
        begin: UnknownValues,
        phase: str = "all data",
        max_iterations: int | None = None,
        *,
        is_rough: bool = False,
        is_judged: bool = False,
        cost_to_beat: float = np.inf,
    ) -> tuple[FitProblem, Solution]:
        """Search over all data.

        Where the noise is estimated, it is searched for together with the parameters; the search
        with the stated noise only leads near.

        Args:
            problem: Problem of all segments.
            begin: Unknowns at which the search begins.
            phase: Name of the search for the user.
            max_iterations: Largest number of iterations, if it is below that of the settings.
            is_rough: True for a fit whose predictions alone count, which hardly change any more
                long before the search converges.
            is_judged: True for a fit that is judged before it converges (`nearer`, `converged`).
                With much data, it ends near the minimum.
            cost_to_beat: Cost with the stated noise above which a minimum is of no use, so that
                the search for it ends early.

        Returns:
            The problem with the noise that was used, and its solution.

        Raises:
            SimulationDivergedError: The simulation diverges at the begin.
        """
        settings = self._final_settings(problem, max_iterations)
        if is_rough:
            settings = replace(
                settings, tolerance=FIRST_TOLERANCE, rough_share=COMPARED_ROUGH_SHARE
            )
        if self.task.noise_is_stated:
            settings = replace(settings, cost_to_beat=cost_to_beat)
            if is_rough:
                settings = replace(settings, stagnant_share=COMPARED_ROUGH_SHARE)
            if is_judged and self._is_much(problem):
                settings = replace(settings, rough_share=CLEAR_ROUGH_SHARE)
            return problem, self._minimise(problem, begin, settings, phase)
        if self.task.settings.loss != "linear":
            return self._solve_in_turn_with_noise(problem, begin, max_iterations, phase)

        # The stated noise is only the first guess: its minimum is left as soon as it is near.
        near = replace(
            settings, relinearise_at_end=False, rough_share=ROUGH_SHARE, next_step_length=None
        )
        first = self._minimise(problem, begin, near, phase)
        if first.interrupted:
            return problem, first

        smallest = MIN_NOISE_SHARE * self.task.system.noise.sigma
        likelihood = EstimatedNoiseProblem(problem, smallest)
        if settings.next_step_length is not None:
            estimate = next_step_on_part(problem, likelihood.lasting_noise)
            settings = replace(settings, next_step_length=estimate)
        try:
            found = self._minimise(
                likelihood, first.unknowns, settings, f"{phase}, noise estimated"
            )
        except InterruptedPassError:
            return problem, _interrupted(first)
        except SimulationDivergedError:
            return problem, _without_neighbourhood(first)

        # The linearisation of the solution is weighted with this noise. After a request to stop, it
        # may be that of the unknowns before the last step.
        weighted = likelihood.linearised
        cost = completed(partial(likelihood.cost_of_squares, weighted.noise, found.unknowns))
        return weighted, replace(_after(first, found), cost=cost)

    def nearer(self, problem: FitProblem, solution: Solution) -> tuple[FitProblem, Solution]:
        """Continue a search that ended near the minimum until its residuals can be tested.

        Args:
            problem: Problem of all segments.
            solution: Where the search ended.

        Returns:
            The problem and its solution, unchanged after a search that ended otherwise.
        """
        return self._continued(problem, solution, JUDGED_ROUGH_SHARE)

    def converged(self, problem: FitProblem, solution: Solution) -> tuple[FitProblem, Solution]:
        """Continue a search that ended near the minimum because it was judged first.

        Args:
            problem: Problem of all segments.
            solution: Where the search ended.

        Returns:
            The problem and its solution, unchanged after a search that ended otherwise.
        """
        return self._continued(problem, solution, 0.0)

    def _continued(
        self, problem: FitProblem, solution: Solution, rough_share: float
    ) -> tuple[FitProblem, Solution]:
        """Continue a search that ended near the minimum, to a `SearchSettings.rough_share`."""
        if not solution.rough:
            return problem, solution
        if self.interrupted():
            return problem, _interrupted(solution)

        settings = self._final_settings(problem)
        settings = replace(settings, begins_near=True, rough_share=rough_share)
        try:
            found = self._minimise(problem, solution.unknowns, settings, "all data")
        except InterruptedPassError:
            return problem, _interrupted(solution)
        except SimulationDivergedError:
            return problem, _without_neighbourhood(solution)
        iterations = solution.iterations + found.iterations
        return problem, replace(_after(solution, found), iterations=iterations)

    def _solve_in_turn_with_noise(
        self, problem: FitProblem, begin: UnknownValues, max_iterations: int | None, phase: str
    ) -> tuple[FitProblem, Solution]:
        """Search, and estimate the noise robustly, in turn until the noise stays the same."""
        settings = self._final_settings(problem, max_iterations)
        solution = self._minimise(problem, begin, settings, phase)
        for _ in range(MAX_NOISE_ROUNDS):
            if solution.interrupted:
                break

            # The noise that is estimated from the residuals weights them in the next search.
            sigma = self._robust_sigma(problem, solution.unknowns)
            change = float(np.abs(sigma / problem.noise.sigma - 1.0).max())
            noise = Noise(covariance=np.diag(sigma**2), strides=problem.noise.strides)
            reweighted = problem.with_noise(noise)
            settings = self._final_settings(reweighted, max_iterations)
            try:
                refined = self._minimise(
                    reweighted, solution.unknowns, settings, f"{phase}, noise estimated"
                )
            except InterruptedPassError:
                return problem, _interrupted(solution)
            except SimulationDivergedError:
                return problem, _without_neighbourhood(solution)
            problem = reweighted
            solution = _after(solution, refined)
            if change < NOISE_TOLERANCE:
                break
        return problem, solution

    def over_roughness(
        self, problem: FitProblem, solution: Solution
    ) -> tuple[FitProblem, Solution]:
        """Continue a search that ended because no step lowered the cost.

        Contacts, dry friction and chaos make residuals rough: derivatives of short differences then
        do not show where the cost falls. Longer differences show the trend.

        Args:
            problem: Problem of all segments.
            solution: Where the search ended.

        Returns:
            The problem and its solution, unchanged after a search that ended otherwise.
        """
        for factor in LONGER_DIFFERENCES:
            if not solution.stuck or self.task.method == "newton" or self.interrupted():
                break
            longer = problem.with_longer_differences(factor)
            settings = self._final_settings(longer, ROUGH_ITERATIONS)
            settings = replace(settings, next_step_length=None)
            phase = "all data, longer differences"
            try:
                found = self.minimise(longer, solution.unknowns, settings, phase)
            except InterruptedPassError:
                break
            if found is None:
                break
            found = _after(solution, found)
            if found.success:
                return longer, found

            # A lower cost counts, but slopes that lead nowhere do not.
            condensed = problem.condense(found.unknowns)
            if condensed is not None and found.cost < solution.cost:
                solution = replace(found, condensed=condensed)
        return problem, solution

    def _final_settings(
        self, problem: FitProblem, max_iterations: int | None = None
    ) -> SearchSettings:
        """Settings of the search over all data, with at most some iterations."""
        if self.task.method == "newton":
            return NEWTON

        iterations = self.task.settings.max_iterations
        if max_iterations is not None:
            iterations = min(iterations, max_iterations)
        settings = SearchSettings(
            max_iterations=iterations,
            tolerance=FINAL_TOLERANCE,
            curved_rows=problem.curved_rows,
            begins_near=self.begins_near,
            in_true_deviations=True,
            lengthens=self.task.settings.loss != "linear",
        )
        if not self._is_much(problem):
            return settings

        # A search over a part of the data has led near the minimum, where there is such a part.
        begins_near = len(first_subset(problem)) < len(problem.segments)
        next_step_length = next_step_on_part(problem) if begins_near else None
        return replace(
            settings,
            tolerance=FINAL_TOLERANCE_OF_MUCH_DATA,
            relinearise_at_end=False,
            next_step_length=next_step_length,
            begins_near=self.begins_near or next_step_length is not None,
        )

    def _is_much(self, problem: FitProblem) -> bool:
        """Whether one linearisation of a problem takes long."""
        samples = problem.sample_count * 2 * len(self.task.system.parameters)
        return samples >= SAMPLES_OF_MUCH_DATA

    def with_initial_states(
        self,
        problem: FitProblem,
        begin: UnknownValues,
        iterations: int = SHORT_SEARCH_ITERATIONS,
    ) -> UnknownValues:
        """Unknowns with measured initial states improved for the given theta.

        They are unchanged where initial states are stated.

        Args:
            problem: The problem.
            begin: The unknowns.
            iterations: Largest number of iterations.

        Returns:
            The improved unknowns.
        """
        if not problem.layout.free_starts or self.interrupted():
            return begin

        settings = SearchSettings(
            max_iterations=iterations,
            tolerance=INITIAL_STATE_TOLERANCE,
            relinearise_at_end=False,
            rough_share=INITIAL_STATE_ROUGH_SHARE,
        )
        held = problem.with_shared_held()
        try:
            found = minimise(held, begin, settings, self.budget, self._reporter("initial states"))
        except InterruptedPassError:
            return begin
        return begin if found is None else found.unknowns

    def with_begun_states(self, problem: FitProblem, begin: UnknownValues) -> UnknownValues:
        """Unknowns with measured initial states improved by the first part of every segment.

        Args:
            problem: The problem.
            begin: The unknowns.
        """
        first_parts = problem.of_first_parts(INITIAL_STATE_SHARE)
        return self.with_initial_states(first_parts, begin, INITIAL_STATE_ITERATIONS)

    def _from_random_starts(self, problem: FitProblem, starts: int) -> list[Solution]:
        """Results of short searches from random parameters; those that diverge are left out."""
        if starts == 1 or self.interrupted():
            return []

        system = self.task.system
        samples = sample_parameters(
            system.parameters,
            self.task.start,
            starts,
            self.task.settings.seed,
            system.impossible,
        )
        settings = SearchSettings(
            max_iterations=SHORT_SEARCH_ITERATIONS,
            tolerance=SHORT_SEARCH_TOLERANCE,
            relinearise_at_end=False,
        )

        # The first sample is the stated start, which was searched before.
        works = [
            partial(_short_search, begin=problem.begin(theta), settings=settings)
            for theta in samples[1:]
        ]
        searched = []
        for number, solution in enumerate(problem.of_whole(works, self.budget), start=2):
            begin_stage("searching from random starts", number, starts)
            searched.append(solution)
        return [solution for solution in searched if solution is not None]

    def minimise(
        self, problem: Problem, begin: UnknownValues, settings: SearchSettings, phase: str
    ) -> Solution | None:
        """Search for a minimum within the budget, and report the iterations.

        Args:
            problem: The problem.
            begin: Unknowns at which the search begins.
            settings: Tolerance and number of iterations.
            phase: Name of the search for the user.

        Returns:
            The solution; None where the simulation diverges at the begin.
        """
        return minimise(problem, begin, settings, self.budget, self._reporter(phase))

    def _minimise(
        self, problem: Problem, begin: UnknownValues, settings: SearchSettings, phase: str
    ) -> Solution:
        """Solution of a search. Raises SimulationDivergedError where its start diverges."""
        found = self.minimise(problem, begin, settings, phase)
        if found is None:
            raise SimulationDivergedError(
                f"the simulation diverges next to the start of the fit ({phase})"
            )
        return found

    def _reporter(self, phase: str) -> Callable[[IterationReport], None] | None:
        """Callback of the optimiser that reports its iterations as events of a phase."""
        callback = self.callback
        if callback is None:
            return None

        def report(iteration: IterationReport) -> None:
            """Report one iteration as an event."""
            callback(
                FitEvent(
                    phase=phase,
                    iteration=iteration.iteration,
                    cost=iteration.cost,
                    step=iteration.step_length,
                )
            )

        return report

    def _robust_sigma(self, problem: FitProblem, at: UnknownValues) -> Array:
        """(ny,) standard deviations of the residuals that are no outliers [y-unit].

        Outliers hardly change the median, from which they are taken.
        """
        sigma = np.array(problem.noise.sigma)
        predicted = problem.predict(at)
        if predicted is None:
            return sigma

        smallest = MIN_NOISE_SHARE * self.task.system.noise.sigma
        for j, errors in enumerate(problem.errors(predicted)):
            if len(errors):
                spread = SIGMA_PER_MEDIAN * float(np.median(np.abs(errors)))
                sigma[j] = max(spread, smallest[j])
        return sigma
