"""Time-varying linear-quadratic problems: linear recursions, regulator and descent.

A linear recursion over all samples is a banded system with a unit triangular matrix. One BLAS call
solves it, without a Python loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

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
        """(2n, (N+1) n) the unit lower triangular matrix of the recursion.

        It is stored by diagonals, as LAPACK stores banded matrices.
        """
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
        """(N+1, n) solution of the banded system, or of its transpose.

        Args:
            rhs: (N+1, n) right-hand side.
            transposed: Whether to solve the transposed system.
        """
        N, n, _ = self.A.shape
        if rhs.shape != (N + 1, n):
            raise ValueError(
                f"the right-hand side has shape {rhs.shape}; "
                f"a recursion over {N} samples of {n} states needs {(N + 1, n)}"
            )

        flat = np.array(rhs, dtype=np.float64).reshape(-1)
        with np.errstate(over="ignore", invalid="ignore"):
            solution = scipy.linalg.blas.dtbsv(
                2 * n - 1,
                self._banded_matrix,
                flat,
                lower=1,
                trans=int(transposed),
                diag=1,
                overwrite_x=1,
            )
        return np.asarray(solution).reshape(rhs.shape)


def largest_amplification(A: Array, sizes: Array | None = None) -> float:
    """Largest amplification of a deviation of the state.

    Deviations from the first to any sample and from any to the last sample are examined.

    Args:
        A: (N, nx, nx) transition matrices.
        sizes: (nx,) sizes of the state's components, in which deviations are measured [x-unit];
            default: 1.

    Returns:
        The largest spectral norm of the products of these transition matrices; at least 1.
    """
    if sizes is not None:
        A = A * (sizes / sizes[:, None])

    return _largest_norm(_products(A))


def amplification_in_best_units(A: Array, sizes: Array | None = None) -> float:
    """Upper bound of the amplification of deviations, in units of the state that make it small.

    It is the smaller one of two bounds over the deviations of `largest_amplification`, each in
    units of its own.

    The first bound is `largest_amplification` in units of the sizes.

    For the second one, the entry (i, j) of a matrix M is the largest deviation of component i that
    follows from a deviation 1 of component j. Units D of the state turn M into `D^-1 M D`. The
    smallest value, over all units, of its largest row sum is the spectral radius of M (Perron and
    Frobenius), and no deviation grows more than that in these units, in the largest norm.

    So a position that only integrates a speed does not count, however long the motion is, nor does
    a slow oscillation, whose speeds are small beside its positions. But the entries of M are
    largest at different times, so that the second bound grows with the number of states; the first
    one does not.

    Args:
        A: (N, nx, nx) transition matrices.
        sizes: (nx,) sizes of the state's components [x-unit]; default: 1.

    Returns:
        The bound, at least 1; infinite where a deviation overflows.
    """
    if sizes is not None:
        A = A * (sizes / sizes[:, None])

    products = _products(A)
    largest = np.max([np.abs(each).max(axis=0) for each in products], axis=0)
    if not np.isfinite(largest).all():
        return np.inf

    by_components = float(np.abs(np.linalg.eigvals(largest)).max(initial=1.0))
    return min(by_components, _largest_norm(products))


def _largest_norm(products: tuple[Array, Array]) -> float:
    """Largest spectral norm of the products of `_products`."""
    return float(max(np.linalg.norm(each, 2, axis=(1, 2)).max() for each in products))


def _products(A: Array) -> tuple[Array, Array]:
    """Products of transition matrices: (N, nx, nx).

    Returns:
        (N+1, nx, nx) products from the first sample to each one, and from each one to the last.
    """
    N, nx, _ = A.shape
    recursion = LinearRecursion(A)
    zero = np.zeros((N, nx))
    unit = np.eye(nx)

    from_start = np.stack([recursion.forward(e, zero) for e in unit], axis=2)
    to_end = np.stack([recursion.adjoint(np.concatenate([zero, e[None]])) for e in unit], axis=1)
    return from_start, to_end


def _solve_positive_definite(S: Array, rhs: Array) -> Array:
    """Product S^-1 rhs for a small symmetric positive definite matrix S.

    LAPACK is called directly, because the checks of NumPy take longer than the solution.
    """
    _, x, info = scipy.linalg.lapack.dposv(S, rhs)
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
        (N, nu, nx) gain K; it has no rows without controls.

    Raises:
        numpy.linalg.LinAlgError: `R + B'PB` is not positive definite.
    """
    K = np.zeros((len(A), B.shape[2], A.shape[1]))
    if not K.size:
        return K

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
    """A quadratic form on tangent curves (z, v).

    It is the sum over all samples k of

        z_k' Q_k z_k + 2 v_k' S_k z_k + v_k' R_k v_k + W_k (v_k - v_{k-1})^2,

    where v is zero before the first and after the last sample.

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
        """This form multiplied by a number.

        Args:
            factor: The number.

        Returns:
            The scaled form.
        """
        return Weights(Q=factor * self.Q, S=factor * self.S, R=factor * self.R, W=factor * self.W)

    def half_gradient(self, zeta: TangentCurve) -> tuple[Array, Array]:
        """Half of the form's gradient (a, b) at a tangent curve zeta.

        The inner product of zeta with any tangent curve (z, v) is `sum a'z + b'v`.

        Args:
            zeta: The tangent curve.

        Returns:
            a: (N+1, nx) and b: (N, nu).
        """
        z = zeta.z
        v = zeta.v

        a = np.einsum("kij,kj->ki", self.Q, z)
        a[:-1] += np.einsum("kui,ku->ki", self.S, v)
        b = np.einsum("kui,ki->ku", self.S, z[:-1])
        b += np.einsum("kuw,kw->ku", self.R, v)

        # A change of the control between two samples involves both of them.
        changes = np.diff(v, axis=0, prepend=0.0, append=0.0)
        weighted = self.W * changes
        return a, b + weighted[:-1] - weighted[1:]


def descent(
    A: Array, B: Array, a: Array, b: Array, *, Q: Array, R: Array, terminal: Array
) -> TangentCurve:
    """Steepest descent on the tangent space: the paper's problem (8), by Riccati equations.

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
    """Factored linear-quadratic problem with weights that vary over time.

    The Riccati equations are solved once; the minimiser of any linear cost then needs only two
    banded systems. With weights on the control's changes, the state of the problem is extended by
    the control of the previous sample, and its size n is nx + nu; otherwise, n is nx.

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
    """The problem with the state extended by the previous control.

    Weights on changes of the control become weights on the extended state.

    Args:
        A: (N, nx, nx) transition matrices.
        B: (N, nx, nu) input matrices.
        weights: Quadratic form with weights W on changes of the control.

    Returns:
        Transition and input matrices of the state (x_k, v_{k-1}), and the form without W.
    """
    N, nx, nu = B.shape
    n = nx + nu
    unit = np.eye(nu)
    change_weights = unit * weights.W[:, None]

    # Dynamics of the extended state; its last part becomes the present control.
    wide_A = np.zeros((N, n, n))
    wide_A[:, :nx, :nx] = A
    wide_B = np.zeros((N, n, nu))
    wide_B[:, :nx] = B
    wide_B[:, nx:] = unit

    # Terms of W (v_k - v_{k-1})^2 with the previous control, with both, and with the present one.
    Q = np.zeros((N + 1, n, n))
    Q[:, :nx, :nx] = weights.Q
    Q[:, nx:, nx:] = change_weights
    S = np.zeros((N, nu, n))
    S[:, :, :nx] = weights.S
    S[:, :, nx:] = -change_weights[:-1]
    R = weights.R + change_weights[:-1]

    wide = Weights(Q=Q, S=S, R=R, W=np.zeros_like(weights.W))
    return wide_A, wide_B, wide


@dataclass(frozen=True, kw_only=True, eq=False)
class CurveCoordinates:
    """Tangent curves in the curve coordinate `c = v + K z`.

    In this coordinate, the projection operator is affine.

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
        feedback = np.einsum("kui,ki->ku", self.K, z[:-1])
        return TangentCurve(z=z, v=c - feedback)

    def coordinate(self, zeta: TangentCurve) -> Array:
        """Curve coordinate `c = v + K z` of a tangent curve.

        Args:
            zeta: The tangent curve.

        Returns:
            (N, nu) curve coordinate.
        """
        return np.asarray(zeta.v + np.einsum("kui,ki->ku", self.K, zeta.z[:-1]))
