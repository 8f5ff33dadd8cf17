"""Interior-point method for designs under hard limits.

It minimises `log J + mu B` in stages with falling barrier weight mu. A control that violates the
limits by far is first steered inside them, without the cost. A stage whose result violates a limit
tightens the limits of the next stage.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopReason
from mjfim.excitation.barrier_state import BarrierState, BetweenStages, WithinStage
from mjfim.excitation.constraints import ConstraintSet
from mjfim.excitation.feasibility import shrink_about_each
from mjfim.excitation.interior_problem import InteriorPoint, InteriorProblem, values_of
from mjfim.excitation.objective import DesignProblem
from mjfim.optimize.projection_operator import Armijo, Iterate, Regulator, optimize
from mjfim.optimize.structured_bfgs import StructuredBFGS
from mjfim.records.design import Status

# Ratio of the barrier weights mu of two successive stages.
MU_FACTOR = 3.0

# Ratio of the relaxation delta of the barrier to its weight mu.
RELAXATION_PER_MU = 0.3

# Largest relaxation delta of the barrier.
MAX_RELAXATION = 0.1

# Largest weight mu of the barrier with which a violated limit is tightened in the next stage.
TIGHTENING_MU = 4e-3

# A violation at the end of a stage tightens the limit by this many times the violation.
TIGHTENING_GAIN = 1.2

# A tightened limit that holds with a margin is released by this share of the margin.
RELEASE_GAIN = 0.5

# A stage may take this many times its equal share of the time that is left.
TIME_SHARE_FACTOR = 1.5

# Largest number of repetitions of the last stage after results that violate a limit.
MAX_REPEATED_STAGES = 3

# Share of the budget after which a run without a feasible iterate continues from a shrunk control.
PATIENCE_OUTSIDE = 0.5

# Violation of a limit, relative to half of its range, up to which the relaxed barrier makes a
# control feasible without steering.
MAX_START_VIOLATION = 1.0

# Largest number of iterations that steer a control inside the limits.
MAX_STEERING_ITERATIONS = 60

# Largest number of such iterations where a shrunk control is feasible already.
MAX_STEERING_TRIAL = 20

# Slope of the barrier, relative to its size, at which steering has converged.
STEERING_TOLERANCE = 1e-6

# Weight of a control in the metric: this number over the number of samples and over the square of
# half of the control's range.
RIDGE = 0.03


@dataclass(frozen=True, kw_only=True)
class BarrierSchedule:
    """Weights mu of the barrier, one per stage, and when a stage ends.

    Attributes:
        first: Largest weight.
        last: Smallest weight.
        patience: Largest number of iterations of a stage; twice this number in the last stage.
        settled: A stage ends when the merit falls by less than this times mu over `window`
            iterations.
        window: Number of iterations over which progress is measured.
        tolerance: Slope, relative to the size of the merit, at which the last stage has converged.
        relaxation: Ratio of the relaxation delta of the barrier to its weight mu. Limits whose
            multiplier is larger than twice the inverse of it are violated by the minima.
        follows_curvature: Whether directions may follow the curvature of a sharp barrier along a
            step. That saves iterations near the optimum, but takes time that grows with the
            numbers of states and limits.
    """

    first: float = 0.1
    last: float = 1e-4
    patience: int = 40
    settled: float = 2.0
    window: int = 8
    tolerance: float = 1e-5
    relaxation: float = RELAXATION_PER_MU
    follows_curvature: bool = False

    def barrier_weights(self) -> list[float]:
        """All weights mu, a geometric sequence with a ratio of about `MU_FACTOR`."""
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
        repaired: True where this is the iterate before, shrunk until all limits hold.
        state: State from which the run can go on; None where it cannot be interrupted.
    """

    iterate: Iterate[InteriorPoint]
    mu: float
    margins: dict[str, float]
    status: Status | None = None
    repaired: bool = False
    state: BarrierState | None = None

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
        begun: State of the run at its beginning.
        problem: The problem to minimise, with the tightened limits of this stage.
        budget: Time of the stage.
        total: Time and iterations of the whole run.
        max_iterations: Largest number of iterations of the stage.
        is_last: True for the stage with the smallest mu and its repetitions.
    """

    begun: BetweenStages
    problem: InteriorProblem
    budget: Budget
    total: Budget
    max_iterations: int
    is_last: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _StageResult:
    """Result of one barrier stage.

    Attributes:
        iterate: Last iterate of the stage, numbered within the stage.
        is_feasible: True where all limits hold along it.
        was_feasible: True where all limits hold along any iterate of the stage.
        converged: True where the run has converged at it, so that no stage may follow.
        stalled: True where no step lowers the merit any more, so that no stage may follow.
    """

    iterate: Iterate[InteriorPoint]
    is_feasible: bool
    was_feasible: bool
    converged: bool
    stalled: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class InteriorPointMethod:
    """Method that minimises a cost under hard limits, in stages with falling barrier weight.

    Attributes:
        base: The cost on the plant without clamps.
        constraints: The limits.
        centre: (nu,) control about which controls vary [u-unit].
        other_centres: Further controls, (nu,) each, towards which an infeasible control is shrunk
            where shrinking towards `centre` does not help [u-unit].
        basis: (N, M) curves whose sums are the allowed deviations of the control from its centre;
            None where the control is free.
        regulator: Gain of the projection operator.
        schedule: Weights of the barrier, and when a stage ends.
        inside_first: Steer the control inside all limits before the cost is minimised, however
            little it violates them.
    """

    base: DesignProblem
    constraints: ConstraintSet
    centre: Array
    basis: Array | None
    regulator: Regulator
    schedule: BarrierSchedule = BarrierSchedule()
    other_centres: tuple[Array, ...] = ()
    inside_first: bool = False

    def run(self, control: Array, budget: Budget) -> Iterator[BarrierIterate]:
        """Run the method from a control.

        Args:
            control: (N, nu) control, which may be infeasible [u-unit].
            budget: Time and iterations of the run. Iterations that steer the control inside the
                limits do not count.

        Yields:
            Every iterate.
        """
        first = yield from self._find_first_control(control, budget)

        # A run that has to begin inside ends where no control inside was found.
        is_inside = first.control is not None and self._is_near_feasible(first.control, 0.0)
        if self.inside_first and not is_inside:
            return

        if first.control is not None and not budget.stop.requested:
            yield from self._minimize(first.control, budget, first.iterations)

    @property
    def tolerance(self) -> float:
        """Slope at which a stage has converged.

        It is below a coarser stated tolerance: a smaller slope also means a smaller violation.
        """
        return min(self.schedule.tolerance, BarrierSchedule.tolerance)

    def resume(self, state: BarrierState, budget: Budget) -> Iterator[BarrierIterate]:
        """Go on from an iterate, to the last digit as if the run had not been interrupted.

        Args:
            state: State of the iterate.
            budget: Time and iterations of the run, of which a part is used.

        Yields:
            Every later iterate.
        """
        return self._run_stages(state.begun, budget, state.within)

    def shrink_inside(self, control: Array) -> Array | None:
        """Shrink a control about one of the centres until all limits hold strictly.

        Args:
            control: (N, nu) control [u-unit].

        Returns:
            (N, nu) the control, shrunk about the first centre for which a factor makes it feasible;
            None where there is none.
        """
        problem = self._problem_without_cost

        def keep_feasible(candidate: Array) -> Array | None:
            """Return the candidate where it is strictly feasible."""
            values = problem.point(candidate).values
            if values is None or not self.constraints.is_feasible(values, strictly=True):
                return None
            return np.asarray(candidate)

        centres = (self.centre, *map(self._fit_to_basis, self.other_centres))
        return next(shrink_about_each(control, centres, keep_feasible), None)

    # ---- the first control

    def _find_first_control(
        self, control: Array, budget: Budget
    ) -> Generator[BarrierIterate, None, _FirstControl]:
        """Find a control from which the barrier stages can start.

        It is the given control where that is nearly feasible; else it is shrunk or steered inside
        the limits, whichever has the lower merit.
        """
        fitted = self._fit_to_basis(control)

        # A small violation is removed by the relaxed barrier.
        if self._is_near_feasible(fitted, 0.0 if self.inside_first else MAX_START_VIOLATION):
            return _FirstControl(control=fitted, iterations=0)

        shrunk = self.shrink_inside(fitted)

        # Steer the control inside; only a few iterations where the shrunk control is feasible.
        longest = MAX_STEERING_ITERATIONS if shrunk is None else MAX_STEERING_TRIAL
        if not self.inside_first:
            longest = int(min(budget.max_iterations, longest))
        steered: BarrierIterate | None = None
        for steered in self._steer_inside(fitted, longest, budget):
            yield steered

        if steered is None:
            return _FirstControl(control=shrunk, iterations=0)

        steered_control = steered.iterate.point.ctrl
        iterations = steered.iterate.index + 1
        if shrunk is None:
            return _FirstControl(control=steered_control, iterations=iterations)

        # Where both are feasible, take the one of lower merit.
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
        """The nearest control, (N, nu) or (nu,), that the basis can represent."""
        if self.basis is None:
            return control

        control = np.broadcast_to(control, (len(self.basis), len(self.centre)))
        coefficients = np.linalg.lstsq(self.basis, control - self.centre)[0]
        return np.asarray(self.centre + self.basis @ coefficients)

    def _is_near_feasible(self, control: Array, violation: float) -> bool:
        """Check whether the relaxed barrier can make a control feasible.

        Args:
            control: (N, nu) control [u-unit].
            violation: Largest violation that is accepted, relative to half of the range.
        """
        values = self._problem_without_cost.point(control).values
        if values is None:
            return False

        return nearly_inside(self.constraints.relative_margins(values), violation)

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
        """Run all stages from a control."""
        point = self._problem(self.schedule.barrier_weights()[0], self.constraints).point(control)
        if point.values is None:
            # The simulation diverges when the parameters change slightly.
            return

        # All stages share one direction, because its curvature pairs do not depend on mu.
        begun = BetweenStages(point=point, direction=self._direction(), first_index=first_index)
        yield from self._run_stages(begun, budget)

    def _run_stages(
        self, begun: BetweenStages, budget: Budget, within: WithinStage | None = None
    ) -> Iterator[BarrierIterate]:
        """Run the stages with falling mu.

        The last one is repeated until it has converged or the budget is used up, but only a few
        times while its result is infeasible.

        Args:
            begun: State at the beginning of the first stage.
            budget: Time and iterations of all stages.
            within: State within the first stage; None to begin it.
        """
        while True:
            stage = self._stage(begun, budget, within)
            ended = yield from self._run_stage(stage, within)
            within = None
            if ended.converged:
                return

            first_index = begun.first_index + ended.iterate.index
            budget.spend(iterations=ended.iterate.index)
            reason = budget.exhausted

            # Repair an infeasible result, since no better one may follow. After Ctrl-C this would
            # take too long.
            repaired = None
            if not ended.is_feasible and reason is not StopReason.REQUESTED:
                repaired = yield from self._repair(stage.problem, ended.iterate, first_index)

            repeats = begun.infeasible_repeats + (stage.is_last and not ended.is_feasible)
            if reason is not None or ended.stalled or repeats > MAX_REPEATED_STAGES:
                return

            begun = replace(
                begun,
                point=ended.iterate.point,
                number=begun.number + 1,
                first_index=first_index,
                was_feasible=begun.was_feasible or ended.was_feasible,
                infeasible_repeats=repeats,
            )

            # Use the rest of the budget inside the limits where no iterate has been there.
            is_late = budget.used >= PATIENCE_OUTSIDE
            if repaired is not None and is_late and not begun.was_feasible:
                begun = replace(begun, point=repaired, direction=self._direction())

            # Tighten violated limits, so that the result of the next stage keeps them.
            if stage.problem.mu <= TIGHTENING_MU:
                margins = self.constraints.relative_margins(values_of(begun.point))
                begun = replace(begun, tightening=updated_tightening(begun.tightening, margins))

    def _stage(self, begun: BetweenStages, budget: Budget, within: WithinStage | None) -> _Stage:
        """Settings of a stage: its share of the time and of the iterations that are left."""
        weights = self.schedule.barrier_weights()
        mu = weights[min(begun.number, len(weights) - 1)]
        stages_left = max(len(weights) - begun.number, 1)
        is_last = stages_left == 1

        # A stage may take somewhat more than an equal share of the time, the last one all of it.
        share = 1.0 if is_last else min(TIME_SHARE_FACTOR / stages_left, 1.0)

        patience = self.schedule.patience * (2 if is_last else 1)
        max_iterations = int(min(patience, np.ceil(budget.iterations_left / stages_left)))

        return _Stage(
            begun=begun,
            problem=self._problem(mu, self.constraints.tightened(begun.tightening)),
            budget=budget.share(share) if within is None else within.budget.resumed(budget.stop),
            total=budget,
            max_iterations=max_iterations if within is None else within.max_iterations,
            is_last=is_last,
        )

    def _run_stage(
        self, stage: _Stage, within: WithinStage | None
    ) -> Generator[BarrierIterate, None, _StageResult]:
        """Minimise with one mu until convergence, stagnation, or the end of the stage's budget.

        Args:
            stage: The stage.
            within: State from which it goes on, whose iterate is not yielded again; None to begin.
        """
        schedule = self.schedule
        problem = stage.problem
        values = [] if within is None else list(within.values)
        was_feasible = within is not None and within.was_feasible

        for iterate in self._iterates(stage, within):
            margins = self.constraints.margins(values_of(iterate.point))
            is_feasible = self.constraints.is_feasible(values_of(iterate.point))

            # A status ends the run only in the last stage, and only where the stated limits hold.
            status = Status.CONVERGED if iterate.slope <= schedule.tolerance else iterate.status
            if not (stage.is_last and is_feasible):
                status = None

            if within is None:
                yield BarrierIterate(
                    iterate=replace(iterate, index=stage.begun.first_index + iterate.index),
                    mu=problem.mu,
                    margins=margins,
                    status=status,
                    state=_state_at(stage, iterate, values, was_feasible),
                )
            within = None
            was_feasible = was_feasible or is_feasible

            if status is Status.CONVERGED:
                break

            # A stage that stagnates ends: the next, sharper barrier improves more.
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
            was_feasible=was_feasible,
            converged=status is Status.CONVERGED,
            stalled=status is Status.STALLED,
        )

    def _iterates(
        self, stage: _Stage, within: WithinStage | None
    ) -> Iterator[Iterate[InteriorPoint]]:
        """Iterates of a stage; the first one is that of the state from which it goes on."""
        begun = stage.begun
        start = stage.problem.reevaluate(begun.point) if within is None else begun.point

        return optimize(
            stage.problem,
            start,
            begun.direction,
            self.regulator,
            Armijo(),
            tolerance=self.tolerance,
            max_iterations=stage.max_iterations,
            resumed=None if within is None else within.descent,
        )

    def _repair(
        self, problem: InteriorProblem, iterate: Iterate[InteriorPoint], index: int
    ) -> Generator[BarrierIterate, None, InteriorPoint | None]:
        """Shrink an infeasible iterate until all limits hold; yield and return it if possible."""
        control = self.shrink_inside(iterate.point.ctrl)
        if control is None:
            return None

        stated = replace(problem, constraints=self.constraints)
        point = stated.point(control)
        if point.values is None:
            return None

        repaired = replace(
            iterate, index=index, point=point, value=stated.value(point), gamma=0.0, status=None
        )
        margins = self.constraints.margins(point.values)
        yield BarrierIterate(iterate=repaired, mu=problem.mu, margins=margins, repaired=True)
        return point

    # ---- problems and direction of the stages

    def _problem(self, mu: float, constraints: ConstraintSet) -> InteriorProblem:
        """The problem with barrier weight mu; the relaxation delta is proportional to mu."""
        delta = min(MAX_RELAXATION, self.schedule.relaxation * mu)
        return InteriorProblem(
            base=self.base,
            constraints=constraints,
            mu=mu,
            delta=delta,
            follows_curvature=self.schedule.follows_curvature,
        )

    @property
    def _problem_without_cost(self) -> InteriorProblem:
        """The problem of steering a control inside the limits: the barrier without a cost."""
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


def _state_at(
    stage: _Stage, iterate: Iterate[InteriorPoint], values: list[float], was_feasible: bool
) -> BarrierState | None:
    """State at an iterate of a stage, after the merits of its iterates before; None without one."""
    if iterate.state is None:
        return None

    within = WithinStage(
        descent=iterate.state,
        budget=stage.budget.paused(),
        max_iterations=stage.max_iterations,
        values=tuple(values),
        was_feasible=was_feasible,
    )
    return BarrierState(begun=stage.begun, within=within, budget=stage.total.paused())


def nearly_inside(relative_margins: Mapping[str, float], violation: float) -> bool:
    """Check whether all limits hold, apart from a violation that the barrier can remove.

    Constraints on the final state are ignored where a violation is accepted: their tolerances are
    narrow, so that even a usable control misses them by many times the tolerance.

    Args:
        relative_margins: Smallest margin relative to half of the range, by kind; negative where
            violated.
        violation: Largest violation that is accepted, relative to half of the range.
    """
    return all(
        margin > -violation
        for kind, margin in relative_margins.items()
        if violation == 0.0 or not kind.startswith("end_")
    )


def updated_tightening(
    tightening: Mapping[str, float], relative_margins: Mapping[str, float]
) -> dict[str, float]:
    """Choose how far the limits are moved inwards in the next stage.

    Args:
        tightening: Distance by which limits are moved so far, relative to half of the range, by
            kind.
        relative_margins: Smallest margin relative to half of the range, by kind; negative where
            violated.

    Returns:
        The new distances: larger where the limit is violated, smaller where it holds with a margin.
    """
    updated = {}
    for kind, margin in relative_margins.items():
        gain = TIGHTENING_GAIN if margin < 0.0 else RELEASE_GAIN
        updated[kind] = max(0.0, tightening.get(kind, 0.0) - gain * margin)

    return updated
