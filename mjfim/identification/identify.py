"""Least-squares identification of parameters from recordings.

It minimises `sum_k |Sigma^-1/2 (y~_k - y_k(theta))|^2` over theta; the Jacobian is the sensitivity
G = dy/dtheta. The default method is Levenberg-Marquardt inside the bounds. The method `newton` is
the paper's Newton-Raphson iteration, with the Fisher information as Hessian (Gauss-Newton).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import SimulationDivergedError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.cad_prior import CadPrior
from mjfim.identification.continuation import (
    WholeFit,
    continued_fit,
    is_doubtful,
    may_be_repeated,
)
from mjfim.identification.fit_problem import FitProblem, have_same_initial_states
from mjfim.identification.fit_quality import fit_quality
from mjfim.identification.fit_start import begin_fit
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.horizons import HorizonChoice, choose_horizon, with_length
from mjfim.identification.next_step import spread_over_data
from mjfim.identification.report import FitResult, estimate_from
from mjfim.identification.searches import NEWTON, FitSearch
from mjfim.identification.sensitivity_rows import sensitivity_rows
from mjfim.identification.subsets import first_subset, of_subset, quick_subset
from mjfim.identification.task import FitTask, Method
from mjfim.information.null_space import (
    CLEAR_SINGULAR_VALUE,
    NullSpace,
    find_null_space,
    has_weak_column,
)
from mjfim.optimize.levenberg_marquardt import (
    InterruptedPassError,
    SearchSettings,
    Solution,
    UnknownValues,
    completed,
    minimise,
)
from mjfim.parallel import ExecutorLike, one_blas_thread
from mjfim.records.estimate import Estimate
from mjfim.records.events import FitEvent, begin_stage, shown_progress
from mjfim.records.trajectory import Recording

# Shares of the segments, or of each one of few, on which combinations without effect are searched
# for in turn with one-sided differences. Only where all data leave a doubt, differences of two
# lengths show how large the error is.
SHARES_THAT_DETERMINE = (0.2, 0.5, 1.0)

# A smaller share that is tried first where it has enough segments.
SMALL_SHARE = 0.05
SEGMENTS_OF_SMALL_SHARE = 3

# Reasons for an estimate over whole recordings, although segments predict left-out data better.
DIVERGED = "the fit over this length diverged"
STOPPED = "the search was stopped before the fit over this length was complete"

Callback = Callable[[FitEvent], None]


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
    executor: ExecutorLike | None = None,
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
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            simulates parts of much data, searches from several starts, and predicts parts of the
            data from the others side by side.

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
        return identify_task(task, callback=show, stop=stop, executor=executor)


def identify_system(
    system: System,
    recordings: Sequence[Recording],
    *,
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: Sequence[Recording] = (),
    callback: Callback | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
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
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        ExperimentError: Something is wrong in the arguments.
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    task = FitTask.of(system, recordings, method=method, start=start, held_out=held_out)
    return identify_task(task, callback=callback, stop=stop, executor=executor)


def identify_task(
    task: FitTask,
    *,
    callback: Callback | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Estimate:
    """Estimate the parameters of a task. See `identify`.

    Args:
        task: System, recordings and settings.
        callback: Called with every iterate.
        stop: Token that ends the search with the best result so far.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    begun = time.perf_counter()
    steps_before = task.system.plant.engine_steps

    with one_blas_thread(), stop_on_interrupt(stop) as token:
        workers = None if executor is None else FitWorkers(executor, token)
        search = FitSearch(task=task, budget=Budget(stop=token), callback=callback)
        estimate = estimate_from(fit_task(search, workers), search.budget)

    return replace(
        estimate,
        seconds=time.perf_counter() - begun,
        steps=task.system.plant.engine_steps - steps_before,
    )


