"""Descents on one level: Algorithm 1 without a barrier, and stages of the interior-point method.

Both yield a `Step` for each iterate, so that whoever asks for the next one decides when it ends.
Under hard limits a stage minimises `log J + mu B`. B is a barrier of the limits; its weight mu
falls from stage to stage.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.limits.constraints import FORCE_KINDS
from mjfim.excitation.objective import DIVERGED, DesignPoint, DesignProblem
from mjfim.excitation.search.inside import largest_share
from mjfim.excitation.search.interior_problem import InteriorPoint, InteriorProblem, values_of
from mjfim.excitation.search.levels import DescentLevel, regulator_for
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import independent_curves
from mjfim.optimize.directions import LBFGS, MetricDescent, StructuredBFGS
from mjfim.optimize.projection_operator import Direction, Iterate, Regulator, optimize
from mjfim.parallel.budget import Budget
from mjfim.records.design import Status

# Smallest tolerance on a coarse level. It is coarse, because the stated level refines the minimum.
COARSE_TOLERANCE = 1e-5

# Ratio of the second to the smallest eigenvalue below which the E-criterion is smoothed, and that
# after a descent has stalled.
MEETING_RATIO = 1.02
STALLED_MEETING_RATIO = 1.2

# Powers of the smooth E-criterion: the first one, and the sharper one that may follow on the stated
# level. Under hard limits several of the smallest eigenvalues meet, so that it is always smooth.
SMOOTH_POWERS = (40.0, 160.0)

# Ratio of the smooth to the exact criterion below which the first power is accurate enough.
MAX_SMOOTHING_ERROR = 1.01

# Largest number of successive iterates along which a clamp of the model acts. With more of them the
# design needs a barrier.
MAX_CLAMPED_ITERATES = 10

# Growth of a small deviation along the trajectory above which the projection uses feedback under
# hard limits. It is larger than without, because steps are shorter here.
FEEDBACK_THRESHOLD = 100.0

# Weight of an eigenvector, relative to the largest weight, below which the gradient leaves it out.
MIN_EIGENVECTOR_WEIGHT = 3e-3

# Ratio of the barrier weights mu of two successive stages.
MU_FACTOR = 3.0

# Largest relaxation delta of the barrier.
MAX_RELAXATION = 0.1

# Number of iterates over which a stage has to lower the merit by some times mu; the last stage may
# take twice as many iterations as the others.
WINDOW = 8
SETTLED = 2.0
STAGE_ITERATIONS = 40

# Violation of a limit, relative to half of its range, up to which the relaxed barrier makes a
# control feasible without steering.
MAX_START_VIOLATION = 1.0

# Largest number of iterations that steer a control inside the limits, and the slope of the barrier,
# relative to its size, at which steering has converged.
STEERING_ITERATIONS = 60
STEERING_TOLERANCE = 1e-6

# Weight of a control in the metric: this number over the number of samples and over the square of
# half of the control's range.
RIDGE = 0.03


@record
class Barrier:
    """Weights mu of the barrier, one per stage, and when its descent has converged.

    Attributes:
        first: Weight of the first stage.
        last: Weight of the last stage.
        relaxation: Ratio of the relaxation delta to the weight.
        tolerance: Slope of the merit at which the last stage has converged.
        follows_curvature: Directions follow the curvature of a sharp barrier along a step.
    """

    first: float = 0.1
    last: float = 1e-4
    relaxation: float = 0.3
    tolerance: float = 1e-5
    follows_curvature: bool = False

    @property
    def weights(self) -> list[float]:
        """All weights mu, a geometric sequence with a ratio of about `MU_FACTOR`."""
        count = max(round(np.log(self.first / self.last) / np.log(MU_FACTOR)), 1)
        weights: list[float] = np.geomspace(self.first, self.last, count + 1).tolist()
        return weights


@record
class Step:
    """An iterate of a descent.

    Attributes:
        iterate: The iterate of Algorithm 1.
        point: Its trajectory with the exact criterion; None where only the barrier is minimised.
        control: (N, nu) control at the stated sample rate [u-unit].
        mu: Weight of the barrier; 0 without one.
        margins: Smallest relative margin of the limits of each kind.
        is_inside: All limits hold on this level.
        has_left: A descent without a barrier has left the limits.
    """

    iterate: Iterate[Any]
    point: DesignPoint | None
    control: Array
    mu: float = 0.0
    margins: Mapping[str, float] = field(default_factory=dict)
    is_inside: bool = True
    has_left: bool = False


@record
class Ground:
    """The level on which descents work, over one repetition of the control.

    Attributes:
        level: The level, on the plant without the clamps that limits make unreachable.
        curves: (N, M) curves at the stated sample rate of which controls are sums; None where each
            sample is free.
        repeats: How often the control is played, one after the other.
    """

    level: DescentLevel
    curves: Array | None = None
    repeats: int = 1

    @classmethod
    def of(cls, level: DescentLevel, curves: Array | None = None, repeats: int = 1) -> Ground:
        """The ground of a level; a limited bandwidth requires splines."""
        task = level.task
        if repeats > 1:
            task = task.with_horizon(task.horizon / repeats)
            level = replace(level, task=task)
        if curves is None:
            curves = task.bandwidth_basis(task.stated_times)
        return cls(level=level, curves=curves, repeats=repeats)

    @property
    def task(self) -> DesignTask:
        """The task on this level."""
        return self.level.task

    def exact(self, point: DesignPoint) -> DesignPoint:
        """A point with the exact criterion of all repetitions."""
        return self.level.problem.reevaluated(_repeated(point, self.repeats))

    def at_stated_rate(self, control: Array) -> Array:
        """Convert a control of this level to the stated sample rate."""
        factor = self.task.system.variant.sample_factor
        if factor == 1 or self.curves is None:
            return np.repeat(control, factor, axis=0)
        averaged = self.task.averaged(self.curves)
        coefficients = np.linalg.lstsq(averaged, control - self.task.centre)[0]
        return np.asarray(self.task.centre + self.curves @ coefficients)

    # ---- without a barrier

    def descend_freely(
        self,
        controls: Sequence[Array],
        memory: FreeMemory,
        done: int,
        budget: Budget,
        *,
        is_limited: bool,
    ) -> Iterator[Step]:
        """Run Algorithm 1 from the control of lowest cost.

        The exact E-criterion has a kink where eigenvalues meet, so that it is smoothed there.

        Args:
            controls: (N, nu) controls at the stated sample rate [u-unit].
            memory: What a coarser level has learnt; it gets what this one learns.
            done: Number of iterations on coarser levels.
            budget: Ends a line search.
            is_limited: The limits are checked.
        """
        rate, clamped = 1.0 / self.task.dt, 0
        while True:
            level = replace(self.level, power=memory.power)
            direction, problem = _direction_for(level)
            if isinstance(memory.direction, LBFGS):
                R = np.diag(self.task.control_weight) * self.task.dt
                direction = memory.direction.refined(R, round(rate / memory.rate))

            status, eigenvalues = None, np.zeros(0)
            for iterate in self._free_iterates(problem, controls, direction, done, budget):
                step = self._free_step(iterate, level.power)
                if is_limited:
                    step, clamped = self._watched(step, clamped)
                yield step
                status, controls = iterate.status, [step.control]
                eigenvalues = step.iterate.point.criterion.eigenvalues
                if status is None and iterate.index and _meet(level, eigenvalues, MEETING_RATIO):
                    break

            done += iterate.index + 1 if len(eigenvalues) else 0
            memory.power = _next_power(level, eigenvalues, status)
            memory.direction, memory.rate = None, rate
            if memory.power == level.power or budget.exhausted is not None:
                memory.direction = direction
                return

    def _free_iterates(
        self,
        problem: DesignProblem,
        controls: Sequence[Array],
        direction: Direction,
        done: int,
        budget: Budget,
    ) -> Iterator[Iterate[DesignPoint]]:
        """Iterates of Algorithm 1 on this level; none where all controls diverge."""
        descent = self.task.experiment.descent
        tolerance, most = descent.tolerance, descent.max_iterations
        if self.task.system.variant.is_coarse:
            tolerance, most = max(tolerance, COARSE_TOLERANCE), most // 2
        start = DIVERGED
        for control in {id(each): each for each in controls}.values():
            try:
                moved = self.task.plant.simulate(self.task.theta, self.task.averaged(control))
            except SimulationDivergedError:
                continue
            start = min(start, problem.point(moved), key=lambda point: point.cost)
        if not np.isfinite(start.cost):
            return
        yield from optimize(
            problem,
            start,
            direction,
            regulator_for(self.task),
            budget=budget,
            tolerance=tolerance,
            max_iterations=max(most - done, 0),
        )

    def _free_step(self, iterate: Iterate[DesignPoint], power: float) -> Step:
        """An iterate of a descent without a barrier."""
        point = iterate.point
        if point.trajectory is None or point.criterion is None:
            raise SimulationDivergedError("an iterate of Algorithm 1 diverged")
        if iterate.status is Status.CONVERGED and np.isfinite(power):
            iterate = replace(iterate, status=Status.SMOOTHED)
        factor = self.task.system.variant.sample_factor
        return Step(
            iterate=iterate,
            point=point if np.isinf(power) else self.exact(point),
            control=np.repeat(point.trajectory.ctrl, factor, axis=0),
        )

    def _watched(self, step: Step, clamped: int) -> tuple[Step, int]:
        """An iterate, and whether it has left the limits over all engine steps.

        Derivatives do not exist where a clamp of the model acts. clamped: number of iterates before
        this one, one after the other, along which a clamp acts; it comes back with this one.
        """
        values = self.level.values(step.iterate.point.trajectory.ctrl)
        if values is None or not self.level.constraints.is_feasible(values):
            return replace(step, is_inside=False, has_left=True), clamped
        margins = self.level.constraints.margins(values)
        is_clamped = any(margins.get(kind, 1.0) <= 0.0 for kind in FORCE_KINDS)
        clamped = clamped + 1 if is_clamped else 0
        has_left = clamped > MAX_CLAMPED_ITERATES
        return replace(step, is_inside=not is_clamped, has_left=has_left), clamped

    # ---- with a barrier

    def begin(self, control: Array, budget: Budget, *, strictly: bool = False) -> Array | None:
        """Find a control of this level from which the barrier can start.

        A small violation is removed by the relaxed barrier itself. A larger one is scaled away,
        and where no share is inside, the barrier alone steers the control inside the limits.

        Args:
            control: (N, nu) control at the stated sample rate [u-unit].
            budget: Ends the search.
            strictly: A small violation is removed before as well.

        Returns:
            The control; None where none inside was found.
        """
        fitted = self._fitted(self.task.averaged(control))
        if not strictly and self.is_near(fitted):
            return fitted

        for centre in map(self._fitted, self.task.centres):

            def keeps(share: float, centre: Array = centre) -> bool:
                """Check whether a share of the control is strictly inside."""
                values = self.level.values(centre + share * (fitted - centre))
                return values is not None and self.level.constraints.is_feasible(
                    values, strictly=True
                )

            share = largest_share(keeps, budget)
            if share is not None:
                return np.asarray(centre + share * (fitted - centre))
        return self._steered(fitted, budget)

    def _steered(self, control: Array, budget: Budget) -> Array | None:
        """Minimise the barrier alone until all limits hold strictly."""
        problem = self.problem(Barrier(), 1.0, {}, with_cost=False)
        start = problem.point(control)
        if start.values is None:
            return None
        iterates = optimize(
            problem,
            start,
            self.direction(),
            self._regulator,
            budget=budget,
            tolerance=STEERING_TOLERANCE,
            max_iterations=STEERING_ITERATIONS,
        )
        for iterate in iterates:
            found = iterate.point
            if self.level.constraints.is_feasible(values_of(found), strictly=True):
                return found.ctrl
            if budget.exhausted is not None:
                break
        return found.ctrl if self.is_near(found.ctrl) else None

    def problem(
        self, barrier: Barrier, mu: float, tightening: Mapping[str, float], with_cost: bool = True
    ) -> InteriorProblem:
        """The problem of a stage: `log J + mu B` within limits that are moved inwards."""
        return InteriorProblem(
            base=self._smooth,
            constraints=self.level.constraints.tightened(tightening),
            mu=mu,
            delta=min(MAX_RELAXATION, barrier.relaxation * mu),
            with_cost=with_cost,
            follows_curvature=barrier.follows_curvature,
        )

    def stage(
        self,
        barrier: Barrier,
        problem: InteriorProblem,
        point: InteriorPoint,
        direction: StructuredBFGS,
        max_iterations: int,
        budget: Budget,
    ) -> Iterator[Step]:
        """Minimise with one weight of the barrier until it converges or stagnates.

        Args:
            barrier: The barrier of all stages.
            problem: The problem of this stage.
            point: Where it begins.
            direction: The direction, which all stages share: its curvature pairs do not depend on
                the weight.
            max_iterations: Largest number of iterations.
            budget: Ends a line search.
        """
        is_last = problem.mu <= barrier.last
        merits = []
        iterates = optimize(
            problem,
            problem.reevaluate(point),
            direction,
            self._regulator,
            budget=budget,
            tolerance=min(barrier.tolerance, Barrier.tolerance),
            max_iterations=min(max_iterations, STAGE_ITERATIONS * (1 + is_last)),
        )
        for iterate in iterates:
            step = self._limited_step(iterate, problem.mu)
            status = Status.CONVERGED if iterate.slope <= barrier.tolerance else iterate.status
            if not (is_last and step.is_inside):
                status = None
            yield replace(step, iterate=replace(iterate, status=status))
            if status is Status.CONVERGED:
                return

            # A stage that stagnates ends: the next, sharper barrier improves more.
            merits.append(iterate.value)
            if is_last or len(merits) <= WINDOW:
                continue
            if merits[-1 - WINDOW] - merits[-1] < SETTLED * problem.mu:
                return

    def _limited_step(self, iterate: Iterate[InteriorPoint], mu: float) -> Step:
        """An iterate of a stage."""
        values, point = values_of(iterate.point), iterate.point.point
        return Step(
            iterate=iterate,
            point=None if point is None else self.exact(point),
            control=self.at_stated_rate(iterate.point.ctrl),
            mu=mu,
            margins=self.level.constraints.relative_margins(values),
            is_inside=self.level.constraints.is_feasible(values),
        )

    def direction(self) -> StructuredBFGS:
        """A quasi-Newton direction under hard limits, without any curvature pairs yet."""
        ridge = RIDGE / self.task.samples / self.level.constraints.control.bounds.scale**2
        return StructuredBFGS(ridge, self._basis)

    @cached_property
    def _basis(self) -> Array | None:
        """Independent curves on the samples of this level."""
        return None if self.curves is None else independent_curves(self.task.averaged(self.curves))

    @cached_property
    def _regulator(self) -> Regulator:
        """Regulator of the projection; with curves there is none, because it leaves their span."""
        threshold = FEEDBACK_THRESHOLD if self._basis is None else np.inf
        return replace(regulator_for(self.task), feedback_threshold=threshold)

    @cached_property
    def _smooth(self) -> DesignProblem:
        """The cost that is minimised under hard limits."""
        is_kinked = self.task.experiment.cost.criterion == "E"
        level = replace(self.level, power=SMOOTH_POWERS[0] if is_kinked else np.inf)
        information = level.problem.information
        smooth = replace(information, negligible_weight=MIN_EIGENVECTOR_WEIGHT)
        return replace(level.problem, information=smooth)

    def _fitted(self, control: Array) -> Array:
        """The nearest control, (N, nu) or (nu,), that the curves can represent."""
        basis, centre = self._basis, self.task.centre
        if basis is None:
            return control
        control = np.broadcast_to(control, (len(basis), len(centre)))
        return np.asarray(centre + basis @ np.linalg.lstsq(basis, control - centre)[0])

    def is_near(self, control: Array) -> bool:
        """Check whether the relaxed barrier can make a control feasible.

        The end of a motion depends on all of it, and gets inside without help.
        """
        values = self.level.values(control)
        if values is None:
            return False
        margins = self.level.constraints.relative_margins(values)
        inner = [margin for kind, margin in margins.items() if not kind.startswith("end_")]
        return min(inner, default=0.0) > -MAX_START_VIOLATION


@dataclass(kw_only=True, eq=False)
class FreeMemory:
    """Data that a descent without a barrier leaves for the next level.

    Attributes:
        direction: Direction with its memory; None without one.
        rate: Sample rate of its level [Hz].
        power: Power of the smooth E-criterion; infinite for the exact one.
    """

    direction: Direction | None = None
    rate: float = 0.0
    power: float = np.inf


def _direction_for(level: DescentLevel) -> tuple[Direction, DesignProblem]:
    """Make the descent direction that the experiment states, and the problem that it needs."""
    task = level.task
    descent = task.experiment.descent
    R = np.diag(task.control_weight) * task.dt
    Q = np.diag(task.tracking) * task.dt
    if descent.method == "lbfgs":
        return LBFGS(R), level.problem
    if descent.psi_weight == 0.0:
        return MetricDescent(Q, R, Q), level.problem

    # The metric of the paper also weighs the sensitivities psi, as states of the extended system.
    psi_weights = np.full(len(Q) * len(task.parameters), descent.psi_weight * task.dt)
    extended_Q = np.diag(np.concatenate([np.diag(Q), psi_weights]))
    direction = MetricDescent(extended_Q, R, extended_Q, weighs_psi=True)
    return direction, replace(level.problem, extends=True)


def _meet(level: DescentLevel, eigenvalues: Array, ratio: float) -> bool:
    """Check whether the smallest eigenvalues nearly meet with the exact E-criterion."""
    is_exact = level.task.experiment.cost.criterion == "E" and np.isinf(level.power)
    if not is_exact or len(eigenvalues) < 2:
        return False
    return bool(eigenvalues[1] < ratio * eigenvalues[0])


def _next_power(level: DescentLevel, eigenvalues: Array, status: Status | None) -> float:
    """Choose the power of the E-criterion after a descent, which is repeated with a new one."""
    power = level.power
    if np.isinf(power):
        ratios = {None: MEETING_RATIO, Status.STALLED: STALLED_MEETING_RATIO}
        meet = status in ratios and _meet(level, eigenvalues, ratios[status])
        return SMOOTH_POWERS[0] if meet else power

    # At the stated rate, a smooth criterion that is too far from the exact one is sharpened once.
    if level.task.system.variant.is_coarse or not len(eigenvalues):
        return power
    error = float(np.sum((eigenvalues[0] / eigenvalues) ** power) ** (1.0 / power))
    return SMOOTH_POWERS[-1] if error > MAX_SMOOTHING_ERROR else power


def _repeated(point: DesignPoint, count: int) -> DesignPoint:
    """A point with the information of several repetitions of its trajectory."""
    if count == 1 or point.information is None:
        return point
    others = tuple(_repeated(other, count) for other in point.others)
    return replace(point, information=count * point.information, others=others)
