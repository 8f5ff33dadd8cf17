"""Results of a coarse level are compared by their costs on the stated plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.merged_results import continued
from mjfim.excitation.rounds import Judge, Judgement
from mjfim.excitation.run_result import RunResult


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