def fit_task(search: FitSearch, workers: FitWorkers | None = None) -> FitResult:
    """Search for the parameters of a task from its start.

    Args:
        search: The task, and the budget of its searches.
        workers: Workers that simulate parts of the data; None for this process.

    Returns:
        The fit, whose accuracy is not yet assessed.

    Raises:
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    stated = search.task
    problem, held_out = _problems(stated, workers)

    # A fit to the equation of motion gives the start where that is asked for, or where the model
    # diverges at the stated one.
    begun = begin_fit(search, problem)
    search = begun.search
    task = search.task

    # With much data, the search begins on a subset of the segments.
    subset = quick_subset(problem)
    begin = problem.begin(task.start)

    # Combinations of parameters that no recording determines are held at their start values.
    begin_stage("testing what the recordings determine")
    null_space = completed(partial(_unseen_directions, task, problem.of_segments(subset)))
    problem = problem.pinned(task.start, null_space)

    # Short searches from several starts avoid local minima. The best result continues over all
    # data.
    problem, subset, first = _first_fit(search, problem, subset, begin)

    # A result that does not explain the data may be a local minimum. Fits over short segments then
    # give another start, and the better one of the two results is kept.
    fit = continued_fit(search, problem, first, null_space)
    result = FitResult(
        task=stated,
        problem=fit.problem,
        solution=fit.solution,
        quality=fit.quality,
        null_space=null_space,
        held_out=held_out,
        subset=subset,
        restart=fit.restart,
        inverse_dynamics=begun.inverse_dynamics or fit.inverse_dynamics,
        begun_instead=begun.instead,
    )

    # Where the model does not explain whole recordings, the length of the segments matters.
    if not _chooses_length(task) or search.interrupted() or not is_doubtful(task, fit):
        return result
    return _over_chosen_length(search, problem, fit, result, workers)


def _chooses_length(task: FitTask) -> bool:
    """Whether the length of the segments is left to the fit."""
    return task.settings.segments is None and task.method != "newton"


def _over_chosen_length(
    search: FitSearch,
    problem: FitProblem,
    fit: WholeFit,
    result: FitResult,
    workers: FitWorkers | None,
) -> FitResult:
    """The fit over the length of segments that predicts left-out data best.

    Args:
        search: The searches of the identification.
        problem: Problem of the whole recordings, with the stated noise.
        fit: The fit over whole recordings.
        result: Its result.
        workers: Workers that simulate parts of the data; None for this process.
    """
    choice = choose_horizon(search, problem, fit, result.null_space)
    if choice is None:
        return result
    if choice.length is None:
        return replace(result, horizons=choice.study)
    if search.interrupted():
        return _not_over_length(result, choice, STOPPED)

    task = with_length(search.task, choice.length)
    cut, held_out = _problems(task, workers)
    cut = cut.pinned(task.start, result.null_space)
    chosen = replace(search, task=task)
    try:
        begin = chosen.with_initial_states(cut, cut.begin(choice.theta))
        weighted, solution = chosen.solve(cut, begin, f"segments of {choice.length:.2g} s")
        quality = fit_quality(weighted, solution)
    except InterruptedPassError:
        return _not_over_length(result, choice, STOPPED)
    except SimulationDivergedError:
        return _not_over_length(result, choice, DIVERGED)
    return replace(
        result,
        task=replace(task, start=result.task.start),
        problem=weighted,
        solution=solution,
        quality=quality,
        held_out=held_out,
        subset=quick_subset(cut),
        horizons=choice.study,
    )


def _not_over_length(result: FitResult, choice: HorizonChoice, reason: str) -> FitResult:
    """The fit over whole recordings, in place of one over the chosen length.

    Args:
        result: The fit.
        choice: The chosen length.
        reason: Why there is no fit over it, in words.
    """
    return replace(result, horizons=replace(choice.study, why_not_used=reason))


def refit_task(
    search: FitSearch,
    near: FitResult,
    workers: FitWorkers | None = None,
    *,
    is_rough: bool = True,
    other_start: Array | None = None,
) -> FitResult:
    """Search for the parameters of a task near its start, where a similar fit has ended.

    Args:
        search: The task, whose start is near the solution, and the budget of its search.
        near: The similar fit to the same recordings, whose initial states of the segments and
            values of single recordings are used.
        workers: Workers that simulate parts of the data; None for this process.
        is_rough: True for a fit whose predictions alone count (`FitSearch.solve`).
        other_start: (p,) parameters where the search begins instead if the recordings cost less
            there [theta-unit]; None for none.

    Returns:
        The fit, whose accuracy is not yet assessed.

    Raises:
        SimulationDivergedError: The model diverges at the start.
    """
    task = search.task
    problem, held_out = _problems(task, workers)
    subset = quick_subset(problem)
    null_space = completed(partial(_unseen_directions, task, problem.of_segments(subset)))
    problem = problem.pinned(task.start, null_space)

    begin = _begin_near(problem, problem.begin(task.start), near)
    if other_start is not None:
        other = _begin_near(problem, problem.begin(other_start), near)
        begin = min(begin, other, key=problem.cost)
    nearby = replace(search, begins_near=True)
    weighted, solution = nearby.solve(problem, begin, "near a similar fit", is_rough=is_rough)
    if not is_rough:
        weighted, solution = nearby.over_roughness(weighted, solution)
    return FitResult(
        task=task,
        problem=weighted,
        solution=solution,
        quality=fit_quality(weighted, solution),
        null_space=null_space,
        held_out=held_out,
        subset=subset,
        restart=None,
    )


def _begin_near(problem: FitProblem, begin: UnknownValues, near: FitResult) -> UnknownValues:
    """The unknowns at the begin of a search, those besides theta as a similar fit has found them.

    Args:
        problem: The problem.
        begin: Its unknowns at the parameters where the search begins.
        near: The similar fit to the same recordings.
    """
    found, layout = near.solution.unknowns, near.problem.layout

    if have_same_initial_states(problem, near.problem):
        begin = replace(begin, private=found.private)

    # A parameter with a value for each recording keeps these values.
    names, known = problem.system.parameters.names, near.problem.system.parameters.names
    columns = {known[j]: column for column, j in enumerate(layout.per_recording.tolist())}
    per_recording = np.array(begin.per_recording)
    for place, j in enumerate(problem.layout.per_recording.tolist()):
        if names[j] in columns:
            per_recording[:, place] = found.per_recording[:, columns[names[j]]]
    return replace(begin, per_recording=per_recording)


def _problems(task: FitTask, workers: FitWorkers | None) -> tuple[FitProblem, FitProblem | None]:
    """The least-squares problems of the fitted and of the held-out recordings."""
    problem = task.problem()
    held_out = task.held_out_problem()
    if workers is None:
        return problem, held_out
    return problem.on_workers(workers), None if held_out is None else held_out.on_workers(workers)


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


def _first_fit(
    search: FitSearch, problem: FitProblem, subset: np.ndarray, begin: UnknownValues
) -> tuple[FitProblem, np.ndarray, tuple[FitProblem, Solution]]:
    """The fit from the best start.

    After a request to stop before the first pass over all data is complete, it is a fit to the
    segments alone on which the search began. Initial states were improved only there.

    Args:
        search: The searches of the identification.
        problem: Problem of all segments.
        subset: Indices of segments that are quick to simulate.
        begin: Unknowns at the stated start.

    Returns:
        The problem that was solved, its segments that are quick to simulate, and the problem with
        the noise of the fit and its solution.
    """
    count = len(problem.segments)
    searched = first_subset(problem)
    try:
        begin = search.best_start(problem, begin)
        if not search.interrupted() or len(searched) == count:
            is_judged = may_be_repeated(search.task)
            return problem, subset, search.solve(problem, begin, is_judged=is_judged)
    except InterruptedPassError:
        pass

    part = replace(problem.of_segments(searched), workers=None)
    weighted, solution = search.solve(part, of_subset(begin, searched))
    if len(searched) < count:
        status = f"{solution.status}, from {len(searched)} of {count} segments"
        solution = replace(solution, status=status)
    return part, np.arange(len(searched)), (weighted, solution)


def _unseen_directions(task: FitTask, problem: FitProblem) -> NullSpace:
    """Directions of theta, at the start, about which the data contain no information.

    The data are the recordings and the priors. What a part of them determines clearly, all of them
    determine as well, and one difference step is enough to see it, unless an effect is so weak that
    it may be round-off.
    """
    tested = _tested_parameters(task)
    if not tested.any():
        count = len(task.system.parameters)
        nothing = np.zeros((count, 0))
        return NullSpace(directions=nothing, silent=(), basis=np.eye(count), smallest=1.0)

    for part in _parts_that_determine(problem):
        J, change = _stacked_sensitivity(task, part, with_error=False)
        if has_weak_column(J[:, tested], task.system.parameters.magnitude[tested]):
            continue
        quick = _null_space(task, J, change)
        if not quick.count and quick.smallest > CLEAR_SINGULAR_VALUE:
            return quick
    return _null_space(task, *_stacked_sensitivity(task, problem, with_error=True))


def _tested_parameters(task: FitTask) -> np.ndarray:
    """(p,) True for the parameters of which the data may contain no information.

    Those that are held are none, and no direction of inertias with a CAD prior is without it.
    """
    parameters = task.system.parameters
    tested = ~np.isin(parameters.names, task.settings.hold)
    tested[CadPrior.of(parameters).columns] = False
    return tested


def _parts_that_determine(problem: FitProblem) -> Iterator[FitProblem]:
    """Parts of the data that may determine all parameters, small ones first."""
    count = len(problem.segments)
    is_much = SMALL_SHARE * count >= SEGMENTS_OF_SMALL_SHARE
    for share in (*[SMALL_SHARE] * is_much, *SHARES_THAT_DETERMINE):
        wanted = int(share * count)
        if wanted:
            yield problem.of_segments(spread_over_data(count, wanted))
        else:
            yield problem.of_first_parts(share)


def _stacked_sensitivity(
    task: FitTask, problem: FitProblem, *, with_error: bool
) -> tuple[Array, Array]:
    """(n, p) rows of the sensitivity of some segments and of the priors, and their error.

    Args:
        task: The task.
        problem: Problem of the segments.
        with_error: Whether to simulate with a second difference step, which shows round-off.
    """
    begin, tested = problem.begin(task.start), _tested_parameters(task)
    rows = sensitivity_rows(problem, begin, with_error=with_error, wanted=tested)
    J = np.concatenate([row for row, _ in rows])
    change = np.concatenate([error for _, error in rows])

    # Priors are further rows, which have no error of finite differences.
    prior = task.system.parameters.prior_rows
    return np.concatenate([J, prior]), np.concatenate([change, np.zeros_like(prior)])


def _null_space(task: FitTask, J: Array, change: Array) -> NullSpace:
    """Directions of theta without effect on (n, p) rows, whose error is `change`.

    Only tested parameters are in them.
    """
    parameters = task.system.parameters
    free = np.flatnonzero(_tested_parameters(task))
    count = len(free)
    found = find_null_space(
        J[:, free],
        change[:, free],
        parameters.magnitude[free],
        parameters.scale[free],
        np.arange(count),
        np.zeros((count, count)),
    )
    directions = np.zeros((len(parameters), found.count))
    directions[free] = found.directions
    silent = tuple(free[list(found.silent)].tolist())
    return replace(found, directions=directions, silent=silent)
