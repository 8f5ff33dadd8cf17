"""Fourier series and B-splines, optimised with SciPy or with mjfim's own optimiser: many bluntly, the best ones sharply.

SciPy gets what is best for it: the exact gradient of `log J + mu * barrier`, mu falling in the stages of `barrier_weights`, and
coefficients whitened by the Gauss-Newton metric of the barrier, anew at every stage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.bandwidth import boundary_splines
from mjfim.excitation.constrained import Chase, ConstrainedSearch, pursue, smoothed
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import (
    MAX_RELAXATION,
    RELAXED,
    TIGHTENING_MU,
    BarrierSchedule,
    InteriorPoint,
    InteriorPointMethod,
    InteriorProblem,
    updated_tightening,
)
from mjfim.excitation.objective import DesignProblem
from mjfim.excitation.unconstrained import regulator_for
from mjfim.optimize.lq import Weights
from mjfim.optimize.structured_bfgs import BasisMetric
from mjfim.signals import fourier_basis, independent_curves
from mjfim.studies.baselines.budget import Arena, Spent

BASES = (0.2, 0.1, 0.4, 0.8, 0.15)  # [Hz] of Fourier series, to begin with
KNOTS = (1.0, 2.0)  # [Hz] bandwidth of B-splines, to begin with
PERIODS = (0.4, 5.0)  # of the first harmonic of other series within the horizon
BUSIEST = 5  # harmonics that other series have at least, where the bandwidth allows them
BLUNT = 0.03  # mu down to which all series are optimised


FIRST, SECOND = 0.3, 0.45  # share of the budget after which the better ones go on, and the best one


KEPT = 3  # one in so many is a better one
LEAST = 12  # iterations of each; where the budget does not bear them, fewer series take part
SCIPY = ("L-BFGS-B", {"maxcor": 30})
FAR = 1e6  # value of what diverges
RIDGE = 0.03  # weight of the control in the metric, over that of its barrier


@dataclass(eq=False)
class Series:
    """Curves, and where the search within them has come to.

    basis: (N, M);  control: (N, nu);  cost: J there, infinite outside the limits;  mu: barrier to go on with
    """

    name: str
    basis: Array
    control: Array
    cost: float = np.inf
    mu: float = BarrierSchedule().first

    @property
    def finished(self) -> bool:
        """Down to the sharpest barrier."""
        return self.mu == 0.0


Optimiser = Callable[
    [Arena, Series, float, float], None
]  # to a last mu, or until a share of the budget is used


def fourier(arena: Arena, harmonics: int) -> Iterator[Series]:
    """Finite Fourier series (Swevers et al. 1997) of the usual base frequencies, then of any."""
    e = arena.task.experiment
    fastest = e.limits.bandwidth or 0.5 * e.rate
    rest = (e.boundary.start == "rest", e.boundary.end == "rest")

    def made(frequency: float) -> Array:
        count = max(min(harmonics, int(fastest / frequency + 1e-9)), 1)
        return independent_curves(
            fourier_basis(arena.task.t, arena.task.horizon, frequency, count, *rest)
        )

    ends = tuple(
        min(periods / arena.task.horizon, fastest / min(harmonics, BUSIEST)) for periods in PERIODS
    )
    return _any(arena, [f for f in BASES if f <= fastest], ends, made)


def splines(arena: Arena) -> Iterator[Series]:
    """Uniform cubic B-splines of the usual knots, then of any between."""
    e = arena.task.experiment
    fastest = e.limits.bandwidth or 0.5 * e.rate

    def made(bandwidth: float) -> Array:
        return independent_curves(boundary_splines(arena.task, arena.task.t, bandwidth))

    ends = (min(0.5 * KNOTS[0], fastest), min(2.0 * KNOTS[-1], fastest))
    return _any(arena, [f for f in KNOTS if f <= fastest], ends, made)


def _any(
    arena: Arena, usual: Sequence[float], ends: Sequence[float], made: Callable[[float], Array]
) -> Iterator[Series]:
    """The usual frequencies from the initial control, then any between the ends from random coefficients."""
    i, n = arena.job.part
    for frequency in usual[i::n]:
        basis = made(frequency)
        fitted = basis @ np.linalg.lstsq(basis, arena.task.control - arena.centre)[0]
        yield started(arena, f"{frequency:.3g} Hz", basis, fitted)
    size = arena.constraints.control.bounds.scale
    while True:
        frequency = float(np.exp(arena.rng.uniform(*np.log(ends))))
        basis = made(frequency)
        swing = (
            basis
            @ arena.rng.normal(size=(basis.shape[1], len(size)))
            * size
            / np.sqrt(basis.shape[1])
        )
        yield started(arena, f"{frequency:.3g} Hz, at random", basis, swing)


def started(arena: Arena, name: str, basis: Array, swing: Array) -> Series:
    """Curves with a start, (N, nu) about the centre, as large as the limits allow, up to what it is."""
    arena.require()
    scale = arena.largest(swing)
    series = Series(name, basis, arena.centre + (scale or 1.0) * swing)
    if scale:
        offered(arena, series, arena.looking.point(series.control))
    return series


def offered(arena: Arena, series: Series, point: InteriorPoint) -> None:
    """Keep a point if it is the best of the series, and of all."""
    cost = arena.offer(point, series.name)
    if cost < series.cost:
        series.control, series.cost = point.ctrl, cost


def tournament(arena: Arena, entrants: Iterator[Series], count: int, optimise: Optimiser) -> None:
    """Optimise so many series a little and bluntly, the better third more, the best one sharply; again until all is spent."""
    known: list[Series] = []

    def advance(series: Series, last: float, limit: float) -> None:
        if series.mu > last:
            with suppress(Spent):
                optimise(arena, series, last, limit)
        arena.require()

    def best(many: int) -> list[Series]:
        return sorted((s for s in known if not s.finished), key=lambda series: series.cost)[:many]

    while True:
        begun = arena.used
        first, second = (begun + share * (1.0 - begun) for share in (FIRST, SECOND))
        for i in range(count):
            known.append(next(entrants))
            arena.grace = LEAST
            advance(known[-1], BLUNT, arena.used + (first - arena.used) / (count - i))
            if arena.used >= first:
                break
        better = best(-(-len(known) // KEPT))
        for i, series in enumerate(better):
            advance(series, BLUNT, arena.used + (second - arena.used) / (len(better) - i))
        for series in best(1):
            advance(series, BarrierSchedule().last, 1.0)


# with mjfim's own optimiser ---------------------------------------------------------------------------------------------


def own(arena: Arena, series: Series, last: float, limit: float) -> None:
    """Descend as designs do, within the series."""
    job, chase = arena.job, Chase(series.name)
    left = (
        (1.0 - arena.used) * job.seconds if limit >= 1.0 else np.inf
    )  # else sharper barriers would come too early
    start = InitialControl(name=series.name, control=series.control, basis=series.basis)
    schedule = BarrierSchedule(first=series.mu, last=last)
    search = ConstrainedSearch(
        job.experiment,
        start,
        schedule,
        100_000,
        left,
        job.combinations,
        job.added,
        threads=job.threads,
    )
    for row in pursue(search, chase, arena.task):
        series.mu = min(row.mu, series.mu)
        if chase.control is not None and chase.cost < series.cost:
            series.control, series.cost = chase.control, chase.cost
            arena.keep(chase.control, chase.cost, 0.0, series.name)
        arena.require(limit)
    series.mu = last if last > BarrierSchedule().last else 0.0


# with SciPy -------------------------------------------------------------------------------------------------------------


def scipy_own(arena: Arena, series: Series, last: float, limit: float) -> None:
    """Minimise the experiment's own cost."""
    criterion = arena.task.experiment.cost.criterion
    base = smoothed(arena.task, arena.job.combinations) if criterion == "E" else arena.exact
    Descent(arena, series, base, limit).run(BarrierSchedule(first=series.mu, last=last))


