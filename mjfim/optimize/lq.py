"""Time-varying linear-quadratic problems: linear recursions, regulator and descent.

The search for a design solves them along every trajectory. A linear recursion over all samples is
a banded system with a unit triangular matrix. One call of LAPACK solves it without a Python loop,
and for many right-hand sides at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from mjfim.arrays import Array, record


@dataclass(frozen=True, eq=False)
class LinearRecursion:
    """The linear recursion `z_{k+1} = A_k z_k + c_k` from a given z_0, and its adjoint.

    Attributes:
        A: (N, n, n) transition matrices.
    """

    A: Array

    @cached_property
    def _banded_matrix(self) -> Array:
        """(2n, (N+1) n) unit lower triangular matrix of the recursion, by diagonals for LAPACK."""
        N, n, _ = self.A.shape
        band = np.zeros((2 * n, (N + 1) * n), order="F")
        band[0] = 1.0

        # Entry (i, j) of block k couples z_{k+1, i} with z_{k, j}. It is n + i - j rows below the
        # diagonal. So the entries of a column lie side by side in memory. Those of the next column
        # begin 2 n - 1 numbers later.
        blocks = band.T[:-n].reshape(N, 2 * n * n)
        blocks[:, n:].reshape(N, n, 2 * n - 1)[:, :, :n] = -self.A.swapaxes(1, 2)
        return band

    def forward(self, z0: Array, c: Array) -> Array:
        """Solve the recursion.

        Args:
            z0: (n,) first state, or (m, n).
            c: (N, n) inputs, or (m, N, n) for m recursions.

        Returns:
            (N+1, n) states z, or (m, N+1, n).
        """
        rhs = np.empty((*c.shape[:-2], c.shape[-2] + 1, c.shape[-1]))
        rhs[..., 0, :] = z0
        rhs[..., 1:, :] = c
        return self._solve(rhs, transposed=False)

    def adjoint(self, a: Array) -> Array:
        """Solve the adjoint recursion `l_k = A_k' l_{k+1} + a_k` with `l_N = a_N`.

        Args:
            a: (N+1, n) inputs, or (m, N+1, n) for m recursions.

        Returns:
            (N+1, n) costates l, or (m, N+1, n).
        """
        return self._solve(np.array(a, dtype=np.float64), transposed=True)

    def _solve(self, rhs: Array, transposed: bool) -> Array:
        """Solution of the banded system, or of its transpose.

        Args:
            rhs: (N+1, n) or (m, N+1, n) right-hand sides, which are overwritten.
            transposed: Whether to solve the transposed system.
        """
        N, n, _ = self.A.shape
        if rhs.shape[-2:] != (N + 1, n):
            raise ValueError(
                f"the right-hand side has shape {rhs.shape[-2:]}; "
                f"a recursion over {N} samples of {n} states needs {(N + 1, n)}"
            )

        # Each right-hand side is a column for LAPACK.
        columns = rhs.reshape(-1, (N + 1) * n).T
        with np.errstate(over="ignore", invalid="ignore"):
            solution, _ = scipy.linalg.lapack.dtbtrs(
                self._banded_matrix,
                columns,
                uplo="L",
                trans="T" if transposed else "N",
                diag="U",
                overwrite_b=1,
            )
        return np.asarray(solution.T.reshape(rhs.shape))


def products_at_samples(matrices: Array, vectors: Array) -> Array:
    """Products of a matrix and a vector at every sample.

    Args:
        matrices: (N, i, j) matrices.
        vectors: (N, j) vectors, or m of them at every sample: (m, N, j).

    Returns:
        (N, i) or (m, N, i) products.
    """
    if vectors.ndim == 2:
        return np.asarray(np.einsum("kij,kj->ki", matrices, vectors))

    # One product of matrices per sample is quicker than m products with a vector.
    columns = np.ascontiguousarray(vectors.transpose(1, 2, 0))
    return (matrices @ columns).transpose(2, 0, 1)


def largest_amplification(A: Array, sizes: Array | float = 1.0) -> float:
    """Largest amplification of a deviation of the state.

    It covers deviations from the first sample to any other, and from any sample to the last.

    Args:
        A: (N, nx, nx) transition matrices.
        sizes: (nx,) sizes of the state's components, in which deviations are measured [x-unit].

    Returns:
        The largest spectral norm of the products of transition matrices; at least 1.
    """
    return _largest_norm(_products(A, sizes))


def amplification_in_best_units(A: Array, sizes: Array | float = 1.0) -> float:
    """Upper bound of the amplification of deviations, in units of the state that make it small.

    It is the smaller one of two bounds. The first bound is `largest_amplification` in units of the
    sizes.

    The second bound uses a matrix M. Its entry (i, j) is the largest deviation of component i after
    a deviation 1 of component j. Units D of the state turn M into `D^-1 M D`. The best units make
    its largest row sum equal to the spectral radius of M (Perron and Frobenius). In these units and
    the largest norm, no deviation grows by a larger factor.

    So a position that only integrates a speed does not count, however long the motion is. A slow
    oscillation does not count either, because its speeds are small beside its positions. But the
    entries of M are largest at different times. So the second bound grows with the number of
    states; the first one does not.

    Args:
        A: (N, nx, nx) transition matrices.
        sizes: (nx,) sizes of the state's components [x-unit].

    Returns:
        The bound, at least 1; infinite where a deviation overflows.
    """
    products = _products(A, sizes)
    largest = np.max([np.abs(each).max(axis=0) for each in products], axis=0)
    if not np.isfinite(largest).all():
        return np.inf

    by_components = float(np.abs(np.linalg.eigvals(largest)).max(initial=1.0))
    return min(by_components, _largest_norm(products))


def _largest_norm(products: tuple[Array, Array]) -> float:
    """Largest spectral norm of the products of `_products`."""
    return float(max(np.linalg.norm(each, 2, axis=(1, 2)).max() for each in products))


def _products(A: Array, sizes: Array | float) -> tuple[Array, Array]:
    """Products of transition matrices: (N, nx, nx), in units of (nx,) sizes of the state.

    Returns:
        (N+1, nx, nx) products from the first sample to each one, and from each one to the last.
    """
    N, nx, _ = A.shape
    units = np.ones(nx) * sizes
    recursion = LinearRecursion(A * (units / units[:, None]))
    zero = np.zeros((nx, N, nx))
    unit = np.eye(nx)

    from_start = recursion.forward(unit, zero)
    to_end = recursion.adjoint(np.concatenate([zero, unit[:, None]], axis=1))
    return from_start.transpose(1, 2, 0), to_end.swapaxes(0, 1)


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
    if not B.shape[2]:
        return np.zeros((len(A), 0, A.shape[1]))

    return RiccatiSolution.solve(A, B, Weights.constant(len(A), Q, R, terminal)).K


@record
class TangentCurve:
    """A tangent vector zeta = (z, v) of the trajectory manifold.

    Some functions also take m of them, stacked along a further first axis; they say so.

    Attributes:
        z: (N+1, nx) change of the state [x-unit].
        v: (N, nu) change of the control [u-unit].
    """

    z: Array
    v: Array


@record
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

    @staticmethod
    def constant(N: int, Q: Array, R: Array, terminal: Array) -> Weights:
        """The form with the same weights at N samples, and a weight of its own of the last state.

        Args:
            N: Number of samples.
            Q: (nx, nx) weight of the state.
            R: (nu, nu) weight of the control.
            terminal: (nx, nx) weight of the last state.
        """
        return Weights(
            Q=np.stack([*[Q] * N, terminal]),
            S=np.zeros((N, len(R), len(Q))),
            R=np.stack([R] * N),
            W=np.zeros((N + 1, len(R))),
        )

    def plus(self, other: Weights, factor: float) -> Weights:
        """Sum of this form and a multiple of another one.

        Args:
            other: The form to add.
            factor: Number with which the other form is multiplied.
        """
        arrays = vars(other)
        return Weights(**{name: own + factor * arrays[name] for name, own in vars(self).items()})

    def scaled(self, factor: float) -> Weights:
        """This form multiplied by a number.

        Args:
            factor: The number.
        """
        return Weights(**{name: factor * array for name, array in vars(self).items()})

    def half_gradient(self, zeta: TangentCurve) -> tuple[Array, Array]:
        """Half of the form's gradient (a, b) at a tangent curve zeta.

        The inner product of zeta with any tangent curve (z, v) is `sum a'z + b'v`.

        Args:
            zeta: The tangent curve, or m of them.

        Returns:
            a: (N+1, nx) and b: (N, nu), or (m, N+1, nx) and (m, N, nu).
        """
        z, v = zeta.z, zeta.v
        a = products_at_samples(self.Q, z)
        a[..., :-1, :] += products_at_samples(self.S.swapaxes(1, 2), v)
        b = products_at_samples(self.S, z[..., :-1, :])
        b += products_at_samples(self.R, v)
        if not self.W.any():
            return a, b

        # A change of the control between two samples involves both of them.
        changes = np.diff(v, axis=-2, prepend=0.0, append=0.0)
        weighted = self.W * changes
        return a, b + weighted[..., :-1, :] - weighted[..., 1:, :]


@record
class RiccatiSolution:
    """Factored linear-quadratic problem with weights that vary over time.

    The Riccati equations are solved once. The minimiser of any linear cost then needs only two
    banded systems. The size n of the problem's state is nx. Weights on the control's changes extend
    the state by the control of the previous sample, so that n is nx + nu.

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

        # Each step of the recursion is one quadratic form of (v_k, z_k). It adds the weights of the
        # sample and those of the next state, which the matrix [B A] gives.
        to_next = np.concatenate([B, A], axis=2)
        coupling = weights.S.swapaxes(1, 2)
        forms = np.block([[weights.R, weights.S], [coupling, weights.Q[:-1]]])
        factors = np.empty((N, nu, forms.shape[2]))
        P = weights.Q[N]

        steps = zip(to_next[::-1], forms[::-1], factors[::-1], strict=True)
        for matrix, form, factor in steps:
            form += matrix.T.dot(P).dot(matrix)

            # LAPACK is called directly, because the checks of NumPy take longer than the solution.
            _, factor[:], info = scipy.linalg.lapack.dposv(form[:nu, :nu], form[:nu])
            if info != 0:
                raise np.linalg.LinAlgError(
                    "the Riccati recursion lost positive definiteness; its weights must be positive"
                )

            # The minimum over v_k is a form of z_k. It is made symmetric, because round-off would
            # grow backwards in time.
            P = (form - form[:, :nu].dot(factor))[nu:, nu:]
            P = 0.5 * (P + P.T)

        K = factors[:, :, nu:]
        inverse = np.asarray(np.linalg.inv(forms[:, :nu, :nu]), dtype=np.float64)
        return RiccatiSolution(
            K=K, inverse=inverse, closed_loop=LinearRecursion(A - B @ K), B=B, nx=nx
        )

    def descent(self, a: Array, b: Array) -> TangentCurve:
        """Minimiser of the linear cost `sum a'z + b'v` plus half of the quadratic form.

        It is the solution of the paper's problem (8), with `z_{k+1} = A_k z_k + B_k v_k` and
        `z_0 = 0`.

        Args:
            a: (N+1, nx) derivative of the cost by the state, or (m, N+1, nx) for m costs.
            b: (N, nu) derivative of the cost by the control, or (m, N, nu).

        Returns:
            The tangent curve, or m of them.
        """
        # The costate of the closed loop comes backwards in time.
        n = self.B.shape[1]
        driving = np.zeros((*a.shape[:-1], n))
        driving[..., : self.nx] = a
        driving[..., :-1, :] -= products_at_samples(self.K.swapaxes(1, 2), b)
        costate = self.closed_loop.adjoint(driving)

        # The open-loop part of the control moves the closed loop forwards in time.
        reduced = b + products_at_samples(self.B.swapaxes(1, 2), costate[..., 1:, :])
        feedforward = products_at_samples(self.inverse, reduced)
        inputs = -products_at_samples(self.B, feedforward)
        z = self.closed_loop.forward(np.zeros(n), inputs)

        v = -products_at_samples(self.K, z[..., :-1, :]) - feedforward
        return TangentCurve(z=z[..., : self.nx], v=v)


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
    unit = np.eye(nu)
    change_weights = unit * weights.W[:, None]

    # Dynamics of the extended state; its last part becomes the present control.
    room = ((0, 0), (0, nu), (0, nu))
    wide_A = np.pad(A, room)
    wide_B = np.concatenate([B, np.broadcast_to(unit, (N, nu, nu))], axis=1)

    # Terms of W (v_k - v_{k-1})^2 with the previous control, with both, and with the present one.
    Q = np.pad(weights.Q, room)
    Q[:, nx:, nx:] = change_weights
    S = np.concatenate([weights.S, -change_weights[:-1]], axis=2)
    R = weights.R + change_weights[:-1]
    return wide_A, wide_B, Weights(Q=Q, S=S, R=R, W=np.zeros_like(weights.W))


