"""Least squares over many pieces whose starts are their own unknowns, without ever holding all rows.

The whitened rows `[J_private, J_common, r]` of each block of data are brought to a triangle that has the same inner products
(QR); private unknowns are eliminated piece by piece. What is left is exact linear algebra of the size of the common unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from mjfim.arrays import Array

BATCH = 128  # rows of a pass of a tall QR decomposition
TALL = 512  # rows from which it goes in passes
MOST_EXCHANGES = 20  # of active bounds for every unknown; one for each, scipy's choice, may end short of the minimum


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the unknowns. common: (c,);  private: (P, n);  gain: by how much half of the linearised squares falls

    size: standard deviations that the common unknowns move;  each: root mean square of those of the private ones
    """

    common: Array
    private: Array
    gain: float
    size: float
    each: float


@dataclass(frozen=True, eq=False)
class Condensed:
    """Linearised residuals of P pieces in B blocks. n private unknowns a piece, c common ones, m = n + c + 1.

    blocks: (B, m, m) rows `[J_private, J_common, r]` of each block, condensed;  piece: (B,) to which each belongs
    inner: (P, k, m) further rows of each piece's private unknowns, e.g. priors;  outer: (l, c+1) of the common ones
    """

    blocks: Array
    piece: np.ndarray
    inner: Array
    outer: Array

    @property
    def pieces(self) -> int:
        """P."""
        return len(self.inner)

    @property
    def common(self) -> int:
        """c."""
        return int(self.outer.shape[1] - 1)

    @property
    def private(self) -> int:
        """n."""
        return int(self.blocks.shape[1] - self.common - 1)

    @cached_property
    def triangles(self) -> Array:
        """(P, m, m), one for each piece."""
        m = self.blocks.shape[1]
        counts = np.bincount(self.piece, minlength=self.pieces)
        stacked = np.zeros((self.pieces, max(int(counts.max(initial=0)), 1), m, m))
        order = np.argsort(self.piece, kind="stable")
        slot = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        stacked[self.piece[order], slot] = self.blocks[order]
        rows = np.concatenate([stacked.reshape(self.pieces, -1, m), self.inner], axis=1)
        return triangle(rows)

    @cached_property
    def eliminated(self) -> Array:
        """(P, n, c) change of each piece's private unknowns with the common ones where they follow them."""
        return np.asarray(-self._inverse @ self.triangles[:, : self.private, self.private : -1])

    @cached_property
    def _inverse(self) -> Array:
        """(P, n, n) pseudo-inverse of the private triangles, whatever the units of the unknowns."""
        n = self.private
        unit = np.maximum(self.lengths[:n], 1e-300)
        return np.asarray(
            np.linalg.pinv(self.triangles[:, :n, :n] / unit, rcond=1e-12) / unit[:, None]
        )

    def profile(self) -> Array:
        """(k, c+1) rows of the common unknowns once the private ones follow them, `outer` left out."""
        R, n = self.triangles, self.private
        if not n:
            return np.asarray(R.reshape(-1, R.shape[2]))
        rows = R[:, :n, :n] @ self.eliminated + R[:, :n, n:-1]
        # what the least-squares private step leaves of r, should a piece not determine its start
        own = R[:, :n, -1:] - R[:, :n, :n] @ (self._inverse @ R[:, :n, -1:])
        left = np.concatenate([np.concatenate([rows, own], axis=2), R[:, n:, n:]], axis=1)
        return np.asarray(left.reshape(-1, left.shape[2]))

    @property
    def rank(self) -> int:
        """Number of unknowns that the rows determine."""
        n, R = self.private, self.triangles
        length = np.maximum(np.linalg.norm(R[:, :, :n], axis=1, keepdims=True), 1e-300)
        own = int(np.linalg.matrix_rank(R[:, :, :n] / length, tol=1e-8).sum()) if n else 0
        H = self.information()
        unit = np.sqrt(np.maximum(np.diag(H), 1e-300))
        return own + (
            int(np.linalg.matrix_rank(H / np.outer(unit, unit), tol=1e-12, hermitian=True))
            if len(H)
            else 0
        )

    def information(self, outer: bool = True) -> Array:
        """(c, c) of the common unknowns, the private ones marginalised; outer: with the rows of `outer`."""
        J = self.profile()[:, :-1]
        J = np.concatenate([J, self.outer[:, :-1]]) if outer else J
        return np.asarray(J.T @ J)

    @cached_property
    def lengths(self) -> Array:
        """(n+c,) root of the mean square, and norm, of the columns: private, then common."""
        R = self.triangles[:, :, :-1]
        squares = np.sum(R**2, axis=1)
        own = np.sqrt(squares[:, : self.private].mean(axis=0))
        rest = np.sqrt(
            squares[:, self.private :].sum(axis=0) + np.sum(self.outer[:, :-1] ** 2, axis=0)
        )
        return np.asarray(np.concatenate([own, rest]))

    def step(self, damping: float, scale: Array, lower: Array, upper: Array) -> Step:
        """The Levenberg-Marquardt step: `min |J d + r|^2 + damping |scale d|^2` with lower <= d_common <= upper.

        scale: (n+c,);  lower, upper: (c,)
        """
        n, c = self.private, self.common
        R = np.array(self.triangles)
        weight = np.sqrt(damping) * scale
        if n:
            damp = np.zeros((self.pieces, n, R.shape[2]))
            damp[:, np.arange(n), np.arange(n)] = np.maximum(
                weight[:n], 1e-12 * np.maximum(scale[:n], 1e-300)
            )
            R = triangle(np.concatenate([R, damp], axis=1))
        rows = R[:, n:, n:].reshape(-1, c + 1)
        extra = np.concatenate([np.diag(weight[n:]), np.zeros((c, 1))], axis=1)
        rows = triangle(np.concatenate([rows, self.outer, extra]))
        d = _bounded(rows[:, :-1], -rows[:, -1], lower, upper)
        own: Array = np.zeros((self.pieces, n))
        if n:
            rhs = R[:, :n, -1] + R[:, :n, n:-1] @ d
            own = np.asarray(-np.linalg.solve(R[:, :n, :n], rhs[..., None])[..., 0])
        return self._judged(d, own)

    def _judged(self, d: Array, own: Array) -> Step:
        moves = np.concatenate([own, np.broadcast_to(d, (self.pieces, len(d)))], axis=1)
        R = self.triangles
        change = (R[:, :, :-1] @ moves[..., None])[..., 0]
        outer = self.outer[:, :-1] @ d
        gain = -float(np.sum(change * (R[:, :, -1] + 0.5 * change)))
        gain -= float(outer @ (self.outer[:, -1] + 0.5 * outer))
        size = float(np.sqrt(d @ self.information() @ d)) if len(d) else 0.0
        n = self.private
        each = (R[:, :, :n] @ own[..., None])[..., 0]
        return Step(
            d,
            own,
            gain,
            size,
            float(np.sqrt(np.mean(each**2) * R.shape[1] / max(n, 1))) if n else 0.0,
        )

    @cached_property
    def scores(self) -> Array:
        """(B, c) gradient of half of the squares by the common unknowns, block by block, the private ones following."""
        J, r = self._following
        return np.asarray((np.swapaxes(J, 1, 2) @ r)[..., 0])

    @cached_property
    def grams(self) -> Array:
        """(B, c, c) information of each block about the common unknowns, the private ones following."""
        J, _ = self._following
        return np.asarray(np.swapaxes(J, 1, 2) @ J)

    @property
    def known(self) -> Array:
        """(P, k, c+1) rows of `inner` by the common unknowns, the private ones following."""
        n = self.private
        J = self.inner[:, :, n:-1] + self.inner[:, :, :n] @ self.eliminated
        return np.concatenate([J, self.inner[:, :, -1:]], axis=2)

    @property
    def _following(self) -> tuple[Array, Array]:
        n = self.private
        J = self.blocks[:, :, n:-1] + self.blocks[:, :, :n] @ self.eliminated[self.piece]
        return J, self.blocks[:, :, -1:]


