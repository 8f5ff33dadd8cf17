"""Small changes of a control that bring the end of its motion back to its target.

A motion that was optimised on a coarse level ends a little beside its target on the stated plant.
Its tolerances there are narrow, so that a share of the control that keeps them would tell little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.constraint_kinds import ConstraintValues, EndStateConstraint
from mjfim.excitation.inside import InsideControl, LimitedCost
from mjfim.parallel.budget import Budget

# Singular values of the reachable ends, relative to the largest one, below which they count as
# zero: no control of reasonable size reaches these directions.
LEAST_REACH = 1e-6

# Shares of a control that are tried, and the largest number of corrections of each.
SHARES = (1.0, 0.98, 0.94, 0.85, 0.72, 0.55, 0.35)
CORRECTIONS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class EndCorrection:
    """The smallest change of a control that moves the last state, to first order.

    It keeps the bandwidth that the experiment states. Without one it is free at each sample.

    Attributes:
        cost: Cost of controls that keep all limits, whose plant is linearised.
        change: (N, nu, nv) change of the control [u-unit] for a unit of each component of the last
            state that has a tolerance [x-unit].
    """

    cost: LimitedCost
    change: Array

    @classmethod
    def along(cls, cost: LimitedCost, values: ConstraintValues) -> EndCorrection | None:
        """Linearise the plant along a motion.

        Args:
            cost: Cost of controls that keep all limits.
            values: Limited quantities along the motion.

        Returns:
            The correction; None with a free end, and where the motion diverges or is so unstable
            that its derivatives overflow.
        """
        constraints, task = cost.constraints, cost.level.task
        if constraints.end is None:
            return None
        try:
            A, B, _ = task.plant.derivatives.observation_jacobians(
                task.theta, values.trajectory, constraints.observations
            )
        except SimulationDivergedError:
            return None

        # Derivative of the last state by the control of each sample, in sizes of the controls.
        bounded = _has_tolerance(constraints.end)
        sizes = constraints.control.bounds.scale
        reach = np.eye(len(bounded))[bounded]
        by_control = np.empty((len(A), len(reach), B.shape[2]))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in reversed(range(len(A))):
                by_control[k] = reach @ B[k] * sizes
                reach = reach @ A[k]

            # A control of limited bandwidth is a sum of splines, of which only the shares are free.
            curves = bandwidth_basis(task, task.stated_times)
            by_share = by_control if curves is None else np.tensordot(curves.T, by_control, axes=1)

            # States have several units, so that each row is divided by its tolerance.
            tolerance = constraints.end.bounds.scale[bounded]
            flat = by_share.transpose(1, 0, 2).reshape(len(tolerance), -1) / tolerance[:, None]
        if not np.isfinite(flat).all():
            return None

        inverse = np.linalg.pinv(flat, rcond=LEAST_REACH) / tolerance
        change = inverse.reshape(len(by_share), B.shape[2], len(tolerance)) * sizes[:, None]
        if curves is not None:
            change = np.tensordot(curves, change, axes=1)
        return cls(cost=cost, change=change)

    def corrected(self, control: Array, values: ConstraintValues) -> Array:
        """Change a control so that its motion ends nearer to the target.

        Args:
            control: (N, nu) control [u-unit].
            values: Limited quantities along its motion.
        """
        end = self.cost.constraints.end
        assert end is not None
        difference = end.space.minus(values.trajectory.state[-1], end.target)
        return np.asarray(control - self.change @ difference[_has_tolerance(end)])


def _has_tolerance(end: EndStateConstraint) -> NDArray[np.bool_]:
    """(nx,) True for each component of the last state that has a tolerance."""
    return np.isfinite(end.bounds.upper)


def with_corrected_end(cost: LimitedCost, control: Array, budget: Budget) -> InsideControl | None:
    """Find a large share of a control that keeps all limits, when its end is corrected.

    Args:
        cost: The cost within the limits.
        control: (N, nu) control, whose motion misses its target by little [u-unit].
        budget: A request to stop ends the search.

    Returns:
        The control; None where the motion does not miss its target, or no share helps.
    """
    centre = cost.level.task.centre
    correction: EndCorrection | None = None
    for share in SHARES:
        candidate = np.asarray(centre + share * (control - centre))
        for corrections_left in reversed(range(1 + CORRECTIONS)):
            values = cost.values(candidate)
            if values is None or budget.stop.requested:
                break
            if cost.constraints.is_feasible(values):
                point = cost.point_along(values) if cost.keeps_along(values) else None
                if point is not None and np.isfinite(point.cost):
                    deviation = candidate - centre
                    return InsideControl(about=centre, deviation=deviation, point=point)
                break
            margins = cost.constraints.margins(values)
            misses = any(each < 0.0 for kind, each in margins.items() if kind.startswith("end_"))
            if not (misses and corrections_left):
                break
            # The change of the control hardly depends on its size, so that it is computed once.
            correction = correction or EndCorrection.along(cost, values)
            if correction is None:
                return None
            candidate = correction.corrected(candidate, values)
    return None
