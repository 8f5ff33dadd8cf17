"""Designs under hard limits: `log J + mu * barrier`, mu falling in stages (Hauser & Saccon 2006).

The logarithm makes the cost free of scale, so that one barrier_weights of mu fits every experiment; its minima are those of J.
The barrier is relaxed: it stays defined outside, and an infeasible start is first driven inside without any cost.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.constraint_kinds import ConstraintValues
from mjfim.excitation.constraints import ConstraintSet
from mjfim.excitation.objective import DIVERGED, DesignPoint, DesignProblem
from mjfim.optimize.barrier import BarrierExpansion
from mjfim.optimize.lq import TangentCurve
from mjfim.optimize.projection_operator import Armijo, Expansion, Iterate, Regulator, optimize
from mjfim.optimize.structured_bfgs import StructuredBFGS
from mjfim.records.design import Status


@dataclass(frozen=True, eq=False)
class InteriorPoint:
    """A trajectory with its cost and its limits. A diverged trial has no values and infinite value.

    point: with the cost J, or None where only the limits are looked at;  merit: log J, 0 without
    barrier: its value, mu left out
    """

    values: ConstraintValues | None
    point: DesignPoint | None
    merit: float
    barrier: float

    @property
    def ctrl(self) -> Array:
        """(N, nu)"""
        return values_of(self).trajectory.ctrl


DIVERGED_POINT = InteriorPoint(None, None, np.inf, np.inf)


def values_of(point: InteriorPoint) -> ConstraintValues:
    """What its limits look at. Raises ValueError for a diverged trial."""
    if point.values is None:
        raise ValueError("a diverged trial has no trajectory")
    return point.values


@dataclass(frozen=True, eq=False)
class InteriorProblem:
    """`log J + mu B` as Algorithm 1 wants it; D-optimality has its logarithm in it already and is counted per parameter.

    costs: False where only the limits are to be met;  delta: relaxation of the barrier
    """

    base: DesignProblem
    constraints: ConstraintSet
    mu: float
    delta: float
    costs: bool = True

    def point(self, ctrl: Array) -> InteriorPoint:
        """Evaluate along the open-loop trajectory of a control."""
        watched = self.base.plant.observe(self.base.theta, ctrl, self.constraints.observations)
        if watched is None:
            return DIVERGED_POINT
        values = self.constraints.evaluate(*watched, slopes=False)
        barrier = self.constraints.value(values, self.delta)
        if not self.costs:
            return InteriorPoint(values, None, 0.0, barrier)
        point = self.base.point(values.trajectory, self.base.plant.derivatives.quickest_accuracy)
        return (
            DIVERGED_POINT
            if point is DIVERGED
            else InteriorPoint(values, point, self._merit(point), barrier)
        )

    def again(self, point: InteriorPoint) -> InteriorPoint:
        """A point of a problem that differs from this one in criterion, mu, delta or the constraints's bounds."""
        if point.values is None or point.point is None:
            return point
        judged = self.base.reevaluated(point.point)
        return InteriorPoint(
            point.values,
            judged,
            self._merit(judged),
            self.constraints.value(point.values, self.delta),
        )

    def _merit(self, point: DesignPoint) -> float:
        if self.base.information.criterion == "D":
            return point.cost / self._nats(point)
        return float(np.log(point.cost)) if point.cost > 0.0 and np.isfinite(point.cost) else np.inf

    def _share(self, point: InteriorPoint) -> float:
        """dJ over the change of the merit."""
        if point.point is None:
            return 1.0
        return (
            self._nats(point.point) if self.base.information.criterion == "D" else point.point.cost
        )

    def _nats(self, point: DesignPoint) -> float:
        count = 1 if point.criterion is None else len(point.criterion.eigenvalues)
        return self.base.information.weight * count

    def value(self, point: InteriorPoint) -> float:
        """`log J + mu B`."""
        return point.merit + self.mu * point.barrier

    def size(self, point: InteriorPoint) -> float:
        """One e-fold of J, or the barrier where that is more; without a cost, the barrier in full."""
        return max(1.0, abs(point.barrier) * (self.mu if self.costs else 1.0))

    def expand(self, point: InteriorPoint) -> Expansion:
        """Expansion of the sum; the barrier's share stands apart as well."""
        values = values_of(point)
        values = self.constraints.evaluate(values.trajectory, values.observed, slopes=True)
        if point.point is None:
            A, B, rise = self.base.plant.derivatives.observation_jacobians(
                self.base.theta, values.trajectory, self.constraints.observations
            )
            e = Expansion(
                A=A, B=B, a=np.zeros((len(A) + 1, A.shape[1])), b=np.zeros((len(A), B.shape[2]))
            )
        else:
            e, found = self.base.expand_observed(point.point, self.constraints.observations)
            if found is None:
                raise ValueError("an expansion along a criterion without directions")
            rise = found
        share = self._share(point)
        barrier: BarrierExpansion = self.constraints.expand(values, rise, self.delta).scaled(
            self.mu
        )
        return Expansion(
            A=e.A,
            B=e.B,
            a=e.a / share + barrier.a,
            b=e.b / share + barrier.b,
            extended=None,
            barrier=barrier,
            eigenvalue_model=e.eigenvalue_model,
        )

    def project(
        self, point: InteriorPoint, zeta: TangentCurve, gamma: float, K: Array
    ) -> InteriorPoint:
        """P(xi + gamma zeta), evaluated."""
        trajectory = values_of(point).trajectory
        if not K.any():
            return self.point(trajectory.ctrl + gamma * zeta.v)
        moved = self.base.plant.project(self.base.theta, trajectory, zeta, gamma, K)
        return DIVERGED_POINT if moved is None else self.point(moved.ctrl)

    def difference(self, new: InteriorPoint, old: InteriorPoint) -> TangentCurve:
        """(x_new - x_old, u_new - u_old)."""
        return self.base.plant.difference(values_of(new).trajectory, values_of(old).trajectory)

    def refine(self, point: InteriorPoint) -> InteriorPoint | None:
        """Never: the barrier_weights of mu ends before the differences matter."""
        return None


