"""Time-varying linear-quadratic problems on arrays: recursions, regulator, descent. Knows no plant and no cost.

The linear recursions are unit-triangular banded systems; one BLAS call solves each, no Python loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtbsv
from scipy.linalg.lapack import dposv

from mjfim.arrays import Array


@dataclass(frozen=True, eq=False)
class LinearRecursion:
    """The linear recursion `z_{k+1} = A_k z_k + c_k`, z_0 given, and its adjoint, for one A: (N, n, n)."""

    A: Array

    @cached_property
    def _band(self) -> Array:
        N, n, _ = self.A.shape
        band = np.zeros((2 * n, (N + 1) * n), order="F")
        band[0] = 1.0
        i, j = np.indices((n, n))
        columns = (np.arange(N) * n)[:, None, None] + j
        band[np.broadcast_to(n + i - j, columns.shape), columns] = -self.A
        return band

    def forward(self, z0: Array, c: Array) -> Array:
        """z: (N+1, n) from z0: (n,) and c: (N, n)."""
        rhs = np.concatenate([z0[None], c])
        return self._solve(rhs, transposed=False)

    def adjoint(self, a: Array) -> Array:
        """l: (N+1, n) with `l_k = A_k' l_{k+1} + a_k`, `l_N = a_N`, from a: (N+1, n)."""
        return self._solve(a, transposed=True)

    def _solve(self, rhs: Array, transposed: bool) -> Array:
        N, n, _ = self.A.shape
        if rhs.shape != (N + 1, n):
            raise ValueError(
                f"a recursion over {N} samples of {n} needs {(N + 1, n)} numbers, got {rhs.shape}"
            )
        flat = np.array(rhs, dtype=np.float64).reshape(-1)
        with np.errstate(over="ignore", invalid="ignore"):
            solution = dtbsv(
                2 * n - 1, self._band, flat, lower=1, trans=int(transposed), diag=1, overwrite_x=1
            )
        return np.asarray(solution).reshape(rhs.shape)


def largest_amplification(A: Array) -> float:
    """Largest amplification of a unit deviation, from the start to any sample or from any sample to the end.

    A: (N, nx, nx)
    """
    N, nx, _ = A.shape
    recursion, zero = LinearRecursion(A), np.zeros((N, nx))
    unit = np.eye(nx)
    onward = np.stack([recursion.forward(e, zero) for e in unit], axis=2)
    back = np.stack([recursion.adjoint(np.concatenate([zero, e[None]])) for e in unit], axis=1)
    return float(
        max(
            np.linalg.norm(onward, 2, axis=(1, 2)).max(), np.linalg.norm(back, 2, axis=(1, 2)).max()
        )
    )


def _solve(S: Array, rhs: Array) -> Array:
    """S^-1 rhs for a small symmetric positive definite S, without the overhead of NumPy's checks."""
    _, x, info = dposv(S, rhs)
    if info != 0:
        raise np.linalg.LinAlgError(
            "the Riccati recursion lost positive definiteness; its weights must be positive"
        )
    return np.asarray(x)


def regulator(A: Array, B: Array, Q: Array, R: Array, terminal: Array) -> Array:
    """Gain K: (N, nu, nx) minimising `sum z'Qz + v'Rv` plus `z_N' terminal z_N` with `v = -K z`.

    A: (N, nx, nx);  B: (N, nx, nu);  Q, terminal: (nx, nx);  R: (nu, nu)
    """
    K = np.empty((len(A), B.shape[2], A.shape[1]))
    P = terminal
    for k in range(len(A) - 1, -1, -1):
        BP = B[k].T @ P
        K[k] = _solve(R + BP @ B[k], BP @ A[k])
        P = Q + A[k].T @ P @ (A[k] - B[k] @ K[k])
        P = 0.5 * (P + P.T)  # symmetrise: round-off grows backwards in time otherwise
    return K


@dataclass(frozen=True, kw_only=True, eq=False)
class TangentCurve:
    """A tangent vector zeta = (z, v) of the trajectory manifold. z: (N+1, nx), v: (N, nu)."""

    z: Array
    v: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Weights:
    """A quadratic form on tangent curves, `sum z'Qz + 2 v'Sz + v'Rv`, and one on the steps of the control.

    Q: (N+1, nx, nx), the last on z_N;  S: (N, nu, nx);  R: (N, nu, nu)
    W: (N+1, nu), of `v_k - v_{k-1}`, where the control before the first and after the last sample does not move
    """

    Q: Array
    S: Array
    R: Array
    W: Array

    def plus(self, other: Weights, factor: float = 1.0) -> Weights:
        """Sum of this form and a multiple of another one.

        Args:
            other: The form to add.
            factor: Number with which the other form is multiplied.

        Returns:
            The sum; neither form is changed.
        """
        return Weights(
            Q=self.Q + factor * other.Q,
            S=self.S + factor * other.S,
            R=self.R + factor * other.R,
            W=self.W + factor * other.W,
        )

    def scaled(self, factor: float) -> Weights:
        """This form multiplied by a number."""
        return Weights(Q=factor * self.Q, S=factor * self.S, R=factor * self.R, W=factor * self.W)

    def half_gradient(self, zeta: TangentCurve) -> tuple[Array, Array]:
        """(N+1, nx) and (N, nu): half the derivative of the form, so that `<zeta, other> = a.z + b.v`."""
        z, v = zeta.z, zeta.v
        a = np.einsum("kij,kj->ki", self.Q, z)
        a[:-1] += np.einsum("kui,ku->ki", self.S, v)
        b = np.einsum("kui,ki->ku", self.S, z[:-1]) + np.einsum("kuw,kw->ku", self.R, v)
        pull = self.W * np.diff(v, axis=0, prepend=0.0, append=0.0)
        return a, b + pull[:-1] - pull[1:]