@record
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
    def _has_feedback(self) -> bool:
        """Whether K is not zero; without feedback, the products with K are left out."""
        return bool(self.K.any())

    @cached_property
    def _closed_loop(self) -> LinearRecursion:
        """Recursion of `A - B K`."""
        return LinearRecursion(self.A - self.B @ self.K if self._has_feedback else self.A)

    def gradient(self, a: Array, b: Array) -> Array:
        """Gradient by the curve coordinate of the cost `sum a'z + b'v`.

        Args:
            a: (N+1, nx) derivative of the cost by the state, or (m, N+1, nx) for m costs.
            b: (N, nu) derivative of the cost by the control, or (m, N, nu).

        Returns:
            (N, nu) gradient, or (m, N, nu).
        """
        driving = np.array(a)
        if self._has_feedback:
            driving[..., :-1, :] -= products_at_samples(self.K.swapaxes(1, 2), b)
        costate = self._closed_loop.adjoint(driving)
        return b + products_at_samples(self.B.swapaxes(1, 2), costate[..., 1:, :])

    def lift(self, c: Array) -> TangentCurve:
        """Tangent curve of a curve coordinate.

        Args:
            c: (N, nu) curve coordinate, or (m, N, nu) for m of them.

        Returns:
            The tangent curve (z, v) with z_0 = 0, or m of them.
        """
        inputs = products_at_samples(self.B, c)
        z = self._closed_loop.forward(np.zeros(self.A.shape[1]), inputs)
        if not self._has_feedback:
            return TangentCurve(z=z, v=c)
        return TangentCurve(z=z, v=c - products_at_samples(self.K, z[..., :-1, :]))

    def coordinate(self, zeta: TangentCurve) -> Array:
        """Curve coordinate `c = v + K z` of a tangent curve.

        Args:
            zeta: The tangent curve, or m of them.

        Returns:
            (N, nu) curve coordinate, or (m, N, nu).
        """
        if not self._has_feedback:
            return zeta.v
        return zeta.v + products_at_samples(self.K, zeta.z[..., :-1, :])
