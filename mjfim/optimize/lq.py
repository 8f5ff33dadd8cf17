"""Time-varying linear-quadratic problems on arrays: linear recursions, regulator and constrained descent.

A linear recursion over all samples is a unit-triangular banded system. One BLAS call solves it,
without a Python loop.
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
    """The linear recursion `z_{k+1} = A_k z_k + c_k` from a given z_0, and its adjoint.

    Attributes:
        A: (N, n, n) transition matrices.
    """

    A: Array

    @cached_property
    def _banded_matrix(self) -> Array:
        """(2n, (N+1) n) the recursion's unit lower triangular matrix, in LAPACK's storage of banded matrices."""
        N, n, _ = self.A.shape
        band = np.zeros((2 * n, (N + 1) * n), order="F")
        band[0] = 1.0

        # Entry (i, j) of block k couples z_{k+1, i} with z_{k, j}, which is n + i - j rows below
        # the diagonal.
        i, j = np.indices((n, n))
        columns = (np.arange(N) * n)[:, None, None] + j
        rows = np.broadcast_to(n + i - j, columns.shape)
        band[rows, columns] = -self.A
        return band

    def forward(self, z0: Array, c: Array) -> Array:
        """Solve the recursion.

        Args:
            z0: (n,) first state.
            c: (N, n) inputs.

        Returns:
            (N+1, n) states z.
        """
        rhs = np.concatenate([z0[None], c])
        return self._solve(rhs, transposed=False)

    def adjoint(self, a: Array) -> Array:
        """Solve the adjoint recursion `l_k = A_k' l_{k+1} + a_k` with `l_N = a_N`.

        Args:
            a: (N+1, n) inputs.

        Returns:
            (N+1, n) costates l.
        """
        return self._solve(a, transposed=True)

    def _solve(self, rhs: Array, transposed: bool) -> Array:
        """(N+1, n) solution of the banded system, or of its transpose, for a right-hand side: (N+1, n)."""
        N, n, _ = self.A.shape
        if rhs.shape != (N + 1, n):
            raise ValueError(
                f"a recursion over {N} samples of {n} needs {(N + 1, n)} numbers, got {rhs.shape}"
            )

        flat = np.array(rhs, dtype=np.float64).reshape(-1)
        with np.errstate(over="ignore", invalid="ignore"):
            solution = dtbsv(
                2 * n - 1,
                self._banded_matrix,
                flat,
                lower=1,
                trans=int(transposed),
                diag=1,
                overwrite_x=1,
            )
        return np.asarray(solution).reshape(rhs.shape)


def largest_amplification(A: Array) -> float:
    """Largest amplification of a unit deviation, from the start to any sample or from any sample to the end.

    Args:
        A: (N, nx, nx) transition matrices.

    Returns:
        The largest spectral norm of these transition matrices; at least 1.
    """
    N, nx, _ = A.shape
    recursion = LinearRecursion(A)
    zero = np.zeros((N, nx))
    unit = np.eye(nx)

    from_start = np.stack([recursion.forward(e, zero) for e in unit], axis=2)
    to_end = np.stack([recursion.adjoint(np.concatenate([zero, e[None]])) for e in unit], axis=1)
    return float(
        max(
            np.linalg.norm(from_start, 2, axis=(1, 2)).max(),
            np.linalg.norm(to_end, 2, axis=(1, 2)).max(),
        )
    )


def _solve_positive_definite(S: Array, rhs: Array) -> Array:
    """S^-1 rhs for a small symmetric positive definite matrix, without the overhead of NumPy's checks."""
    _, x, info = dposv(S, rhs)
    if info != 0:
        raise np.linalg.LinAlgError(
            "the Riccati recursion lost positive definiteness; its weights must be positive"
        )
    return np.asarray(x)


def regulator(A: Array, B: Array, Q: Array, R: Array, terminal: Array) -> Array:
    """Feedback gain of the linear-quadratic regulator.

    It minimises `sum_k z_k' Q z_k + v_k' R v_k + z_N' terminal z_N` with `v_k = -K_k z_k` along
    `z_{k+1} = A_k z_k + B_k v_k`.

    Args:
        A: (N, nx, nx) transition matrices.
        B: (N, nx, nu) input matrices.
        Q: (nx, nx) weight of the state.
        R: (nu, nu) weight of the control.
        terminal: (nx, nx) weight of the last state.

    Returns:
        (N, nu, nx) gain K.

    Raises:
        numpy.linalg.LinAlgError: `R + B'PB` is not positive definite.
    """
    K = np.empty((len(A), B.shape[2], A.shape[1]))
    P = terminal

    for k in range(len(A) - 1, -1, -1):
        BP = B[k].T @ P
        K[k] = _solve_positive_definite(R + BP @ B[k], BP @ A[k])
        P = Q + A[k].T @ P @ (A[k] - B[k] @ K[k])

        # Symmetrise: round-off grows backwards in time otherwise.
        P = 0.5 * (P + P.T)

    return K


