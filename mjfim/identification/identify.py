"""Least-squares identification of parameters from recordings.

It minimises `sum_k |Sigma^-1/2 (y~_k - y_k(theta))|^2` over theta; the Jacobian is the sensitivity
G = dy/dtheta. The default method is Levenberg-Marquardt inside the bounds. The method `newton` is
the paper's Newton-Raphson iteration, with the Fisher information as Hessian (Gauss-Newton).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import SimulationDivergedError, explain_renamed_arguments, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.extreme_values import describe_extreme_value
from mjfim.identification.report import FitResult, estimate_from
from mjfim.identification.residuals import FitProblem
from mjfim.identification.segment_simulation import SAMPLES_FOR_ONE_SIDED
from mjfim.identification.task import FitTask, Method
from mjfim.information.null_space import NullSpace, find_null_space
from mjfim.model.parameter_samples import sample_parameters
from mjfim.optimize.levenberg_marquardt import (
    IterationReport,
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.parallel import one_blas_thread
from mjfim.plant.divergence import NO_WARNING, explain_divergence, find_divergence
from mjfim.plant.noise import Noise
from mjfim.records.estimate import Estimate
from mjfim.records.events import FitEvent
from mjfim.records.progress import shown_progress
from mjfim.records.recording import Recording

# Settings of the paper's Newton-Raphson iteration.
NEWTON = SearchSettings(max_iterations=50, tolerance=1e-5, damped=False)

# Length of a step [standard deviations] below which the search over all data has converged.
FINAL_TOLERANCE = 1e-3

# Length of a step [standard deviations] below which the search over a large amount of data has
# converged. It is looser, because every linearisation takes long.
FINAL_TOLERANCE_OF_MUCH_DATA = 1e-2

# Number of samples that one linearisation simulates, with two-sided differences, above which the
# amount of data is large.
SAMPLES_OF_MUCH_DATA = 10 * SAMPLES_FOR_ONE_SIDED

# Number of samples of the subset of segments on which the search begins, if there are more data.
SUBSET_SAMPLES = 40_000

# Iterations of a short search: from a random start, or for the initial states of a subset.
SHORT_SEARCH_ITERATIONS = 8

# Length of a step [standard deviations] at which a search from a random start ends.
SHORT_SEARCH_TOLERANCE = 1e-2

# Iterations of the initial states of all segments, after theta was found on a subset of them.
INITIAL_STATE_ITERATIONS = 2

# Length of a step [standard deviations] at which initial states count as found.
INITIAL_STATE_TOLERANCE = 0.1

# Largest number of times that the noise is estimated and the parameters are fitted again.
MAX_NOISE_ROUNDS = 10

# Relative change of an estimated standard deviation below which it has converged.
NOISE_TOLERANCE = 0.01

# Smallest estimated standard deviation, as a share of the stated one.
MIN_NOISE_SHARE = 1e-3

# Standard deviation of normal noise over its median absolute value.
SIGMA_PER_MEDIAN = 1.4826

Callback = Callable[[FitEvent], None]


@explain_renamed_arguments
def identify(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: Sequence[Recording] = (),
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Estimate:
    """Estimate parameters from recordings, with the settings of the table `[fit]`.

    The stated `std` is formal: it is the accuracy only if the model and the noise are right.
    `misfit` is true when they are not, and `interval` remains valid where residuals are
    autocorrelated. Ctrl-C ends the search with the best result so far.

    Args:
        experiment: Model, parameters and noise; nothing else needs to be stated.
        recordings: Recordings to which the parameters are fitted.
        method: `least_squares` (inside the bounds) or `newton` (the paper's method, without
            bounds).
        start: (p,) parameters at which the search starts; default: the guess.
        held_out: Recordings that are predicted, not fitted.
        callback: Called with every iterate.
        threads: Threads for the engine; default: one per core.
        stop: Token that ends the search with the best result so far.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        ExperimentError: Something is wrong in the experiment or in the arguments.
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    with shown_progress("identifying", callback, progress) as show:
        task = FitTask.resolve(
            experiment, recordings, method=method, start=start, held_out=held_out, threads=threads
        )
        return identify_task(task, callback=show, stop=stop)


