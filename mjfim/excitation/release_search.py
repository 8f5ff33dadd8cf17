"""Search for the release, an initial state within ranges, whose motion tells most.

The ranges have few coordinates. A grid of releases over all ranges is simulated first. From the
best of them, which lie apart, a trust-region method without derivatives (COBYQA) follows; it keeps
ranges and limits, and tolerates the kinks of the smallest eigenvalue.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.evaluation import UNSTABLE_GROWTH
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DIVERGED, DesignPoint
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.optimize.lq import largest_amplification
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.plant.plant import Plant
from mjfim.records.design import HistoryRow, StartResult, Status, extended
from mjfim.records.events import DesignCallback, DesignEvent
from mjfim.records.iterates import IterateMotion
from mjfim.records.trajectory import Trajectory

# The grid has 2^(5 + d) releases for d coordinates, but no more than 2^9, and the corners of up to
# four coordinates.
GRID_EXPONENT = 5
MAX_GRID_EXPONENT = 9
MAX_CORNER_COORDINATES = 4

# Share of the time that the grid may use.
GRID_TIME_SHARE = 0.5

# Number of local searches, and the least distance of their starts relative to the ranges.
LOCAL_SEARCHES = 3
LEAST_DISTANCE = 0.1

# First radius of the trust region relative to the ranges, and bounds of the last one.
FIRST_RADIUS = 0.05
LAST_RADII = (1e-6, 1e-2)

# Relative margin that the search keeps from the limits, so that its result is inside.
SAFETY = 1e-4

# Objective of a release that diverges, above that of any other.
WORST = 1e3

# Name of the growth of a small disturbance among the margins.
GROWTH = "growth"

# Least cost whose logarithm is taken; it avoids the logarithm of zero.
TINY = 1e-300


class _BudgetUsedUpError(Exception):
    """Ends a local search, whose method has no other way to end at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Release:
    """One release, evaluated.

    Attributes:
        shares: (d,) place in the ranges.
        point: Its motion, information and cost.
        margins: Smallest relative margin of each kind of limit, and of the growth of a small
            disturbance; empty where it diverges.
    """

    shares: Array
    point: DesignPoint
    margins: dict[str, float]

    @property
    def margin(self) -> float:
        """Smallest relative margin; -infinite where the simulation diverges."""
        if self.point.trajectory is None:
            return -np.inf
        return min(self.margins.values(), default=np.inf)

    @property
    def margins_of_limits(self) -> dict[str, float]:
        """Smallest relative margin of the limits of each kind."""
        return {kind: margin for kind, margin in self.margins.items() if kind != GROWTH}

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of the releases: those within the limits first, then by cost or violation."""
        if self.margin >= 0.0:
            return False, self.point.cost
        return True, -self.margin


@dataclass(frozen=True, kw_only=True, eq=False)
class ReleaseResult:
    """Result of the search.

    Attributes:
        best: The best release.
        plant: Plant whose initial state is that of the release.
        status: How the search ended.
        history: The improvements.
        starts: Results of the local searches.
        found_by: Name of the search that found it.
    """

    best: Release
    plant: Plant
    status: Status
    history: tuple[HistoryRow, ...]
    starts: tuple[StartResult, ...]
    found_by: str


class ReleaseSearch:
    """Search for the best release of a task.

    Args:
        stage: The task and its criterion.
        space: Ranges of the release.
        budget: Time of the search and the token that stops it.
        callback: Called with every improvement, or None.
    """

    def __init__(
        self,
        stage: DescentLevel,
        space: ReleaseSpace,
        budget: Budget,
        callback: DesignCallback | None,
    ) -> None:
        self.stage = stage
        self.space = space
        self.budget = budget
        self.plant = stage.task.plant
        self.best: Release | None = None
        self.found_by = "grid of releases"

        self._callback: Callable[[DesignEvent], None] = callback or (lambda event: None)
        self._name = self.found_by
        self._known: dict[bytes, Release] = {}
        self._history: list[HistoryRow] = []
        self._steps_before = stage.task.plant.engine_steps

        self._constraints: ConstraintSet | None = None
        if stage.task.is_limited:
            self._constraints = constraint_set_of(stage.task)

    def run(self) -> ReleaseResult:
        """Search the ranges.

        Raises:
            SimulationDivergedError: The simulation diverges from every release.
        """
        tried = self._try_grid()
        self._calibrate()
        results = self._local_searches(tried)

        best = self.best
        if best is None or best.point.trajectory is None:
            raise SimulationDivergedError("the simulation diverges from every release")

        # A release of the grid that no local search improves is the end of these searches.
        status = Status.MAX_ITERATIONS
        if self.found_by in results:
            status = results[self.found_by].status
        elif any(ended.status.success for ended in results.values()):
            status = Status.RELEASE_FOUND

        return ReleaseResult(
            best=best,
            plant=self._released(best.shares),
            status=status,
            history=tuple(self._history),
            starts=tuple(results.values()),
            found_by=self.found_by,
        )

    def _try_grid(self) -> list[Release]:
        """Evaluate the stated release, the corners of the ranges and a Sobol sequence."""
        d = len(self.space.names)
        stated = self.space.shares_of_stated()
        sequence = scipy.stats.qmc.Sobol(d, scramble=False)
        grid = list(sequence.random_base2(min(GRID_EXPONENT + d, MAX_GRID_EXPONENT)))
        if d <= MAX_CORNER_COORDINATES:
            corners = [np.array(corner) for corner in itertools.product((0.0, 1.0), repeat=d)]

            # Of releases that tell as much, such as mirror images, the first one stays.
            if stated is not None:
                corners.sort(key=lambda corner: float(np.abs(corner - stated).sum()))
            grid = [*corners, *grid]
        if stated is not None:
            grid.insert(0, stated)

        tried = []
        for shares in grid:
            tried.append(self.evaluate(shares))
            if self.budget.exhausted or self.budget.used > GRID_TIME_SHARE:
                break
        return tried

    def _calibrate(self) -> None:
        """Choose difference steps that suit the best release of the grid.

        The stated release may hardly move, so that its steps are too long for another one.
        """
        best = self.best
        if best is None or best.point.trajectory is None or self.budget.exhausted:
            return
        theta = self.stage.task.theta
        self.plant = self._released(best.shares).calibrated(theta, best.point.trajectory)
        self._known.clear()
        self.best = self._evaluated(best.shares)
        last = self._history[-1]
        self._history[-1] = self._row(self.best, last.iteration, last.gamma)

    def _local_searches(self, tried: list[Release]) -> dict[str, StartResult]:
        """Follow the best releases of the grid; results by name."""
        wanted = max(LOCAL_SEARCHES, self.stage.task.experiment.descent.starts)
        starts = _apart(sorted(tried, key=lambda release: release.rank), wanted)

        results = {}
        for number, start in enumerate(starts, start=1):
            if self.budget.exhausted:
                break
            name = f"grid release {number} of {len(starts)}"
            results[name] = self._local_search(name, start)
        return results

    def _local_search(self, name: str, start: Release) -> StartResult:
        """Follow one release by COBYQA."""
        descent = self.stage.task.experiment.descent
        lowest, highest = LAST_RADII
        radius = float(np.clip(np.sqrt(descent.tolerance), lowest, highest))
        reached = [start]
        status = Status.MAX_ITERATIONS
        count = len(self._known)
        self._name = name

        def seen(shares: Array) -> Release:
            """Evaluate a release inside its ranges, and remember it."""
            release = self.evaluate(np.clip(shares, 0.0, 1.0))
            reached.append(release)
            return release

        constraints = []
        if start.margins:
            kinds = tuple(start.margins)
            constraints = [
                scipy.optimize.NonlinearConstraint(
                    lambda x: _margins(seen(x), kinds) - SAFETY, 0.0, np.inf
                )
            ]
        try:
            found = scipy.optimize.minimize(
                lambda x: self._objective(seen(x)),
                start.shares,
                method="COBYQA",
                bounds=[(0.0, 1.0)] * len(start.shares),
                constraints=constraints,
                options={
                    "initial_tr_radius": FIRST_RADIUS,
                    "final_tr_radius": radius,
                    "maxfev": max(descent.max_iterations, 1),
                },
            )
            if found.success:
                status = Status.RELEASE_FOUND
        except _BudgetUsedUpError:
            pass

        best = min(reached, key=lambda release: release.rank)
        return StartResult(
            name=name, cost=best.point.cost, status=status, iterations=len(self._known) - count
        )

    def _objective(self, release: Release) -> float:
        """Objective of the local search, which has no unit."""
        if self.budget.exhausted:
            raise _BudgetUsedUpError
        cost = release.point.cost
        if not np.isfinite(cost):
            return WORST

        # A logarithmic criterion may be negative; one nat per parameter is its size.
        if self.stage.problem.information.criterion == "D":
            return cost / self.stage.problem.size(release.point)
        return float(np.log(max(cost, TINY)))

    def evaluate(self, shares: Array) -> Release:
        """Evaluate a release, and keep it if it is the best one.

        Args:
            shares: (d,) place in the ranges.
        """
        key = shares.tobytes()
        if key in self._known:
            return self._known[key]

        release = self._evaluated(shares)
        self._known[key] = release
        if release.point.trajectory is not None and (
            self.best is None or release.rank < self.best.rank
        ):
            self._keep(release)
        return release

    def _keep(self, release: Release) -> None:
        """Keep the best release, and report it."""
        moved = 0.0
        if self.best is not None:
            moved = float(np.abs(release.shares - self.best.shares).max())
        self.best, self.found_by = release, self._name

        row = self._row(release, len(self._history), moved)
        self._history = list(extended(tuple(self._history), [row]))
        self._callback(DesignEvent(start=self._name, row=row))

    def _row(self, release: Release, iteration: int, moved: float) -> HistoryRow:
        """The iterate of a release; `moved`: distance from the one before, in ranges."""
        task, criterion = self.stage.task, release.point.criterion
        return HistoryRow(
            iteration=iteration,
            cost=release.point.cost,
            criterion=np.inf if criterion is None else criterion.value,
            min_eigenvalue=0.0 if criterion is None else float(criterion.eigenvalues[0]),
            slope=np.nan,
            gamma=moved,
            seconds=self.budget.seconds_used,
            steps=task.plant.engine_steps - self._steps_before,
            rate=1.0 / task.dt,
            margin=min(release.margins_of_limits.values(), default=np.nan),
            margins=release.margins_of_limits,
            motion=IterateMotion.of(release.point.trajectory),
        )

    def _released(self, shares: Array) -> Plant:
        """The plant with the initial state of a release."""
        return self.plant.with_initial_state(self.space.state(shares))

    def _evaluated(self, shares: Array) -> Release:
        """Simulate a release, with its limits, its information and its cost."""
        plant = self._released(shares)
        moved = self._simulated(plant)
        if moved is None:
            return Release(shares=shares, point=DIVERGED, margins={})

        trajectory, margins = moved
        problem = replace(self.stage.problem, plant=plant)
        point = problem.point(trajectory, CENTRAL_DIFFERENCES)
        if point.trajectory is None:
            return Release(shares=shares, point=DIVERGED, margins={})

        margins = {**margins, GROWTH: self._margin_of_growth(plant, trajectory)}
        return Release(shares=shares, point=point, margins=margins)

    def _margin_of_growth(self, plant: Plant, trajectory: Trajectory) -> float:
        """Margin of the growth of a small disturbance; 0 where it grows `UNSTABLE_GROWTH`-fold.

        The criterion favours motions that are close to chaotic, which no feedback could steer.
        """
        task = self.stage.task
        try:
            A, _, _, _ = plant.derivatives.jacobians(task.theta, trajectory)
        except SimulationDivergedError:
            return -1.0

        growth = largest_amplification(A, task.sizes[: task.space.nx])
        least = np.finfo(float).tiny
        return float(1.0 - np.log(max(growth, least)) / np.log(UNSTABLE_GROWTH))

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
        trajectory, observed = found
        values = constraints.evaluate(trajectory, observed, slopes=False)
        return trajectory, constraints.relative_margins(values)


def _margins(release: Release, kinds: tuple[str, ...]) -> Array:
    """(k,) relative margins of some kinds of limits; -1 where the simulation diverges."""
    return np.array([release.margins.get(kind, -1.0) for kind in kinds])


def _apart(ranked: list[Release], count: int) -> list[Release]:
    """The first releases of a ranking that lie apart from those before, at most `count`."""
    chosen: list[Release] = []
    for release in ranked:
        if release.point.trajectory is None:
            continue
        far = all(np.abs(release.shares - other.shares).max() > LEAST_DISTANCE for other in chosen)
        if far:
            chosen.append(release)
        if len(chosen) == count:
            break
    return chosen
