"""Interior-point method for designs under hard limits: minimise `log J + mu B` in stages with falling barrier weight mu.

A control that is far outside the limits is first steered inside without any cost. A stage that ends
outside tightens the limits of the next one.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopReason
from mjfim.excitation.constraints import ConstraintSet
from mjfim.excitation.feasibility import shrink_until_feasible
from mjfim.excitation.interior_problem import InteriorPoint, InteriorProblem, values_of
from mjfim.excitation.objective import DesignProblem
from mjfim.optimize.projection_operator import Armijo, Iterate, Regulator, optimize
from mjfim.optimize.structured_bfgs import StructuredBFGS
from mjfim.records.design import Status

# Factor between the barrier weights mu of two successive stages.
MU_FACTOR = 3.0

# Relaxation delta of the barrier, over mu.
RELAXATION_PER_MU = 0.3

# Largest relaxation delta of the barrier.
MAX_RELAXATION = 0.1

# Weight mu of the barrier from which on violated limits are answered by tighter limits in the next
# stage.
TIGHTENING_MU = 4e-3

# A violation at the end of a stage tightens the limit by this many times the violation.
TIGHTENING_GAIN = 1.2

# A limit that is well kept is released again by this share of its margin.
RELEASE_GAIN = 0.5

# A stage may take this many times its equal share of the time that is left.
TIME_SHARE_FACTOR = 1.5

# Number of times that the last stage is repeated, at most, because its result violates a limit.
MAX_REPEATED_STAGES = 3

# Violation of a limit, over half of its range, up to which the barrier can bring a control back
# inside by itself.
MAX_START_VIOLATION = 1.0

# Iterations that steer a control inside the limits, at most.
MAX_STEERING_ITERATIONS = 60

# The same where shrinking the control leads inside as well, so that steering only has to be tried.
MAX_STEERING_TRIAL = 20

# Slope of the barrier, over its size, at which steering has converged.
STEERING_TOLERANCE = 1e-6

# Weight of the control in the metric, times the number of samples, over the square of half of the
# control's range.
RIDGE = 0.03


@dataclass(frozen=True, kw_only=True)
class BarrierSchedule:
    """Weights mu of the barrier, one per stage, and when a stage ends.

    Attributes:
        first: Largest weight.
        last: Smallest weight.
        patience: Iterations of a stage, at most; the last stage may take twice as many.
        settled: A stage ends when the merit falls by less than this times mu over `window`
            iterations.
        window: Number of iterations over which progress is measured.
        tolerance: Slope, over the size of the merit, at which the last stage has converged.
    """

    first: float = 0.1
    last: float = 1e-4
    patience: int = 40
    settled: float = 2.0
    window: int = 8
    tolerance: float = 1e-5

    def barrier_weights(self) -> list[float]:
        """All weights mu, from the first to the last, in equal ratios of about `MU_FACTOR`."""
        ratio = self.first / self.last
        count = max(round(np.log(ratio) / np.log(MU_FACTOR)), 1)

        weights: list[float] = np.geomspace(self.first, self.last, count + 1).tolist()
        return weights


@dataclass(frozen=True, kw_only=True, eq=False)
class BarrierIterate:
    """One iterate of the interior-point method.

    Attributes:
        iterate: The iterate, numbered over all stages.
        mu: Weight of the barrier; infinite while the control is steered inside the limits.
        margins: Worst margin of each kind of constraint [unit of the kind], negative where
            violated.
        status: How the run ended; None except in the last iterate.
        repaired: True where this is not a new iterate, but the one before, shrunk until it keeps
            all limits.
    """

    iterate: Iterate[InteriorPoint]
    mu: float
    margins: dict[str, float]
    status: Status | None = None
    repaired: bool = False

    @property
    def feasible(self) -> bool:
        """True where all limits hold."""
        return all(margin >= 0.0 for margin in self.margins.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class _FirstControl:
    """Control with which the first stage begins.

    Attributes:
        control: (N, nu) control [u-unit]; None where every candidate diverges.
        iterations: Number of iterates that were needed to find it.
    """

    control: Array | None
    iterations: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stage:
    """Settings of one barrier stage.

    Attributes:
        problem: What is minimised, with the limits as they are tightened in this stage.
        budget: Time of the stage.
        max_iterations: Iterations of the stage, at most.
        is_last: True for the stage with the smallest mu and its repetitions.
        first_index: Number of its first iterate.
    """

    problem: InteriorProblem
    budget: Budget
    max_iterations: int
    is_last: bool
    first_index: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _StageResult:
    """Result of one barrier stage.

    Attributes:
        iterate: Last iterate of the stage, numbered within the stage.
        is_feasible: True where it keeps all limits.
        converged: True where it is the final result of the run.
    """

    iterate: Iterate[InteriorPoint]
    is_feasible: bool
    converged: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class InteriorPointMethod:
    """Minimise a cost under hard limits.

    Attributes:
        base: The cost on the plant without clamps.
        constraints: The limits.
        centre: (nu,) control about which an infeasible control is shrunk [u-unit].
        basis: (N, M) curves of which the control minus its centre is made; None where the control
            is free.
        regulator: Gain of the projection operator.
        schedule: Weights of the barrier and when a stage ends.
    """

    base: DesignProblem
    constraints: ConstraintSet
    centre: Array
    basis: Array | None
    regulator: Regulator
    schedule: BarrierSchedule = BarrierSchedule()

    def run(self, control: Array, budget: Budget) -> Iterator[BarrierIterate]:
        """Run the method from a control.

        Args:
            control: (N, nu) control [u-unit]; need not be feasible.
            budget: Time and iterations of the run. Iterations that steer the control inside the
                limits are not counted.

        Yields:
            Every iterate.
        """
        first = yield from self._find_first_control(control, budget)

        if first.control is not None and not budget.stop.requested:
            yield from self._minimize(first.control, budget, first.iterations)

    def shrink_inside(self, control: Array) -> Array | None:
        """Shrink a control about the centre until all limits hold strictly.

        Args:
            control: (N, nu) control [u-unit].

        Returns:
            (N, nu) the shrunk control, or None where no shrinking helps.
        """
        problem = self._problem_without_cost

        def keep_feasible(candidate: Array) -> Array | None:
            """Return the candidate where it is strictly feasible."""
            values = problem.point(candidate).values
            if values is None or not self.constraints.is_feasible(values, strictly=True):
                return None
            return np.asarray(candidate)

        return shrink_until_feasible(control, self.centre, keep_feasible)

    # ---- the first control

    def _find_first_control(
        self, control: Array, budget: Budget
    ) -> Generator[BarrierIterate, None, _FirstControl]:
        """Find a control near the feasible set: the given one, or the better of the shrunk and the steered one."""
        fitted = self._fit_to_basis(control)

        # The barrier itself brings a control back that is only a little outside.
        if self._is_near_feasible(fitted):
            return _FirstControl(control=fitted, iterations=0)

        shrunk = self.shrink_inside(fitted)

        # Steer the control inside; only a few iterations where shrinking has worked.
        longest = MAX_STEERING_ITERATIONS if shrunk is None else MAX_STEERING_TRIAL
        steered: BarrierIterate | None = None
        for steered in self._steer_inside(fitted, int(min(budget.max_iterations, longest)), budget):
            yield steered

        if steered is None:
            return _FirstControl(control=shrunk, iterations=0)

        steered_control = steered.iterate.point.ctrl
        iterations = steered.iterate.index + 1
        if shrunk is None:
            return _FirstControl(control=steered_control, iterations=iterations)

        # Both are available: begin with the one of lower merit.
        problem = InteriorProblem(
            base=self.base,
            constraints=self.constraints,
            mu=self.schedule.first,
            delta=MAX_RELAXATION,
        )
        candidates = [shrunk, steered_control] if steered.feasible else [shrunk]
        values = [problem.value(problem.point(candidate)) for candidate in candidates]
        best = candidates[int(np.argmin(values))]
        return _FirstControl(control=best, iterations=iterations)

    def _fit_to_basis(self, control: Array) -> Array:
        """The nearest control, (N, nu), that the basis can represent."""
        if self.basis is None:
            return control

        coefficients = np.linalg.lstsq(self.basis, control - self.centre)[0]
        return np.asarray(self.centre + self.basis @ coefficients)

    def _is_near_feasible(self, control: Array) -> bool:
        """Whether the relaxed barrier can restore feasibility from here; terminal constraints are ignored.

        The end may be missed by any number of its tolerances, because the tolerances are narrow.
        """
        values = self._problem_without_cost.point(control).values
        if values is None:
            return False

        margins = self.constraints.relative_margins(values)
        return all(
            margin > -MAX_START_VIOLATION
            for kind, margin in margins.items()
            if not kind.startswith("end_")
        )

    def _steer_inside(
        self, control: Array, max_iterations: int, budget: Budget
    ) -> Iterator[BarrierIterate]:
        """Minimise the barrier alone until all limits hold strictly."""
        problem = self._problem_without_cost
        start = problem.point(control)
        if start.values is None:
            return

        iterates = optimize(
            problem,
            start,
            self._direction(),
            self.regulator,
            Armijo(),
            tolerance=STEERING_TOLERANCE,
            max_iterations=max_iterations,
        )
        for iterate in iterates:
            values = values_of(iterate.point)
            margins = self.constraints.margins(values)
            yield BarrierIterate(iterate=iterate, mu=np.inf, margins=margins)

            inside = self.constraints.is_feasible(values, strictly=True)
            if inside or budget.exhausted is not None:
                return

    # ---- the barrier stages

    def _minimize(
        self, control: Array, budget: Budget, first_index: int
    ) -> Iterator[BarrierIterate]:
        """Run the stages with falling mu; the last one is repeated while its result violates a limit."""
        weights = self.schedule.barrier_weights()
        stages = [*weights, *weights[-1:] * MAX_REPEATED_STAGES]

        # One direction for all stages: its curvature pairs do not depend on mu.
        direction = self._direction()
        tightening = dict[str, float]()

        point = self._problem(weights[0], self.constraints).point(control)
        if point.values is None:
            # The simulation diverges when the parameters move a little.
            return

        for number, mu in enumerate(stages):
            problem = self._problem(mu, self.constraints.tightened(tightening))
            stage = self._stage(problem, len(weights) - number, budget, first_index)
            ended = yield from self._run_stage(stage, problem.reevaluate(point), direction)
            if ended.converged:
                return

            point = ended.iterate.point
            first_index += ended.iterate.index
            budget.spend(iterations=ended.iterate.index)
            reason = budget.exhausted

            # Repair an infeasible end, since nothing better may follow; but nobody waits for that
            # after Ctrl-C.
            if not ended.is_feasible and reason is not StopReason.REQUESTED:
                yield from self._repair(problem, ended.iterate, first_index)

            if reason is not None or (stage.is_last and ended.is_feasible):
                return

            # Move the limits inwards by what is violated, so that the next stage ends inside.
            if mu <= TIGHTENING_MU:
                margins = self.constraints.relative_margins(values_of(point))
                tightening = updated_tightening(tightening, margins)

    def _stage(
        self, problem: InteriorProblem, stages_left: int, budget: Budget, first_index: int
    ) -> _Stage:
        """Settings of the next stage: its share of the time and of the iterations that are left."""
        stages_left = max(stages_left, 1)
        is_last = stages_left == 1

        # A stage may take somewhat more than its equal share of the time; the last one may take all
        # of it.
        share = 1.0 if is_last else min(TIME_SHARE_FACTOR / stages_left, 1.0)

        patience = self.schedule.patience * (2 if is_last else 1)
        max_iterations = min(patience, np.ceil(budget.iterations_left / stages_left))

        return _Stage(
            problem=problem,
            budget=budget.share(share),
            max_iterations=int(max_iterations),
            is_last=is_last,
            first_index=first_index,
        )

    def _run_stage(
        self, stage: _Stage, start: InteriorPoint, direction: StructuredBFGS
    ) -> Generator[BarrierIterate, None, _StageResult]:
        """Minimise with one mu until convergence, stagnation, or the end of the stage's budget."""
        schedule = self.schedule
        problem = stage.problem
        values: list[float] = []

        # A tighter tolerance than many a stated one: a smaller slope also makes a violation
        # smaller.
        tolerance = min(schedule.tolerance, BarrierSchedule.tolerance)

        iterates = optimize(
            problem,
            start,
            direction,
            self.regulator,
            Armijo(),
            tolerance=tolerance,
            max_iterations=stage.max_iterations,
        )
        for iterate in iterates:
            margins = self.constraints.margins(values_of(iterate.point))
            is_feasible = self.constraints.is_feasible(values_of(iterate.point))

            # Convergence counts on the last stage only, and only inside the stated limits.
            status = Status.CONVERGED if iterate.slope <= schedule.tolerance else iterate.status
            if not (stage.is_last and is_feasible):
                status = None

            numbered = replace(iterate, index=stage.first_index + iterate.index)
            yield BarrierIterate(iterate=numbered, mu=problem.mu, margins=margins, status=status)

            if status is Status.CONVERGED:
                break

            # Stagnation: a sharper barrier promises more than further iterations.
            values.append(iterate.value)
            stagnates = (
                len(values) > schedule.window
                and values[-1 - schedule.window] - values[-1] < schedule.settled * problem.mu
            )
            if stage.budget.exhausted is not None or (stagnates and not stage.is_last):
                break

        return _StageResult(
            iterate=iterate,
            is_feasible=is_feasible,
            converged=status is Status.CONVERGED,
        )

    def _repair(
        self, problem: InteriorProblem, iterate: Iterate[InteriorPoint], index: int
    ) -> Iterator[BarrierIterate]:
        """Yield an infeasible iterate again, shrunk until it keeps all limits, if that is possible."""
        control = self.shrink_inside(iterate.point.ctrl)
        if control is None:
            return

        stated = replace(problem, constraints=self.constraints)
        point = stated.point(control)
        if point.values is None:
            return

        repaired = replace(
            iterate, index=index, point=point, value=stated.value(point), gamma=0.0, status=None
        )
        margins = self.constraints.margins(point.values)
        yield BarrierIterate(iterate=repaired, mu=problem.mu, margins=margins, repaired=True)

    # ---- what the stages are made of

    def _problem(self, mu: float, constraints: ConstraintSet) -> InteriorProblem:
        """The problem with a weight of the barrier; the relaxation falls with it."""
        delta = min(MAX_RELAXATION, RELAXATION_PER_MU * mu)
        return InteriorProblem(base=self.base, constraints=constraints, mu=mu, delta=delta)

    @property
    def _problem_without_cost(self) -> InteriorProblem:
        """The barrier alone."""
        return InteriorProblem(
            base=self.base,
            constraints=self.constraints,
            mu=1.0,
            delta=MAX_RELAXATION,
            with_cost=False,
        )

    def _direction(self) -> StructuredBFGS:
        """A quasi-Newton direction without any curvature pairs yet."""
        N = len(self.base.running.desired_state) - 1
        ridge = RIDGE / N / self.constraints.control.bounds.scale**2
        return StructuredBFGS(ridge, self.basis)


def updated_tightening(
    tightening: Mapping[str, float], relative_margins: Mapping[str, float]
) -> dict[str, float]:
    """Choose how far each kind of limit is moved inwards in the next stage.

    Args:
        tightening: Share of half of the range that was held back so far, by kind.
        relative_margins: Worst margin over half of the range at the end of the stage, by kind;
            negative where violated.

    Returns:
        The new shares: larger where the limit was violated, smaller where it was well kept.
    """
    updated = {}
    for kind, margin in relative_margins.items():
        gain = TIGHTENING_GAIN if margin < 0.0 else RELEASE_GAIN
        updated[kind] = max(0.0, tightening.get(kind, 0.0) - gain * margin)

    return updated