def identify_system(
    system: System,
    recordings: Sequence[Recording],
    *,
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: Sequence[Recording] = (),
    callback: Callback | None = None,
    stop: StopToken | None = None,
) -> Estimate:
    """Estimate the parameters of a resolved system.

    Args:
        system: Model, parameters, outputs and noise.
        recordings: Recordings to which the parameters are fitted.
        method: Method of the search.
        start: (p,) parameters at which the search starts; default: the guess.
        held_out: Recordings that are predicted, not fitted.
        callback: Called with every iterate.
        stop: Token that ends the search with the best result so far.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        ExperimentError: Something is wrong in the arguments.
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    task = FitTask.of(system, recordings, method=method, start=start, held_out=held_out)
    return identify_task(task, callback=callback, stop=stop)


def identify_task(
    task: FitTask, *, callback: Callback | None = None, stop: StopToken | None = None
) -> Estimate:
    """Estimate the parameters of a task. See `identify`.

    Args:
        task: System, recordings and settings.
        callback: Called with every iterate.
        stop: Token that ends the search with the best result so far.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    begun = time.perf_counter()
    steps_before = task.system.plant.engine_steps

    with one_blas_thread(), stop_on_interrupt(stop) as token:
        problem = task.problem()
        held_out = task.held_out_problem()
        search = _Search(task=task, budget=Budget(stop=token), callback=callback)

        # With much data, the search begins on a subset of the segments.
        subset = _quick_subset(problem)
        begin = problem.begin(task.start)
        _require_finite_cost(task, problem, subset, begin)

        # Combinations of parameters that no recording determines are held at their start values.
        null_space = _unseen_directions(task, problem.of_segments(subset))
        problem = problem.pinned(task.start, null_space)

        # Short searches from several starts avoid local minima. The best result continues over
        # all data.
        begin = search.best_start(problem, subset, begin)
        problem, solution = search.solve(problem, begin)

        result = FitResult(
            task=task,
            problem=problem,
            solution=solution,
            null_space=null_space,
            held_out=held_out,
            subset=subset,
        )
        estimate = estimate_from(result, search.budget)

    return replace(
        estimate,
        seconds=time.perf_counter() - begun,
        steps=task.system.plant.engine_steps - steps_before,
    )


def least_squares(
    problem: FitProblem,
    start: Array,
    settings: SearchSettings | None = None,
    budget: Budget | None = None,
) -> Solution:
    """Minimise the cost of a problem by Levenberg-Marquardt inside the bounds.

    Args:
        problem: Residuals as functions of the unknowns.
        start: (p,) parameters at which the search starts.
        settings: Tolerance and number of iterations.
        budget: Time and stop token; default: no limit.

    Returns:
        The solution.

    Raises:
        SimulationDivergedError: The simulation diverges at the start.
    """
    settings = SearchSettings() if settings is None else settings
    found = minimise(problem, problem.begin(start), settings, budget)
    if found is None:
        raise SimulationDivergedError("the simulation diverges at the start of the fit")
    return found


def newton_raphson(problem: FitProblem, start: Array, budget: Budget | None = None) -> Solution:
    """The paper's iteration `theta - (J'J)^-1 J'r` without bounds.

    A step is halved while it would raise the cost. The iteration ends when a step is below 1e-5
    standard deviations.

    Args:
        problem: Residuals as functions of the unknowns.
        start: (p,) parameters at which the search starts.
        budget: Time and stop token; default: no limit.

    Returns:
        The solution.

    Raises:
        SimulationDivergedError: The simulation diverges at the start.
    """
    return least_squares(problem.unbounded(), start, NEWTON, budget)


def _quick_subset(problem: FitProblem) -> np.ndarray:
    """Indices of segments that are quick to simulate, evenly spread over the data.

    With little data, these are all segments.
    """
    count = len(problem.segments)
    if problem.sample_count <= SUBSET_SAMPLES or count == 1:
        return evenly_spread_indices(count, count)

    wanted = max(int(SUBSET_SAMPLES * count / problem.sample_count), 1)
    return evenly_spread_indices(count, wanted)


