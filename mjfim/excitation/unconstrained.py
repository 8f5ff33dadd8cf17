"""Algorithm 1 on an experiment without hard limits: levels of sample rate, and a smooth criterion where eigenvalues meet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.constraints import ConstraintSet
from mjfim.excitation.extended_system import ExtendedDesignProblem
from mjfim.excitation.objective import DIVERGED, DesignPoint, DesignProblem
from mjfim.excitation.task import DesignTask
from mjfim.optimize.directions import LBFGS, ExtendedMetricDescent, MetricDescent
from mjfim.optimize.projection_operator import Armijo, Direction, Iterate, Regulator, optimize
from mjfim.records.design import HistoryRow, Status


@dataclass(frozen=True, eq=False)
class Stage:
    """A level of the descent: the experiment at one sample rate and the criterion as it is minimised there.

    basis: identifiable combinations, or None;  power: of the smooth E-criterion, infinite for 1/lambda_min itself
    """

    task: DesignTask
    basis: Array | None
    power: float = np.inf

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost."""
        problem = self.task.problem
        information = replace(problem.information, basis=self.basis, power=self.power)
        return replace(
            problem,
            information=information,
            forward_differences_only=self.task.system.variant.sample_factor > 1,
        )


@dataclass
class Run:
    """One start on its way. point: the last iterate at the stated sample rate;  control: (N, nu) the last of any level.

    rate: sample rate of the level that it is on [Hz];  steps: MuJoCo steps taken on other plants than the experiment's
    outside: it was left because an iterate left the limits;  inside: no limit is known to be missed
    """

    name: str
    point: DesignPoint | None = None
    control: Array | None = None
    status: Status = Status.STALLED
    slope: float = np.inf
    history: tuple[HistoryRow, ...] = ()
    rate: float = 0.0
    steps: int = 0
    outside: bool = False
    inside: bool = True

    @property
    def cost(self) -> float:
        """J reached."""
        return np.inf if self.point is None else self.point.cost


def direction_for(stage: Stage) -> tuple[Direction, DesignProblem]:
    """The descent direction that the experiment asks for, and the problem that feeds it."""
    task = stage.task
    d, dt = task.experiment.descent, task.dt
    R, Q = np.diag(task.control_weight) * dt, np.diag(task.tracking) * dt
    if d.method == "lbfgs":
        return LBFGS(R), stage.problem
    if d.psi_weight == 0.0:
        return MetricDescent(Q, R, Q), stage.problem
    nx, p = len(Q), len(task.parameters)
    wide = np.diag(np.concatenate([np.diag(Q), np.full(nx * p, d.psi_weight * dt)]))
    return ExtendedMetricDescent(wide, R, wide), ExtendedDesignProblem.of(stage.problem)


CALM = 10.0


def regulator_for(task: DesignTask) -> Regulator:
    """Unit weights on state and control along the trajectory; no feedback where the plant is calm without."""
    Q, R = np.eye(task.space.nx) * task.dt, np.eye(len(task.controls)) * task.dt
    return Regulator(Q=Q, R=R, terminal=Q / task.dt, feedback_threshold=CALM)


AUTO = 4  # how many times longer the samples of a coarse level are, where the experiment leaves it open
COARSEST = 50  # samples of a coarse level, at least
BORNE = 0.05  # relative change of the initial cost that it may make


def coarse_level(task: DesignTask, first: DesignPoint, basis: Array | None) -> DesignTask | None:
    """The coarse level, where the experiment wants it and the model bears it (the initial cost agrees within 5 %).

    Raises ExperimentError where a stated factor does not divide the samples.
    """
    d = task.experiment.descent
    factor = AUTO if d.coarse == "auto" else d.coarse
    if factor == 1 or d.method != "lbfgs":
        return None
    if d.coarse != "auto" and task.samples % factor:
        valid = ", ".join(str(k) for k in range(1, 17) if task.samples % k == 0)
        raise ExperimentError(
            f"{task.experiment.source}: descent.coarse: {factor} does not divide the {task.samples} samples; "
            f"valid for example: {valid}"
        )
    if task.samples % factor or task.samples < COARSEST * factor:
        return None
    coarse = task.coarser(factor)
    return coarse if borne(Stage(coarse, basis), first, task.problem.size(first), BORNE) else None


def borne(coarse: Stage, first: DesignPoint, size: float, share: float) -> bool:
    """Whether the initial cost of a coarse level is that of the first point, up to a share of its size."""
    try:
        there = coarse.problem.point(coarse.task.initial)
    except SimulationDivergedError:
        return False
    return abs(there.cost - first.cost) <= share * size


COARSE_TOLERANCE = 1e-5
MEETING = 1.02  # second over smallest eigenvalue at which E-optimality turns smooth
NEAR = 1.2  # the same for a descent that stalled
POWERS = (40.0, 160.0)
CLOSE = 1.01  # smooth over exact criterion that is good enough
CLAMPED = (
    10  # iterates in a row that may rest on a clamp of the model before a barrier keeps them off it
)


def descend(
    stages: Sequence[Stage], control: Array, run: Run, constraints: ConstraintSet | None = None
) -> Iterator[HistoryRow]:
    """Follow Algorithm 1 from one control through the levels, coarse to fine, keeping `run` up to date.

    With a constraint set it ends where an iterate leaves the limits, or several in a row rest on a clamp; its control is
    the last feasible one.
    Where the smallest eigenvalues meet, E-optimality goes on with the smooth criterion, on this level and all finer ones.
    """
    power, memory, given, clamped = np.inf, None, control, 0
    for level in stages:
        while True:
            stage = replace(level, power=power)
            pass_ = _Pass(stage, (control, given), run, memory)
            for row in pass_.rows():
                margin = (
                    np.inf
                    if constraints is None
                    else _margin(level.task, constraints, pass_.control)
                )
                clamped = clamped + 1 if margin == 0.0 else 0
                if margin < 0.0 or clamped > CLAMPED:
                    run.outside = True
                    return
                if not clamped:
                    run.control = pass_.control
                yield row
            if pass_.failed:
                return
            control = pass_.control
            power, again = _sharper(stage, pass_)
            memory = None if again else pass_.direction
            if not again:
                break
    run.outside = clamped > 0


