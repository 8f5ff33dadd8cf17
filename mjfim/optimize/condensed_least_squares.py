"""Condensed linear least squares over many segments with private unknowns, and robust losses.

The whitened rows `[J_private, J_common, r]` of each block of data are reduced to a triangle with
equal inner products (QR decomposition), so that all rows are never in memory at once. The private
unknowns are then eliminated segment by segment. The remaining problem has the size of the common
unknowns, and its solution is exact. Names and formulas of the robust losses are those of
`scipy.optimize.least_squares`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from mjfim.arrays import Array, record, scaled_to_unit_diagonal

# Rows of one batch in the first pass of a tall QR decomposition; a batch stays in the cache.
QR_BATCH_ROWS = 128

# Smallest number of rows of such a batch for each column, so that the first pass leaves fewer rows.
BATCH_ROWS_PER_COLUMN = 4

# Number of rows above which a QR decomposition takes two passes.
TALL_ROWS = 512

# Exchanges of active bounds per unknown in a bounded least-squares problem. SciPy's default of one
# exchange per unknown may end before the minimum is reached.
MAX_EXCHANGES_PER_UNKNOWN = 20

# Smallest column norm or scale; protects divisions by zero.
SMALLEST_NORM = 1e-300

# Smallest damping of the private unknowns, relative to their scale. It keeps the elimination
# regular where a segment does not determine its private unknowns.
MIN_PRIVATE_DAMPING = 1e-12

# Singular values below this share of the largest one are dropped from the pseudo-inverse of the
# private triangles.
PRIVATE_RANK_TOLERANCE = 1e-12

# Singular values of the scaled private columns below this value do not count towards the rank.
PRIVATE_RANK_COUNT_TOLERANCE = 1e-8

# Eigenvalues of the scaled information of the common unknowns below this value do not count towards
# the rank.
COMMON_RANK_COUNT_TOLERANCE = 1e-12

# Largest and smallest number of stretches of rows whose gradients show how autocorrelated residuals
# are.
MAX_STRETCHES = 40
MIN_STRETCHES = 10

# Ratio of the true to the formal standard deviation that counts as larger than 1, and the largest
# one that is believed.
MIN_TRUE_DEVIATION = 2.0
MAX_TRUE_DEVIATION = 10.0

# Smallest threshold [standard deviations] above which a residual counts as an outlier; normal noise
# rarely exceeds it.
MIN_OUTLIER_THRESHOLD = 3.0

# Smallest squared residual in a weight, because zero has no negative power.
SMALLEST_SQUARE = 1e-300


@record
class Step:
    """Step of all unknowns.

    Attributes:
        common: (c,) step of the common unknowns.
        private: (P, n) steps of the private unknowns of each segment.
        predicted_decrease: Decrease of half of the squares according to the linearisation.
        common_length: Length of the step of the common unknowns [standard deviations].
        private_length: Root mean square length of the steps of the private unknowns [standard
            deviations].
    """

    common: Array
    private: Array
    predicted_decrease: float
    common_length: float
    private_length: float


@record
class Condensed:
    """Linearised residuals of P segments in B blocks of rows.

    Every segment has n private unknowns, and all segments share c common unknowns. The columns are
    those of the private unknowns, of the common unknowns, and of the residual; m = n + c + 1.

    Attributes:
        blocks: (B, m, m) rows `[J_private, J_common, r]` of each block, condensed to a triangle.
        segment_of_block: (B,) number of the segment to which each block belongs.
        private_rows: (P, k, m) further rows of each segment, e.g. priors on its private unknowns.
        common_rows: (l, c+1) further rows `[J_common, r]`, e.g. priors on the common unknowns.
    """

    blocks: Array
    segment_of_block: np.ndarray
    private_rows: Array
    common_rows: Array

    @property
    def segment_count(self) -> int:
        """Number of segments P."""
        return len(self.private_rows)

    @property
    def common_count(self) -> int:
        """Number of common unknowns c."""
        return int(self.common_rows.shape[1] - 1)

    @property
    def private_count(self) -> int:
        """Number of private unknowns of a segment n."""
        return int(self.blocks.shape[1] - self.common_count - 1)

    @cached_property
    def triangles(self) -> Array:
        """(P, m, m) triangle of all rows of each segment."""
        m = self.blocks.shape[1]
        counts = np.bincount(self.segment_of_block, minlength=self.segment_count)
        largest_count = max(int(counts.max(initial=0)), 1)

        # Blocks sorted by segment, and the place of each block among those of its segment.
        order = np.argsort(self.segment_of_block, kind="stable")
        first = np.cumsum(counts) - counts
        place = np.arange(len(order)) - np.repeat(first, counts)
        segment = self.segment_of_block[order]

        stacked = np.zeros((self.segment_count, largest_count, m, m))
        stacked[segment, place] = self.blocks[order]

        rows = stacked.reshape(self.segment_count, -1, m)
        all_rows = np.concatenate([rows, self.private_rows], axis=1)
        return triangle(all_rows)

    @cached_property
    def private_response(self) -> Array:
        """(P, n, c) derivative of the optimal private unknowns by the common unknowns."""
        n = self.private_count
        coupling = self.triangles[:, :n, n:-1]
        return -self._private_inverse @ coupling

    @cached_property
    def _private_inverse(self) -> Array:
        """(P, n, n) pseudo-inverse of the private triangles.

        Columns are scaled, so that it does not depend on the units of the unknowns.
        """
        n = self.private_count
        norms = np.maximum(self.column_norms[:n], SMALLEST_NORM)
        scaled = self.triangles[:, :n, :n] / norms

        inverse = np.linalg.pinv(scaled, rcond=PRIVATE_RANK_TOLERANCE)
        return inverse / norms[:, None]

    def reduced_rows(self) -> Array:
        """Rows of the common unknowns after elimination of the private ones.

        Returns:
            (k, c+1) rows `[J_common, r]`, without the `common_rows`.
        """
        R = self.triangles
        n = self.private_count

        # Where a segment has no full rank, the best private unknowns do not cancel these rows.
        J, residual = self._following(R[:, :n], self.private_response)
        residual = residual - R[:, :n, :n] @ (self._private_inverse @ residual)
        remaining = np.concatenate([J, residual], axis=2)
        rows = np.concatenate([remaining, R[:, n:, n:]], axis=1)
        return rows.reshape(-1, rows.shape[2])

    def after(self, step: Step) -> Condensed:
        """The linearised residuals at the end of a step.

        Args:
            step: Step of all unknowns.

        Returns:
            Rows with equal derivatives, and with the residuals that the linearisation predicts.
        """
        moves = self._moves(step.common, step.private)
        blocks = np.array(self.blocks)
        blocks[..., -1:] += blocks[..., :-1] @ moves[self.segment_of_block]
        private_rows = np.array(self.private_rows)
        private_rows[..., -1:] += private_rows[..., :-1] @ moves
        common_rows = np.array(self.common_rows)
        common_rows[:, -1] += common_rows[:, :-1] @ step.common
        return replace(self, blocks=blocks, private_rows=private_rows, common_rows=common_rows)

    def _moves(self, common: Array, private: Array) -> Array:
        """(P, n+c, 1) moves of all unknowns of each segment."""
        everywhere = np.broadcast_to(common, (self.segment_count, len(common)))
        return np.concatenate([private, everywhere], axis=1)[..., None]

    def of_segments(self, indices: np.ndarray) -> Condensed:
        """The linearised residuals of some segments only, and the rows of the common unknowns.

        Args:
            indices: Indices of the segments.
        """
        number = np.full(self.segment_count, -1)
        number[indices] = np.arange(len(indices))
        number_of_block = number[self.segment_of_block]
        is_kept = number_of_block >= 0
        return replace(
            self,
            blocks=self.blocks[is_kept],
            segment_of_block=number_of_block[is_kept],
            private_rows=self.private_rows[indices],
        )

    def without_blocks(self, left_out: np.ndarray) -> Condensed:
        """The linearised residuals without some blocks; all segments are kept.

        Args:
            left_out: (B,) True for the blocks that are left out.
        """
        return replace(
            self, blocks=self.blocks[~left_out], segment_of_block=self.segment_of_block[~left_out]
        )

    @property
    def rank(self) -> int:
        """Number of unknowns, private and common, that the rows determine."""
        columns = self.triangles[:, :, : self.private_count]
        norms = np.linalg.norm(columns, axis=1, keepdims=True)
        private = columns / np.maximum(norms, SMALLEST_NORM)
        of_segments = np.linalg.matrix_rank(private, tol=PRIVATE_RANK_COUNT_TOLERANCE)

        common, _ = scaled_to_unit_diagonal(self.information())
        of_common = np.linalg.matrix_rank(common, tol=COMMON_RANK_COUNT_TOLERANCE, hermitian=True)
        return int(of_segments.sum() + of_common)

    def information(self, with_common_rows: bool = True) -> Array:
        """Information about the common unknowns, the private ones marginalised.

        Args:
            with_common_rows: Whether to include the `common_rows`, i.e. the priors.

        Returns:
            (c, c) Gauss-Newton Hessian `J'J`.
        """
        J = self.reduced_rows()[:, :-1]
        if with_common_rows:
            J = np.concatenate([J, self.common_rows[:, :-1]])

        return J.T @ J

    @cached_property
    def column_norms(self) -> Array:
        """(n+c,) norms of the Jacobian's columns, private ones first.

        Those of the private unknowns are root mean squares over the segments.
        """
        n = self.private_count
        squares = np.sum(self.triangles[:, :, :-1] ** 2, axis=1)
        private = squares[:, :n].mean(axis=0)

        common_J = self.common_rows[:, :-1]
        common = squares[:, n:].sum(axis=0) + np.sum(common_J**2, axis=0)
        return np.asarray(np.sqrt(np.concatenate([private, common])))

    def step(self, damping: float, scale: Array, lower: Array, upper: Array) -> Step:
        """Levenberg-Marquardt step, with bounds on the common unknowns.

        The step d minimises `|J d + r|^2 + damping |scale d|^2`.

        Args:
            damping: Damping factor, 0 for a Gauss-Newton step.
            scale: (n+c,) scale of every unknown, usually the column norms.
            lower: (c,) lower bounds of the step of the common unknowns, at most 0.
            upper: (c,) upper bounds of the step of the common unknowns, at least 0.

        Returns:
            The step with its predicted decrease.
        """
        rows = triangle(np.concatenate([self.damped_rows(damping, scale), self.common_rows]))
        common = bounded_least_squares(rows[:, :-1], -rows[:, -1], lower, upper)
        return self.step_to(common, damping, scale)

    def damped_rows(self, damping: float, scale: Array) -> Array:
        """Rows of the common unknowns after elimination of the private ones, with damping.

        Args:
            damping: Damping factor.
            scale: (n+c,) scale of every unknown.

        Returns:
            (k, c+1) rows `[J_common, r]`, without the `common_rows`.
        """
        n = self.private_count
        c = self.common_count
        segment_rows = self._damped_triangles(damping, scale)[:, n:, n:].reshape(-1, c + 1)
        damping_rows = np.diag(np.append(np.sqrt(damping) * scale[n:], 0.0))[:c]
        return np.concatenate([segment_rows, damping_rows])

    def step_to(self, common: Array, damping: float, scale: Array) -> Step:
        """The step of all unknowns with a given step of the common ones.

        Args:
            common: (c,) step of the common unknowns.
            damping: Damping factor of the private unknowns.
            scale: (n+c,) scale of every unknown.

        Returns:
            The step with its predicted decrease.
        """
        n = self.private_count
        damped = self._damped_triangles(damping, scale)
        rhs = damped[:, :n, -1] + damped[:, :n, n:-1] @ common
        private = np.asarray(-np.linalg.solve(damped[:, :n, :n], rhs[..., None])[..., 0])

        # Change of all residuals along the step. The damping does not count.
        R = self.triangles
        residual = R[:, :, -1]
        common_residual = self.common_rows[:, -1]
        change = (R[:, :, :-1] @ self._moves(common, private))[..., 0]
        common_change = self.common_rows[:, :-1] @ common

        decrease = -float(np.sum(change * (residual + 0.5 * change)))
        decrease -= float(common_change @ (common_residual + 0.5 * common_change))

        # Lengths in standard deviations.
        common_length = float(np.sqrt(common @ self.information() @ common))
        private_length = 0.0
        if n:
            private_change = (R[:, :, :n] @ private[..., None])[..., 0]
            private_length = float(np.sqrt(np.mean(private_change**2) * R.shape[1] / n))

        return Step(
            common=common,
            private=private,
            predicted_decrease=decrease,
            common_length=common_length,
            private_length=private_length,
        )

    def _damped_triangles(self, damping: float, scale: Array) -> Array:
        """(P, m, m) triangles of all rows of each segment and of the damping of private unknowns.

        Args:
            damping: Damping factor.
            scale: (n+c,) scale of every unknown.
        """
        n = self.private_count
        R = self.triangles
        if not n:
            return R

        least = MIN_PRIVATE_DAMPING * np.maximum(scale[:n], SMALLEST_NORM)
        damping_rows = np.zeros((self.segment_count, n, R.shape[2]))
        weight = np.maximum(np.sqrt(damping) * scale[:n], least)
        damping_rows[:, np.arange(n), np.arange(n)] = weight
        return triangle(np.concatenate([R, damping_rows], axis=1))

    @cached_property
    def block_scores(self) -> Array:
        """(B, c) gradient of half of each block's squares by the common unknowns.

        The private unknowns follow the common ones at their optimum.
        """
        J, r = self._reduced_blocks
        return (np.swapaxes(J, 1, 2) @ r)[..., 0]

    @cached_property
    def block_information(self) -> Array:
        """(B, c, c) information of each block about the common unknowns.

        The private unknowns follow the common ones at their optimum.
        """
        J, _ = self._reduced_blocks
        return np.swapaxes(J, 1, 2) @ J

    def _scatter(self, stretches: int) -> Array:
        """(c, c) scatter of the gradients of some long stretches of rows."""
        number = np.arange(len(self.blocks)) * stretches // len(self.blocks)
        gradients = np.zeros((stretches, self.common_count))
        np.add.at(gradients, number, self.block_scores)

        # The gradient is zero at the minimum only, so that its mean does not count as scatter.
        centred = gradients - gradients.mean(axis=0)
        return np.asarray(centred.T @ centred * (stretches / (stretches - 1)))

    @property
    def true_deviation(self) -> float:
        """Ratio of the standard deviations to the formal ones.

        The scatter of the gradients of long stretches of rows shows it (sandwich covariance; White,
        1982). Autocorrelated residuals tell as much as fewer white ones. It is the ratio of the
        common unknown for which it is smallest; 1 where it is not clearly larger, and at most
        `MAX_TRUE_DEVIATION`, because it depends on the point of the linearisation.
        """
        stretches = min(len(self.blocks), MAX_STRETCHES)
        if stretches < MIN_STRETCHES or not self.common_count:
            return 1.0

        scatter = self._scatter(stretches)
        scaled, scale = scaled_to_unit_diagonal(self.information())
        inverse = np.linalg.pinv(scaled, rcond=COMMON_RANK_COUNT_TOLERANCE, hermitian=True)
        formal = np.diag(inverse)
        sandwich = np.diag(inverse @ (scatter / np.outer(scale, scale)) @ inverse)
        is_known = formal > 0.0
        if not is_known.any():
            return 1.0

        # Rounding may leave a variance below zero.
        least = float(np.min(sandwich[is_known] / formal[is_known]))
        ratio = float(np.sqrt(max(least, 0.0)))
        return min(ratio, MAX_TRUE_DEVIATION) if ratio > MIN_TRUE_DEVIATION else 1.0

    @property
    def reduced_private_rows(self) -> Array:
        """(P, k, c+1) the `private_rows` as rows of the common unknowns.

        The private unknowns follow the common ones at their optimum.
        """
        J, r = self._following(self.private_rows, self.private_response)
        return np.concatenate([J, r], axis=2)

    @property
    def _reduced_blocks(self) -> tuple[Array, Array]:
        """(B, m, c) Jacobian of each block by the common unknowns, and its (B, m, 1) residuals."""
        return self._following(self.blocks, self.private_response[self.segment_of_block])

    def _following(self, rows: Array, response: Array) -> tuple[Array, Array]:
        """Rows of the common unknowns and residuals; private unknowns follow at their optimum.

        Args:
            rows: (..., k, m) rows of all unknowns.
            response: (..., n, c) derivatives of the private unknowns by the common ones.
        """
        n = self.private_count
        return rows[..., n:-1] + rows[..., :n] @ response, rows[..., -1:]


def triangle(rows: Array) -> Array:
    """Triangular factor R of the QR decomposition: few rows with equal inner products.

    Args:
        rows: (..., k, m) rows. A tall two-dimensional matrix takes two passes, the first one over
            batches that stay in the cache.

    Returns:
        (..., min(k, m), m) factor R.
    """
    k, m = rows.shape[-2:]
    batch = max(QR_BATCH_ROWS, BATCH_ROWS_PER_COLUMN * m)
    if rows.ndim == 2 and k > max(TALL_ROWS, 2 * batch):
        whole = k // batch * batch
        batches = rows[:whole].reshape(-1, batch, m)
        first_pass = np.asarray(np.linalg.qr(batches, mode="r"))
        return triangle(np.concatenate([first_pass.reshape(-1, m), rows[whole:]]))

    return np.asarray(np.linalg.qr(rows, mode="r"))


def bounded_least_squares(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """Minimiser of `|A d - b|` between bounds that contain 0.

    Args:
        A: (k, c) matrix, which need not have full rank.
        b: (k,) right-hand side.
        lower: (c,) lower bounds, at most 0.
        upper: (c,) upper bounds, at least 0.

    Returns:
        (c,) minimiser.
    """
    # An unknown without effect does not move. A tiny scale would turn round-off into a huge step.
    norms = np.linalg.norm(A, axis=0)
    norms = np.where(norms > SMALLEST_NORM, norms, 1.0)

    # The unbounded minimum is the solution where it lies inside the bounds.
    d = np.asarray(np.linalg.lstsq(A / norms, b)[0] / norms)
    if ((lower <= d) & (d <= upper)).all():
        return d

    # Unknowns whose bounds coincide do not move: lsq_linear needs room between its bounds.
    free = upper > lower
    d = np.zeros_like(d)
    if not free.any():
        return d

    low = lower[free]
    high = upper[free]
    norms = norms[free]
    solved = scipy.optimize.lsq_linear(
        A[:, free] / norms,
        b,
        (low * norms, high * norms),
        method="bvls",
        tol=1e-14,
        max_iter=MAX_EXCHANGES_PER_UNKNOWN * len(norms),
    )

    # An unknown that the solver holds at a bound is placed exactly there; the scaling by the norms
    # has round-off.
    inside = np.clip(solved.x / norms, low, high)
    d[free] = np.select([solved.active_mask < 0, solved.active_mask > 0], [low, high], inside)
    return d


@record
class RobustLoss:
    """Loss `scale^2 rho((r / scale)^2)` of a whitened residual r.

    Attributes:
        kind: Function rho. With `linear`, the loss is the square; `huber`, `soft_l1` and `cauchy`
            grow more slowly.
        scale: Residual [standard deviations] above which the loss clearly differs from the square.
    """

    kind: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    scale: float = 3.0

    @property
    def outlier_threshold(self) -> float:
        """Size above which a residual counts as an outlier [standard deviations].

        It is infinite for the loss `linear`.
        """
        return np.inf if self.kind == "linear" else max(self.scale, MIN_OUTLIER_THRESHOLD)

    @property
    def inlier_mean_square(self) -> float:
        """Mean square of standard normal residuals that are not outliers."""
        # Variance of the normal distribution truncated at both sides, by chi-square probabilities.
        square = self.outlier_threshold**2
        return float(scipy.special.chdtr(3, square) / scipy.special.chdtr(1, square))

    def value(self, r: Array) -> float:
        """Sum of the loss over residuals.

        Args:
            r: (...) whitened residuals.

        Returns:
            The sum.
        """
        if self.kind == "linear":
            return float(np.sum(r**2))

        z = (r / self.scale) ** 2
        if self.kind == "huber":
            rho = np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0)
        elif self.kind == "soft_l1":
            rho = 2.0 * (np.sqrt(1.0 + z) - 1.0)
        else:
            rho = np.log1p(z)

        return float(self.scale**2 * rho.sum())

    def weight(self, r: Array) -> Array:
        """Weights of the rows in iteratively reweighted least squares.

        Args:
            r: (...) whitened residuals.

        Returns:
            (...) square roots of the derivative of rho, between 0 and 1.
        """
        z = (r / self.scale) ** 2
        if self.kind == "huber":
            return np.minimum(1.0, np.maximum(z, SMALLEST_SQUARE) ** -0.25)
        powers = {"soft_l1": -0.25, "cauchy": -0.5}
        return (1.0 + z) ** powers.get(self.kind, 0.0)