def descent(
    A: Array, B: Array, a: Array, b: Array, Q: Array, R: Array, terminal: Array
) -> TangentCurve:
    """Minimiser of `sum a'z + b'v + 1/2 z'Qz + 1/2 v'Rv` subject to `z_{k+1} = A z_k + B v_k`, `z_0 = 0`.

    a: (N+1, nx);  b: (N, nu);  Q, terminal: (nx, nx), the metric on z_k for k < N and on z_N;  R: (nu, nu)
    The paper's problem (8), solved by its Riccati equations.
    """
    N, nx, nu = B.shape
    held = Weights(
        Q=np.stack([*[Q] * N, terminal]),
        S=np.zeros((N, nu, nx)),
        R=np.stack([R] * N),
        W=np.zeros((N + 1, nu)),
    )
    return RiccatiSolution.solve(A, B, held).descent(a, b)


@dataclass(frozen=True, eq=False)
class RiccatiSolution:
    """The same problem under weights that vary over time, couple state and control, and hold the control's steps down.

    Factored once for any number of costs: only banded systems are left. With weights on the steps, the state of the
    recursion also carries the control before.
    K: (N, nu, n) gain;  inverse: (N, nu, nu) of `R + B'PB`;  closed: `A - B K`;  drive: (N, n, nu);  nx: n, or less
    """

    K: Array
    inverse: Array
    closed: LinearRecursion
    drive: Array
    nx: int

    @staticmethod
    def solve(A: Array, B: Array, weights: Weights) -> RiccatiSolution:
        """Solve the Riccati equations. Raises LinAlgError where the form is not positive on the controls."""
        N, nx, nu = B.shape
        Q, S, R = weights.Q, weights.S, weights.R
        if weights.W.any():
            wide, drive, steps = (
                np.zeros((N, nx + nu, nx + nu)),
                np.zeros((N, nx + nu, nu)),
                np.eye(nu) * weights.W[:, None],
            )
            wide[:, :nx, :nx], drive[:, :nx], drive[:, nx:] = A, B, np.eye(nu)
            A, B, R = wide, drive, R + steps[:-1]
            Q, S = np.zeros((N + 1, nx + nu, nx + nu)), np.zeros((N, nu, nx + nu))
            Q[:, :nx, :nx], Q[:, nx:, nx:] = weights.Q, steps
            S[:, :, :nx], S[:, :, nx:] = weights.S, -steps[:-1]
        K, inverse, P, unit = np.empty_like(S), np.empty_like(R), Q[N], np.eye(nu)
        for k in range(N - 1, -1, -1):
            BP = B[k].T @ P
            both = _solve(R[k] + BP @ B[k], np.concatenate([BP @ A[k] + S[k], unit], axis=1))
            K[k], inverse[k] = both[:, :-nu], both[:, -nu:]
            P = Q[k] + A[k].T @ P @ (A[k] - B[k] @ K[k]) - S[k].T @ K[k]
            P = 0.5 * (P + P.T)
        return RiccatiSolution(K, inverse, LinearRecursion(A - B @ K), B, nx)

    def descent(self, a: Array, b: Array) -> TangentCurve:
        """The minimiser for the cost `sum a'z + b'v`. a: (N+1, nx);  b: (N, nu)"""
        wide = np.zeros((len(a), self.drive.shape[1]))
        wide[:, : self.nx] = a
        wide[:-1] -= np.einsum("kui,ku->ki", self.K, b)
        costate = self.closed.adjoint(wide)
        ahead = np.einsum(
            "kuw,kw->ku", self.inverse, b + np.einsum("kiu,ki->ku", self.drive, costate[1:])
        )
        z = self.closed.forward(
            np.zeros(wide.shape[1]), -np.einsum("kiu,ku->ki", self.drive, ahead)
        )
        return TangentCurve(z=z[:, : self.nx], v=-np.einsum("kui,ki->ku", self.K, z[:-1]) - ahead)


@dataclass(frozen=True, kw_only=True, eq=False)
class CurveCoordinates:
    """Tangent curves in the coordinate `c = u + K x`, in which the projection is affine. A, B of the trajectory; K: gain"""

    A: Array
    B: Array
    K: Array

    @cached_property
    def _closed(self) -> LinearRecursion:
        return LinearRecursion(self.A - self.B @ self.K)

    def gradient(self, a: Array, b: Array) -> Array:
        """(N, nu) derivative by the coordinate of a cost `sum a'z + b'v`."""
        a = np.array(a)
        a[:-1] -= np.einsum("kui,ku->ki", self.K, b)
        costate = self._closed.adjoint(a)
        return np.asarray(b + np.einsum("kiu,ki->ku", self.B, costate[1:]))

    def lift(self, c: Array) -> TangentCurve:
        """Tangent vector whose coordinate moves by c: (N, nu)."""
        z = self._closed.forward(np.zeros(self.A.shape[1]), np.einsum("kiu,ku->ki", self.B, c))
        return TangentCurve(z=z, v=c - np.einsum("kui,ki->ku", self.K, z[:-1]))