def _margin(task: DesignTask, constraints: ConstraintSet, control: Array) -> float:
    """Sign of the worst margin at any engine step of the level, for a control at the stated rate; 0 where a force is clamped."""
    watched = task.plant.observe(task.theta, task.averaged(control), constraints.observations)
    if watched is None:
        return -1.0
    values = constraints.evaluate(*watched, slopes=False)
    if not constraints.is_feasible(values):
        return -1.0
    margins = constraints.margins(values)
    return float(all(margins.get(kind, 1.0) > 0.0 for kind in ("force", "joint_force")))


def _sharper(stage: Stage, done: _Pass) -> tuple[float, bool]:
    """Power of the E-criterion from here on, and whether this level has to be done again with it."""
    values, power = done.eigenvalues, stage.power
    if stage.task.experiment.cost.criterion != "E" or len(values) < 2:
        return power, False
    if np.isinf(power):
        meet = done.met or (done.run.status is Status.STALLED and values[1] < NEAR * values[0])
        return (POWERS[0], True) if meet else (power, False)
    gap = float(np.sum((values[0] / values) ** power) ** (1.0 / power))
    if gap > CLOSE and power < POWERS[-1] and stage.task.system.variant.sample_factor == 1:
        return POWERS[-1], True
    return power, False


class _Pass:
    """One run of Algorithm 1 on one stage, from the better of some controls: a coarse level may lead astray.

    met: it was left because the smallest eigenvalues meet
    """

    def __init__(
        self, stage: Stage, controls: Sequence[Array], run: Run, memory: Direction | None
    ) -> None:
        self.stage, self.controls, self.run = stage, controls, run
        self.control = controls[0]
        self.direction, self.problem = direction_for(stage)
        if isinstance(memory, LBFGS) and run.rate:
            task = stage.task
            factor = round(1.0 / (task.dt * run.rate))
            self.direction = memory.refined(np.diag(task.control_weight) * task.dt, factor)
        self.met = self.failed = False
        self.eigenvalues = np.zeros(0)

    def rows(self) -> Iterator[HistoryRow]:
        """Every iterate as a row of the history."""
        level, run = self.stage.task, self.run
        d, fine, rate = (
            level.experiment.descent,
            level.system.variant.sample_factor == 1,
            1.0 / level.dt,
        )
        start = self._start()
        if not np.isfinite(start.cost):
            self.failed = True
            return
        exact = Stage(level, self.stage.basis).problem
        tolerance = d.tolerance if fine else max(d.tolerance, COARSE_TOLERANCE)
        done = run.history[-1].iteration + 1 if run.history else 0
        budget = max((d.max_iterations if fine else d.max_iterations // 2) - done, 0)
        run.rate = rate
        for iterate in optimize(
            self.problem,
            start,
            self.direction,
            regulator_for(level),
            Armijo(),
            tolerance=tolerance,
            max_iterations=budget,
        ):
            trajectory, criterion = iterate.point.trajectory, iterate.point.criterion
            if trajectory is None or criterion is None:
                raise SimulationDivergedError("an iterate of Algorithm 1 diverged")
            self.control = np.repeat(trajectory.ctrl, level.system.variant.sample_factor, axis=0)
            self.eigenvalues = criterion.eigenvalues
            point = (
                iterate.point if np.isinf(self.stage.power) else exact.reevaluated(iterate.point)
            )
            run.slope, run.status = iterate.slope, iterate.status or Status.INTERRUPTED
            if run.status is Status.CONVERGED and np.isfinite(self.stage.power):
                run.status = Status.SMOOTHED
            if fine and (run.point is None or point.cost <= run.point.cost):
                run.point = point
            last = run.history[-1] if run.history else None
            if last is None or last.iteration != done + iterate.index or last.rate != rate:
                yield _row(replace(iterate, point=point, value=point.cost), done, rate)
            if self._meets() and iterate.status is None and iterate.index > 0:
                self.met = True
                return

    def _start(self) -> DesignPoint:
        """The cheapest point of the controls; infinite where all diverge."""
        level, points = self.stage.task, []
        for control in {id(c): c for c in self.controls}.values():
            try:
                points.append(
                    self.problem.point(level.plant.simulate(level.theta, level.averaged(control)))
                )
            except SimulationDivergedError:
                continue
        return min(points, key=lambda point: point.cost, default=DIVERGED)

    def _meets(self) -> bool:
        """The smallest eigenvalues are about to cross while the exact E-criterion is descended."""
        values = self.eigenvalues
        wanted = self.stage.task.experiment.cost.criterion == "E" and np.isinf(self.stage.power)
        return bool(wanted and len(values) > 1 and values[1] < MEETING * values[0])


def _row(iterate: Iterate[DesignPoint], done: int, rate: float) -> HistoryRow:
    criterion = iterate.point.criterion
    value, smallest = (
        (np.inf, 0.0) if criterion is None else (criterion.value, float(criterion.eigenvalues[0]))
    )
    return HistoryRow(
        iteration=done + iterate.index,
        cost=iterate.value,
        criterion=value,
        min_eigenvalue=smallest,
        slope=iterate.slope,
        gamma=iterate.gamma,
        seconds=0.0,
        steps=0,
        rate=rate,
    )
