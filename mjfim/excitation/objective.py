"""The extended system of the paper: states (x, psi), with the linearisation of its section IV-E.3.

    z' = A z + B v,   zeta_j' = (D_x DF[psi_j, e_j]) (z, v) + A zeta_j        for each parameter j

`n_x (1 + p)` states; meant for small systems, where a metric may weigh psi.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.robust import ParameterSamples
from mjfim.information.criteria import Criterion
from mjfim.information.fisher import FisherInformation
from mjfim.optimize.lq import TangentCurve
from mjfim.optimize.projection_operator import Expansion
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.derivatives import (
    CENTRAL_DIFFERENCES,
    FORWARD_DIFFERENCES,
    Bilinear,
    DifferenceAccuracy,
)
from mjfim.plant.plant import Plant
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Sensitivity, Trajectory


def extend(full: Bilinear, a: Array, b: Array, a_psi: Array) -> Expansion:
    """Expansion over (x, psi_1, ..., psi_p).

    full: bilinear along the unit directions of theta;  a: (N+1, nx);  b: (N, nu);  a_psi: (N+1, nx, p)
    """
    N, nx, nu = full.B.shape
    p = a_psi.shape[2]
    A = np.zeros((N, nx * (1 + p), nx * (1 + p)))
    B = np.zeros((N, nx * (1 + p), nu))
    A[:, :nx, :nx], B[:, :nx] = full.A, full.B
    for j in range(p):
        block = slice(nx * (1 + j), nx * (2 + j))
        mixed = np.swapaxes(full.F_mixed[j], 1, 2)
        A[:, block, block] = full.A
        A[:, block, :nx] = mixed[:, :, :nx]
        B[:, block] = mixed[:, :, nx:]
    stacked = np.swapaxes(a_psi, 1, 2).reshape(N + 1, nx * p)
    return Expansion(A=A, B=B, a=np.concatenate([a, stacked], axis=1), b=np.array(b))


@dataclass(frozen=True, eq=False)
class RunningCost:
    """`1/2 sum_k dt [(x_{k+1} - x_d)' Q (x_{k+1} - x_d) + (u_k - u_d)' R (u_k - u_d)]` over k = 0 ... N-1; x_0 is given.

    desired: x_d, (N+1, ns);  Q: (nx,) and R: (nu,) diagonals, not yet multiplied by dt;  rest: u_d, (nu,)
    """

    space: StateSpace
    dt: float
    desired: Array
    Q: Array
    R: Array
    rest: Array

    def value(self, trajectory: Trajectory) -> float:
        """The integral."""
        dx = self.space.minus(trajectory.state, self.desired)[1:]
        return float(
            0.5
            * self.dt
            * (np.sum(dx**2 * self.Q) + np.sum((trajectory.ctrl - self.rest) ** 2 * self.R))
        )

    def gradient(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """(a, b): derivative by x_k (N+1, nx) and u_k (N, nu)."""
        a = self.dt * self.space.minus(trajectory.state, self.desired) * self.Q
        a[0] = 0.0
        return a, self.dt * (trajectory.ctrl - self.rest) * self.R


@dataclass(frozen=True, eq=False)
class DesignPoint:
    """A trajectory with everything computed along it. A diverged trial has no trajectory and infinite cost.

    others: the same control at the further parameter samples of a robust design
    """

    trajectory: Trajectory | None
    sensitivity: Sensitivity | None
    information: Array | None
    criterion: Criterion | None
    cost: float
    accuracy: DifferenceAccuracy
    others: tuple[DesignPoint, ...] = ()

    @property
    def phi(self) -> tuple[float, ...]:
        """The criterion here and at the other samples."""
        return tuple(
            np.inf if p.criterion is None else p.criterion.value for p in (self, *self.others)
        )


DIVERGED = DesignPoint(None, None, None, None, np.inf, FORWARD_DIFFERENCES)


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """J(theta fixed) as Algorithm 1 wants it: a `pronto.Problem` over `Point`s.

    extended: expansions also carry psi as a state;  draft: never refine the differences (coarse levels)
    parameter_samples: of a robust design, its first sample theta itself; each sample is driven by the same control, open loop
    """

    plant: Plant
    theta: Array
    information: FisherInformation
    running: RunningCost
    extended: bool = False
    draft: bool = False
    parameter_samples: ParameterSamples | None = None

    def point(
        self, trajectory: Trajectory, accuracy: DifferenceAccuracy = FORWARD_DIFFERENCES
    ) -> DesignPoint:
        """Evaluate J along a trajectory."""
        point = self._sensed(self.theta, trajectory, accuracy)
        if point.criterion is None:
            return DIVERGED
        others = []
        for theta in () if self.parameter_samples is None else self.parameter_samples.thetas[1:]:
            try:
                others.append(
                    self._sensed(theta, self.plant.simulate(theta, trajectory.ctrl), accuracy)
                )
            except SimulationDivergedError:
                return DIVERGED
        return self._priced(replace(point, others=tuple(others)))

    def reevaluated(self, point: DesignPoint) -> DesignPoint:
        """A point of a problem that differs from this one in the criterion alone."""
        here, *others = (
            p
            if p.information is None
            else replace(p, criterion=self.information.evaluate(p.information))
            for p in (point, *point.others)
        )
        return (
            point if here.criterion is None else self._priced(replace(here, others=tuple(others)))
        )

    def _priced(self, point: DesignPoint) -> DesignPoint:
        trajectory, _, criterion = _computed(point)
        phi = (
            criterion.value
            if self.parameter_samples is None
            else self.parameter_samples.value(point.phi)
        )
        return replace(point, cost=phi + self.running.value(trajectory))

    def _sensed(
        self, theta: Array, trajectory: Trajectory, accuracy: DifferenceAccuracy
    ) -> DesignPoint:
        """A trajectory of the model at theta with its information; its cost is left open."""
        sensitivity = self.plant.derivatives.sensitivity(
            theta, trajectory, central=not accuracy.shared_origin
        )
        if sensitivity is None:
            return DIVERGED
        information = self.information.matrix(sensitivity)
        return DesignPoint(
            trajectory,
            sensitivity,
            information,
            self.information.evaluate(information),
            np.inf,
            accuracy,
        )

    def value(self, point: DesignPoint) -> float:
        """J; infinite for a diverged trial."""
        return point.cost

    def size(self, point: DesignPoint) -> float:
        """J; for D-optimality, whose J has no natural zero, one nat per parameter and the running cost."""
        if self.information.criterion != "D":
            return point.cost
        trajectory, _, criterion = _computed(point)
        return self.information.weight * len(criterion.eigenvalues) + self.running.value(trajectory)

    def expand(self, point: DesignPoint) -> Expansion:
        """Expansion of J about a point: mixed differences for the information, closed form for the rest."""
        return self.expand_observed(point, None)[0]

    def expand_observed(
        self, point: DesignPoint, observations: SubstepObservations | None
    ) -> tuple[Expansion, Array | None]:
        """The expansion, and the derivatives (N, looked-at substeps, w, nx+nu) of the observations, from the same steps."""
        trajectory, sensitivity, criterion = _computed(point)
        bilinear, a, b = self._slope(self.theta, point, observations)
        spectral = None
        if (
            self.parameter_samples is None
            and np.isfinite(criterion.power)
            and observations is not None
        ):
            spectral = self.information.spectral(criterion, sensitivity, bilinear, point.cost)
        if self.parameter_samples is not None:
            weights = self.parameter_samples.weights(point.phi)
            a, b = weights[0] * a, weights[0] * b
            for weight, theta, other in zip(
                weights[1:], self.parameter_samples.thetas[1:], point.others, strict=True
            ):
                own, a_own, b_own = self._slope(theta, other)
                open_loop = np.zeros((len(b_own), b_own.shape[1], a_own.shape[1]))
                b += weight * Expansion(A=own.A, B=own.B, a=a_own, b=b_own).gradient(open_loop)
        a_running, b_running = self.running.gradient(trajectory)
        extended = None
        if self.extended:
            full = self.plant.derivatives.bilinear(
                self.theta, trajectory, sensitivity.psi, np.eye(len(self.theta)), point.accuracy
            )
            a_psi, a_h, b_h = self.information.partials(criterion, sensitivity, full)
            extended = extend(full, a_running + a_h, b_running + b_h, a_psi)
        return Expansion(
            A=bilinear.A,
            B=bilinear.B,
            a=a + a_running,
            b=b + b_running,
            extended=extended,
            barrier=None,
            eigenvalue_model=spectral,
        ), bilinear.observation_jacobian

    def _slope(
        self, theta: Array, point: DesignPoint, observations: SubstepObservations | None = None
    ) -> tuple[Bilinear, Array, Array]:
        """Derivatives at a point, and those of phi by x (N+1, nx) and u (N, nu)."""
        trajectory, sensitivity, criterion = _computed(point)
        bilinear = self.plant.derivatives.bilinear(
            theta, trajectory, sensitivity.psi, criterion.directions, point.accuracy, observations
        )
        return bilinear, *self.information.gradient(criterion, sensitivity, bilinear)

    def project(
        self, point: DesignPoint, zeta: TangentCurve, gamma: float, K: Array
    ) -> DesignPoint:
        """P(xi + gamma zeta), evaluated."""
        trajectory, _, _ = _computed(point)
        moved = self.plant.project(self.theta, trajectory, zeta, gamma, K)
        return DIVERGED if moved is None else self.point(moved, point.accuracy)

    def difference(self, new: DesignPoint, old: DesignPoint) -> TangentCurve:
        """(x_new - x_old, u_new - u_old)."""
        return self.plant.difference(_computed(new)[0], _computed(old)[0])

    def refine(self, point: DesignPoint) -> DesignPoint | None:
        """The same point, to be expanded with central differences."""
        if self.draft or point.accuracy is CENTRAL_DIFFERENCES:
            return None
        return replace(
            point,
            accuracy=CENTRAL_DIFFERENCES,
            others=tuple(replace(o, accuracy=CENTRAL_DIFFERENCES) for o in point.others),
        )


def _computed(point: DesignPoint) -> tuple[Trajectory, Sensitivity, Criterion]:
    if point.trajectory is None or point.sensitivity is None or point.criterion is None:
        raise ValueError("a diverged trial has no expansion")
    return point.trajectory, point.sensitivity, point.criterion
