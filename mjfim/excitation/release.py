"""Search for the release, an initial state within ranges, whose motion tells most.

The ranges have few coordinates. A grid of releases over all ranges is simulated first. From the
best of them, which lie apart, local searches without derivatives follow.
"""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.evaluation import (
    UNSTABLE_GROWTH,
    DesignReport,
    Ending,
    identifiability_along,
    require_designable,
)
from mjfim.excitation.limits.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.limits.verification import require_feasible_start
from mjfim.excitation.objective import DIVERGED, DesignPoint
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.excitation.search.climb import row_of
from mjfim.excitation.search.inside import LimitedCost
from mjfim.excitation.search.levels import DescentLevel, require_coarse_factor
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.optimize.lq import largest_amplification
from mjfim.parallel import ExecutorLike, Workers, carry_out, one_blas_thread, pool_stop_token
from mjfim.parallel.budget import Budget
from mjfim.parallel.shared_value import KeptPerThread, SharedValue
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.plant.plant import Plant
from mjfim.records.design import Design, HistoryRow, StartResult, Status, extended
from mjfim.records.events import DesignCallback, DesignEvent
from mjfim.records.trajectory import Trajectory

# The grid has 2^(5 + d) releases for d coordinates, but no more than 2^9, and the corners of up to
# four coordinates. Workers evaluate some of them at once.
GRID_EXPONENT = 5
MAX_GRID_EXPONENT = 9
MAX_CORNER_COORDINATES = 4
RELEASES_PER_ORDER = 4

# Share of the time that the grid may use.
GRID_TIME_SHARE = 0.5

# Number of local searches, and the least distance of their starts relative to the ranges.
LOCAL_SEARCHES = 3
LEAST_DISTANCE = 0.1

# First radius of the trust region relative to the ranges, and bounds of the last one.
FIRST_RADIUS = 0.05
LAST_RADII = (1e-6, 1e-2)

# Relative margin that a local search keeps from the limits, so that its result is inside.
SAFETY = 1e-4

# Name of the growth of a small disturbance among the margins.
GROWTH = "growth"

# Objective of a release that diverges, above that of any other.
WORST = 1e3

# Least cost whose logarithm is taken; it avoids the logarithm of zero.
TINY = 1e-300