FACTOR = 3.0  # between schedule
RELAXED = 0.3  # delta over mu
MAX_RELAXATION = 0.1  # delta at most
SHRINK_FACTORS = np.concatenate(
    [[1.0, 0.997, 0.99, 0.97, 0.94, 0.9], 0.8 ** np.arange(1, 24)]
)  # of a start, tried in turn
TIGHTENING_MU = 4e-3  # mu from which on leaks are answered
SPARE = 1.2  # what was outside at the end of a stage_iterate is held back on the next by that much of it
SLACK = 1.5  # of the time that is left per stage_iterate, what one may take
AGAIN = 3  # times that the last stage_iterate is repeated because of leaks, at most
MAX_START_VIOLATION = (
    1.0  # of a start beyond its limits, over half of their ranges, that is begun with as it is
)


ROUNDS, FEW = 60, 20  # iterations towards the inside, the latter where shrinking leads there too


@dataclass(frozen=True)
class BarrierSchedule:
    """first, last: mu;  patience: iterations per stage at most, twice as many on the last

    settled: progress over `window` iterations, over mu, below which a stage is done
    tolerance: slope at which the last stage is done
    """

    first: float = 0.1
    last: float = 1e-4
    patience: int = 40
    settled: float = 2.0
    window: int = 8
    tolerance: float = 1e-5

    def barrier_weights(self) -> list[float]:
        """Every mu, from the first to the last."""
        count = max(round(np.log(self.first / self.last) / np.log(FACTOR)), 1)
        return [float(mu) for mu in np.geomspace(self.first, self.last, count + 1)]


@dataclass(frozen=True, eq=False)
class BarrierIterate:
    """An iterate on the barrier_weights. margins: worst of each kind;  status: set on the very last one

    repaired: no iterate, but the one before shrunk until it kept all limits
    """

    iterate: Iterate[InteriorPoint]
    mu: float
    margins: dict[str, float]
    status: Status | None = None
    repaired: bool = False

    @property
    def feasible(self) -> bool:
        """Inside all limits."""
        return all(margin >= 0.0 for margin in self.margins.values())


