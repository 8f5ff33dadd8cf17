"""The search for a feasible motion where no start of a design under hard limits found one."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.limited_searches import LimitedSearches, SearchTerms
from mjfim.excitation.merged_results import append_run
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.winner_repair import WinnerRepair
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent

# Least number of iterations of the run that follows where no start found a feasible motion; it is
# never larger than that of the experiment.
RESCUE_ITERATIONS = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class Rescue:
    """Searches for a feasible motion, and optimises from there.

    Attributes:
        searches: Runs the searches.
        repair: Makes results keep all limits of the unmodified model.
        max_iterations: Largest number of iterations of one start.
    """

    searches: LimitedSearches
    repair: WinnerRepair
    max_iterations: int

    def run(self, results: Sequence[RunResult]) -> Runs:
        """Search for a feasible motion where no start found one, and optimise from there.

        Each control is shrunk about the controls that hold the start, even when the time is used
        up. Where that does not help, these are steered inside the limits.

        Args:
            results: Result of every start, none of which is feasible.

        Yields:
            Every iterate.

        Returns:
            The results.
        """
        results = list(results)
        budget = self.searches.budget
        for i, result in enumerate(results):
            # With several starts this may take long.
            if i and budget.exhausted is not None:
                break
            results[i] = self._rescued_by_shrinking(result)

        best = min(range(len(results)), key=lambda i: results[i].cost, default=None)
        if best is None:
            return results

        begins = self._steered_begins(results)
        if np.isfinite(results[best].cost):
            begins = [np.asarray(results[best].control)]
        for control in begins:
            if budget.exhausted is not None:
                break

            found = yield from self._continue_inside(results[best], control)
            if found.cost < results[best].cost:
                results[best] = found
            if np.isfinite(results[best].cost):
                break

        return results

    def _rescued_by_shrinking(self, result: RunResult) -> RunResult:
        """A result with the feasible control to which its own one can be shrunk, if there is one.

        The initial control is shrunk as well, since its motion may be inside where that of the
        result is not.
        """
        if result.control is None:
            return result

        found = (self.repair.shrink(result.control), self.repair.shrunk_initial)
        best = min(found, key=lambda feasible: feasible.cost)
        if not np.isfinite(best.cost):
            return result
        begun = replace(result, control=best.control, cost=best.cost)
        return replace(begun, status=Status.MAX_ITERATIONS)

    def _steered_begins(self, results: Sequence[RunResult]) -> list[Array]:
        """Controls, (N, nu) each, from which the limits may be reached without the cost."""
        task = self.repair.cost.level.task
        begins = [np.tile(centre, (task.samples, 1)) for centre in reversed(task.centres)]
        for result in results:
            if result.control is not None:
                return [*begins, np.array(result.control)]
        return begins

    def _continue_inside(
        self, result: RunResult, control: Array
    ) -> Generator[DesignEvent, None, RunResult]:
        """Optimise from a control, which is first steered inside the limits.

        Args:
            result: Result that is continued.
            control: (N, nu) control with which to begin [u-unit].

        Returns:
            The result with the history and the engine steps of both. It is feasible on the
            unmodified model where its cost is finite.
        """
        done = result.history[-1].iteration if result.history else 0
        iterations = max(self.max_iterations - done, RESCUE_ITERATIONS)
        run = yield from self.searches.run(
            self.repair.cost.level,
            InitialControl(name=result.name, control=control),
            SearchTerms(
                schedule=BarrierSchedule(),
                max_iterations=min(iterations, self.max_iterations),
                seconds=self.searches.budget.seconds_left,
                inside_first=True,
            ),
        )
        if run is None:
            return result
        (repaired,) = self.repair.repaired([run])
        return append_run(result, repaired)