def scipy_determinant(arena: Arena, series: Series, last: float, limit: float) -> None:
    """Minimise it with `-log det` for its criterion; what is kept is judged by the experiment's own."""
    base = replace(arena.exact, information=replace(arena.exact.information, criterion="D"))
    Descent(arena, series, base, limit).run(BarrierSchedule(first=series.mu, last=last))


class Settled(Exception):
    """A stage of the barrier is done."""


class Descent:
    """One series on its way down the barrier's stages with `scipy.optimize.minimize`. base: the cost it minimises"""

    def __init__(self, arena: Arena, series: Series, base: DesignProblem, limit: float) -> None:
        self.arena, self.series, self.base, self.limit = arena, series, base, limit
        self.barrier_weights = InteriorPointMethod(
            base, arena.constraints, arena.centre, series.basis, regulator_for(arena.task)
        )
        self.K = np.zeros((len(series.basis), len(arena.centre), arena.task.space.nx))
        self.s = np.zeros((series.basis.shape[1], len(arena.centre)))

    def run(self, schedule: BarrierSchedule) -> None:
        """All stages. Raises Spent."""
        self.s = self._coefficients(self._begin())
        held = dict[str, float]()
        try:
            for mu in schedule.barrier_weights() if self.arena.holds else [schedule.last]:
                self.series.mu = mu
                last = mu <= schedule.last or not self.arena.holds
                constraints = self.arena.constraints.tightened(held)
                barrier = mu if self.arena.holds else 0.0
                self._stage(
                    InteriorProblem(
                        self.base, constraints, barrier, min(MAX_RELAXATION, RELAXED * mu)
                    ),
                    schedule,
                    mu,
                    last,
                )
                self._mend()
                point = self._point(self.arena.looking)
                if mu <= TIGHTENING_MU and point.values is not None:
                    held = updated_tightening(
                        held, self.arena.constraints.relative_margins(point.values)
                    )
        except Spent:
            self._mend()
            raise
        self.series.mu = (
            schedule.last if schedule.last > BarrierSchedule().last and self.arena.holds else 0.0
        )

    def _begin(self) -> Array:
        """A control inside the limits; where none is near, one on its way there by the barrier alone."""
        arena, start = self.arena, self.series.control
        self.s = self._coefficients(start)
        inner = self.barrier_weights.inside(start) if arena.holds else start
        if inner is not None:
            return inner
        problem = InteriorProblem(self.base, arena.constraints, 1.0, MAX_RELAXATION, costs=False)
        self._stage(problem, BarrierSchedule(), 1.0, False)
        inner = self.barrier_weights.inside(self._control(self.s))
        return self._control(self.s) if inner is None else inner

    def _stage(
        self, problem: InteriorProblem, schedule: BarrierSchedule, mu: float, last: bool
    ) -> None:
        """Minimise one barrier from where the search is, until little is won."""
        point = self._point(problem)
        if point.values is None:
            return
        factor = self._whitening(problem, point)
        enough, patience = (
            schedule.tolerance if last else schedule.settled * mu,
            schedule.patience * (2 if last else 1),
        )
        values, tried = [problem.value(point)], dict[bytes, float]()

        def value(y: Array) -> tuple[float, Array]:
            found, slope = self._valued(
                problem, solve_triangular(factor.T, y).reshape(self.s.shape)
            )
            tried[y.tobytes()] = found
            return found, solve_triangular(factor, slope, lower=True)

        def accepted(y: Array) -> None:
            self.s = solve_triangular(factor.T, y).reshape(self.s.shape)
            values.append(tried.get(np.asarray(y).tobytes(), values[-1]))
            slow = (
                len(values) > schedule.window and values[-1 - schedule.window] - values[-1] < enough
            )
            if slow or len(values) > patience:
                raise Settled

        method, options = SCIPY
        with suppress(Settled):
            minimize(
                value,
                factor.T @ self.s.reshape(-1),
                jac=True,
                method=method,
                options=options,
                callback=accepted,
            )

    def _valued(self, problem: InteriorProblem, s: Array) -> tuple[float, Array]:
        """Value and slope by the coefficients; every point that keeps the limits is offered."""
        self.arena.require(self.limit)
        nothing = FAR, np.zeros(s.size)
        point = problem.point(self._control(s))
        if point.values is None or not np.isfinite(problem.value(point)):
            return nothing
        offered(self.arena, self.series, point)
        if not problem.costs and self.arena.inside(point):
            self.s = s
            raise Settled
        try:
            slope = self.series.basis.T @ problem.expand(point).gradient(self.K)
        except SimulationDivergedError:
            return nothing
        return problem.value(point), slope.reshape(-1)

    def _mend(self) -> None:
        """Shrink what leaks about the centre until it does not."""
        point = self._point(self.arena.looking)
        if self.arena.holds and (point.values is None or not self.arena.inside(point)):
            control = self.barrier_weights.inside(self._control(self.s))
            point = point if control is None else self.arena.looking.point(control)
        offered(self.arena, self.series, point)

    def _whitening(self, problem: InteriorProblem, point: InteriorPoint) -> Array:
        """Lower Cholesky factor of the barrier's Gauss-Newton Hessian and a ridge on the coefficients."""
        task, e = self.arena.task, problem.expand(point)
        if e.barrier is None:
            raise ValueError("nothing to whiten with")
        N, w = len(self.series.basis), e.barrier.weights
        ridge = RIDGE / N / self.arena.constraints.control.bounds.scale**2
        if problem.costs and point.point is not None and point.point.cost > 0.0:
            ridge = ridge + task.control_weight * task.dt / point.point.cost
        H = BasisMetric.from_weights(
            e, Weights(Q=w.Q, S=w.S, R=w.R + np.diag(ridge), W=w.W), self.series.basis
        ).H
        return np.asarray(cholesky(H + 1e-12 * np.trace(H) * np.eye(len(H)), lower=True))

    def _control(self, s: Array) -> Array:
        return np.asarray(self.arena.centre + self.series.basis @ s)

    def _coefficients(self, control: Array) -> Array:
        return np.asarray(
            np.linalg.lstsq(self.series.basis, control - self.arena.centre)[0], dtype=np.float64
        )

    def _point(self, problem: InteriorProblem) -> InteriorPoint:
        return problem.point(self._control(self.s))