def _of_subset(at: UnknownValues, subset: np.ndarray) -> UnknownValues:
    """The unknowns of some segments."""
    return replace(at, private=at.private[subset])


def _require_finite_cost(
    task: FitTask, problem: FitProblem, subset: np.ndarray, begin: UnknownValues
) -> None:
    """Raise SimulationDivergedError where the model diverges at the start of the search."""
    # The square of an extreme measured value is infinite, which the message below explains.
    with np.errstate(over="ignore"):
        cost = problem.of_segments(subset).cost(_of_subset(begin, subset))
    if not np.isfinite(cost):
        names = task.system.parameters.names
        values = listed([f"{n} = {v:.6g}" for n, v in zip(names, task.start, strict=True)])
        extreme = describe_extreme_value(task.recordings, task.system.channels.control_columns)
        why = _why_diverged(problem, task.start)
        cause = f"; {extreme}; is it a fault of the log?" if extreme else f": {why}"
        raise SimulationDivergedError(f"the simulation diverges at the start ({values}){cause}")


def _why_diverged(problem: FitProblem, theta: Array) -> str:
    """Why the simulation of a segment from its start diverges, as a clause for a message.

    Args:
        problem: Problem with the segments.
        theta: (p,) parameters [theta-unit].
    """
    plant = problem.system.plant
    model = plant.model(theta)
    substeps = plant.simulator.substeps

    for segment in problem.segments:
        end = segment.begin + segment.samples
        ctrl = problem.recordings[segment.recording].ctrl[segment.begin : end]
        if find_divergence(model, segment.start, ctrl, substeps) is not None:
            return explain_divergence(model, segment.start, ctrl, substeps)
    return NO_WARNING