@dataclass(frozen=True, eq=False)
class Entry:
    """Where a descent begins. control: (N, nu), or None where all diverge;  iterations: that it took to get there"""

    control: Array | None
    iterations: int


@dataclass
class InteriorPointMethod:
    """One descent. base: the cost on the lifted plant;  basis: (N, M) what the control minus centre is made of, or None

    centre: (nu,) control about which a start is shrunk until it is inside
    """

    base: DesignProblem
    constraints: ConstraintSet
    centre: Array
    basis: Array | None
    regulate: Regulator
    schedule: BarrierSchedule = BarrierSchedule()

    def run(self, control: Array, budget: int, until: float = np.inf) -> Iterator[BarrierIterate]:
        """Every iterate from a control: (N, nu), at most `budget`, until a time of `time.perf_counter`."""
        entry = yield from self._entered(control, min(budget, ROUNDS), until)
        if entry.control is not None:
            yield from self._down(entry.control, self._direction(), budget, until, entry.iterations)

    def _entered(
        self, control: Array, budget: int, until: float
    ) -> Generator[BarrierIterate, None, Entry]:
        """A control inside all limits or near them; of those far outside, shrunk about the centre or steered, what costs less."""
        fitted = self._fitted(control)
        if self._near(fitted):
            return Entry(fitted, 0)
        shrunk = self.inside(fitted)
        stage_iterate: BarrierIterate | None = None
        for stage_iterate in self._steered(
            fitted, budget if shrunk is None else min(budget, FEW), until
        ):
            yield stage_iterate
        if stage_iterate is None:
            return Entry(shrunk, 0)
        steered, taken = stage_iterate.iterate.point.ctrl, stage_iterate.iterate.index + 1
        if shrunk is None:
            return Entry(steered, taken)
        problem = InteriorProblem(self.base, self.constraints, self.schedule.first, MAX_RELAXATION)
        entries = [shrunk, steered] if stage_iterate.feasible else [shrunk]
        values = [problem.value(problem.point(ctrl)) for ctrl in entries]
        return Entry(entries[int(np.argmin(values))], taken)

    def _near(self, control: Array) -> bool:
        """What a relaxed barrier brings back inside on its way down: an end that is missed can be any number of its bands off."""
        point = InteriorProblem(
            self.base, self.constraints, 1.0, MAX_RELAXATION, costs=False
        ).point(control)
        if point.values is None:
            return False
        return all(
            s > -MAX_START_VIOLATION
            for kind, s in self.constraints.relative_margins(point.values).items()
            if not kind.startswith("end_")
        )

    def _direction(self) -> StructuredBFGS:
        N = len(self.base.running.desired_state) - 1
        ridge = 0.03 / N / self.constraints.control.bounds.scale**2
        return StructuredBFGS(ridge, self.basis)

    def _fitted(self, control: Array) -> Array:
        """The nearest control that the basis can make."""
        if self.basis is None:
            return control
        return np.asarray(
            self.centre + self.basis @ np.linalg.lstsq(self.basis, control - self.centre)[0]
        )

    def inside(self, control: Array) -> Array | None:
        """A control shrunk about the centre until all limits hold; None where even the least one leaves them."""
        problem = InteriorProblem(self.base, self.constraints, 1.0, MAX_RELAXATION, costs=False)
        for share in SHRINK_FACTORS:
            candidate = control if share == 1.0 else self.centre + share * (control - self.centre)
            point = problem.point(candidate)
            if point.values is not None and self.constraints.is_feasible(
                point.values, strictly=True
            ):
                return np.asarray(candidate)
        return None

    def _steered(self, control: Array, budget: int, until: float) -> Iterator[BarrierIterate]:
        """Iterates towards the inside, without any cost."""
        problem = InteriorProblem(self.base, self.constraints, 1.0, MAX_RELAXATION, costs=False)
        begin = problem.point(control)
        if begin.values is None:  # it diverges
            return
        for iterate in optimize(
            problem,
            begin,
            self._direction(),
            self.regulate,
            Armijo(),
            tolerance=1e-6,
            max_iterations=budget,
        ):
            margins = self.constraints.margins(values_of(iterate.point))
            stage_iterate = BarrierIterate(iterate, np.inf, margins)
            yield stage_iterate
            if (
                self.constraints.is_feasible(values_of(iterate.point), strictly=True)
                or time.perf_counter() > until
            ):
                return

    def _down(
        self, control: Array, direction: StructuredBFGS, budget: int, until: float, done: int
    ) -> Iterator[BarrierIterate]:
        r, held, budget = self.schedule, dict[str, float](), budget + done
        barrier_weights = r.barrier_weights()
        point = InteriorProblem(self.base, self.constraints, r.first, MAX_RELAXATION).point(control)
        if point.values is None:  # it diverges where the parameters move a little
            return
        for i, mu in enumerate([*barrier_weights, *barrier_weights[-1:] * AGAIN]):
            left, last, now = (
                max(len(barrier_weights) - i, 1),
                i >= len(barrier_weights) - 1,
                time.perf_counter(),
            )
            deadline = until if last else min(until, now + SLACK * (until - now) / left)
            patience = min(
                r.patience * (2 if last else 1),
                -(-(budget - done) // left) if left > 1 else budget - done,
            )
            constraints = self.constraints.tightened(held)
            problem = InteriorProblem(self.base, constraints, mu, min(MAX_RELAXATION, RELAXED * mu))
            point = problem.again(point)
            values: list[float] = []
            tight = min(
                r.tolerance, BarrierSchedule.tolerance
            )  # what leaks is repaired by less slope than many a stated tolerance
            for iterate in optimize(
                problem,
                point,
                direction,
                self.regulate,
                Armijo(),
                tolerance=tight,
                max_iterations=patience,
            ):
                point, margins = iterate.point, self.constraints.margins(values_of(iterate.point))
                kept = self.constraints.is_feasible(values_of(iterate.point))
                status = Status.CONVERGED if iterate.slope <= r.tolerance else iterate.status
                status = status if last and kept else None
                yield BarrierIterate(
                    replace(iterate, index=done + iterate.index), mu, margins, status
                )
                if status is Status.CONVERGED:
                    return
                values.append(iterate.value)
                settled = (
                    len(values) > r.window and values[-1 - r.window] - values[-1] < r.settled * mu
                )
                if time.perf_counter() > deadline or (settled and not last):
                    break
            done += iterate.index
            over = done >= budget or time.perf_counter() > until
            if not kept:
                yield from self._mended(problem, iterate, mu, done)
            if over or (last and kept):
                return
            if mu <= TIGHTENING_MU:
                held = updated_tightening(held, self.constraints.relative_margins(values_of(point)))

    def _mended(
        self, problem: InteriorProblem, iterate: Iterate[InteriorPoint], mu: float, done: int
    ) -> Iterator[BarrierIterate]:
        """An iterate that leaks, shrunk until it does not: the best so far in case that nothing follows."""
        control = self.inside(iterate.point.ctrl)
        if control is not None:
            point = replace(problem, constraints=self.constraints).point(control)
            if point.values is not None:
                own = replace(
                    iterate,
                    index=done,
                    point=point,
                    value=problem.value(point),
                    gamma=0.0,
                    status=None,
                )
                yield BarrierIterate(own, mu, self.constraints.margins(point.values), repaired=True)


def updated_tightening(held: Mapping[str, float], shares: Mapping[str, float]) -> dict[str, float]:
    """How far each kind is held back from its bounds next: more where it was outside, less where it was well inside."""
    return {
        kind: max(0.0, held.get(kind, 0.0) - share * (SPARE if share < 0.0 else 0.5))
        for kind, share in shares.items()
    }