@dataclass(frozen=True, kw_only=True, eq=False)
class Release:
    """One release, evaluated.

    Attributes:
        shares: (d,) place of the release within the ranges.
        point: Its motion with its information and its cost; `DIVERGED` without one.
        margins: Smallest relative margin of the limits of each kind, and of the growth.
        objective: What the local search minimises.
    """

    shares: Array
    point: DesignPoint = DIVERGED
    margins: dict[str, float]
    objective: float = WORST

    @property
    def diverges(self) -> bool:
        """True where the simulation diverges."""
        return self.point.trajectory is None

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of the releases: those within the limits first, then by cost or violation."""
        margin = -np.inf if self.diverges else min(self.margins.values(), default=np.inf)
        return (False, self.point.cost) if margin >= 0.0 else (True, -margin)


class Releases:
    """Evaluates releases of a task.

    Args:
        stage: The stated level.
        space: The ranges.
        plant: Plant with difference steps that suit.
    """

    def __init__(self, stage: DescentLevel, space: ReleaseSpace, plant: Plant) -> None:
        self.stage = stage
        self.space = space
        self.plant = plant

    @cached_property
    def _constraints(self) -> ConstraintSet | None:
        """The limits; None without any."""
        task = self.stage.task
        return constraint_set_of(task) if task.is_limited else None

    def released(self, shares: Array) -> Plant:
        """Give the plant the initial state of a release: (d,) shares."""
        return self.plant.with_initial_state(self.space.state(shares))

    def evaluate(self, shares: Array) -> Release:
        """Simulate a release, (d,) shares, with its limits, its information and its cost."""
        plant = self.released(shares)
        moved = self._simulated(plant)
        nothing = Release(shares=shares, margins={})
        if moved is None:
            return nothing
        trajectory, margins = moved
        problem = replace(self.stage.problem, plant=plant)
        point = problem.point(trajectory, CENTRAL_DIFFERENCES)
        if point.trajectory is None or point.criterion is None:
            return nothing

        # The objective has no unit. A logarithmic criterion may be negative; one nat per parameter
        # is its size.
        objective = WORST
        if np.isfinite(point.cost):
            objective = float(np.log(max(point.cost, TINY)))
            if problem.information.criterion == "D":
                objective = point.cost / problem.size(point)
        growth = self._margin_of_growth(plant, trajectory)
        margins = {**margins, GROWTH: growth}
        return Release(shares=shares, point=point, margins=margins, objective=objective)

    def _margin_of_growth(self, plant: Plant, trajectory: Trajectory) -> float:
        """Margin of the growth of a small disturbance; 0 where it grows `UNSTABLE_GROWTH`-fold."""
        task = self.stage.task
        try:
            A, _, _, _ = plant.derivatives.jacobians(task.theta, trajectory)
        except SimulationDivergedError:
            return -1.0
        growth = max(largest_amplification(A, task.sizes[: task.space.nx]), np.finfo(float).tiny)
        return float(1.0 - np.log(growth) / np.log(UNSTABLE_GROWTH))

    def _simulated(self, plant: Plant) -> tuple[Trajectory, dict[str, float]] | None:
        """Motion of a plant from its initial state, with the relative margins of its limits."""
        task, constraints = self.stage.task, self._constraints
        if constraints is None:
            try:
                return plant.simulate(task.theta, task.control), {}
            except SimulationDivergedError:
                return None
        found = plant.observe(task.theta, task.control, constraints.observations)
        if found is None:
            return None
        values = constraints.evaluate(*found, slopes=False)
        return found[0], constraints.relative_margins(values)

    def evaluated(self, grid: Sequence[Array], is_over: Callable[[], bool]) -> list[Release]:
        """Evaluate releases, (d,) shares each, until the time is over; the first one always."""
        found: list[Release] = []
        for shares in grid:
            if found and is_over():
                break
            found.append(self.evaluate(shares))
        return found

    def followed(
        self, start: Release, is_over: Callable[[], bool]
    ) -> tuple[list[Release], Status | None]:
        """Follow a release to a minimum of its objective within the limits, with COBYQA.

        Args:
            start: The release.
            is_over: Whether the time is over.

        Returns:
            What was tried; and how the search has ended, None where its time was over.
        """
        descent = self.stage.task.experiment.descent
        radius = float(np.clip(np.sqrt(descent.tolerance), *LAST_RADII))
        known = {start.shares.tobytes(): start}

        def seen(shares: Array) -> Release:
            """Evaluate a release inside its ranges, and remember it."""
            inside = np.clip(shares, 0.0, 1.0)
            key = inside.tobytes()
            if key not in known:
                if len(known) > 1 and is_over():
                    raise _TimeIsOverError
                known[key] = self.evaluate(inside)
            return known[key]

        def margins(shares: Array) -> Array:
            """(k,) relative margins of the kinds of limits; -1 where the simulation diverges."""
            found = seen(shares).margins
            return np.array([found.get(kind, -1.0) - SAFETY for kind in start.margins])

        constraints = [scipy.optimize.NonlinearConstraint(margins, 0.0, np.inf)]
        status = None
        try:
            result = scipy.optimize.minimize(
                lambda shares: seen(shares).objective,
                start.shares,
                method="COBYQA",
                bounds=[(0.0, 1.0)] * len(start.shares),
                constraints=constraints if start.margins else [],
                options={
                    "initial_tr_radius": FIRST_RADIUS,
                    "final_tr_radius": radius,
                    "maxfev": max(descent.max_iterations, 1),
                },
            )
            status = Status.RELEASE_FOUND if result.success else Status.MAX_ITERATIONS
        except _TimeIsOverError:
            pass
        return list(known.values())[1:], status


class _TimeIsOverError(Exception):
    """Ends a local search, whose method has no other way to end at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Plan:
    """What all orders share, for workers."""

    experiment: Experiment
    added_information: Array | None
    basis: Array | None
    space: ReleaseSpace
    step_factors: Array | None
    threads: int

    def releases(self) -> Releases:
        """Make the evaluation in a worker."""
        task = DesignTask.resolve(
            self.experiment, threads=self.threads, added_information=self.added_information
        )
        plant = task.plant.with_step_factors(self.step_factors)
        return Releases(DescentLevel(task, self.basis), self.space, plant)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Order:
    """Order to evaluate some releases, or to follow one."""

    plan: SharedValue[_Plan]
    budget: Budget
    grid: tuple[Array, ...] = ()
    start: Release | None = None


_kept = KeptPerThread[Releases](2)


@one_blas_thread()
def _in_worker(order: _Order) -> tuple[list[Release], Status | None, int]:
    """Carry out an order; what was tried, how it has ended, and the engine steps."""
    releases = _kept.get(order.plan.digest, order.plan.value.releases)
    stop, before = pool_stop_token(), releases.plant.engine_steps

    def is_over() -> bool:
        """Whether the time is over, or a stop was requested."""
        return stop.requested or order.budget.exhausted is not None

    if order.start is None:
        found, status = releases.evaluated(order.grid, is_over), None
    else:
        found, status = releases.followed(order.start, is_over)
    return found, status, releases.plant.engine_steps - before


