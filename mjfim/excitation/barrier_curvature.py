"""Curvature of the barrier of all limits along a step, instead of that at its beginning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.constraint_kinds import ConstraintValues, ExpansionSums, LimitedQuantities
from mjfim.optimize.barrier import CurvatureAlong, StepCurvature, curvature_factors
from mjfim.optimize.lq import TangentCurve


@dataclass(frozen=True, kw_only=True, eq=False)
class CurvatureOfLimits(StepCurvature):
    """The barrier about a trajectory, from which its curvature along steps follows.

    It can be pickled with the state of a search.

    Attributes:
        members: The kinds of limited quantities.
        values: The quantities along the trajectory, with their derivatives.
        delta: Relaxation of the barrier, a relative margin.
        nu: Number of controls.
        mu: Weight of the barrier.
    """

    members: tuple[LimitedQuantities, ...]
    values: ConstraintValues
    delta: float
    nu: int
    mu: float = 1.0

    def along(self, step: TangentCurve, factors: Sequence[Array] | None) -> CurvatureAlong:
        """See `StepCurvature.along`."""
        found: list[Array] = []
        growth = 1.0
        for i, member in enumerate(self.members):
            slacks = member.slacks(self.values)
            old = np.ones(slacks.shape) if factors is None else factors[i]
            changes = member.slack_changes(self.values, step)
            new = curvature_factors(slacks, changes, old, self.delta)
            growth = max(growth, float((new / old).max(initial=1.0)))
            found.append(new)

        return CurvatureAlong(
            weights=self.sums(found).weights.scaled(self.mu), factors=tuple(found), growth=growth
        )

    def sums(self, factors: Sequence[Array] | None = None) -> ExpansionSums:
        """Gradient and Gauss-Newton Hessian of the barrier, without its weight.

        Args:
            factors: Factors of the curvature, by kind; default: 1.
        """
        jacobian = self.values.observation_jacobian
        if jacobian is None:
            raise ValueError("the observations have no derivatives")

        sums = ExpansionSums.zero(len(jacobian), jacobian.shape[-1] - self.nu, self.nu)
        for i, member in enumerate(self.members):
            each = None if factors is None else factors[i]
            member.add_expansion(self.values, self.delta, sums, each)
        return sums

    def scaled(self, mu: float) -> CurvatureOfLimits:
        """See `StepCurvature.scaled`."""
        return replace(self, mu=mu * self.mu)