def triangle(rows: Array) -> Array:
    """R of the QR decomposition of (..., k, m) rows: m rows with the same inner products (fewer where k < m).

    Tall ones go in two passes, the first over batches that stay in the cache.
    """
    k, m = rows.shape[-2:]
    if rows.ndim == 2 and k > TALL:
        whole = k // BATCH * BATCH
        firsts = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, BATCH, m), mode="r"))
        return triangle(np.concatenate([firsts.reshape(-1, m), rows[whole:]]))
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _bounded(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """`min |A d - b|` within bounds that hold 0; A need not have full rank."""
    unit = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    d = np.linalg.lstsq(A / unit, b)[0] / unit
    if (d >= lower).all() and (d <= upper).all():
        return np.asarray(d)
    low, high = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    thin = high - low <= 0.0  # at both bounds: lsq_linear wants room
    out = np.zeros(len(d))
    if thin.all():
        return out
    A, unit = A[:, ~thin] / unit[~thin], unit[~thin]
    box = (low[~thin] * unit, high[~thin] * unit)
    solved = lsq_linear(A, b, box, method="bvls", tol=1e-14, max_iter=MOST_EXCHANGES * len(unit))
    # An unknown that the solver holds at a bound lies exactly there, whatever rounding the scaling by `unit` leaves.
    within = np.clip(solved.x / unit, low[~thin], high[~thin])
    within = np.where(solved.active_mask < 0, low[~thin], within)
    within = np.where(solved.active_mask > 0, high[~thin], within)

    out[~thin] = within
    return out
