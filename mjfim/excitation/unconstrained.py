"""Algorithm 1 without a barrier, from a coarse to the stated sample rate.

The E-criterion is replaced by a smooth one where the smallest eigenvalues meet.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopReason
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.constraints import FORCE_KINDS, ConstraintSet
from mjfim.excitation.extended_system import ExtendedDesignProblem
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DIVERGED, DesignPoint, DesignProblem
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.search_slices import SealedState, SearchSlice, SliceLength
from mjfim.excitation.task import DesignTask
from mjfim.optimize.directions import LBFGS, ExtendedMetricDescent, MetricDescent
from mjfim.optimize.projection_operator import (
    Armijo,
    DescentState,
    Direction,
    Iterate,
    Regulator,
    optimize,
)
from mjfim.parallel import offer_result
from mjfim.records.design import HistoryRow, IterateMotion, Status, extended
from mjfim.records.events import DesignEvent

# Growth of a small deviation along the trajectory above which the projection uses feedback. It is
# measured in the best units of the state, see `amplification_in_best_units`.
FEEDBACK_THRESHOLD = 10.0

# Smallest tolerance on a coarse level. It is coarse, because the stated level refines the minimum.
COARSE_TOLERANCE = 1e-5

# Ratio of the second to the smallest eigenvalue below which the E-criterion is smoothed.
MEETING_RATIO = 1.02

# Ratio of the second to the smallest eigenvalue below which the E-criterion is smoothed after a
# descent has stalled.
STALLED_MEETING_RATIO = 1.2

# Powers of the smooth E-criterion: the first one, and the sharper one that may follow on the stated
# level.
SMOOTH_POWERS = (40.0, 160.0)

# Ratio of the smooth to the exact criterion below which the first power is accurate enough.
MAX_SMOOTHING_ERROR = 1.01

# Largest number of successive iterates along which a clamp of the model acts. With more of them the
# design needs a barrier.
MAX_CLAMPED_ITERATES = 10


def direction_for(stage: DescentLevel) -> tuple[Direction, DesignProblem]:
    """Make the descent direction that the experiment states.

    Args:
        stage: Level of the descent.

    Returns:
        The direction, and the problem whose expansions it needs.
    """
    task = stage.task
    descent = task.experiment.descent
    R = np.diag(task.control_weight) * task.dt
    Q = np.diag(task.tracking) * task.dt

    if descent.method == "lbfgs":
        return LBFGS(R), stage.problem
    if descent.psi_weight == 0.0:
        return MetricDescent(Q, R, Q), stage.problem

    # The metric of the paper also weighs the sensitivities psi, as states of the extended system.
    psi_count = len(Q) * len(task.parameters)
    psi_weights = np.full(psi_count, descent.psi_weight * task.dt)
    extended_Q = np.diag(np.concatenate([np.diag(Q), psi_weights]))
    return ExtendedMetricDescent(extended_Q, R, extended_Q), ExtendedDesignProblem.of(stage.problem)


def regulator_for(task: DesignTask) -> Regulator:
    """Make the regulator of the projection operator.

    Args:
        task: The task.

    Returns:
        A regulator with unit weights on state and control in units of their sizes, and without
        feedback where deviations grow less than `FEEDBACK_THRESHOLD`.
    """
    nx = task.space.nx
    state_sizes, control_sizes = task.sizes[:nx], task.sizes[nx:]

    # The sum over samples is a mean over time, so that the weight of the last state has no unit.
    share = 1.0 / task.samples
    last = np.diag(state_sizes**-2.0)
    return Regulator(
        Q=last * share,
        R=np.diag(control_sizes**-2.0) * share,
        terminal=last,
        feedback_threshold=FEEDBACK_THRESHOLD,
        state_sizes=state_sizes,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Progress:
    """State of a run.

    Attributes:
        result: The best result so far.
        rate: Sample rate of the last level [Hz]; 0 before the first level.
        clamped_iterates: Number of successive iterates along which a clamp of the model acts.
    """

    result: RunResult
    rate: float = 0.0
    clamped_iterates: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pass:
    """Result of one run of Algorithm 1 on one level.

    Attributes:
        progress: State of the run.
        control: (N, nu) last control, at the stated sample rate.
        eigenvalues: (s,) of the information at the last iterate, ascending.
        direction: Descent direction with the curvature that it has learnt.
        eigenvalues_meet: True where the smallest eigenvalues met, which ended Algorithm 1.
        ends_run: True where no level may follow.
        done: Number of iterations before.
        descent: State of Algorithm 1 where the slice of the search is over; None elsewhere.
    """

    progress: _Progress
    control: Array
    eigenvalues: Array
    direction: Direction
    eigenvalues_meet: bool = False
    ends_run: bool = False
    done: int = 0
    descent: DescentState[DesignPoint] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeState:
    """State of a descent without a barrier at an iterate. It can be pickled.

    Attributes:
        level: Number of the level.
        power: Power of the E-criterion on this level.
        interrupted: State of the run of Algorithm 1 on this level.
        steps: Engine steps of all levels so far.
    """

    level: int
    power: float
    interrupted: _Pass
    steps: int


@dataclass(frozen=True, kw_only=True, eq=False)
class UnconstrainedSearch:
    """Descents without a barrier from several initial controls.

    Attributes:
        levels: Levels from the coarsest to the stated one.
        budget: Time of all descents.
        constraints: Limits that a descent must not leave, or None; it ends where it does.
        steps_before: Engine steps of all levels' plants when the search began.
        length: When a slice of a descent ends.
    """

    levels: Sequence[DescentLevel]
    budget: Budget
    constraints: ConstraintSet | None
    steps_before: int
    length: SliceLength = field(default_factory=SliceLength)

    def run_all(self, starts: Iterable[InitialControl]) -> Runs:
        """Descend from one initial control after the other.

        The search ends when the budget is exhausted, or when a descent leaves the limits.

        Args:
            starts: The initial controls.

        Yields:
            Every iterate.

        Returns:
            One result for every descent that was begun.
        """
        results: list[RunResult] = []
        for start in starts:
            result = yield from self.run(start)

            # Report steps of the coarse plant only; the caller counts those of the stated plant.
            counted = sum(earlier.steps for earlier in results)
            coarse = self.levels[0].task.plant.engine_steps if len(self.levels) > 1 else counted
            results.append(replace(result, steps=coarse - counted))

            if result.left_limits or self.budget.exhausted is not None:
                break

        return results

    def run(self, start: InitialControl) -> Generator[DesignEvent, None, RunResult]:
        """Descend from one initial control through all levels.

        Where the smallest eigenvalues meet, the E-criterion is replaced by the smooth one, on this
        and all finer levels.

        Args:
            start: The initial control.

        Yields:
            Every iterate.

        Returns:
            The result; with constraints its control is the last one that kept all limits.
        """
        found = yield from self.run_slice(start)
        return found.result

    def run_slice(
        self, start: InitialControl, before: FreeState | None = None
    ) -> Generator[DesignEvent, None, SearchSlice[FreeState]]:
        """Run a part of a descent, with the result of the whole one to the last digit.

        Args:
            start: The initial control.
            before: State at the end of the part before; None to begin.

        Yields:
            Every iterate of the part.

        Returns:
            The result so far, and the state from which the next part goes on.
        """
        progress = _Progress(result=RunResult(name=start.name))
        given = start.over_horizon
        control = given
        power = np.inf if before is None else before.power
        memory: Direction | None = None
        resumed = None if before is None else before.interrupted
        resumed_at = None if resumed is None else resumed.descent

        for number in range(0 if before is None else before.level, len(self.levels)):
            repeat = True
            while repeat:
                stage = replace(self.levels[number], power=power)
                if resumed is None or resumed_at is None:
                    ended = yield from self._run_pass(stage, [control, given], progress, memory)
                else:
                    ended = yield from self._resume_pass(stage, resumed, resumed_at)
                resumed = None
                progress = ended.progress
                if ended.descent is not None:
                    state = FreeState(
                        level=number, power=power, interrupted=ended, steps=self.steps
                    )
                    return SearchSlice(result=progress.result, state=SealedState.of(state))
                if ended.ends_run:
                    return SearchSlice(result=progress.result)

                control = ended.control
                power, repeat = _next_power(stage, ended)
                memory = None if repeat else ended.direction

        # Where a clamp acts, derivatives do not exist, so that the design needs a barrier.
        result = replace(progress.result, left_limits=progress.clamped_iterates > 0)
        return SearchSlice(result=result)

    @property
    def steps(self) -> int:
        """Engine steps of all levels since the search began."""
        return sum(level.task.plant.engine_steps for level in self.levels) - self.steps_before

    def _run_pass(
        self,
        stage: DescentLevel,
        controls: Sequence[Array],
        progress: _Progress,
        memory: Direction | None,
    ) -> Generator[DesignEvent, None, _Pass]:
        """Run Algorithm 1 on one level, from the control of lowest cost.

        The given control is compared with that of the coarse level, which may cost more here.
        """
        task = stage.task
        direction, problem = _direction_with_memory(stage, memory, progress.rate)
        ended = _Pass(
            progress=progress,
            control=controls[0],
            eigenvalues=np.zeros(0),
            direction=direction,
        )

        start = _cheapest_point(task, problem, controls)
        if not np.isfinite(start.cost):
            return replace(ended, ends_run=True)

        # Iterations are counted over all levels.
        history = progress.result.history
        done = history[-1].iteration + 1 if history else 0
        begun = replace(ended, done=done)
        return (yield from self._follow(stage, begun, self._iterates(stage, problem, begun, start)))

    def _resume_pass(
        self, stage: DescentLevel, interrupted: _Pass, descent: DescentState[DesignPoint]
    ) -> Generator[DesignEvent, None, _Pass]:
        """Go on with a run of Algorithm 1, whose first iterate is known already."""
        _, problem = direction_for(stage)
        iterates = self._iterates(stage, problem, interrupted, descent.point)
        begun = replace(interrupted, descent=None)
        return (yield from self._follow(stage, begun, iterates, known=1))

    def _iterates(
        self, stage: DescentLevel, problem: DesignProblem, begun: _Pass, start: DesignPoint
    ) -> Iterator[Iterate[DesignPoint]]:
        """Iterates of Algorithm 1 from a point, or from that at which it was interrupted."""
        tolerance, max_iterations = _stopping_rule(stage.task)
        return optimize(
            problem,
            start,
            begun.direction,
            regulator_for(stage.task),
            Armijo(),
            tolerance=tolerance,
            max_iterations=max(max_iterations - begun.done, 0),
            resumed=begun.descent,
        )

    def _follow(
        self,
        stage: DescentLevel,
        begun: _Pass,
        iterates: Iterator[Iterate[DesignPoint]],
        known: int = 0,
    ) -> Generator[DesignEvent, None, _Pass]:
        """Observe Algorithm 1 until it ends, leaves the limits, or the time or slice is over.

        Args:
            stage: The level.
            begun: The run before.
            iterates: The iterates.
            known: Number of iterates that were observed already.
        """
        rate = 1.0 / stage.task.dt
        ended = begun
        for count, iterate in enumerate(iterates):
            is_new = False
            if count >= known:
                ended = _advance(ended, stage, iterate, rate)
                is_new = _is_new(ended.progress.result, begun.done + iterate.index, rate)

            if is_new:
                ended = self._check_limits(ended, stage.task)
                if ended.ends_run:
                    return ended

                ended, row = self._record(ended, stage, iterate, begun.done)
                offer_result(SearchSlice(result=ended.progress.result))
                yield DesignEvent(start=ended.progress.result.name, row=row)

                reason = self.budget.exhausted
                if reason is not None:
                    return _stop(ended, reason)
                if iterate.status is None and self.length.is_over(count):
                    return replace(ended, descent=iterate.state)

            # Where the smallest eigenvalues meet, the exact criterion has a kink, at which steps
            # become too short.
            may_continue = iterate.status is None and iterate.index > 0
            if may_continue and _eigenvalues_meet(stage, ended.eigenvalues):
                return replace(ended, eigenvalues_meet=True)

        return ended

    def _check_limits(self, ended: _Pass, task: DesignTask) -> _Pass:
        """End the run where the iterate leaves the limits.

        It also ends where a clamp of the model acts along more than `MAX_CLAMPED_ITERATES`
        successive iterates.
        """
        progress = ended.progress
        sign = np.inf
        if self.constraints is not None:
            sign = _worst_margin_sign(task, self.constraints, ended.control)

        clamped = progress.clamped_iterates + 1 if sign == 0.0 else 0
        if sign < 0.0 or clamped > MAX_CLAMPED_ITERATES:
            left = replace(progress.result, left_limits=True)
            return replace(ended, progress=replace(progress, result=left), ends_run=True)

        # Only a control along which no clamp acts may be continued with a barrier.
        result = progress.result
        if not clamped:
            result = replace(result, control=ended.control)

        return replace(ended, progress=replace(progress, result=result, clamped_iterates=clamped))

    def _record(
        self, ended: _Pass, stage: DescentLevel, iterate: Iterate[DesignPoint], done: int
    ) -> tuple[_Pass, HistoryRow]:
        """Append an iterate to the history."""
        point = _exact_point(stage, iterate.point)
        criterion = point.criterion

        row = HistoryRow(
            iteration=done + iterate.index,
            cost=point.cost,
            criterion=np.inf if criterion is None else criterion.value,
            min_eigenvalue=0.0 if criterion is None else float(criterion.eigenvalues[0]),
            slope=iterate.slope,
            gamma=iterate.gamma,
            seconds=self.budget.seconds_used,
            steps=self.steps,
            rate=1.0 / stage.task.dt,
            motion=IterateMotion.of(point.trajectory),
        )
        result = ended.progress.result
        result = replace(result, history=extended(result.history, [row]))
        return replace(ended, progress=replace(ended.progress, result=result)), row


def _stopping_rule(task: DesignTask) -> tuple[float, int]:
    """Tolerance and largest number of iterations; a coarse level may take half of them."""
    descent = task.experiment.descent
    if task.system.variant.sample_factor == 1:
        return descent.tolerance, descent.max_iterations

    return max(descent.tolerance, COARSE_TOLERANCE), descent.max_iterations // 2


def _is_new(result: RunResult, iteration: int, rate: float) -> bool:
    """Check whether an iteration at a sample rate [Hz] is not in the history yet.

    Algorithm 1 yields its last iterate twice, the second time with its status.
    """
    if not result.history:
        return True

    last = result.history[-1]
    return last.iteration != iteration or last.rate != rate


def _direction_with_memory(
    stage: DescentLevel, memory: Direction | None, rate: float
) -> tuple[Direction, DesignProblem]:
    """Make the direction and the problem of a level.

    Args:
        stage: The level.
        memory: Direction of a coarser level, whose curvature is taken over; None without one.
        rate: Sample rate of the coarser level [Hz]; 0 without one.
    """
    direction, problem = direction_for(stage)
    if isinstance(memory, LBFGS) and rate:
        task = stage.task
        factor = round(1.0 / (task.dt * rate))
        direction = memory.refined(np.diag(task.control_weight) * task.dt, factor)

    return direction, problem


def _cheapest_point(
    task: DesignTask, problem: DesignProblem, controls: Sequence[Array]
) -> DesignPoint:
    """The point of lowest cost among controls at the stated rate; `DIVERGED` if all diverge."""
    points = []
    distinct = {id(control): control for control in controls}
    for control in distinct.values():
        try:
            trajectory = task.plant.simulate(task.theta, task.averaged(control))
            points.append(problem.point(trajectory))
        except SimulationDivergedError:
            continue

    return min(points, key=lambda point: point.cost, default=DIVERGED)


def _exact_point(stage: DescentLevel, point: DesignPoint) -> DesignPoint:
    """The point with the cost of the exact criterion, where the smooth one is minimised."""
    if np.isinf(stage.power):
        return point

    return DescentLevel(stage.task, stage.basis).problem.reevaluated(point)


def _advance(
    ended: _Pass, stage: DescentLevel, iterate: Iterate[DesignPoint], rate: float
) -> _Pass:
    """Take an iterate into the state of the run."""
    task = stage.task
    trajectory, criterion = iterate.point.trajectory, iterate.point.criterion
    if trajectory is None or criterion is None:
        raise SimulationDivergedError("an iterate of Algorithm 1 diverged")

    # A run without a status has not ended, so that it counts as interrupted if it is stopped here.
    status = iterate.status or Status.INTERRUPTED
    if status is Status.CONVERGED and np.isfinite(stage.power):
        status = Status.SMOOTHED
    result = replace(ended.progress.result, slope=iterate.slope, status=status)

    # Only points at the stated rate count as results.
    if task.system.variant.sample_factor == 1:
        point = _exact_point(stage, iterate.point)
        if result.point is None or point.cost <= result.cost:
            result = replace(result, point=point, cost=point.cost)

    return replace(
        ended,
        progress=replace(ended.progress, result=result, rate=rate),
        control=np.repeat(trajectory.ctrl, task.system.variant.sample_factor, axis=0),
        eigenvalues=criterion.eigenvalues,
    )


def _stop(ended: _Pass, reason: StopReason) -> _Pass:
    """End a run whose budget is exhausted."""
    result = ended.progress.result
    if result.status is Status.INTERRUPTED and reason is not StopReason.REQUESTED:
        result = replace(result, status=Status.MAX_ITERATIONS)

    return replace(ended, progress=replace(ended.progress, result=result), ends_run=True)


def _worst_margin_sign(task: DesignTask, constraints: ConstraintSet, control: Array) -> float:
    """Compute the sign of the smallest margin over all engine steps of a level.

    Args:
        task: The task on the level.
        constraints: The limits.
        control: (N, nu) control at the stated sample rate [u-unit].

    Returns:
        -1 where a limit is violated, 0 where a force is clamped at its limit, else 1.
    """
    observed = task.plant.observe(task.theta, task.averaged(control), constraints.observations)
    if observed is None:
        return -1.0

    values = constraints.evaluate(*observed, slopes=False)
    if not constraints.is_feasible(values):
        return -1.0

    margins = constraints.margins(values)
    is_clamped = any(margins.get(kind, 1.0) <= 0.0 for kind in FORCE_KINDS)
    return 0.0 if is_clamped else 1.0


def _eigenvalues_meet(stage: DescentLevel, eigenvalues: Array) -> bool:
    """Check whether the smallest eigenvalues nearly meet with the exact E-criterion."""
    is_exact = stage.task.experiment.cost.criterion == "E" and np.isinf(stage.power)
    if not is_exact or len(eigenvalues) < 2:
        return False

    return bool(eigenvalues[1] < MEETING_RATIO * eigenvalues[0])


def _next_power(stage: DescentLevel, ended: _Pass) -> tuple[float, bool]:
    """Choose the power of the E-criterion after a run of Algorithm 1.

    Args:
        stage: The level with its power so far.
        ended: Result of the run on this level.

    Returns:
        The power for this and all later levels, and whether this level has to be repeated with it.
    """
    values = ended.eigenvalues
    power = stage.power
    if stage.task.experiment.cost.criterion != "E" or len(values) < 2:
        return power, False

    # The exact criterion is smoothed where eigenvalues meet, or where the descent stalls near that.
    if np.isinf(power):
        stalled = ended.progress.result.status is Status.STALLED
        close = bool(values[1] < STALLED_MEETING_RATIO * values[0])
        meet = ended.eigenvalues_meet or (stalled and close)
        return (SMOOTH_POWERS[0], True) if meet else (power, False)

    # At the stated rate, a smooth criterion that is too far from the exact one is sharpened once.
    error = float(np.sum((values[0] / values) ** power) ** (1.0 / power))
    is_stated_rate = stage.task.system.variant.sample_factor == 1
    if error > MAX_SMOOTHING_ERROR and power < SMOOTH_POWERS[-1] and is_stated_rate:
        return SMOOTH_POWERS[-1], True

    return power, False
