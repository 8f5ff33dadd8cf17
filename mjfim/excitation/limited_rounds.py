"""Rounds of searches under hard limits, whose best result keeps all limits of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.rescue import Rescue
from mjfim.excitation.rounds import Entry, RoundPlan
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.run_rounds import run_rounds
from mjfim.excitation.tightened_runs import run_within_tighter_limits
from mjfim.excitation.winner_repair import WinnerRepair

# Share of the time that is reserved for runs within tighter limits.
RESERVED_SHARE = 0.05

# Number of iterations for which there has to be time, so that the search of a start is useful.
FEWEST_ITERATIONS = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class LimitedRounds(RoundPlan):
    """Rounds of searches under hard limits, and what makes the best result keep all limits.

    Attributes:
        iterations_done: Iterations of the design before.
    """

    iterations_done: int = 0

    def run(self) -> Runs:
        """Optimise from all starts.

        Yields:
            Every iterate.

        Returns:
            One result per start that was begun; its cost is that on the stated plant, except after
            a request to stop.
        """
        return (yield from run_rounds(self, self.affordable()))

    def affordable(self) -> Sequence[InitialControl]:
        """The first starts, as many as there is time for."""
        return self.starts

    def tighten_winner(self, results: Sequence[RunResult]) -> Runs:
        """Make the best result keep all limits of the unmodified model.

        It is optimised again within tighter limits. Where that does not help, its control is
        shrunk. Where no start found anything feasible, a feasible motion is searched for.

        Args:
            results: Result of every start.

        Yields:
            Every iterate.

        Returns:
            The results, of which the best one is replaced.
        """
        results = yield from run_within_tighter_limits(
            self.searches, self.repair, results, self.sharpest
        )
        results = self.repair.repaired(results)
        if (
            any(np.isfinite(result.cost) for result in results)
            or self.searches.budget.stop.requested
        ):
            return results

        rescue = Rescue(
            searches=self.searches, repair=self.repair, max_iterations=self.max_iterations
        )
        return (yield from rescue.run(results))

    @property
    def sharpest(self) -> BarrierSchedule:
        """Stages of the barrier on the stated level."""
        return BarrierSchedule()

    @cached_property
    def repair(self) -> WinnerRepair:
        """Makes results keep all limits of the unmodified model."""
        return WinnerRepair(cost=self.limited_cost, budget=self.searches.budget)

    @property
    def reserved_seconds(self) -> float:
        """Time that is reserved for runs within tighter limits [s]; 0 without a limit of time."""
        return RESERVED_SHARE * (self.searches.stated.task.experiment.descent.seconds or 0.0)

    @property
    def seconds_left(self) -> float:
        """Time that is left for rounds [s]."""
        return max(self.searches.budget.seconds_left - self.reserved_seconds, 0.0)

    def seconds_of_iteration(self, entry: Entry) -> float:
        """Expected time of an iteration on the level of a start [s]; 0 in the first round."""
        return entry.seconds_per_step * self.rounds[entry.round].level.engine_steps

    def has_time_for(self, entry: Entry) -> bool:
        """Check whether there is time for a useful search on the level of a start."""
        return self.seconds_left >= FEWEST_ITERATIONS * self.seconds_of_iteration(entry)

    @property
    def max_iterations(self) -> int:
        """Largest number of iterations of one start over all rounds."""
        return max(
            self.searches.stated.task.experiment.descent.max_iterations - self.iterations_done, 1
        )
