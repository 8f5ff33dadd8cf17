"""Search for the release, an initial state within ranges, whose motion tells most.

The ranges have few coordinates. A grid of releases over all ranges is simulated first. From the
best of them, which lie apart, local searches without derivatives follow.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.evaluation import UNSTABLE_GROWTH
from mjfim.excitation.limits.limits import ReleaseSpace
from mjfim.excitation.objective import DIVERGED, DesignPoint
from mjfim.excitation.prior_information import EarlierExperiments
from mjfim.excitation.search.climb import Candidate, row_of
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.optimize.lq import largest_amplification
from mjfim.parallel import ExecutorLike, Workers, results_on
from mjfim.parallel.budget import Budget, StopToken
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.plant.plant import Plant
from mjfim.records.design import HistoryRow, StartResult, Status, extended
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


@record
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Releases:
    """Evaluates releases of a task.

    Attributes:
        stage: The stated level.
        space: The ranges.
        plant: Plant with difference steps that suit.
    """

    stage: DescentLevel
    space: ReleaseSpace
    plant: Plant

    def released(self, shares: Array) -> Plant:
        """Give the plant the initial state of a release: (d,) shares."""
        return self.plant.with_initial_state(self.space.state(shares))

    def evaluate(self, shares: Array) -> Release:
        """Simulate a release, (d,) shares, with its limits, its information and its cost."""
        plant, task, problem = self.released(shares), self.stage.task, self.stage.problem
        values = self.stage.constraints.along(plant, task.theta, task.control)
        nothing = Release(shares=shares, margins={})
        if values is None:
            return nothing
        point = replace(problem, plant=plant).point(values.trajectory, CENTRAL_DIFFERENCES)
        if point.trajectory is None:
            return nothing

        # The objective has no unit. A logarithmic criterion may be negative; one nat per parameter
        # is its size.
        objective = WORST
        if np.isfinite(point.cost):
            objective = float(np.log(max(point.cost, TINY)))
            if problem.information.criterion == "D":
                objective = point.cost / problem.size(point)
        margins = {
            **self.stage.constraints.relative_margins(values),
            GROWTH: self._margin_of_growth(plant, values.trajectory),
        }
        return Release(shares=shares, point=point, margins=margins, objective=objective)

    def _margin_of_growth(self, plant: Plant, trajectory: Trajectory) -> float:
        """Margin of the growth of a small disturbance; 0 where it grows `UNSTABLE_GROWTH`-fold."""
        task = self.stage.task
        try:
            A = plant.derivatives.jacobians(task.theta, trajectory)[0]
        except SimulationDivergedError:
            return -1.0
        growth = max(largest_amplification(A, task.sizes[: task.space.nx]), np.finfo(float).tiny)
        return float(1.0 - np.log(growth) / np.log(UNSTABLE_GROWTH))

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


def _made(
    experiment: Experiment,
    added: EarlierExperiments | None,
    basis: Array | None,
    space: ReleaseSpace,
    step_factors: Array | None,
    threads: int,
) -> Releases:
    """Make the evaluation in a worker."""
    task = DesignTask.resolve(experiment, threads=threads, added=added)
    plant = task.plant.with_step_factors(step_factors)
    return Releases(stage=DescentLevel(task, basis), space=space, plant=plant)


# Name of an order, releases of the grid, (d,) shares each, to be evaluated, or a release to be
# followed, and the budget at whose end it ends.
_Order = tuple[str, list[Array] | Release, Budget]

# Name of an order, what it has tried, how it has ended, and the engine steps. Without a status its
# time was over.
_Tried = tuple[str, list[Release], Status | None, int]


def _tried(releases: Releases, order: _Order, stop: StopToken) -> _Tried:
    """Carry out an order."""
    before = releases.plant.engine_steps
    name, chosen, budget = order

    def is_over() -> bool:
        """Whether the time is over, or a stop was requested."""
        return stop.requested or budget.exhausted is not None

    found, status = list[Release](), None
    if isinstance(chosen, Release):
        found, status = releases.followed(chosen, is_over)
    else:
        for shares in chosen:
            if found and is_over():
                break
            found.append(releases.evaluate(shares))
    return name, found, status, releases.plant.engine_steps - before


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
        self._releases = Releases(stage=stage, space=space, plant=stage.task.plant)
        self._budget = budget
        self._workers = Workers.of_any(executor)
        self._callback: Callable[[DesignEvent], None] = callback or (lambda event: None)
        self._history: tuple[HistoryRow, ...] = ()
        self._steps_before = stage.task.plant.engine_steps
        self._found_by = "grid of releases"
        self.best: Release | None = None

    def run(self) -> tuple[Release, Candidate, list[StartResult]]:
        """Search the ranges; the best release, as a candidate as well, and the local searches.

        Raises:
            SimulationDivergedError: The simulation diverges from every release.
        """
        grid, tried = self._grid(), list[Release]()
        size = 1 if self._workers is None else RELEASES_PER_ORDER
        budget = self._budget.share(GRID_TIME_SHARE)
        orders: list[_Order] = [
            (self._found_by, grid[first : first + size], budget)
            for first in range(0, len(grid), size)
        ]
        for _, found, _, _ in self._carried_out(orders, budget):
            for release in found:
                tried.append(release)
                self._take(release, self._found_by)
        # After a request to stop before the first result there is at least this one.
        if self.best is None:
            tried.append(self._releases.evaluate(grid[0]))
            self._take(tried[-1], self._found_by)
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
        control = self._releases.stage.task.control
        winner = Candidate(
            name=self._found_by,
            control=control,
            best=control,
            status=status,
            slope=np.nan,
            history=self._history,
        )
        return self.best, winner, list(starts.values())

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

    def _carried_out(self, orders: list[_Order], budget: Budget) -> Iterator[_Tried]:
        """Results of the orders, in their order, here or on the workers."""
        own = self._releases.plant
        before = own.engine_steps
        for tried in results_on(self._releases, self._plan, _tried, orders, self._workers, budget):
            # The steps of this process are counted already.
            own.simulator.add_steps(tried[-1] - (own.engine_steps - before))
            before = own.engine_steps
            yield tried

    def _calibrate(self) -> None:
        """Choose difference steps that suit the best release of the grid."""
        best = self.best
        if best is None or best.point.trajectory is None or self._budget.exhausted is not None:
            return
        before = self._releases
        theta = before.stage.task.theta
        plant = before.released(best.shares).calibrated(theta, best.point.trajectory)
        self._releases = replace(before, plant=plant)
        self.best = self._releases.evaluate(best.shares)
        last = self._history[-1]
        row = self._row(self.best, last.iteration, last.gamma)
        self._history = (*self._history[:-1], row)

    def _local_searches(self, tried: list[Release]) -> dict[str, StartResult]:
        """Follow the best releases of the grid; results by name."""
        wanted = max(LOCAL_SEARCHES, self._releases.stage.task.experiment.descent.starts)
        chosen = _apart(sorted(tried, key=lambda release: release.rank), wanted)
        starts = {f"grid release {i} of {len(chosen)}": each for i, each in enumerate(chosen, 1)}
        if self._budget.exhausted is not None:
            return {}
        orders: list[_Order] = [(name, start, self._budget) for name, start in starts.items()]
        rows = {}
        for name, found, status, _ in self._carried_out(orders, self._budget):
            if not found and status is None:
                continue
            for release in found:
                self._take(release, name)
            best = min([starts[name], *found], key=lambda release: release.rank)
            rows[name] = StartResult(
                name=name,
                cost=best.point.cost,
                status=status or Status.MAX_ITERATIONS,
                iterations=len(found),
            )
        return rows

    def _plan(self, threads: int) -> Callable[[], Releases]:
        """The evaluation, as a worker with a number of threads makes it."""
        releases, task = self._releases, self._releases.stage.task
        return partial(
            _made,
            for_workers(task.experiment, task.system.source),
            task.added,
            releases.stage.basis,
            releases.space,
            releases.plant.step_factors,
            threads,
        )

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
    stage: DescentLevel,
    space: ReleaseSpace,
    first: DesignPoint,
    budget: Budget,
    callback: DesignCallback | None,
    executor: ExecutorLike | None,
) -> tuple[Candidate, DesignPoint, list[StartResult], tuple[str, ...]]:
    """Design the initial state of a motion whose control is given.

    Args:
        stage: The stated level.
        space: Ranges of the initial state.
        first: The motion from the stated initial state.
        budget: Ends the search.
        callback: Called for each release that is better than all before.
        executor: Workers; None for this process.

    Returns:
        The best release as a candidate, its motion, the results of local searches, and warnings.
    """
    best, winner, rows = ReleaseSearch(stage, space, budget, callback, executor).run()
    point, task = best.point, stage.task
    # The stated release stays where no better one within the limits was found.
    if first.cost < point.cost and first.trajectory is not None:
        relaxed = DescentLevel(task.relaxed(), stage.basis)
        if not task.is_limited or relaxed.keeps(first.trajectory.ctrl):
            point = first
    return winner, point, rows, tuple(space.edges(best.shares))
