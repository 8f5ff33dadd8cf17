"""Results of a coarse level are compared by their costs on the stated plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.coarse_comparison import without_jumps
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
)
from mjfim.excitation.corrected_shares import CorrectedShares
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.merged_results import continued
from mjfim.excitation.rounds import Judge, Judgement
from mjfim.excitation.run_result import RunResult
from mjfim.records.design import Status


@dataclass(frozen=True, kw_only=True, eq=False)
class StatedComparison(Judge):
    """Replaces the cost on a coarse level by that on the stated plant."""

    def judged(self, cost: LimitedCost, result: RunResult, begun: InitialControl) -> Judgement:
        """Judge the result of a start.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: Its result in the first round.
            begun: Its initial control.

        Returns:
            The result with the better of the found and the initial control, by their costs on the
            stated plant. The second round continues from it, except where the found control
            violates a limit on the stated plant: then from the found control, with its cost on the
            coarse level, because the second round makes it feasible again.
        """
        found = [control for control in (result.control, begun.over_horizon) if control is not None]
        costs = [cost(control) for control in found]

        best = int(np.argmin(costs))
        compared = replace(result, cost=costs[best])
        if np.isfinite(compared.cost):
            compared = replace(compared, control=found[best])

        violates = result.control is not None and np.isinf(costs[0])
        candidate = result if violates else compared
        following = None if candidate.control is None else continued(candidate)
        return Judgement(result=compared, following=following, cost=candidate.cost)


@dataclass(frozen=True, kw_only=True, eq=False)
class LargestShare(Judge):
    """Replaces a control of a coarse level by a large share that keeps all limits.

    The end of the motion is corrected for each share. J is evaluated once, for the largest one.

    Attributes:
        budget: Time of the whole design, and the token that stops it.
        sample_factor: Factor by which the samples of the level are longer.
        compares_begin: Whether the initial control of the start may cost less. That of the first
            start is compared with the design anyway.
    """

    budget: Budget
    sample_factor: int = 1
    compares_begin: bool = True

    def judged(self, cost: LimitedCost, result: RunResult, begun: InitialControl) -> Judgement:
        """Judge the result of a start.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: Its result in the first round.
            begun: Its initial control.

        Returns:
            The result with the largest share of its control, or with the initial control where that
            costs less, and the cost on the stated plant. The second round continues from the
            control of the coarse level itself, or from the initial control where that costs less
            than the share.
        """
        found = result.control
        following: InitialControl | None = None
        inside: InsideControl | None = None
        if found is not None:
            found = without_jumps(cost, found, self.sample_factor)
            following = InitialControl(name=result.name, control=found)
            inside = self._inside(cost, found)

        best = found if inside is None else inside.control
        best_cost = np.inf if inside is None else inside.cost
        ranking = result.cost if inside is None else inside.cost

        # The initial control often costs little where it is an earlier design, for example.
        if self.compares_begin and not self.budget.stop.requested:
            begin_cost = cost(begun.over_horizon)
            if begin_cost < best_cost:
                best, best_cost = begun.over_horizon, begin_cost
                if inside is not None or found is None:
                    following, ranking = InitialControl(name=result.name, control=best), begin_cost

        # An optimum of a coarse level is none of the stated one.
        status = result.status
        if np.isfinite(best_cost) and (status.success or status is Status.INFEASIBLE):
            status = Status.MAX_ITERATIONS
        compared = replace(result, control=best, cost=best_cost, status=status)
        return Judgement(result=compared, following=following, cost=ranking)

    def _inside(self, cost: LimitedCost, control: Array) -> InsideControl | None:
        """A large share of a control that keeps all limits; None without one.

        This takes a few simulations, also when the time is over, so that nothing is lost.
        """
        centre = cost.level.task.centre
        trials = ControlsWithinLimits(cost=cost, budget=self.budget)
        if cost.constraints.end is not None:
            shares = CorrectedShares(cost, control, self.budget.stop)
            for found in shares.largest():
                inside = trials.inside(centre, found.control - centre, found.share)
                if inside is not None:
                    return inside
        return trials.largest(centre, control - centre)
