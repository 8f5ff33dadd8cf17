"""The best result of a design under hard limits is made to keep all limits of the model.

The barrier evaluates distances at the samples and other quantities at some engine steps; between
them a limit may be violated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.feasibility import reduced_actuators, shrink_about_each
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.task import DesignTask
from mjfim.excitation.verification import verify
from mjfim.records.design import Status

# Time after a request to stop in which a result may still be moved inside the limits [s].
SECONDS_AFTER_STOP = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class CostedControl:
    """A control with its cost on the unmodified model.

    Attributes:
        cost: J; infinite where the control violates a limit.
        control: (N, nu) control [u-unit].
    """

    cost: float
    control: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ViolatingWinner:
    """The best result where it violates a limit of the unmodified model.

    Attributes:
        index: Its index.
        margins: Worst margins relative to half of the range, by kind of limit.
    """

    index: int
    margins: Mapping[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class WinnerRepair:
    """Makes sure that the best result keeps all limits of the unmodified model.

    Attributes:
        cost: Cost of controls that keep all limits.
        budget: Time of the whole design, and the token that stops it.
    """

    cost: LimitedCost
    budget: Budget

    def violating(self, results: Sequence[RunResult]) -> ViolatingWinner | None:
        """Find out whether the best result violates a limit on the unmodified model.

        Args:
            results: Result of every start.

        Returns:
            The best result; None where it keeps all limits.
        """
        if not results:
            return None

        winner = min(range(len(results)), key=lambda i: results[i].cost)
        control = results[winner].control
        if control is None or not np.isfinite(results[winner].cost):
            return None

        task = self._task
        found = verify(task, task.plant.simulate(task.theta, control))
        if found.is_feasible or not np.isfinite(found.deviation):
            return None

        return ViolatingWinner(index=winner, margins=found.relative_margins)

    def repaired(self, results: Sequence[RunResult]) -> list[RunResult]:
        """Replace the best result until it keeps all limits.

        A winner that violates a limit is replaced by the best feasible control that its start has
        seen, or counts as infeasible; then the next best result has to be feasible. After a request
        to stop this ends with the waiting time.

        Args:
            results: Result of every start.
        """
        results = list(results)
        waiting = Budget(seconds=SECONDS_AFTER_STOP)
        while not (self.budget.stop.requested and waiting.exhausted):
            winner = self.violating(results)
            if winner is None:
                return results

            results[winner.index] = self._best_feasible(results[winner.index], waiting)
        return results

    def shrink(self, control: Array) -> CostedControl:
        """Shrink a control about each centre until no limit is violated; the best one counts.

        Args:
            control: (N, nu) control [u-unit].

        Returns:
            The best shrunk control; the given one with an infinite cost where none is feasible.
        """

        def feasible(candidate: Array) -> CostedControl | None:
            """The control with its cost; None where it violates a limit."""
            cost = self.cost(candidate)
            return CostedControl(cost=cost, control=candidate) if np.isfinite(cost) else None

        found = shrink_about_each(control, self._task.centres, feasible)
        outside = CostedControl(cost=np.inf, control=control)
        return min(found, key=lambda candidate: candidate.cost, default=outside)

    @cached_property
    def shrunk_initial(self) -> CostedControl:
        """The initial control, shrunk inside the limits."""
        return self.shrink(self._task.control)

    def _best_feasible(self, result: RunResult, waiting: Budget) -> RunResult:
        """A result with its best feasible control: a shrunk one, or that of an earlier stage."""
        control = np.asarray(result.control)
        found = [self.shrink(control)]
        found += [CostedControl(cost=self.cost(each), control=each) for each in result.earlier]

        # No run within tighter limits may follow a request to stop.
        if self.budget.stop.requested:
            found += self._with_reduced_actuators(control, waiting)

        best = min(found, key=lambda feasible: feasible.cost)
        if not np.isfinite(best.cost):
            return replace(result, cost=np.inf, status=Status.INFEASIBLE)
        return replace(result, control=best.control, cost=best.cost, status=Status.BEST_SEEN)

    def _with_reduced_actuators(self, control: Array, waiting: Budget) -> Iterator[CostedControl]:
        """Feasible controls in which one actuator deviates less, while there is time to wait."""
        for candidates in reduced_actuators(control, self._task.centre):
            for candidate in candidates:
                if waiting.exhausted is not None:
                    return
                cost = self.cost(candidate)
                if np.isfinite(cost):
                    yield CostedControl(cost=cost, control=candidate)
                    break

    @property
    def _task(self) -> DesignTask:
        """The stated task, on the plant without clamps."""
        return self.cost.level.task
