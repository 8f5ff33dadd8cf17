"""Results of a coarse level are compared by their costs on the stated plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.constraint_kinds import ConstraintValues
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
)
from mjfim.excitation.end_correction import EndCorrection
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.merged_results import continued
from mjfim.excitation.rounds import Judge, Judgement
from mjfim.excitation.run_result import RunResult
from mjfim.records.design import Status

# Shares of a control of a coarse level that are tried with a corrected end, and the largest number
# of corrections of each.
SHARES = (1.0, 0.98, 0.94, 0.85, 0.72, 0.55, 0.35)
CORRECTIONS = 2


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

    The end of the motion is corrected for each share. Only one of them is evaluated.
    """

    def judged(self, cost: LimitedCost, result: RunResult, begun: InitialControl) -> Judgement:
        """Judge the result of a start.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: Its result in the first round.
            begun: Its initial control, which is not evaluated again.

        Returns:
            The result with the largest share of its control and the cost of it on the stated plant.
            The second round continues from the control itself.
        """
        if result.control is None:
            return Judgement(result=replace(result, cost=np.inf))

        inside = self._inside(cost, result.control)
        following = continued(result)
        if inside is None:
            outside = replace(result, cost=np.inf)
            return Judgement(result=outside, following=following, cost=result.cost)

        # An optimum of a coarse level is none of the stated one.
        is_optimum = result.status.success or result.status is Status.INFEASIBLE
        status = Status.MAX_ITERATIONS if is_optimum else result.status
        found = replace(result, control=inside.control, cost=inside.cost, status=status)
        return Judgement(result=found, following=following, cost=inside.cost)

    def _inside(self, cost: LimitedCost, control: Array) -> InsideControl | None:
        """A large share of a control that keeps all limits, with a corrected end; None without one.

        This takes a few simulations, also when the time is over, so that nothing is lost.
        """
        centre = cost.level.task.centre
        trials = ControlsWithinLimits(cost=cost, budget=Budget())
        correction: EndCorrection | None = None
        for share in SHARES:
            candidate = np.asarray(centre + share * (control - centre))
            for _ in range(1 + CORRECTIONS):
                values = cost.values(candidate)
                if values is not None and cost.constraints.is_feasible(values):
                    found = trials.inside(centre, candidate - centre, share)
                    if found is not None:
                        return found
                    break
                if values is None or not _misses_end(cost, values):
                    break

                # The change of the control hardly depends on its size.
                correction = correction or EndCorrection.along(cost, values)
                if correction is None:
                    break
                candidate = correction.corrected(candidate, values)
        return trials.largest(centre, control - centre)


def _misses_end(cost: LimitedCost, values: ConstraintValues) -> bool:
    """Check whether a motion ends outside the tolerances of its target."""
    margins = cost.constraints.margins(values)
    return any(margin < 0.0 for kind, margin in margins.items() if kind.startswith("end_"))
