"""Optimised Fourier series and B-splines.

Many of them are optimised roughly, the best ones to the end, with SciPy or with mjfim's optimiser.
SciPy gets all the help that is available: the exact gradient of `log J + mu * barrier`, where mu
decreases in the stages of a barrier schedule, and coefficients that are whitened at every stage
with the Gauss-Newton metric of the barrier.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.bandwidth import boundary_splines
from mjfim.excitation.constrained import ConstrainedSearch, smoothed
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import (
    MAX_RELAXATION,
    RELAXATION_PER_MU,
    TIGHTENING_MU,
    BarrierSchedule,
    InteriorPointMethod,
    updated_tightening,
)
from mjfim.excitation.interior_problem import InteriorPoint, InteriorProblem
from mjfim.excitation.objective import DesignProblem
from mjfim.excitation.run_result import consume
from mjfim.excitation.unconstrained import regulator_for
from mjfim.optimize.lq import Weights
from mjfim.optimize.structured_bfgs import BasisMetric
from mjfim.records.events import DesignEvent
from mjfim.signals import fourier_basis, independent_curves
from mjfim.studies.baselines.evaluator import ControlEvaluator

# Base frequencies of the first Fourier series [Hz].
FOURIER_FREQUENCIES = (0.2, 0.1, 0.4, 0.8, 0.15)

# Bandwidths of the first B-splines [Hz].
SPLINE_BANDWIDTHS = (1.0, 2.0)

# Smallest and largest number of periods of the first harmonic within the horizon, for Fourier
# series with random base frequencies.
RANDOM_PERIODS = (0.4, 5.0)

# Smallest number of harmonics of series with random base frequencies, where the bandwidth allows
# them.
MIN_RANDOM_HARMONICS = 5

# The bandwidths of random B-splines lie between these multiples of the smallest and of the largest
# bandwidth of the first B-splines.
RANDOM_BANDWIDTH_FACTORS = (0.5, 2.0)

# Barrier weight mu down to which all series are optimised.
ROUGH_MU = 0.03

# Share of the remaining budget after which only the better series are continued.
ROUGH_SHARE = 0.3

# Share of the remaining budget after which only the best series is continued.
BETTER_SHARE = 0.45

# One in three series is one of the better ones.
SELECTION_RATE = 3

# Smallest number of evaluations for every series. Where the budget does not allow them, fewer
# series are optimised.
MIN_EVALUATIONS = 12

# Largest number of iterations of mjfim's optimiser. It is never reached, because the budget ends
# the optimisation.
UNLIMITED_ITERATIONS = 100_000

# SciPy's method, and the number of curvature pairs that it keeps.
SCIPY_METHOD = "L-BFGS-B"
SCIPY_OPTIONS = {"maxcor": 30}

# Value that SciPy gets where the simulation diverges.
DIVERGED_VALUE = 1e6

# Weight of the control in the whitening metric, divided by the weight of its barrier.
RIDGE = 0.03

# Multiple of the mean eigenvalue that is added to the metric, so that its Cholesky factor exists.
METRIC_JITTER = 1e-12


@dataclass(eq=False, kw_only=True)
class ParametricRun:
    """A parametric excitation and the state of its optimisation.

    Attributes:
        name: Name for the user.
        basis: (N, M) curves of which the control minus its centre is made.
        control: (N, nu) the best control so far [unit of the actuator].
        cost: J of this control; infinite where it is infeasible.
        mu: Barrier weight with which the optimisation continues; 0 once it is finished.
    """

    name: str
    basis: Array
    control: Array
    cost: float = np.inf
    mu: float = BarrierSchedule().first

    @property
    def finished(self) -> bool:
        """True after the stage with the smallest barrier weight."""
        return self.mu == 0.0

    def finish_schedule(self, last: float) -> None:
        """Remember that all stages down to a barrier weight are done."""
        is_rough = last > BarrierSchedule().last
        self.mu = last if is_rough else 0.0

    def update(self, evaluator: ControlEvaluator, point: InteriorPoint) -> None:
        """Keep the control of a point if it is the best one of this run, or of all."""
        cost = evaluator.evaluate(point, self.name)
        if cost < self.cost:
            self.control, self.cost = point.ctrl, cost


# Optimises a run down to a barrier weight, or until a share of the budget is used. The arguments
# are the evaluator, the run, the last barrier weight and the share.
Optimiser = Callable[[ControlEvaluator, ParametricRun, float, float], None]


def fourier_runs(evaluator: ControlEvaluator, harmonics: int) -> Iterator[ParametricRun]:
    """Finite Fourier series, with usual base frequencies first and random ones after them.

    The parametrisation is that of Swevers et al. (Optimal robot excitation and identification,
    1997).

    Args:
        evaluator: Scales the initial controls to the limits.
        harmonics: Number of harmonics, where the bandwidth allows them.

    Yields:
        Runs without end, until the budget is exhausted.
    """
    task = evaluator.task
    experiment = task.experiment
    fastest = experiment.limits.bandwidth or 0.5 * experiment.rate
    from_rest = experiment.boundary.start == "rest"
    to_rest = experiment.boundary.end == "rest"

    def basis(frequency: float) -> Array:
        """(N, M) harmonics of a base frequency [Hz] within the bandwidth."""
        count = max(min(harmonics, int(fastest / frequency + 1e-9)), 1)
        curves = fourier_basis(task.t, task.horizon, frequency, count, from_rest, to_rest)
        return independent_curves(curves)

    usual = [frequency for frequency in FOURIER_FREQUENCIES if frequency <= fastest]
    highest = fastest / min(harmonics, MIN_RANDOM_HARMONICS)
    ends = [min(periods / task.horizon, highest) for periods in RANDOM_PERIODS]
    return _runs(evaluator, usual, ends, basis)


def spline_runs(evaluator: ControlEvaluator) -> Iterator[ParametricRun]:
    """Uniform cubic B-splines, with usual bandwidths first and random ones after them.

    Args:
        evaluator: Scales the initial controls to the limits.

    Yields:
        Runs without end, until the budget is exhausted.
    """
    task = evaluator.task
    experiment = task.experiment
    fastest = experiment.limits.bandwidth or 0.5 * experiment.rate

    def basis(bandwidth: float) -> Array:
        """(N, M) splines of a bandwidth [Hz]."""
        return independent_curves(boundary_splines(task, task.t, bandwidth))

    usual = [bandwidth for bandwidth in SPLINE_BANDWIDTHS if bandwidth <= fastest]
    lowest, highest = RANDOM_BANDWIDTH_FACTORS
    ends = [
        min(lowest * SPLINE_BANDWIDTHS[0], fastest),
        min(highest * SPLINE_BANDWIDTHS[-1], fastest),
    ]
    return _runs(evaluator, usual, ends, basis)


def _runs(
    evaluator: ControlEvaluator,
    usual: Sequence[float],
    ends: Sequence[float],
    basis_of: Callable[[float], Array],
) -> Iterator[ParametricRun]:
    """Runs at usual frequencies, then runs at random frequencies.

    The former begin at the initial control, the latter at random coefficients.

    Args:
        evaluator: Scales the initial controls to the limits.
        usual: The usual frequencies [Hz].
        ends: Smallest and largest of the random frequencies [Hz].
        basis_of: Gives the (N, M) curves of a frequency.

    Yields:
        Runs without end, until the budget is exhausted.
    """
    part, parts = evaluator.search.part

    # A slice goes on after the runs of those before it.
    begun = 0 if evaluator.method is None else len(evaluator.method.runs)
    for frequency in usual[part::parts][begun:]:
        if evaluator.exhausted():
            return
        basis = basis_of(frequency)
        initial = evaluator.task.control - evaluator.centre
        nearest = basis @ np.linalg.lstsq(basis, initial)[0]
        yield _initial_run(evaluator, f"{frequency:.3g} Hz", basis, nearest)

    size, rng = evaluator.constraints.control.bounds.scale, evaluator.rng
    while True:
        # Log-uniform frequencies between the ends.
        frequency = float(np.exp(rng.uniform(*np.log(ends))))
        basis = basis_of(frequency)
        count = basis.shape[1]
        coefficients = rng.normal(size=(count, len(size)))
        deviation = basis @ coefficients * size / np.sqrt(count)

        if evaluator.exhausted():
            return
        yield _initial_run(evaluator, f"{frequency:.3g} Hz, at random", basis, deviation)


def _initial_run(
    evaluator: ControlEvaluator, name: str, basis: Array, deviation: Array
) -> ParametricRun:
    """A run that begins with a deviation from the centre: (N, nu).

    The deviation is scaled down where it violates the limits.
    """
    scale = evaluator.largest_feasible_scale(deviation)
    control = evaluator.centre + (scale or 1.0) * deviation
    run = ParametricRun(name=name, basis=basis, control=control)
    if scale:
        run.update(evaluator, evaluator.problem.point(control))
    return run


def optimise_many(
    evaluator: ControlEvaluator, runs: Iterator[ParametricRun], count: int, optimise: Optimiser
) -> None:
    """Optimise several runs roughly, the better third longer, and the best one to the end.

    This is repeated with further runs until the budget is exhausted.

    Args:
        evaluator: Evaluates controls and holds the budget.
        runs: The runs, in the order in which they are begun.
        count: Number of runs that are added in each repetition, where the budget allows it.
        optimise: Optimises one run.
    """
    state = evaluator.method or SelectionState()
    evaluator.method = state
    search = _SuccessiveSelection(evaluator=evaluator, optimise=optimise, state=state)
    while not evaluator.budget.exhausted:
        if state.phase is Phase.ROUGH and not search.optimise_new_runs(runs, count):
            return
        if state.phase is Phase.BETTER and not search.optimise_better_runs():
            return
        if not search.finish_best_run():
            return


class Phase(Enum):
    """Phase of a selection; the value is what is done in it."""

    ROUGH = "new runs are optimised roughly"
    BETTER = "the better runs are continued"
    FINISH = "the best run is optimised to the end"


@dataclass(eq=False, kw_only=True)
class SelectionState:
    """State from which a selection of runs goes on. It can be pickled.

    Attributes:
        runs: All runs so far.
        phase: What is done.
        first: Number of runs at the begin of the first phase.
        index: Number of runs that are done in this phase.
        ends: Shares of the budget at which the phases before the last one end; empty before the
            first phase of a repetition has begun.
        better: Runs that are continued.
    """

    runs: list[ParametricRun] = field(default_factory=list)
    phase: Phase = Phase.ROUGH
    first: int = 0
    index: int = 0
    ends: tuple[float, ...] = ()
    better: list[ParametricRun] = field(default_factory=list)

    def enter(self, phase: Phase) -> None:
        """Begin another phase."""
        self.phase, self.index = phase, 0


@dataclass(eq=False, kw_only=True)
class _SuccessiveSelection:
    """Runs of an optimisation that continues with the better ones. See `optimise_many`.

    Every method returns whether the search may continue: False where the budget is exhausted, or a
    slice of the search is over. A run that a slice has left is continued by the next one.

    Attributes:
        evaluator: Evaluates controls and holds the budget.
        optimise: Optimises one run.
        state: Where the selection goes on.
    """

    evaluator: ControlEvaluator
    optimise: Optimiser
    state: SelectionState

    def optimise_new_runs(self, runs: Iterator[ParametricRun], count: int) -> bool:
        """Add runs and optimise each roughly, until a share of the budget is used."""
        state = self.state
        if not state.ends:
            used = self.evaluator.used
            state.ends = tuple(used + share * (1.0 - used) for share in (ROUGH_SHARE, BETTER_SHARE))
            state.first = len(state.runs)

        end = state.ends[0]
        while state.index < count:
            # The run that the slice before has left is in the list already.
            place = state.first + state.index
            if place == len(state.runs):
                run = next(runs, None)
                if run is None:
                    return False
                state.runs.append(run)
                self.evaluator.protected_checks = MIN_EVALUATIONS

            # The remaining part of the budget is divided among the runs that are still to come.
            used = self.evaluator.used
            self._advance(state.runs[place], ROUGH_MU, used + (end - used) / (count - state.index))
            if self.evaluator.exhausted():
                return False
            state.index += 1
            if self.evaluator.used >= end:
                break

        number = -(-len(state.runs) // SELECTION_RATE)
        state.better = _cheapest(state.runs, number)
        state.enter(Phase.BETTER)
        return True

    def optimise_better_runs(self) -> bool:
        """Continue the better ones of all runs, until a share of the budget is used."""
        state, end = self.state, self.state.ends[1]
        while state.index < len(state.better):
            used = self.evaluator.used
            limit = used + (end - used) / (len(state.better) - state.index)
            self._advance(state.better[state.index], ROUGH_MU, limit)
            if self.evaluator.exhausted():
                return False
            state.index += 1

        state.enter(Phase.FINISH)
        return True

    def finish_best_run(self) -> bool:
        """Optimise the best run to the end."""
        for run in _cheapest(self.state.runs, 1):
            self._advance(run, BarrierSchedule().last, 1.0)
            if self.evaluator.exhausted():
                return False

        self.state.ends = ()
        self.state.enter(Phase.ROUGH)
        return True

    def _advance(self, run: ParametricRun, last: float, limit: float) -> None:
        """Optimise a run, unless it has reached the barrier weight already."""
        if run.mu > last:
            self.optimise(self.evaluator, run, last, limit)


def _cheapest(runs: Sequence[ParametricRun], count: int) -> list[ParametricRun]:
    """The cheapest runs that are not finished."""
    unfinished = [run for run in runs if not run.finished]
    unfinished.sort(key=lambda run: run.cost)
    return unfinished[:count]


# ---- with mjfim's optimiser


def optimise_with_mjfim(
    evaluator: ControlEvaluator, run: ParametricRun, last: float, limit: float
) -> None:
    """Optimise within the curves of a run, as designs under hard limits are optimised.

    The arguments are those of an `Optimiser`.
    """
    order = evaluator.search
    stop = StopToken()

    # Only the last search gets a time limit. With one, the barrier weight of the other searches
    # would decrease too early.
    seconds = (1.0 - evaluator.used) * order.seconds if limit >= 1.0 else np.inf
    search = ConstrainedSearch(
        experiment=order.experiment,
        start=InitialControl(name=run.name, control=run.control, basis=run.basis),
        schedule=BarrierSchedule(first=run.mu, last=last),
        max_iterations=UNLIMITED_ITERATIONS,
        budget=Budget(stop=stop),
        seconds=seconds,
        combinations=order.combinations,
        added_information=order.added_information,
        threads=order.threads,
    )

    def watch(event: DesignEvent) -> None:
        """Stop the search where the budget is exhausted."""
        run.mu = min(event.row.mu, run.mu)
        if evaluator.exhausted(limit):
            stop.request()

    result = consume(search.run(evaluator.task), watch)
    if result.control is not None and result.cost < run.cost:
        run.control, run.cost = result.control, result.cost
        evaluator.record(result.control, result.cost, 0.0, run.name)
    if stop.requested:
        return

    run.finish_schedule(last)


# ---- with SciPy


def optimise_with_scipy(
    evaluator: ControlEvaluator, run: ParametricRun, last: float, limit: float
) -> None:
    """Minimise the cost of the experiment within the curves of a run.

    The arguments are those of an `Optimiser`.
    """
    base = evaluator.exact
    if evaluator.task.experiment.cost.criterion == "E":
        base = smoothed(evaluator.task, evaluator.search.combinations)

    schedule = BarrierSchedule(first=run.mu, last=last)
    ScipyDescent(evaluator=evaluator, run=run, base=base, limit=limit).descend(schedule)


def optimise_determinant_with_scipy(
    evaluator: ControlEvaluator, run: ParametricRun, last: float, limit: float
) -> None:
    """Minimise `-log det` instead of the experiment's criterion.

    Controls are still compared by the experiment's criterion. The arguments are those of an
    `Optimiser`.
    """
    information = replace(evaluator.exact.information, criterion="D")
    base = replace(evaluator.exact, information=information)

    schedule = BarrierSchedule(first=run.mu, last=last)
    ScipyDescent(evaluator=evaluator, run=run, base=base, limit=limit).descend(schedule)


@dataclass(eq=False, kw_only=True)
class ScipyDescent:
    """Minimises a cost with `scipy.optimize.minimize` in the stages of a barrier schedule.

    Attributes:
        evaluator: Evaluates controls and holds the budget.
        run: The run; its best control and its barrier weight are kept up to date.
        base: Cost that is minimised.
        limit: Share of the budget after which the descent ends.
        out_of_budget: True once the budget has ended the descent.
        s: (M, nu) coefficients of the curves.
    """

    evaluator: ControlEvaluator
    run: ParametricRun
    base: DesignProblem
    limit: float
    out_of_budget: bool = False
    s: Array = field(init=False)

    def __post_init__(self) -> None:
        evaluator, basis = self.evaluator, self.run.basis
        self.method = InteriorPointMethod(
            base=self.base,
            constraints=evaluator.constraints,
            centre=evaluator.centre,
            basis=basis,
            regulator=regulator_for(evaluator.task),
        )
        nu = len(evaluator.centre)
        self._no_feedback = np.zeros((len(basis), nu, evaluator.task.space.nx))
        self.s = np.zeros((basis.shape[1], nu))

    def descend(self, schedule: BarrierSchedule) -> None:
        """Run all stages of a schedule, or as many as the budget allows."""
        evaluator = self.evaluator
        self.s = self.coefficients(self._first_control())
        if self.out_of_budget:
            return

        weights = schedule.barrier_weights() if evaluator.is_limited else [schedule.last]
        tightening: dict[str, float] = {}

        for mu in weights:
            self.run.mu = mu
            problem = InteriorProblem(
                base=self.base,
                constraints=evaluator.constraints.tightened(tightening),
                mu=mu if evaluator.is_limited else 0.0,
                delta=min(MAX_RELAXATION, RELAXATION_PER_MU * mu),
            )
            is_last = mu <= schedule.last or not evaluator.is_limited
            is_complete = self._run_stage(problem, schedule, mu, is_last)
            self._repair()
            if not is_complete:
                return

            # Tighten the constraints where the result of a stage violates them.
            point = self._point(evaluator.problem)
            if mu <= TIGHTENING_MU and point.values is not None:
                margins = evaluator.constraints.relative_margins(point.values)
                tightening = updated_tightening(tightening, margins)

        self.run.finish_schedule(schedule.last if evaluator.is_limited else 0.0)

    def _first_control(self) -> Array:
        """Initial control of the descent.

        Returns:
            (N, nu) control that is feasible if one was found: by shrinking the control of the run,
            or else by minimising the barrier alone.
        """
        evaluator, control = self.evaluator, self.run.control
        if not evaluator.is_limited:
            return control

        inside = self.method.shrink_inside(control)
        if inside is not None:
            return inside

        self.s = self.coefficients(control)
        problem = InteriorProblem(
            base=self.base,
            constraints=evaluator.constraints,
            mu=1.0,
            delta=MAX_RELAXATION,
            with_cost=False,
        )
        self._run_stage(problem, BarrierSchedule(), 1.0, is_last=False)

        control = self.control(self.s)
        inside = None if self.out_of_budget else self.method.shrink_inside(control)
        return control if inside is None else inside

    def _run_stage(
        self, problem: InteriorProblem, schedule: BarrierSchedule, mu: float, is_last: bool
    ) -> bool:
        """Minimise one stage of the barrier until it makes little progress.

        Returns:
            False where the budget has ended the stage.
        """
        point = self._point(problem)
        if point.values is None:
            return True

        stage = _ScipyStage(
            descent=self,
            problem=problem,
            factor=self._whitening_factor(problem, point),
            values=[problem.value(point)],
            least_progress=schedule.tolerance if is_last else schedule.settled * mu,
            patience=schedule.patience * (2 if is_last else 1),
            window=schedule.window,
        )
        stage.minimise()
        return not self.out_of_budget

    def slope(self, problem: InteriorProblem, point: InteriorPoint) -> Array | None:
        """Derivative of the merit by the coefficients.

        Args:
            problem: Merit of the current stage.
            point: Point with finite merit.

        Returns:
            (M nu,) derivative; None where a perturbed simulation diverges.
        """
        try:
            gradient = problem.expand(point).gradient(self._no_feedback)
        except SimulationDivergedError:
            return None

        return np.asarray((self.run.basis.T @ gradient).reshape(-1))

    def _repair(self) -> None:
        """Shrink an infeasible control until it is feasible, and keep it if it is the best."""
        evaluator = self.evaluator
        point = self._point(evaluator.problem)
        if evaluator.is_limited and (point.values is None or not evaluator.is_feasible(point)):
            inside = self.method.shrink_inside(self.control(self.s))
            if inside is not None:
                point = evaluator.problem.point(inside)

        self.run.update(evaluator, point)

    def _whitening_factor(self, problem: InteriorProblem, point: InteriorPoint) -> Array:
        """(M nu, M nu) lower Cholesky factor of the whitening metric.

        The metric is the Gauss-Newton Hessian of the barrier, with a ridge on the control.
        """
        evaluator, task = self.evaluator, self.evaluator.task
        expansion = problem.expand(point)
        if expansion.barrier is None:
            raise ValueError("the expansion has no barrier to whiten with")

        N = len(self.run.basis)
        ridge = RIDGE / N / evaluator.constraints.control.bounds.scale**2
        if problem.with_cost and point.point is not None and point.point.cost > 0.0:
            ridge = ridge + task.control_weight * task.dt / point.point.cost

        barrier = expansion.barrier.weights
        weights = Weights(Q=barrier.Q, S=barrier.S, R=barrier.R + np.diag(ridge), W=barrier.W)
        H = BasisMetric.from_weights(expansion, weights, self.run.basis).H
        jitter = METRIC_JITTER * np.trace(H) * np.eye(len(H))
        return np.asarray(scipy.linalg.cholesky(H + jitter, lower=True))

    def control(self, s: Array) -> Array:
        """(N, nu) control of (M, nu) coefficients [unit of the actuator]."""
        return np.asarray(self.evaluator.centre + self.run.basis @ s)

    def coefficients(self, control: Array) -> Array:
        """(M, nu) coefficients that approximate a control: (N, nu) best."""
        deviation = control - self.evaluator.centre
        solution = np.linalg.lstsq(self.run.basis, deviation)
        return np.asarray(solution[0], dtype=np.float64)

    def _point(self, problem: InteriorProblem) -> InteriorPoint:
        """Point of the current coefficients, evaluated."""
        return problem.point(self.control(self.s))


@dataclass(eq=False, kw_only=True)
class _ScipyStage:
    """One stage of the barrier, minimised with SciPy over whitened coefficients y = L^T s.

    Attributes:
        descent: The descent; its coefficients follow the accepted iterates.
        problem: Merit of this stage.
        factor: (M nu, M nu) L, the lower Cholesky factor of the metric.
        values: Merit of the accepted iterates, the first one included.
        least_progress: Decrease of the merit over `window` iterates below which the stage ends.
        patience: Largest number of iterates.
        window: Number of iterates over which progress is measured.
        ended: True once nothing more has to be evaluated.
        evaluated: Merit at the evaluated coefficients; the keys are the bytes of the coefficients.
    """

    descent: ScipyDescent
    problem: InteriorProblem
    factor: Array
    values: list[float]
    least_progress: float
    patience: int
    window: int
    ended: bool = False
    evaluated: dict[bytes, float] = field(default_factory=dict)

    def minimise(self) -> None:
        """Run SciPy until the stage ends."""
        first = self.factor.T @ self.descent.s.reshape(-1)
        scipy.optimize.minimize(
            self._value_and_slope,
            first,
            jac=True,
            method=SCIPY_METHOD,
            options=SCIPY_OPTIONS,
            callback=self._accept,
        )

    def _coefficients(self, y: Array) -> Array:
        """(M, nu) coefficients from whitened coefficients: (M nu,)."""
        return np.asarray(
            scipy.linalg.solve_triangular(self.factor.T, y).reshape(self.descent.s.shape)
        )

    def _value_and_slope(self, y: Array) -> tuple[float, Array]:
        """The merit and its derivative by whitened coefficients: (M nu,).

        Once the stage has ended, nothing is simulated any more.
        """
        descent = self.descent
        if not self.ended and descent.evaluator.exhausted(descent.limit):
            descent.out_of_budget = self.ended = True

        # SciPy cannot be stopped here. A large value ends its line search after a few evaluations,
        # which cost nothing.
        diverged = DIVERGED_VALUE, np.zeros(y.size)
        if self.ended:
            return diverged

        s = self._coefficients(y)
        point = self.problem.point(descent.control(s))
        value = np.inf if point.values is None else self.problem.value(point)
        self.evaluated[y.tobytes()] = min(value, DIVERGED_VALUE)
        if not np.isfinite(value):
            return diverged
        descent.run.update(descent.evaluator, point)

        # Where the barrier alone is minimised, the first feasible control is the result.
        if not self.problem.with_cost and descent.evaluator.is_feasible(point):
            descent.s, self.ended = s, True
            return diverged

        slope = descent.slope(self.problem, point)
        if slope is None:
            return diverged
        return value, np.asarray(scipy.linalg.solve_triangular(self.factor, slope, lower=True))

    def _accept(self, y: Array) -> None:
        """Accept an iterate of SciPy.

        Raises:
            StopIteration: The stage has ended; SciPy ends a minimisation by this exception.
        """
        if self.ended:
            raise StopIteration

        self.descent.s = self._coefficients(y)
        self.values.append(self.evaluated.get(np.asarray(y).tobytes(), self.values[-1]))

        # End the stage where the last iterates made little progress.
        if len(self.values) > self.window:
            progress = self.values[-1 - self.window] - self.values[-1]
            self.ended = progress < self.least_progress
        self.ended = self.ended or len(self.values) > self.patience
        if self.ended:
            raise StopIteration