def _unseen_directions(task: FitTask, problem: FitProblem) -> NullSpace:
    """Directions of theta, at the start, about which the data contain no information.

    The data are the recordings and the priors.
    """
    parameters = task.system.parameters
    rows = problem.sensitivity_rows(problem.begin(task.start))
    J = np.concatenate([row for row, _ in rows])
    change = np.concatenate([error for _, error in rows])

    # Priors are further rows, which have no error of finite differences.
    prior = np.sqrt(np.diag(np.diag(parameters.prior_information)))
    exact = np.zeros_like(prior)
    return find_null_space(
        np.concatenate([J, prior]),
        np.concatenate([change, exact]),
        parameters.magnitude,
        parameters.scale,
        np.arange(len(parameters)),
        exact,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """Searches of one identification, which share a budget and report their iterations.

    Attributes:
        task: System, recordings and settings.
        budget: Budget whose token ends all searches.
        callback: Called with every iterate, or None.
    """

    task: FitTask
    budget: Budget
    callback: Callback | None

    def interrupted(self) -> bool:
        """True after a request to stop."""
        return self.budget.stop.requested

    def best_start(
        self, problem: FitProblem, subset: np.ndarray, begin: UnknownValues
    ) -> UnknownValues:
        """Find where the search over all data begins.

        This is the best result of short searches on a subset of the segments.

        Args:
            problem: Problem of all segments.
            subset: Indices of the segments of the subset.
            begin: Unknowns at the stated start.

        Returns:
            Unknowns of all segments.
        """
        starts = self.task.settings.starts
        part = problem.of_segments(subset)
        is_whole = len(part.segments) == len(problem.segments)

        # Initial states are estimated first; otherwise theta would compensate for their errors.
        placed = self._with_initial_states(part, _of_subset(begin, subset), SHORT_SEARCH_ITERATIONS)
        if is_whole and starts == 1:
            return placed

        settings = replace(self._final_settings(problem), relinearise_at_end=False)
        found = [self._minimise(part, placed, settings, "part of the data")]
        found += self._from_random_starts(part, starts)
        best = min(found, key=lambda solution: solution.cost).unknowns
        if is_whole:
            return best

        # The initial states of the other segments are the measured ones, improved for the theta
        # that was found.
        private = np.array(begin.private)
        private[subset] = best.private
        whole = replace(best, private=private)
        return self._with_initial_states(problem, whole, INITIAL_STATE_ITERATIONS)

    def solve(self, problem: FitProblem, begin: UnknownValues) -> tuple[FitProblem, Solution]:
        """Search over all data.

        Where the noise is estimated, the search is repeated until the noise agrees with the
        residuals.

        Args:
            problem: Problem of all segments.
            begin: Unknowns at which the search begins.

        Returns:
            The problem with the noise that was used, and its solution.
        """
        settings = self._final_settings(problem)
        solution = self._minimise(problem, begin, settings, "all data")
        if self.task.noise_is_stated:
            return problem, solution

        for _ in range(MAX_NOISE_ROUNDS):
            if solution.interrupted:
                break

            # The noise that is estimated from the residuals weights them in the next search.
            sigma = self._residual_sigma(problem, solution.unknowns)
            change = float(np.abs(sigma / problem.noise.sigma - 1.0).max())
            noise = Noise(covariance=np.diag(sigma**2), strides=problem.noise.strides)
            problem = problem.with_noise(noise)
            solution = self._minimise(
                problem, solution.unknowns, settings, "all data, noise estimated"
            )
            if change < NOISE_TOLERANCE:
                break
        return problem, solution

    def _final_settings(self, problem: FitProblem) -> SearchSettings:
        """Settings of the search over all data."""
        if self.task.method == "newton":
            return NEWTON

        settings = SearchSettings(
            max_iterations=self.task.settings.max_iterations, tolerance=FINAL_TOLERANCE
        )
        samples = problem.sample_count * 2 * len(self.task.system.parameters)
        if samples < SAMPLES_OF_MUCH_DATA:
            return settings
        return replace(settings, tolerance=FINAL_TOLERANCE_OF_MUCH_DATA, relinearise_at_end=False)

    def _with_initial_states(
        self, problem: FitProblem, begin: UnknownValues, iterations: int
    ) -> UnknownValues:
        """Unknowns with measured initial states improved for the given theta.

        They are unchanged where initial states are stated.
        """
        if not problem.layout.free_starts or self.interrupted():
            return begin

        settings = SearchSettings(
            max_iterations=iterations,
            tolerance=INITIAL_STATE_TOLERANCE,
            relinearise_at_end=False,
        )
        held = problem.with_shared_held()
        found = minimise(held, begin, settings, self.budget, self._reporter("initial states"))
        return begin if found is None else found.unknowns

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
        found = []
        for number, theta in enumerate(samples[1:], start=2):
            phase = f"start {number} of {starts}"
            begin = problem.begin(theta)
            solution = minimise(problem, begin, settings, self.budget, self._reporter(phase))
            if solution is not None:
                found.append(solution)
            if self.interrupted():
                break
        return found

    def _minimise(
        self, problem: FitProblem, begin: UnknownValues, settings: SearchSettings, phase: str
    ) -> Solution:
        """Solution of a search. Raises SimulationDivergedError where its start diverges."""
        found = minimise(problem, begin, settings, self.budget, self._reporter(phase))
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

    def _residual_sigma(self, problem: FitProblem, at: UnknownValues) -> Array:
        """(ny,) standard deviations of the residuals [y-unit].

        With a robust loss, outliers do not count.
        """
        sigma = np.array(problem.noise.sigma)
        predicted = problem.predict(at)
        if predicted is None:
            return sigma

        # Fitted parameters make residuals smaller than the noise.
        is_robust = self.task.settings.loss != "linear"
        count = problem.value_count
        correction = count / max(count - problem.unknown_count, 1)
        smallest = MIN_NOISE_SHARE * self.task.system.noise.sigma

        for j, errors in enumerate(problem.errors(predicted)):
            if not len(errors):
                continue

            # The median is used with a robust loss, because outliers hardly change it.
            spread = float(np.sqrt(np.mean(errors**2) * correction))
            if is_robust:
                spread = SIGMA_PER_MEDIAN * float(np.median(np.abs(errors)))
            sigma[j] = max(spread, smallest[j])
        return sigma
