"""Descents under hard limits from one start, as tasks that may run anywhere."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import (
    BarrierIterate,
    BarrierSchedule,
    InteriorPointMethod,
    values_of,
)
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import Stage, regulator_for
from mjfim.experiment.schema import Experiment
from mjfim.model.variants import RELAXED, ModelVariant
from mjfim.parallel import stopped
from mjfim.records.design import HistoryRow, Status
from mjfim.signals import independent_curves

POWER = (
    40.0  # of the smooth E-criterion: several of the smallest eigenvalues meet under hard limits
)
CALM = 100.0  # growth of deviations from which on feedback is worth the time: steps are short under hard limits
FAINT = (
    3e-3  # weight of an eigenvector, over the largest, below which it is left out of the gradient
)


@dataclass(frozen=True, eq=False)
class ConstrainedSearch:
    """A descent under hard limits. seconds: time it may take;  combinations: (t, s) identifiable ones, or None

    added_information: (p, p) of other experiments, or None;  variant: of the plant;  held: shares held back
    begun: when the design began, by `time.time`
    """

    experiment: Experiment
    start: InitialControl
    schedule: BarrierSchedule
    budget: int
    seconds: float = np.inf
    combinations: Array | None = None
    added_information: Array | None = None
    variant: ModelVariant = RELAXED
    threads: int | None = None
    held: Mapping[str, float] = field(default_factory=dict)
    begun: float = field(default_factory=time.time)


@dataclass
class Chase:
    """Where a search has come to. control: (N, nu) the best inside all limits, else the last;  cost: J there, infinite outside"""

    name: str
    control: Array | None = None
    cost: float = np.inf
    status: Status = Status.INTERRUPTED
    slope: float = np.inf
    history: tuple[HistoryRow, ...] = ()
    steps: int = 0


def pursue(
    search: ConstrainedSearch, chase: Chase, task: DesignTask | None = None
) -> Iterator[HistoryRow]:
    """Every iterate of a search, keeping `chase` up to date. task: of the experiment on its lifted plant, if there is one"""
    clock = time.perf_counter()
    repeats = search.start.repeats
    if task is None:
        task = DesignTask.resolve(
            search.experiment,
            threads=search.threads,
            added_information=search.added_information,
            variant=search.variant,
        )
    if repeats > 1:
        task = task.with_horizon(task.horizon / repeats)
    begun = task.plant.engine_steps
    exact, smooth = Stage(task, search.combinations).problem, smoothed(task, search.combinations)
    fine = (
        search.start.basis
        if search.start.basis is not None
        else bandwidth_basis(task, task.stated_times)
    )
    basis = None if fine is None else independent_curves(task.averaged(fine))
    regulate = replace(regulator_for(task), feedback_threshold=CALM if basis is None else np.inf)
    constraints = constraint_set_of(task).tightened(search.held)
    barrier_weights = InteriorPointMethod(
        smooth, constraints, task.centre, basis, regulate, search.schedule
    )
    control = task.averaged(search.start.control)
    for stage_iterate in _sound(
        barrier_weights.run(control, search.budget, clock + search.seconds), chase
    ):
        own = stage_iterate.iterate.point
        point = None if own.point is None else exact.reevaluated(_repeated(own.point, repeats))
        chase.slope, chase.status = (
            stage_iterate.iterate.slope,
            stage_iterate.status or Status.INTERRUPTED,
        )
        chase.steps = task.plant.engine_steps - begun
        cost = np.inf if point is None or not stage_iterate.feasible else point.cost
        if cost <= chase.cost:
            chase.control, chase.cost = np.tile(_stated(task, own.ctrl, fine), (repeats, 1)), cost
        if stage_iterate.repaired:
            continue
        row = _row(stage_iterate, point, 1.0 / task.dt, constraints)
        row = replace(row, seconds=time.time() - search.begun, steps=chase.steps)
        chase.history += (row,)
        yield row
    if chase.status is Status.INTERRUPTED and chase.history:  # the schedule asked for are done
        chase.status = Status.MAX_ITERATIONS
    if not np.isfinite(chase.cost):
        chase.status = Status.INFEASIBLE


def _sound(schedule: Iterator[BarrierIterate], chase: Chase) -> Iterator[BarrierIterate]:
    """As far as numbers go: a start that leads beyond must not end the others."""
    try:
        yield from schedule
    except (SimulationDivergedError, np.linalg.LinAlgError):
        chase.status = Status.STALLED


def _repeated(point: DesignPoint, count: int) -> DesignPoint:
    """A point as if its trajectory were measured so many times."""
    if count == 1 or point.information is None:
        return point
    others = tuple(_repeated(other, count) for other in point.others)
    return replace(point, information=count * point.information, others=others)


def smoothed(task: DesignTask, combinations: Array | None) -> DesignProblem:
    """The cost as it is descended under hard limits: smooth where it is E's, without faint directions."""
    power = POWER if task.experiment.cost.criterion == "E" else np.inf
    smooth = Stage(task, combinations, power).problem
    return replace(smooth, information=replace(smooth.information, negligible_weight=FAINT))


def _stated(task: DesignTask, ctrl: Array, fine: Array | None) -> Array:
    """A level's control on the stated grid of samples, made of the curves fine: (N * coarsen, M) there, or of anything."""
    if task.system.variant.sample_factor == 1 or fine is None:
        return np.repeat(ctrl, task.system.variant.sample_factor, axis=0)
    return np.asarray(
        task.centre + fine @ np.linalg.lstsq(task.averaged(fine), ctrl - task.centre)[0]
    )


def _row(
    stage_iterate: BarrierIterate,
    point: DesignPoint | None,
    rate: float,
    constraints: ConstraintSet,
) -> HistoryRow:
    criterion = None if point is None else point.criterion
    value, smallest = (
        (np.inf, 0.0) if criterion is None else (criterion.value, float(criterion.eigenvalues[0]))
    )
    cost, i = (np.inf if point is None else point.cost), stage_iterate.iterate
    margin = min(constraints.relative_margins(values_of(i.point)).values(), default=np.nan)
    return HistoryRow(
        iteration=i.index,
        cost=cost,
        criterion=value,
        min_eigenvalue=smallest,
        slope=i.slope,
        gamma=i.gamma,
        seconds=0.0,
        steps=0,
        rate=rate,
        mu=stage_iterate.mu,
        margin=margin,
    )


def perform(search: ConstrainedSearch) -> Chase:
    """A search from beginning to end, for an executor; Ctrl-C, or its pool's word, ends it with the best so far."""
    chase = Chase(search.start.name)
    try:
        with threadpool_limits(1, user_api="blas"):
            for _ in pursue(search, chase):
                if stopped():
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        chase.status = Status.INTERRUPTED
    return chase
