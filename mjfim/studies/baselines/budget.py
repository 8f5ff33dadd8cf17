"""The common ground of everything that competes with a design: an experiment on its lifted plant, a budget, the best so far."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.interior_point import (
    MAX_RELAXATION,
    InteriorPoint,
    InteriorProblem,
    values_of,
)
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import Stage
from mjfim.experiment.schema import Experiment
from mjfim.parallel import stopped
from mjfim.records.trajectory import Trajectory

SMALLEST = 0.03  # scale that is tried, over the largest
SCALES = 6  # that are tried at once


@dataclass(frozen=True, eq=False)
class Job:
    """A baseline to be run. method: its key;  steps: MuJoCo's, at most;  part: (i, n), the i-th of n side by side

    combinations: (t, s) identifiable ones, or None;  added: (p, p) information of other experiments, or None
    """

    experiment: Experiment
    method: str
    seconds: float
    steps: float = np.inf
    seed: int = 0
    part: tuple[int, int] = (0, 1)
    combinations: Array | None = None
    added: Array | None = None
    threads: int | None = None


@dataclass
class Attempt:
    """What a baseline has found. control: (N, nu) the best that keeps all limits, else what came nearest, or None

    cost: J, infinite outside;  share: worst margin over half of its range;  found_by: which of its tries
    """

    control: Array | None = None
    cost: float = np.inf
    share: float = -np.inf
    found_by: str = ""
    seconds: float = 0.0
    steps: int = 0


Monitor = Callable[[float, Attempt], None]  # share of the budget that is used, the best so far


class Spent(Exception):
    """The budget, or the share of it that something had, is used up."""


@dataclass(eq=False)
class Arena:
    """One experiment, a budget, and the best control so far.

    holds: whether limits hold at all;  exact: the cost by which all are judged
    grace: looks at the budget before a share of it counts
    """

    job: Job
    monitor: Monitor | None = None
    attempt: Attempt = field(default_factory=Attempt)

    def __post_init__(self) -> None:
        self.clock, self.grace = time.perf_counter(), 0
        plain = DesignTask.resolve(
            self.job.experiment, threads=self.job.threads, added_information=self.job.added
        )
        self.holds = plain.is_limited
        self.task = plain.relaxed() if self.holds else plain
        self.begun = self.task.plant.engine_steps
        self.constraints, self.centre = constraint_set_of(self.task), self.task.centre
        self.exact = Stage(self.task, self.job.combinations).problem
        self.rng = np.random.default_rng((self.job.seed, *self.job.part))

    @property
    def used(self) -> float:
        """Share of the budget."""
        taken = self.task.plant.engine_steps - self.begun
        return max((time.perf_counter() - self.clock) / self.job.seconds, taken / self.job.steps)

    def require(self, limit: float = 1.0) -> None:
        """Raise Spent where the budget is used up, or that share of it and the grace."""
        if self.monitor is not None:
            self.monitor(self.used, self.attempt)
        self.grace -= 1
        if stopped() or self.used >= (1.0 if self.grace >= 0 else min(limit, 1.0)):
            raise Spent

    def finished(self) -> Attempt:
        """The attempt with what it took."""
        self.attempt.seconds = time.perf_counter() - self.clock
        self.attempt.steps = self.task.plant.engine_steps - self.begun
        return self.attempt

    @cached_property
    def looking(self) -> InteriorProblem:
        """Evaluates points by the exact cost."""
        return InteriorProblem(self.exact, self.constraints, 1.0, MAX_RELAXATION)

    def inside(self, point: InteriorPoint) -> bool:
        """Whether it keeps all limits at every engine step."""
        return not self.holds or self.constraints.is_feasible(values_of(point))

    def offer(self, point: InteriorPoint, name: str = "") -> float:
        """Keep a point's control if it is the best so far; its cost J, infinite outside the limits."""
        if point.values is None or point.point is None:
            return np.inf
        cost = self.exact.reevaluated(point.point).cost if self.inside(point) else np.inf
        self.keep(
            point.ctrl,
            cost,
            min(self.constraints.relative_margins(point.values).values(), default=np.inf),
            name,
        )
        return cost

    def keep(self, control: Array, cost: float, share: float, name: str = "") -> None:
        """The same by its numbers."""
        best = self.attempt
        if cost < best.cost or (not np.isfinite(best.cost) and share > best.share):
            best.control, best.cost, best.share, best.found_by = (
                np.array(control),
                cost,
                share,
                name,
            )

    def largest(self, swing: Array, most: float = 1.0) -> float:
        """The largest scale found, up to most, at which the centre plus a swing: (N, nu) keeps all limits; 0 for none."""
        if not self.holds:
            return most
        scales = np.geomspace(most, SMALLEST * most, SCALES)
        for _ in range(3):
            first = self._first(swing, scales)
            if first is not None:
                break
            scales = SMALLEST * scales
        else:
            return 0.0
        for _ in range(2):
            if first is None or first == 0:
                break
            scales = np.geomspace(scales[first - 1], scales[first], SCALES)
            first = self._first(swing, scales[1:-1])
            first = SCALES - 1 if first is None else first + 1
        return float(scales[first or 0])

    def _first(self, swing: Array, scales: Array) -> int | None:
        """Index of the first of falling scales at which all limits hold."""
        plant, theta = self.task.plant, self.task.theta
        ctrl = self.centre + scales[:, None, None] * swing
        start = np.repeat(plant.initial_state(theta)[None], len(scales), axis=0)
        out = plant.simulator.rollout(
            [plant.model(theta)], start, ctrl, self.constraints.observations
        )
        for i in range(len(scales)):
            if not out.finite[i] or out.observed is None:
                continue
            trajectory, observed = plant.trajectory(out.states[i], ctrl[i]), out.observed[i]
            share = _share(replace(self.constraints, clearance=None), trajectory, observed)
            if (
                share >= 0.0 and self.constraints.clearance is not None
            ):  # distances take long, and are looked at last
                share = _share(self.constraints, trajectory, observed)
            if share >= 0.0:
                return i
            self.keep(ctrl[i], np.inf, share)
        return None


def _share(constraints: ConstraintSet, trajectory: Trajectory, observed: Array) -> float:
    """The worst margin over half of its range."""
    return min(
        constraints.relative_margins(
            constraints.evaluate(trajectory, observed, slopes=False)
        ).values(),
        default=np.inf,
    )
