"""Time-varying linear-quadratic problems on arrays: recursions, regulator, descent. Knows no plant and no cost.

The linear recursions are unit-triangular banded systems; one BLAS call solves each, no Python loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtbsv
from scipy.linalg.lapack import dposv

from mjfim.trajectory import Array


@dataclass(frozen=True, eq=False)
class Recursion:
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
            raise ValueError(f"a recursion over {N} samples of {n} needs {(N + 1, n)} numbers, got {rhs.shape}")
        flat = np.array(rhs, dtype=np.float64).reshape(-1)
        with np.errstate(over="ignore", invalid="ignore"):
            solution = dtbsv(2 * n - 1, self._band, flat, lower=1, trans=int(transposed), diag=1, overwrite_x=1)
        return np.asarray(solution).reshape(rhs.shape)


def growth(A: Array) -> float:
    """Largest amplification of a unit deviation, from the start to any sample or from any sample to the end.

    A: (N, nx, nx)
    """
    N, nx, _ = A.shape
    recursion, zero = Recursion(A), np.zeros((N, nx))
    unit = np.eye(nx)
    onward = np.stack([recursion.forward(e, zero) for e in unit], axis=2)
    back = np.stack([recursion.adjoint(np.concatenate([zero, e[None]])) for e in unit], axis=1)
    return float(max(np.linalg.norm(onward, 2, axis=(1, 2)).max(), np.linalg.norm(back, 2, axis=(1, 2)).max()))


def _solve(S: Array, rhs: Array) -> Array:
    """S^-1 rhs for a small symmetric positive definite S, without the overhead of NumPy's checks."""
    _, x, info = dposv(S, rhs)
    if info != 0:
        raise np.linalg.LinAlgError("the Riccati recursion lost positive definiteness; its weights must be positive")
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


@dataclass(frozen=True, eq=False)
class TangentCurve:
    """A tangent vector zeta = (z, v) of the trajectory manifold. z: (N+1, nx), v: (N, nu)."""

    z: Array
    v: Array


@dataclass(frozen=True, eq=False)
class Weights:
    """A quadratic form on tangent curves, `sum z'Qz + 2 v'Sz + v'Rv`, and one on the steps of the control.

    Q: (N+1, nx, nx), the last on z_N;  S: (N, nu, nx);  R: (N, nu, nu)
    W: (N+1, nu), of `v_k - v_{k-1}`, where the control before the first and after the last sample does not move
    """

    Q: Array
    S: Array
    R: Array
    W: Array

    def force(self, zeta: TangentCurve) -> tuple[Array, Array]:
        """(N+1, nx) and (N, nu): half the derivative of the form, so that `<zeta, other> = a.z + b.v`."""
        z, v = zeta.z, zeta.v
        a = np.einsum("kij,kj->ki", self.Q, z)
        a[:-1] += np.einsum("kui,ku->ki", self.S, v)
        b = np.einsum("kui,ki->ku", self.S, z[:-1]) + np.einsum("kuw,kw->ku", self.R, v)
        pull = self.W * np.diff(v, axis=0, prepend=0.0, append=0.0)
        return a, b + pull[:-1] - pull[1:]


def descent(A: Array, B: Array, a: Array, b: Array, Q: Array, R: Array, terminal: Array) -> TangentCurve:
    """Minimiser of `sum a'z + b'v + 1/2 z'Qz + 1/2 v'Rv` subject to `z_{k+1} = A z_k + B v_k`, `z_0 = 0`.

    a: (N+1, nx);  b: (N, nu);  Q, terminal: (nx, nx), the metric on z_k for k < N and on z_N;  R: (nu, nu)
    The paper's problem (8), solved by its Riccati equations.
    """
    N = len(A)
    return _riccati(A, B, a, b, [*[Q] * N, terminal], None, [R] * N)


def weighted_descent(A: Array, B: Array, a: Array, b: Array, weights: Weights) -> TangentCurve:
    """The same under weights that vary over time, couple state and control, and hold the control's steps down.

    With weights on the steps, the state of the recursion also carries the control before.
    """
    if not weights.W.any():
        return _riccati(A, B, a, b, list(weights.Q), list(weights.S), list(weights.R))
    N, nx, nu = B.shape
    wide, drive = np.zeros((N, nx + nu, nx + nu)), np.zeros((N, nx + nu, nu))
    wide[:, :nx, :nx], drive[:, :nx], drive[:, nx:] = A, B, np.eye(nu)
    Q, S, steps = np.zeros((N + 1, nx + nu, nx + nu)), np.zeros((N, nu, nx + nu)), np.eye(nu) * weights.W[:, None]
    Q[:, :nx, :nx], Q[:, nx:, nx:] = weights.Q, steps
    S[:, :, :nx], S[:, :, nx:] = weights.S, -steps[:-1]
    linear = np.concatenate([a, np.zeros((N + 1, nu))], axis=1)
    zeta = _riccati(wide, drive, linear, b, list(Q), list(S), list(weights.R + steps[:-1]))
    return TangentCurve(zeta.z[:, :nx], zeta.v)


def _riccati(
    A: Array, B: Array, a: Array, b: Array, Q: Sequence[Array], S: Sequence[Array] | None, R: Sequence[Array]
) -> TangentCurve:
    """Minimiser under `sum a'z + b'v + 1/2 z'Qz + v'Sz + 1/2 v'Rv`; Q holds one more, of z_N."""
    N, nx, nu = len(A), A.shape[1], B.shape[2]
    K, feedforward = np.empty((N, nu, nx)), np.empty((N, nu))
    P, r = Q[N], a[N]
    for k in range(N - 1, -1, -1):
        BP = B[k].T @ P
        cross = BP @ A[k] if S is None else BP @ A[k] + S[k]
        both = _solve(R[k] + BP @ B[k], np.column_stack([cross, b[k] + B[k].T @ r]))
        K[k], feedforward[k] = both[:, :nx], both[:, nx]
        closed = A[k] - B[k] @ K[k]
        r = a[k] + closed.T @ r - K[k].T @ b[k]
        P = Q[k] + A[k].T @ P @ closed
        if S is not None:
            P = P - S[k].T @ K[k]
        P = 0.5 * (P + P.T)
    z = Recursion(A - B @ K).forward(np.zeros(nx), -np.einsum("kiu,ku->ki", B, feedforward))
    return TangentCurve(z, -np.einsum("kui,ki->ku", K, z[:-1]) - feedforward)