@dataclass(frozen=True, kw_only=True, eq=False)
class TangentCurve:
    """A tangent vector zeta = (z, v) of the trajectory manifold.

    Attributes:
        z: (N+1, nx) change of the state [x-unit].
        v: (N, nu) change of the control [u-unit].
    """

    z: Array
    v: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Weights:
    """A quadratic form on tangent curves: `sum_k z_k' Q_k z_k + 2 v_k' S_k z_k + v_k' R_k v_k + W_k (v_k - v_{k-1})^2`.

    The control before the first and after the last sample does not change.

    Attributes:
        Q: (N+1, nx, nx) weights of the state.
        S: (N, nu, nx) weights that couple control and state.
        R: (N, nu, nu) weights of the control.
        W: (N+1, nu) weights of the control's change from one sample to the next.
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
        """Half of the form's gradient at a tangent curve: `<zeta, other> = sum a'z + b'v` for any other curve (z, v).

        Args:
            zeta: The tangent curve.

        Returns:
            a: (N+1, nx) and b: (N, nu).
        """
        z = zeta.z
        v = zeta.v

        a = np.einsum("kij,kj->ki", self.Q, z)
        a[:-1] += np.einsum("kui,ku->ki", self.S, v)
        b = np.einsum("kui,ki->ku", self.S, z[:-1]) + np.einsum("kuw,kw->ku", self.R, v)

        steps = self.W * np.diff(v, axis=0, prepend=0.0, append=0.0)
        return a, b + steps[:-1] - steps[1:]


def descent(
    A: Array, B: Array, a: Array, b: Array, *, Q: Array, R: Array, terminal: Array
) -> TangentCurve:
    """Steepest descent on the tangent space: the paper's problem (8), solved by its Riccati equations.

    It minimises `sum a'z + b'v + 1/2 z'Qz + 1/2 v'Rv` subject to `z_{k+1} = A_k z_k + B_k v_k` and
    `z_0 = 0`.

    Args:
        A: (N, nx, nx) transition matrices.
        B: (N, nx, nu) input matrices.
        a: (N+1, nx) derivative of the cost by the state.
        b: (N, nu) derivative of the cost by the control.
        Q: (nx, nx) metric on z_k for k < N.
        R: (nu, nu) metric on v_k.
        terminal: (nx, nx) metric on z_N.

    Returns:
        The minimiser.
    """
    N, nx, nu = B.shape
    weights = Weights(
        Q=np.stack([*[Q] * N, terminal]),
        S=np.zeros((N, nu, nx)),
        R=np.stack([R] * N),
        W=np.zeros((N + 1, nu)),
    )
    return RiccatiSolution.solve(A, B, weights).descent(a, b)


@dataclass(frozen=True, kw_only=True, eq=False)
class RiccatiSolution:
    """Factored linear-quadratic problem with weights that vary over time, for any number of linear costs.

    After the Riccati equations are solved once, a descent needs two banded systems. With weights on
    the control's changes, the state of the problem is extended by the control of the previous
    sample; n is its size then, else nx.

    Attributes:
        K: (N, nu, n) feedback gain.
        inverse: (N, nu, nu) inverse of `R + B'PB`.
        closed_loop: Recursion of `A - B K`.
        B: (N, n, nu) input matrices.
        nx: Size of the state without the previous control.
    """

    K: Array
    inverse: Array
    closed_loop: LinearRecursion
    B: Array
    nx: int

    @staticmethod
    def solve(A: Array, B: Array, weights: Weights) -> RiccatiSolution:
        """Solve the Riccati equations.

        Args:
            A: (N, nx, nx) transition matrices.
            B: (N, nx, nu) input matrices.
            weights: Quadratic form to minimise.

        Returns:
            The factored problem.

        Raises:
            numpy.linalg.LinAlgError: The form is not positive on the controls.
        """
        N, nx, nu = B.shape
        if weights.W.any():
            A, B, weights = _with_previous_control(A, B, weights)

        Q = weights.Q
        S = weights.S
        R = weights.R
        K = np.empty_like(S)
        inverse = np.empty_like(R)
        P = Q[N]
        unit = np.eye(nu)

        for k in range(N - 1, -1, -1):
            BP = B[k].T @ P
            both = np.concatenate([BP @ A[k] + S[k], unit], axis=1)
            both = _solve_positive_definite(R[k] + BP @ B[k], both)
            K[k] = both[:, :-nu]
            inverse[k] = both[:, -nu:]

            P = Q[k] + A[k].T @ P @ (A[k] - B[k] @ K[k]) - S[k].T @ K[k]

            # Symmetrise: round-off grows backwards in time otherwise.
            P = 0.5 * (P + P.T)

        return RiccatiSolution(
            K=K, inverse=inverse, closed_loop=LinearRecursion(A - B @ K), B=B, nx=nx
        )

    def descent(self, a: Array, b: Array) -> TangentCurve:
        """Minimiser of the linear cost `sum a'z + b'v` plus half of the quadratic form.

        Args:
            a: (N+1, nx) derivative of the cost by the state.
            b: (N, nu) derivative of the cost by the control.

        Returns:
            The tangent curve.
        """
        # Backward: costate of the closed loop.
        driving = np.zeros((len(a), self.B.shape[1]))
        driving[:, : self.nx] = a
        driving[:-1] -= np.einsum("kui,ku->ki", self.K, b)
        costate = self.closed_loop.adjoint(driving)

        # Forward: the open-loop part of the control moves the closed loop.
        reduced = b + np.einsum("kiu,ki->ku", self.B, costate[1:])
        feedforward = np.einsum("kuw,kw->ku", self.inverse, reduced)
        inputs = -np.einsum("kiu,ku->ki", self.B, feedforward)
        z = self.closed_loop.forward(np.zeros(driving.shape[1]), inputs)

        v = -np.einsum("kui,ki->ku", self.K, z[:-1]) - feedforward
        return TangentCurve(z=z[:, : self.nx], v=v)


def _with_previous_control(A: Array, B: Array, weights: Weights) -> tuple[Array, Array, Weights]:
    """The problem with the state extended by the previous control, which turns weights on its changes into ordinary ones.

    A: (N, nx, nx);  B: (N, nx, nu). Returns matrices of the state (x_k, v_{k-1}) and weights
    without W.
    """
    N, nx, nu = B.shape
    unit = np.eye(nu)
    steps = unit * weights.W[:, None]

    wide_A = np.zeros((N, nx + nu, nx + nu))
    wide_A[:, :nx, :nx] = A
    wide_B = np.zeros((N, nx + nu, nu))
    wide_B[:, :nx] = B
    wide_B[:, nx:] = unit

    Q = np.zeros((N + 1, nx + nu, nx + nu))
    Q[:, :nx, :nx] = weights.Q
    Q[:, nx:, nx:] = steps
    S = np.zeros((N, nu, nx + nu))
    S[:, :, :nx] = weights.S
    S[:, :, nx:] = -steps[:-1]

    wide = Weights(Q=Q, S=S, R=weights.R + steps[:-1], W=np.zeros_like(weights.W))
    return wide_A, wide_B, wide


@dataclass(frozen=True, kw_only=True, eq=False)
class CurveCoordinates:
    """Tangent curves in the curve coordinate `c = v + K z`, in which the projection operator is affine.

    Attributes:
        A: (N, nx, nx) transition matrices of the trajectory.
        B: (N, nx, nu) input matrices of the trajectory.
        K: (N, nu, nx) gain of the projection operator.
    """

    A: Array
    B: Array
    K: Array

    @cached_property
    def _closed_loop(self) -> LinearRecursion:
        """Recursion of `A - B K`."""
        return LinearRecursion(self.A - self.B @ self.K)

    def gradient(self, a: Array, b: Array) -> Array:
        """Gradient by the curve coordinate of the cost `sum a'z + b'v`.

        Args:
            a: (N+1, nx) derivative of the cost by the state.
            b: (N, nu) derivative of the cost by the control.

        Returns:
            (N, nu) gradient.
        """
        driving = np.array(a)
        driving[:-1] -= np.einsum("kui,ku->ki", self.K, b)
        costate = self._closed_loop.adjoint(driving)
        return np.asarray(b + np.einsum("kiu,ki->ku", self.B, costate[1:]))

    def lift(self, c: Array) -> TangentCurve:
        """Tangent curve of a curve coordinate.

        Args:
            c: (N, nu) curve coordinate.

        Returns:
            The tangent curve (z, v) with z_0 = 0.
        """
        inputs = np.einsum("kiu,ku->ki", self.B, c)
        z = self._closed_loop.forward(np.zeros(self.A.shape[1]), inputs)
        return TangentCurve(z=z, v=c - np.einsum("kui,ki->ku", self.K, z[:-1]))

    def coordinate(self, zeta: TangentCurve) -> Array:
        """(N, nu) curve coordinate `c = v + K z` of a tangent curve."""
        return np.asarray(zeta.v + np.einsum("kui,ki->ku", self.K, zeta.z[:-1]))
