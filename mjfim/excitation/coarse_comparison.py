"""Results of levels with longer samples are brought inside the limits of the stated plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
)
from mjfim.excitation.evaluation import point_at_stated_rate
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.rounds import Judge, Judgement
from mjfim.excitation.run_result import RunResult
from mjfim.records.design import Status

# Largest part of J on the stated plant that a coarse level may miss. Beyond that it is wrong, and
# the next level begins where this one began, if that is better.
LARGEST_ERROR = 1.0 / 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseComparison(Judge):
    """Compares the results of a coarse level.

    Attributes:
        sample_factor: Factor by which the samples of the level are longer.
    """

    sample_factor: int

    def judged(self, cost: LimitedCost, result: RunResult, begun: InitialControl) -> Judgement:
        """Judge the result of a start.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: Its result on the coarse level.
            begun: Control with which the round began.

        Returns:
            The result with the largest share of its control that keeps all limits. The next round
            begins with the control itself, or with the one before where that is better.
        """
        stated = self.on_stated_plant(cost, result, is_tried=True)
        candidate = self.candidate(cost, result, begun)
        return replace(candidate, result=stated)

    def candidate(self, cost: LimitedCost, result: RunResult, begun: InitialControl) -> Judgement:
        """The control that a coarse level has found, or the one before where that is better.

        The control before is tried only where the found one costs much more on the stated plant
        than on the coarse level. A round without any usable control changes nothing but the level.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: Its result on the coarse level.
            begun: Control with which the round began.

        Returns:
            The control with its cost: that on the coarse level, or that on the stated plant where
            the coarse one is too low.
        """
        before = replace(begun, basis=None)
        if result.control is None:
            return Judgement(result=result, following=before, is_new=False)

        control = without_jumps(cost, np.asarray(result.control), self.sample_factor)
        found = InitialControl(name=result.name, control=control)
        point = point_without_limits(cost.level, control)
        stated = np.inf if point is None else point.cost
        if point is not None:
            size = cost.level.problem.size(point)
            if stated - result.cost <= LARGEST_ERROR * size:
                return Judgement(result=result, following=found, cost=result.cost)

        point_before = point_without_limits(cost.level, begun.control)
        stated_before = np.inf if point_before is None else point_before.cost
        is_new = stated < stated_before
        return Judgement(
            result=result,
            following=found if is_new else before,
            cost=max(result.cost, min(stated, stated_before)),
            is_new=is_new,
        )

    def on_stated_plant(self, cost: LimitedCost, result: RunResult, *, is_tried: bool) -> RunResult:
        """Result of a coarse level with a control that keeps all limits on the stated plant.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: The result.
            is_tried: Whether there is time to look for such a control; without it, J is infinite.
        """
        inside = self._inside(cost, result) if is_tried else None
        status = result.status
        if inside is None:
            has_ended = is_tried and status not in (Status.INTERRUPTED, Status.LOST)
            status = Status.INFEASIBLE if has_ended else status

        # An optimum of a coarse level is none of the stated one.
        elif status is Status.INFEASIBLE:
            status = Status.MAX_ITERATIONS
        status = Status.MAX_ITERATIONS if status.success else status

        return replace(
            result,
            control=result.control if inside is None else inside.control,
            cost=np.inf if inside is None else inside.cost,
            status=status,
            earlier=(),
        )

    def _inside(self, cost: LimitedCost, result: RunResult) -> InsideControl | None:
        """The largest share of a control of a coarse level that keeps all limits."""
        if result.control is None:
            return None
        centre = cost.level.task.centre
        control = without_jumps(cost, result.control, self.sample_factor)

        # This takes a few simulations, also after a request to stop, so that nothing is lost.
        trials = ControlsWithinLimits(cost=cost, budget=Budget())
        return trials.largest(centre, control - centre)


def without_jumps(cost: LimitedCost, control: Array, factor: int) -> Array:
    """A control without steps where rates of controls are limited.

    Args:
        cost: Cost of controls that keep all limits on the stated plant.
        control: (N, nu) control of a coarse level [u-unit].
        factor: Factor by which the samples of the level are longer.

    Returns:
        (N, nu) control [u-unit].
    """
    if factor == 1 or cost.constraints.rate is None:
        return control

    # A control that consists of curves, such as a Fourier series, is smooth already.
    values = control[::factor]
    if not np.array_equal(control, np.repeat(values, factor, axis=0)):
        return control

    # The values of the longer samples hold at their middles.
    middles = factor * (np.arange(len(values)) + 0.5) - 0.5
    times = np.arange(len(control))
    columns = [np.interp(times, middles, column) for column in values.T]
    return np.stack(columns, axis=1)


def point_without_limits(level: DescentLevel, control: Array) -> DesignPoint | None:
    """Evaluate a control on the stated plant, inside limits or not.

    Args:
        level: The stated level, on the plant without clamps.
        control: (N, nu) control [u-unit].

    Returns:
        The point; None where the simulation diverges.
    """
    point = point_at_stated_rate(level, control)
    return None if point is None or point.trajectory is None else point
