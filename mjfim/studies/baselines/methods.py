"""Baselines that a design is compared with.

Each searches for a control within a budget of time and MuJoCo steps. All of them search under one
set of limits, on one plant, with one cost J. Chirps, multisines and random steps are searched at
random over the few numbers that describe them, and scaled up to the limits. Fourier series and
B-splines are in `parametric`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array
from mjfim.budget import StopToken
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.task import DesignTask
from mjfim.parallel import pool_stop_token
from mjfim.parallel.kept import KeptPerThread
from mjfim.signals import Chirp, Excitation, ExcitationSettings, Multisine, RandomSteps
from mjfim.studies.baselines.evaluator import (
    BaselineSearch,
    ControlEvaluator,
    SearchCallback,
    SearchResult,
    SearchState,
)
from mjfim.studies.baselines.parametric import (
    FOURIER_FREQUENCIES,
    SPLINE_BANDWIDTHS,
    Optimiser,
    fourier_runs,
    optimise_determinant_with_scipy,
    optimise_many,
    optimise_with_mjfim,
    optimise_with_scipy,
    spline_runs,
)

# Largest number of periods of a wave within the horizon.
MAX_CYCLES = 40.0

# Largest deviation of a control without a range, divided by the size of the initial control.
LARGEST_UNBOUNDED_SCALE = 6.0

# Largest deviation of a control with a range, divided by half of the range.
LARGEST_BOUNDED_SCALE = 2.0

# Smallest deviation, divided by the largest feasible one, where weights in the cost may make a
# small control the best.
SMALLEST_WEIGHTED_SCALE = 0.03

# Share of the trials of the random search that are drawn from the whole range, instead of about the
# best trial.
GLOBAL_SHARE = 0.3

# Share of the numbers that a trial about the best one changes, and the smallest number of them.
CHANGED_SHARE = 0.3
MIN_CHANGED = 2.0

# Standard deviation of changes about the best trial at the beginning, and its range.
FIRST_SPREAD = 0.3
SPREAD_RANGE = (0.01, 0.5)

# Factors of that standard deviation after a successful and after an unsuccessful trial.
SPREAD_AFTER_SUCCESS = 1.5
SPREAD_AFTER_FAILURE = 0.93


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """A method that a design is compared with.

    Attributes:
        run: Searches until the budget of an evaluator is exhausted.
        needs_limits: True where the method makes sense under hard limits only.
    """

    run: Callable[[ControlEvaluator], None]
    needs_limits: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class BaselineSlice:
    """Order for a slice of a baseline. It can be pickled.

    Attributes:
        key: Text that is equal for all slices of a baseline, whose task a worker resolves once.
        search: The search.
        before: Where it goes on; None for its begin.
        seconds: Time of the slice [s].
    """

    key: str
    search: BaselineSearch
    before: SearchState | None = None
    seconds: float = np.inf


@dataclass(frozen=True, eq=False, kw_only=True)
class SliceOfBaseline:
    """Result of a slice of a baseline.

    Attributes:
        result: The best control so far.
        state: Where the search goes on; None where it has ended.
    """

    result: SearchResult
    state: SearchState | None


@dataclass(frozen=True, eq=False, kw_only=True)
class _RandomState:
    """State from which a random search goes on.

    Attributes:
        best: (n,) numbers of the best trial; empty before it.
        cost: Its cost.
        spread: Standard deviation of changes about it.
    """

    best: Array
    cost: float
    spread: float


# The latest tasks of a worker, by the key of their slices.
_tasks: KeptPerThread[DesignTask] = KeptPerThread(2)


def run_baseline(
    search: BaselineSearch,
    callback: SearchCallback | None = None,
    stop: StopToken | None = None,
) -> SearchResult:
    """Run a baseline until its budget is exhausted. An executor can call this in a worker process.

    Args:
        search: The order.
        callback: Called during the search with the used share of the budget and the best result so
            far.
        stop: Ends the search early; None for the token of the pool in a worker process.

    Returns:
        The best control.
    """
    return _run(ControlEvaluator(search=search, callback=callback, stop=_stop_of(stop)))


def run_slice(order: BaselineSlice, stop: StopToken | None = None) -> SliceOfBaseline:
    """Run a slice of a baseline. An executor can call this in a worker process.

    Args:
        order: The order.
        stop: Ends the slice early; None for the token of the pool in a worker process.

    Returns:
        The best control so far, and where the search goes on.
    """
    evaluator = ControlEvaluator(
        search=order.search,
        stop=_stop_of(stop),
        stated=_tasks.get(order.key, order.search.resolved),
        before=order.before,
        slice_seconds=order.seconds,
    )
    return SliceOfBaseline(result=_run(evaluator), state=evaluator.state())


def _stop_of(stop: StopToken | None) -> StopToken:
    """The token that ends a search."""
    return pool_stop_token() if stop is None else stop


def _run(evaluator: ControlEvaluator) -> SearchResult:
    """Run the baseline of an evaluator."""
    # The matrices are small, so that several threads of the BLAS would only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        METHODS[evaluator.search.method].run(evaluator)
        return evaluator.result()


def random_search(
    evaluator: ControlEvaluator, kind: Callable[[ExcitationSettings], Excitation]
) -> None:
    """Search at random over the numbers of an excitation, about the best ones or everywhere.

    Args:
        evaluator: Evaluates the trials and ends the search.
        kind: The kind of excitation.
    """
    fitter = ExcitationFitter(evaluator)
    excitation, rng = kind(fitter.settings), evaluator.rng
    state = evaluator.method or _RandomState(best=np.zeros(0), cost=np.inf, spread=FIRST_SPREAD)
    best, best_cost, spread = state.best, state.cost, state.spread

    while True:
        evaluator.method = _RandomState(best=best, cost=best_cost, spread=spread)
        if evaluator.exhausted():
            return

        # The first number is the size, which matters where weights in the cost decide about it.
        numbers = rng.random(1 + excitation.parameter_count)
        is_local = len(best) > 0 and rng.random() > GLOBAL_SHARE
        if is_local:
            share = max(CHANGED_SHARE, MIN_CHANGED / len(numbers))
            changed = rng.random(len(numbers)) < share
            change = spread * changed * rng.normal(size=len(numbers))
            numbers = reflected(best + change)

        # Scale the excitation up to the limits.
        deviation = fitter.deviation(excitation.curve(numbers[1:]))
        scale = evaluator.largest_feasible_scale(deviation, fitter.largest_scale)
        if scale == 0.0:
            continue
        if fitter.has_weights:
            scale *= SMALLEST_WEIGHTED_SCALE ** (1.0 - numbers[0])

        control = evaluator.centre + scale * deviation
        cost = evaluator.evaluate(evaluator.problem.point(control))

        # Widen the local search after a success, narrow it after a failure.
        if is_local:
            factor = SPREAD_AFTER_SUCCESS if cost < best_cost else SPREAD_AFTER_FAILURE
            spread = float(np.clip(spread * factor, *SPREAD_RANGE))
        if cost < best_cost:
            best, best_cost = numbers, cost


def reflected(numbers: Array) -> Array:
    """Bring numbers, (n,), back between 0 and 1 by reflection at these ends."""
    return np.asarray(1.0 - np.abs(1.0 - np.abs(numbers) % 2.0))


class ExcitationFitter:
    """Fits excitations to an experiment.

    They begin and end at rest, stay within the bandwidth, and are in units of the actuators.

    Attributes:
        settings: Frequencies and duration of the excitations.
        has_weights: True where a smaller control may be the better one, because the cost has
            weights or there are no hard limits.
        largest_scale: Largest scale of a deviation that is tried.
    """

    def __init__(self, evaluator: ControlEvaluator) -> None:
        task, constraints = evaluator.task, evaluator.constraints
        experiment = task.experiment
        bandwidth = experiment.limits.bandwidth

        fastest = min(bandwidth or np.inf, 0.25 * experiment.rate, MAX_CYCLES / task.horizon)
        may_jump = (
            constraints.rate is None and bandwidth is None and experiment.boundary.start != "rest"
        )
        self.settings = ExcitationSettings(
            t=task.t,
            horizon=task.horizon,
            nu=len(task.controls),
            min_frequency=min(0.5 / task.horizon, fastest),
            max_frequency=fastest,
            may_jump=may_jump,
        )

        has_weights = bool(task.control_weight.any() or task.tracking.any())
        self.has_weights = has_weights or not evaluator.is_limited

        bounds = constraints.control.bounds
        is_bounded = np.isfinite(bounds.lower).all()
        self.largest_scale = LARGEST_BOUNDED_SCALE if is_bounded else LARGEST_UNBOUNDED_SCALE

        self._size = bounds.scale
        self._window = task.fade(task.samples)
        self._basis = bandwidth_basis(task, task.t)
        self._fit = None if self._basis is None else np.linalg.pinv(self._basis)

    def deviation(self, wave: Array) -> Array:
        """Deviation from the centre that belongs to a wave.

        Args:
            wave: (N, nu) wave of size 1.

        Returns:
            (N, nu) deviation [unit of the actuator]; its size is about half of the range of the
            control.
        """
        windowed = self._window * wave * self._size
        if self._basis is None or self._fit is None:
            return windowed

        # Project the deviation on the curves within the bandwidth.
        return np.asarray(self._basis @ (self._fit @ windowed))


def _optimise_fourier(count: int, optimise: Optimiser) -> Callable[[ControlEvaluator], None]:
    """Method that optimises Fourier series of `count` harmonics."""

    def run(evaluator: ControlEvaluator) -> None:
        """Optimise until the budget is exhausted."""
        runs = fourier_runs(evaluator, count)
        optimise_many(evaluator, runs, len(FOURIER_FREQUENCIES), optimise)

    return run


def _optimise_splines(optimise: Optimiser) -> Callable[[ControlEvaluator], None]:
    """Method that optimises B-splines."""

    def run(evaluator: ControlEvaluator) -> None:
        """Optimise until the budget is exhausted."""
        optimise_many(evaluator, spline_runs(evaluator), len(SPLINE_BANDWIDTHS), optimise)

    return run


# The baselines by their keys; `TITLES` has their names for the user, in the same order.
METHODS = {
    "chirp": Baseline(run=partial(random_search, kind=Chirp)),
    "multisine": Baseline(run=partial(random_search, kind=Multisine)),
    "steps": Baseline(run=partial(random_search, kind=RandomSteps)),
    "fourier5": Baseline(run=_optimise_fourier(5, optimise_with_scipy)),
    "fourier5-D": Baseline(run=_optimise_fourier(5, optimise_determinant_with_scipy)),
    "fourier15": Baseline(run=_optimise_fourier(15, optimise_with_scipy)),
    "splines": Baseline(run=_optimise_splines(optimise_with_scipy)),
    "splines-D": Baseline(run=_optimise_splines(optimise_determinant_with_scipy)),
    "fourier5-mjfim": Baseline(
        run=_optimise_fourier(5, optimise_with_mjfim),
        needs_limits=True,
    ),
    "fourier15-mjfim": Baseline(
        run=_optimise_fourier(15, optimise_with_mjfim),
        needs_limits=True,
    ),
}
