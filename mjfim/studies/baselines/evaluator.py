"""Evaluation of controls for the baselines.

Controls are evaluated under the constraints of an experiment and within a budget; the best one is
kept.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, PausedBudget, StopToken
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.interior_point import MAX_RELAXATION
from mjfim.excitation.interior_problem import InteriorPoint, InteriorProblem, values_of
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.trajectory import Trajectory

# Ratio of the smallest to the largest scale in one batch of scales.
SCALE_RANGE = 0.03

# Number of scales that are simulated at once.
SCALES_PER_BATCH = 6

# Number of batches, each with smaller scales, that are tried before a deviation is given up.
COARSE_BATCHES = 3

# Number of batches that refine the largest feasible scale.
REFINING_BATCHES = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class BaselineSearch:
    """Order for one search by a baseline.

    It can be pickled, so that a worker process can run it.

    Attributes:
        experiment: Experiment for which a control is searched.
        method: Key of the baseline.
        seconds: Time that the search may take [s].
        steps: MuJoCo steps that it may take.
        seed: Seed of its random numbers.
        part: (i, n): this is part i, from 0, of n parts of the search that run side by side.
        combinations: (t, s) identifiable combinations of the t wanted parameters, or None where all
            are identifiable.
        added_information: (p, p) information of other experiments [1 / theta-unit^2], or None.
        threads: Threads of MuJoCo; None for all cores.
    """

    experiment: Experiment
    method: str
    seconds: float
    steps: float = np.inf
    seed: int = 0
    part: tuple[int, int] = (0, 1)
    combinations: Array | None = None
    added_information: Array | None = None
    threads: int | None = None

    def resolved(self) -> DesignTask:
        """The task of the experiment."""
        return DesignTask.resolve(
            self.experiment, threads=self.threads, added_information=self.added_information
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchResult:
    """The best control that a search has found.

    Attributes:
        control: (N, nu) the cheapest feasible control, else the one that is nearest to feasible;
            None before the first one.
        cost: J of the control; infinite where it is infeasible.
        margin: Its smallest relative margin; negative where it is infeasible.
        found_by: Name of the attempt that found it.
        seconds: Time that the search took [s].
        steps: MuJoCo steps that it took.
    """

    control: Array | None = None
    cost: float = np.inf
    margin: float = -np.inf
    found_by: str = ""
    seconds: float = 0.0
    steps: int = 0

    def is_improved_by(self, cost: float, margin: float) -> bool:
        """Whether another control is better than this one.

        Args:
            cost: J of the other control; infinite where it is infeasible.
            margin: Its smallest relative margin.

        Returns:
            True where it costs less, or where neither is feasible and its margin is larger.
        """
        return cost < self.cost or (not np.isfinite(self.cost) and margin > self.margin)


# Smallest number of checks of the budget in a slice, so that also slow evaluations lead further.
CHECKS_OF_SLICE = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchState:
    """State from which a search goes on after a slice. It can be pickled.

    Attributes:
        best: The best control so far.
        budget: What is used of its budget.
        rng: Random numbers.
        method: State of the method.
    """

    best: SearchResult
    budget: PausedBudget
    rng: np.random.Generator
    method: Any


# Called during a search with the used share of the budget and the best result so far.
SearchCallback = Callable[[float, SearchResult], None]


@dataclass(eq=False, kw_only=True)
class ControlEvaluator:
    """Evaluates controls of one experiment within a budget, and keeps the best one.

    Attributes:
        search: The order.
        callback: Called whenever the budget is checked, or None.
        stop: Ends the search early.
        stated: The task of the experiment, if it is resolved already.
        before: Where a slice of the search begins; None for its begin.
        slice_seconds: Time after which the slice ends [s]; infinite for the whole search.
        best: The best control so far.
        method: State of the method where a slice ends; None at the begin.
        protected_checks: Number of checks of the budget for which only the whole budget counts, not
            a share of it.
        task: The task of the experiment; under hard limits, on the plant without clamps.
        constraints: Its constraints.
        centre: (nu,) control about which deviations are scaled [unit of the actuator].
        exact: The cost by which controls are compared.
        rng: Random numbers of this part of the search.
        budget: Time and MuJoCo steps of the search.
    """

    search: BaselineSearch
    callback: SearchCallback | None = None
    stop: StopToken | None = None
    stated: DesignTask | None = None
    before: SearchState | None = None
    slice_seconds: float = np.inf
    best: SearchResult = field(default_factory=SearchResult)
    method: Any = None
    protected_checks: int = 0

    def __post_init__(self) -> None:
        order = self.search
        self.budget = Budget(seconds=order.seconds, steps=order.steps, stop=self.stop)

        stated = order.resolved() if self.stated is None else self.stated
        self.is_limited = stated.is_limited
        self.task = stated.relaxed() if self.is_limited else stated
        self._steps_before = self.task.plant.engine_steps

        self.constraints = constraint_set_of(self.task)
        self.centre = self.task.centre
        self.exact = DescentLevel(self.task, order.combinations).problem
        self.rng = np.random.default_rng((order.seed, *order.part))
        self._checks = 0
        self._slice_end = self.budget.seconds_used + self.slice_seconds
        if self.before is not None:
            self._go_on(self.before)

    def _go_on(self, before: SearchState) -> None:
        """Begin where the slice before has ended."""
        stop = StopToken() if self.stop is None else self.stop
        self.budget = before.budget.resumed(stop)
        self._steps_before -= int(before.budget.steps)
        self._slice_end = self.budget.seconds_used + self.slice_seconds
        self.best = before.best

        # A slice that is lost on a thread is done again from the same state.
        self.method, self.rng = copy.deepcopy((before.method, before.rng))

    def state(self) -> SearchState | None:
        """Return the state from which the search goes on; None where it has ended."""
        self._count_steps()
        if self.budget.exhausted is not None or not self.slice_is_over:
            return None
        return SearchState(
            best=self.best, budget=self.budget.paused(), rng=self.rng, method=self.method
        )

    @property
    def slice_is_over(self) -> bool:
        """True where the slice ends, although the budget may not be exhausted."""
        return self._checks >= CHECKS_OF_SLICE and self.budget.seconds_used >= self._slice_end

    @property
    def used(self) -> float:
        """Used share of the budget; 1 or more when it is exhausted."""
        self._count_steps()
        return self.budget.used

    def exhausted(self, limit: float = 1.0) -> bool:
        """Report the progress and check whether the search has to end.

        Args:
            limit: Share of the budget after which the current part of the search ends.

        Returns:
            True where the search has to end.
        """
        if self.callback is not None:
            self.callback(self.used, self.best)
        self.protected_checks -= 1
        self._checks += 1

        self._count_steps()
        if self.budget.exhausted or self.slice_is_over:
            return True
        return self.protected_checks < 0 and self.budget.used >= limit

    def _count_steps(self) -> None:
        """Update the number of MuJoCo steps in the budget."""
        taken = self.task.plant.engine_steps - self._steps_before
        self.budget.spend(steps=taken - self.budget.steps)

    def result(self) -> SearchResult:
        """The best control, with the time and the steps that the search has taken."""
        steps = self.task.plant.engine_steps - self._steps_before
        return replace(self.best, seconds=self.budget.seconds_used, steps=steps)

    @cached_property
    def problem(self) -> InteriorProblem:
        """Evaluates the exact cost and the constraints of a control."""
        return InteriorProblem(
            base=self.exact, constraints=self.constraints, mu=1.0, delta=MAX_RELAXATION
        )

    def is_feasible(self, point: InteriorPoint) -> bool:
        """True where all constraints hold at every engine step."""
        return not self.is_limited or self.constraints.is_feasible(values_of(point))

    def evaluate(self, point: InteriorPoint, name: str = "") -> float:
        """Keep the control of a point if it is the best so far.

        Args:
            point: Point with a cost.
            name: Name of the attempt that found it.

        Returns:
            The cost J; infinite where a constraint is violated or the simulation diverges.
        """
        if point.values is None or point.point is None:
            return np.inf

        cost = np.inf
        if self.is_feasible(point):
            cost = self.exact.reevaluated(point.point).cost

        margins = self.constraints.relative_margins(point.values).values()
        self.record(point.ctrl, cost, min(margins, default=np.inf), name)
        return cost

    def record(self, control: Array, cost: float, margin: float, name: str = "") -> None:
        """Keep a control if it is the best so far.

        Args:
            control: (N, nu) control [unit of the actuator].
            cost: J; infinite where it is infeasible.
            margin: Smallest relative margin.
            name: Name of the attempt that found it.
        """
        if self.best.is_improved_by(cost, margin):
            self.best = SearchResult(
                control=np.array(control), cost=cost, margin=margin, found_by=name
            )

    def largest_feasible_scale(self, deviation: Array, largest: float = 1.0) -> float:
        """Find the largest scale at which the centre plus the scaled deviation is feasible.

        Args:
            deviation: (N, nu) deviation from the centre [unit of the actuator].
            largest: Largest scale that is tried.

        Returns:
            The scale; 0 where no tried scale is feasible.
        """
        if not self.is_limited:
            return largest

        # Try smaller and smaller scales until one is feasible.
        scales = np.geomspace(largest, SCALE_RANGE * largest, SCALES_PER_BATCH)
        first: int | None = None
        for _ in range(COARSE_BATCHES):
            first = self._first_feasible(deviation, scales)
            if first is not None:
                break
            scales = SCALE_RANGE * scales
        if first is None:
            return 0.0

        # Refine between the last infeasible scale and the first feasible one.
        for _ in range(REFINING_BATCHES):
            if first == 0:
                break
            scales = np.geomspace(scales[first - 1], scales[first], SCALES_PER_BATCH)
            inner = self._first_feasible(deviation, scales[1:-1])
            first = SCALES_PER_BATCH - 1 if inner is None else inner + 1

        return float(scales[first])

    def _first_feasible(self, deviation: Array, scales: Array) -> int | None:
        """Index of the first feasible scale.

        Args:
            deviation: (N, nu) deviation from the centre [unit of the actuator].
            scales: (k,) scales in descending order.

        Returns:
            The index; None where no scale is feasible.
        """
        plant, theta = self.task.plant, self.task.theta
        controls = self.centre + scales[:, None, None] * deviation
        initial_states = np.repeat(plant.initial_state(theta)[None], len(scales), axis=0)
        batch = plant.simulator.rollout(
            [plant.model(theta)], initial_states, controls, self.constraints.observations
        )

        for i, control in enumerate(controls):
            if not batch.finite[i] or batch.observed is None:
                continue
            trajectory = plant.trajectory(batch.states[i], control)
            margin = self._margin(trajectory, batch.observed[i])
            if margin >= 0.0:
                return i
            self.record(control, np.inf, margin)

        return None

    def _margin(self, trajectory: Trajectory, observed: Array) -> float:
        """Smallest relative margin along a trajectory.

        Distances of geoms are expensive: they are measured only where all other constraints hold.
        """
        cheap = replace(self.constraints, clearance=None)
        margin = _smallest_margin(cheap, trajectory, observed)
        if margin < 0.0 or self.constraints.clearance is None:
            return margin

        return _smallest_margin(self.constraints, trajectory, observed)


def _smallest_margin(constraints: ConstraintSet, trajectory: Trajectory, observed: Array) -> float:
    """Smallest relative margin of a constraint set.

    Args:
        constraints: The constraint set.
        trajectory: The trajectory.
        observed: (N, substeps, w) observations at the engine steps.
    """
    values = constraints.evaluate(trajectory, observed, slopes=False)
    margins = constraints.relative_margins(values).values()
    return min(margins, default=np.inf)
