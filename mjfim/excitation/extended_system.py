"""The extended system of the paper: states (x, psi), with the linearisation of its section IV-E.3.

    z' = A z + B v,   zeta_j' = (D_x DF[psi_j, e_j]) (z, v) + A zeta_j        for each parameter j

It has `n_x (1 + p)` states and is meant for small systems, where a metric may weigh psi.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.optimize.projection_operator import Expansion
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.mixed_derivatives import Bilinear


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtendedDesignProblem(DesignProblem):
    """A design problem whose expansions have psi as a state, for a metric that weighs psi."""

    @classmethod
    def of(cls, problem: DesignProblem) -> ExtendedDesignProblem:
        """The extended problem with the attributes of another one."""
        return cls(**{field.name: getattr(problem, field.name) for field in fields(problem)})

    def expand_observed(
        self, point: DesignPoint, observations: SubstepObservations | None
    ) -> tuple[Expansion, Array | None]:
        """Expansion with its extended form. See `DesignProblem.expand_observed`."""
        expansion, jacobian = super().expand_observed(point, observations)
        return replace(expansion, extended=self._extended(point)), jacobian

    def _extended(self, point: DesignPoint) -> Expansion:
        """Expansion of J over (x, psi)."""
        trajectory, sensitivity, criterion = point.trajectory, point.sensitivity, point.criterion
        if trajectory is None or sensitivity is None or criterion is None:
            raise ValueError("a diverged trial has no expansion")

        full = self.plant.derivatives.bilinear(
            self.theta, trajectory, sensitivity.psi, np.eye(len(self.theta)), point.accuracy
        )
        a_psi, a, b = self.information.partial_derivatives(criterion, sensitivity, full)
        a_running, b_running = self.running.gradient(trajectory)
        return extend(full, a_running + a, b_running + b, a_psi)


def extend(full: Bilinear, a: Array, b: Array, a_psi: Array) -> Expansion:
    """Expand over the extended state (x, psi_1, ..., psi_p).

    Args:
        full: Bilinear derivatives along the unit directions of theta.
        a: (N+1, nx) derivative of J by the state at constant psi.
        b: (N, nu) derivative of J by the control at constant psi.
        a_psi: (N+1, nx, p) derivative of J by psi.

    Returns:
        The expansion, with nx (1+p) states.
    """
    N, nx, nu = full.B.shape
    p = a_psi.shape[2]
    A = np.zeros((N, nx * (1 + p), nx * (1 + p)))
    B = np.zeros((N, nx * (1 + p), nu))
    A[:, :nx, :nx] = full.A
    B[:, :nx] = full.B

    for j in range(p):
        # (N, nx, nx+nu) derivative of the next psi_j by the state and the control.
        mixed = np.swapaxes(full.F_mixed[j], 1, 2)

        psi_j = slice(nx * (1 + j), nx * (2 + j))
        A[:, psi_j, :nx] = mixed[:, :, :nx]
        A[:, psi_j, psi_j] = full.A
        B[:, psi_j] = mixed[:, :, nx:]

    stacked = np.swapaxes(a_psi, 1, 2).reshape(N + 1, nx * p)
    return Expansion(A=A, B=B, a=np.concatenate([a, stacked], axis=1), b=np.array(b))
