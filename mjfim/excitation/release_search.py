"""Search for the release, an initial state within ranges, whose motion tells most.

The ranges have few coordinates. A grid of releases over all ranges is simulated first. From the
best of them, which lie apart, local searches follow. Both are divided among the workers of an
executor, if there is one; the result is the same to the last digit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.release_evaluation import Release, ReleaseEvaluation
from mjfim.excitation.release_following import Following, follow
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.excitation.release_workers import ReleaseWorkers
from mjfim.parallel import ExecutorLike
from mjfim.plant.plant import Plant
from mjfim.records.design import HistoryRow, StartResult, Status, extended
from mjfim.records.events import DesignCallback, DesignEvent

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


@dataclass(frozen=True, kw_only=True, eq=False)
class ReleaseResult:
    """Result of the search.

    Attributes:
        best: The best release.
        point: Its motion, information and cost.
        plant: Plant whose initial state is that of the release.
        status: How the search ended.
        history: The improvements.
        starts: Results of the local searches.
        found_by: Name of the search that found it.
    """

    best: Release
    point: DesignPoint
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
        executor: Where releases are evaluated; None for this process.
    """

    def __init__(
        self,
        stage: DescentLevel,
        space: ReleaseSpace,
        budget: Budget,
        callback: DesignCallback | None,
        executor: ExecutorLike | None = None,
    ) -> None:
        self.stage = stage
        self.space = space
        self.budget = budget
        self.best: Release | None = None
        self.found_by = "grid of releases"

        self._evaluation = ReleaseEvaluation(stage, space, stage.task.plant)
        self._workers = None if executor is None else ReleaseWorkers(executor, budget)
        self._callback: Callable[[DesignEvent], None] = callback or (lambda event: None)
        self._name = self.found_by
        self._known: set[bytes] = set()
        self._history: list[HistoryRow] = []
        self._steps_before = stage.task.plant.engine_steps

    def run(self) -> ReleaseResult:
        """Search the ranges.

        Raises:
            SimulationDivergedError: The simulation diverges from every release.
        """
        tried = self._try_grid()
        self._calibrate()
        results = self._local_searches(tried)

        best = self.best
        if best is None or best.diverges:
            raise SimulationDivergedError("the simulation diverges from every release")

        # A release of the grid that no local search improves is the end of these searches.
        status = Status.MAX_ITERATIONS
        if self.found_by in results:
            status = results[self.found_by].status
        elif any(ended.status.success for ended in results.values()):
            status = Status.RELEASE_FOUND

        return ReleaseResult(
            best=best,
            point=self._evaluation.point(best.shares),
            plant=self._evaluation.released(best.shares),
            status=status,
            history=tuple(self._history),
            starts=tuple(results.values()),
            found_by=self.found_by,
        )

    def _try_grid(self) -> list[Release]:
        """Evaluate the stated release, the corners of the ranges and a Sobol sequence."""
        tried = []
        for release in self._evaluated(self._grid()):
            tried.append(release)
            self._take(release)
        return tried

    def _evaluated(self, grid: list[Array]) -> Iterator[Release]:
        """Evaluate releases in their order, until a share of the time is used."""
        if self._workers is not None:
            count = 0
            for release in self._workers.grid(self._evaluation, grid, GRID_TIME_SHARE):
                yield release
                count += 1

            # After a request to stop before the first result there is at least this one.
            if not count:
                yield self._evaluation.release(grid[0])
            return

        for shares in grid:
            yield self._evaluation.release(shares)
            if self.budget.exhausted or self.budget.used > GRID_TIME_SHARE:
                return

    def _grid(self) -> list[Array]:
        """(d,) place of each release of the grid, the stated one first."""
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
        return grid if stated is None else [stated, *grid]

    def _calibrate(self) -> None:
        """Choose difference steps that suit the best release of the grid.

        The stated release may hardly move, so that its steps are too long for another one.
        """
        best = self.best
        if best is None or self.budget.exhausted:
            return
        trajectory = self._evaluation.point(best.shares).trajectory
        if trajectory is None:
            return

        theta = self.stage.task.theta
        plant = self._evaluation.released(best.shares).calibrated(theta, trajectory)
        self._evaluation = ReleaseEvaluation(self.stage, self.space, plant)
        self._known.clear()
        self.best = self._evaluation.release(best.shares)
        last = self._history[-1]
        self._history[-1] = self._row(self.best, last.iteration, last.gamma)

    def _local_searches(self, tried: list[Release]) -> dict[str, StartResult]:
        """Follow the best releases of the grid; results by name."""
        wanted = max(LOCAL_SEARCHES, self.stage.task.experiment.descent.starts)
        starts = _apart(sorted(tried, key=lambda release: release.rank), wanted)

        results = {}
        for number, (start, found) in enumerate(self._followed(starts), start=1):
            name = f"grid release {number} of {len(starts)}"
            results[name] = self._local_result(name, start, found)
        return results

    def _followed(self, starts: list[Release]) -> Iterator[tuple[Release, Following]]:
        """Local searches from some releases that have begun, with their starts."""
        if self._is_over():
            return
        if self._workers is not None:
            found = self._workers.followed(self._evaluation, starts)
            begun = zip(starts, found, strict=True)
            yield from ((start, each) for start, each in begun if each.tried or each.is_lost)
            return

        evaluate, descent = self._evaluation.release, self.stage.task.experiment.descent
        for start in starts:
            if self._is_over():
                return
            yield start, follow(evaluate, start, descent, Following(), self._is_over)

    def _is_over(self) -> bool:
        """True where the time is used up, or after a request to stop."""
        return self.budget.exhausted is not None

    def _local_result(self, name: str, start: Release, found: Following) -> StartResult:
        """Take what a local search has tried."""
        count = len(self._known)
        self._name = name
        for release in found.tried:
            self._take(release)

        best = min([start, *found.tried], key=lambda release: release.rank)
        status = Status.RELEASE_FOUND if found.converged else Status.MAX_ITERATIONS
        if found.is_lost:
            status = Status.LOST
        return StartResult(
            name=name, cost=best.cost, status=status, iterations=len(self._known) - count
        )

    def _take(self, release: Release) -> None:
        """Count a release, and keep and report it if it is the best one."""
        self._known.add(release.shares.tobytes())
        if release.diverges or (self.best is not None and release.rank >= self.best.rank):
            return

        moved = 0.0
        if self.best is not None:
            moved = float(np.abs(release.shares - self.best.shares).max())
        self.best, self.found_by = release, self._name

        row = self._row(release, len(self._history), moved)
        self._history = list(extended(tuple(self._history), [row]))
        self._callback(DesignEvent(start=self._name, row=row))

    def _row(self, release: Release, iteration: int, moved: float) -> HistoryRow:
        """The iterate of a release; `moved`: distance from the one before, in ranges."""
        task = self.stage.task
        return HistoryRow(
            iteration=iteration,
            cost=release.cost,
            criterion=release.criterion,
            min_eigenvalue=release.min_eigenvalue,
            slope=np.nan,
            gamma=moved,
            seconds=self.budget.seconds_used,
            steps=task.plant.engine_steps - self._steps_before,
            rate=1.0 / task.dt,
            margin=min(release.margins_of_limits.values(), default=np.nan),
            margins=release.margins_of_limits,
            motion=release.motion,
        )


def _apart(ranked: list[Release], count: int) -> list[Release]:
    """The first releases of a ranking that lie apart from those before, at most `count`."""
    chosen: list[Release] = []
    for release in ranked:
        if release.diverges:
            continue
        far = all(np.abs(release.shares - other.shares).max() > LEAST_DISTANCE for other in chosen)
        if far:
            chosen.append(release)
        if len(chosen) == count:
            break
    return chosen