class ReleaseSearch:
    """Search for the best release of a task.

    Args:
        stage: The stated level.
        space: The ranges.
        budget: Ends the search.
        callback: Called for each release that is better than all before.
        executor: Workers; None for this process.
    """

    def __init__(
        self,
        stage: DescentLevel,
        space: ReleaseSpace,
        budget: Budget,
        callback: DesignCallback | None,
        executor: ExecutorLike | None = None,
    ) -> None:
        self._releases = Releases(stage, space, stage.task.plant)
        self._budget = budget
        self._workers = None if executor is None else Workers.of(executor)
        self._callback: Callable[[DesignEvent], None] = callback or (lambda event: None)
        self._history: tuple[HistoryRow, ...] = ()
        self._steps_before = stage.task.plant.engine_steps
        self._found_by = "grid of releases"
        self.best: Release | None = None

    def run(self) -> tuple[Release, Ending]:
        """Search the ranges.

        Raises:
            SimulationDivergedError: The simulation diverges from every release.
        """
        tried = []
        for release in self._evaluated(self._grid()):
            tried.append(release)
            self._take(release, self._found_by)
        self._calibrate()
        starts = self._local_searches(tried)
        if self.best is None:
            raise SimulationDivergedError("the simulation diverges from every release")

        # A release of the grid that no local search improves is the end of these searches.
        status = Status.MAX_ITERATIONS
        if self._found_by in starts:
            status = starts[self._found_by].status
        elif any(start.status.success for start in starts.values()):
            status = Status.RELEASE_FOUND
        ending = Ending(
            name=self._found_by,
            status=status,
            slope=np.nan,
            history=self._history,
            starts=tuple(starts.values()),
        )
        return self.best, ending

    def _grid(self) -> list[Array]:
        """(d,) shares of each release of the grid, the stated one first."""
        space = self._releases.space
        d = len(space.names)
        stated = space.shares_of_stated()
        sequence = scipy.stats.qmc.Sobol(d, scramble=False)
        grid = list(sequence.random_base2(min(GRID_EXPONENT + d, MAX_GRID_EXPONENT)))
        if d <= MAX_CORNER_COORDINATES:
            corners = [np.array(corner) for corner in itertools.product((0.0, 1.0), repeat=d)]
            # Of releases that tell as much, such as mirror images, the first one stays.
            if stated is not None:
                corners.sort(key=lambda corner: float(np.abs(corner - stated).sum()))
            grid = [*corners, *grid]
        return grid if stated is None else [stated, *grid]

    def _evaluated(self, grid: list[Array]) -> Iterator[Release]:
        """Evaluate releases in their order, until a share of the time is used."""
        budget = self._budget.share(GRID_TIME_SHARE)
        if self._workers is None:
            for number, shares in enumerate(grid):
                if number and budget.exhausted is not None:
                    return
                yield self._releases.evaluate(shares)
            return

        firsts = range(0, len(grid), RELEASES_PER_ORDER)
        parts = [tuple(grid[first : first + RELEASES_PER_ORDER]) for first in firsts]
        orders = [_Order(plan=self._plan(len(parts)), budget=budget, grid=part) for part in parts]
        for outcome in carry_out(self._workers, _in_worker, orders, budget):
            if outcome.is_lost:
                yield from map(self._releases.evaluate, parts[outcome.index])
                continue
            found, _, steps = outcome.result
            self._releases.plant.simulator.add_steps(steps)
            yield from found
        # After a request to stop before the first result there is at least this one.
        if self.best is None:
            yield self._releases.evaluate(grid[0])

    def _calibrate(self) -> None:
        """Choose difference steps that suit the best release of the grid."""
        best = self.best
        if best is None or best.point.trajectory is None or self._budget.exhausted is not None:
            return
        before = self._releases
        theta = before.stage.task.theta
        plant = before.released(best.shares).calibrated(theta, best.point.trajectory)
        self._releases = Releases(before.stage, before.space, plant)
        self.best = self._releases.evaluate(best.shares)
        last = self._history[-1]
        row = self._row(self.best, last.iteration, last.gamma)
        self._history = (*self._history[:-1], row)

    def _local_searches(self, tried: list[Release]) -> dict[str, StartResult]:
        """Follow the best releases of the grid; results by name."""
        wanted = max(LOCAL_SEARCHES, self._releases.stage.task.experiment.descent.starts)
        starts = _apart(sorted(tried, key=lambda release: release.rank), wanted)
        results = {}
        for number, (found, status) in enumerate(self._followed(starts)):
            if not found and status is None:
                continue
            name = f"grid release {number + 1} of {len(starts)}"
            for release in found:
                self._take(release, name)
            best = min([starts[number], *found], key=lambda release: release.rank)
            results[name] = StartResult(
                name=name,
                cost=best.point.cost,
                status=status or Status.MAX_ITERATIONS,
                iterations=len(found),
            )
        return results

    def _followed(self, starts: list[Release]) -> Iterator[tuple[list[Release], Status | None]]:
        """Local searches from some releases, in their order."""

        def is_over() -> bool:
            """Whether the time is over."""
            return self._budget.exhausted is not None

        if self._workers is None or is_over():
            for start in starts:
                if is_over():
                    return
                yield self._releases.followed(start, is_over)
            return

        plan = self._plan(len(starts))
        orders = [_Order(plan=plan, budget=self._budget, start=start) for start in starts]
        results: list[tuple[list[Release], Status | None]] = [([], None) for _ in starts]
        for outcome in carry_out(self._workers, _in_worker, orders, self._budget):
            if outcome.is_lost:
                results[outcome.index] = self._releases.followed(starts[outcome.index], is_over)
                continue
            found, status, steps = outcome.result
            self._releases.plant.simulator.add_steps(steps)
            results[outcome.index] = found, status
        yield from results

    def _plan(self, tasks: int) -> SharedValue[_Plan]:
        """What all orders share; the workers do some number of tasks."""
        assert self._workers is not None
        releases, task = self._releases, self._releases.stage.task
        plan = _Plan(
            experiment=for_workers(task.experiment, task.system.source),
            added_information=task.added_information,
            basis=releases.stage.basis,
            space=releases.space,
            step_factors=releases.plant.step_factors,
            threads=self._workers.threads_for(tasks),
        )
        return SharedValue(uuid.uuid4().hex, plan)

    def _take(self, release: Release, name: str) -> None:
        """Keep and report a release if it is the best one."""
        if release.diverges or (self.best is not None and release.rank >= self.best.rank):
            return
        moved = 0.0
        if self.best is not None:
            moved = float(np.abs(release.shares - self.best.shares).max())
        self.best, self._found_by = release, name
        row = self._row(release, len(self._history), moved)
        self._history = extended(self._history, [row])
        self._callback(DesignEvent(start=name, row=row))

    def _row(self, release: Release, iteration: int, moved: float) -> HistoryRow:
        """The iterate of a release; `moved`: distance from the one before, in ranges."""
        task = self._releases.stage.task
        margins = {kind: value for kind, value in release.margins.items() if kind != GROWTH}
        return row_of(
            release.point,
            iteration=iteration,
            gamma=moved,
            seconds=self._budget.seconds_used,
            steps=task.plant.engine_steps - self._steps_before,
            rate=1.0 / task.dt,
            margins=margins,
        )


def _apart(ranked: list[Release], count: int) -> list[Release]:
    """The first releases of a ranking that lie apart from those before, at most `count`."""
    chosen: list[Release] = []
    for release in ranked:
        distances = [np.abs(release.shares - other.shares).max() for other in chosen]
        if not release.diverges and min(distances, default=np.inf) > LEAST_DISTANCE:
            chosen.append(release)
    return chosen[:count]


def design_release(
    task: DesignTask, budget: Budget, callback: DesignCallback | None, executor: ExecutorLike | None
) -> Design:
    """Design the initial state of a motion whose control is given. See `design`."""
    assert task.release is not None
    require_feasible_start(task)
    require_coarse_factor(task)
    steps_before = task.plant.engine_steps
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    identifiability = identifiability_along(task, first)
    require_designable(task, identifiability)
    stage = DescentLevel(task, identifiability.basis)
    first = stage.problem.reevaluated(first)
    search = ReleaseSearch(stage, task.release, budget, callback, executor)
    best, ending = search.run()
    interrupted = budget.stop.requested

    # The stated release stays where no better one within the limits was found.
    chosen, played = best.point, task
    if first.cost < chosen.cost and _keeps_limits(stage, first):
        chosen = first
    elif chosen.trajectory is not None:
        played = task.released_as(chosen.trajectory.state[0])
    report = DesignReport(
        stage=stage,
        identifiability=identifiability,
        initial=first,
        final=chosen,
        played=played,
        remarks=tuple(task.release.edges(best.shares)),
    )
    steps = task.plant.engine_steps - steps_before
    return report.design(ending, budget.seconds_used, steps, interrupted)


def _keeps_limits(stage: DescentLevel, point: DesignPoint) -> bool:
    """Check whether the motion of the stated release keeps the limits."""
    if not stage.task.is_limited or point.trajectory is None:
        return not stage.task.is_limited
    relaxed = DescentLevel(stage.task.relaxed(), stage.basis)
    return LimitedCost(level=relaxed).keeps(point.trajectory.ctrl)
