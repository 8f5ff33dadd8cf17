"""Condensed least squares against dense linear algebra on the full stacked Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import lstsq
from scipy.optimize import lsq_linear

from mjfim.optimize.condensed_least_squares import Condensed, Step, triangle
from tests.support.numerics import Array


@dataclass(frozen=True, eq=False)
class Dense:
    """A problem in condensed and in dense form.

    Attributes:
        condensed: Condensed form.
        J: (rows, P n + c) derivatives by all unknowns.
        r: (rows,) residuals.
        blocks: Rows `[private, common, r]` of every block.
        P: Number of segments.
        n: Number of private unknowns of a segment.
        c: Number of common unknowns.
    """

    condensed: Condensed
    J: Array
    r: Array
    blocks: list[Array]
    P: int
    n: int
    c: int

    @property
    def starts(self) -> Array:
        """Columns of the private unknowns."""
        return self.J[:, : self.P * self.n]

    @property
    def shared(self) -> Array:
        """Columns of the common unknowns."""
        return self.J[:, self.P * self.n :]

    def step(self, damping: float = 0.0, scale: Array | None = None) -> Step:
        """The step without bounds; all unknowns are damped alike where no scale is given."""
        scale = np.ones(self.n + self.c) if scale is None else scale
        free = np.full(self.c, FREE)
        return self.condensed.step(damping, scale, -free, free)

    def halves(self, step: Step) -> float:
        """Half of the squares after a step."""
        left = self.J @ np.concatenate([step.private.ravel(), step.common]) + self.r
        return 0.5 * float(left @ left)


def condense(rows: Array) -> Array:
    """(m, m) matrix with the inner products of (k, m) rows.

    It is computed by singular values; the package uses the QR decomposition.
    """
    m = rows.shape[1]
    _, s, V = np.linalg.svd(rows, full_matrices=True)
    out = np.zeros((m, m))
    out[: len(s)] = s[:, None] * V[: len(s)]
    out[:, ~rows.any(axis=0)] = 0.0  # exactly zero, as with QR
    return out


def spread(rows: Array, segment: int, P: int, n: int) -> Array:
    """(k, P n + c) of rows `[private, common]` of one segment among the columns of all unknowns."""
    wide = np.zeros((len(rows), P * n + rows.shape[1] - n))
    wide[:, segment * n : (segment + 1) * n] = rows[:, :n]
    wide[:, P * n :] = rows[:, n:]
    return wide


def problem(
    seed: int,
    P: int = 4,
    n: int = 2,
    c: int = 3,
    inner: int = 1,
    outer: int = 2,
    rank_deficient: bool = False,
) -> Dense:
    """Random segments of one to three blocks in shuffled order, with priors.

    Args:
        seed: Seed of the random numbers.
        P: Number of segments.
        n: Number of private unknowns of a segment.
        c: Number of common unknowns.
        inner: Number of private rows of a segment.
        outer: Number of common rows.
        rank_deficient: Whether no row depends on the last private unknown.
    """
    rng = np.random.default_rng(seed)
    m = n + c + 1
    owner = rng.permutation(np.concatenate([np.full(rng.integers(1, 4), i) for i in range(P)]))
    units = 10.0 ** rng.uniform(-2, 2, m)
    units[-1] = 1.0
    blocks = [rng.standard_normal((rng.integers(1, 9), m)) * units for _ in owner]
    inside, outside = (
        rng.standard_normal((P, inner, m)) * units,
        rng.standard_normal((outer, c + 1)) * units[n:],
    )
    if rank_deficient and n:
        inside[:, :, n - 1] = 0.0
        for block in blocks:
            block[:, n - 1] = 0.0
    condensed = Condensed(
        blocks=np.stack([condense(b) for b in blocks]),
        segment_of_block=owner,
        private_rows=inside,
        common_rows=outside,
    )
    wide_rows = [spread(b[:, :-1], i, P, n) for b, i in zip(blocks, owner, strict=True)]
    wide_rows += [spread(rows[:, :-1], i, P, n) for i, rows in enumerate(inside)]
    J = np.concatenate([*wide_rows, np.pad(outside[:, :-1], ((0, 0), (P * n, 0)))])
    r = np.concatenate([*(b[:, -1] for b in blocks), inside[:, :, -1].ravel(), outside[:, -1]])
    return Dense(condensed, J, r, blocks, P, n, c)


SHAPES = [(4, 2, 3), (1, 3, 2), (5, 0, 3), (3, 4, 1), (6, 1, 5)]
FREE = np.inf


def close(value: Array, expected: Array, rtol: float = 1e-7) -> None:
    """Equal up to round-off of the largest entry."""
    assert value.shape == expected.shape
    assert_allclose(
        value, expected, rtol=rtol, atol=rtol * max(float(np.abs(expected).max(initial=0.0)), 1e-12)
    )


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_step_solves_the_full_stacked_problem(
    shape: tuple[int, int, int], damping: float
) -> None:
    """The dense problem has one further row per unknown for the damping."""
    for seed in range(6):
        dense = problem(seed, *shape, inner=shape[1] + 1, outer=shape[2] + 1)
        scale = np.random.default_rng(seed).uniform(0.5, 2.0, dense.n + dense.c)
        wide = np.concatenate([np.tile(scale[: dense.n], dense.P), scale[dense.n :]])
        rows = np.concatenate([dense.J, np.sqrt(damping) * np.diag(wide)])
        expected = lstsq(rows, -np.concatenate([dense.r, np.zeros(len(wide))]))[0]
        step = dense.step(damping, scale)
        unit = np.linalg.norm(rows, axis=0)
        close(np.concatenate([step.private.ravel(), step.common]) * unit, expected * unit)
        assert step.predicted_decrease == pytest.approx(
            0.5 * float(dense.r @ dense.r) - dense.halves(step), rel=1e-8
        )
        assert dense.condensed.segment_count == dense.P
        assert (dense.condensed.private_count, dense.condensed.common_count) == (dense.n, dense.c)


@pytest.mark.parametrize("shape", SHAPES)
def test_bounds_hold_and_the_bounded_step_is_the_best(shape: tuple[int, int, int]) -> None:
    """Compare with another method of SciPy on the full problem with bounded common unknowns."""
    active = 0
    for seed in range(10):
        dense = problem(seed, *shape, inner=shape[1] + 1, outer=shape[2] + 1)
        best = np.abs(dense.step().common)
        rng = np.random.default_rng(seed)
        lower, upper = (sign * best * rng.uniform(0.0, 1.5, dense.c) for sign in (-1.0, 1.0))
        lower[0] *= dense.c == 1  # at a bound already
        step = dense.condensed.step(0.0, np.ones(dense.n + dense.c), lower, upper)
        assert (step.common >= lower).all()
        assert (step.common <= upper).all()
        unit = np.linalg.norm(dense.J, axis=0)
        none = np.full(dense.P * dense.n, FREE)
        wide = (np.concatenate([-none, lower]) * unit, np.concatenate([none, upper]) * unit)
        expected = lsq_linear(
            dense.J / unit,
            -dense.r,
            wide,
            method="trf",
            tol=1e-15,
            lsq_solver="exact",
            max_iter=500,
        )
        assert dense.halves(step) <= expected.cost * (1 + 1e-9)
        assert_allclose(
            step.common * unit[-dense.c :], expected.x[-dense.c :], rtol=1e-4, atol=1e-5
        )
        active += int(((step.common == lower) | (step.common == upper)).sum())
    assert active > 5, "too few bounds are active for this test"


def test_many_active_bounds_satisfy_the_optimality_conditions() -> None:
    """Unknowns are strongly correlated, and most of them end at a bound."""
    for seed in (
        4,
        1188,
        1211,
        *range(100, 140),
    ):  # the first three take more exchanges than there are unknowns
        rng = np.random.default_rng(seed)
        c = int(rng.integers(2, 20))
        A = np.triu(rng.standard_normal((c + 1, c)))
        rng.standard_normal((c, c))
        A = A @ (
            np.eye(c)
            + rng.choice([0, 1, 5]) * np.outer(rng.standard_normal(c), rng.standard_normal(c))
        )
        b = rng.standard_normal(c + 1) * 10
        lower = -rng.uniform(0, 2, c) * (rng.random(c) < 0.7)
        upper = rng.uniform(0, 2, c) * (rng.random(c) < 0.7)
        condensed = Condensed(
            blocks=np.column_stack([A, -b])[None],
            segment_of_block=np.zeros(1, int),
            private_rows=np.zeros((1, 0, c + 1)),
            common_rows=np.zeros((0, c + 1)),
        )
        d = condensed.step(0.0, np.ones(c), lower, upper).common
        slope = A.T @ (A @ d - b) / (np.abs(A).sum(axis=0) * np.linalg.norm(b))
        assert ((d >= lower) & (d <= upper)).all()
        assert slope[d > lower + 1e-12].max(initial=0.0) < 1e-8, "could go further down"
        assert slope[d < upper - 1e-12].min(initial=0.0) > -1e-8, "could go further up"


def test_a_common_unknown_with_equal_bounds_stays() -> None:
    """Both bounds are zero; the other unknowns solve the problem without its column."""
    dense = problem(3, inner=3, outer=4)
    lower, upper = np.array([-FREE, 0.0, -FREE]), np.array([FREE, 0.0, FREE])
    step = dense.condensed.step(0.0, np.ones(5), lower, upper)
    kept = np.delete(np.arange(dense.J.shape[1]), dense.P * dense.n + 1)
    expected = lstsq(dense.J[:, kept], -dense.r)[0]
    assert step.common[1] == 0.0
    close(step.common[[0, 2]], expected[-2:])
    none = np.zeros(3)
    still = dense.condensed.step(0.0, np.ones(5), none, none)
    close(still.private.ravel(), lstsq(dense.starts, -dense.r)[0])
    assert not still.common.any()
    assert still.common_length == 0.0


@pytest.mark.parametrize("rank_deficient", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_elimination_gives_the_schur_complement(
    shape: tuple[int, int, int], rank_deficient: bool
) -> None:
    """Compare response, information and reduced rows with the full normal matrix."""
    for seed in range(4):
        dense = problem(seed, *shape, rank_deficient=rank_deficient)
        C, P, n, c = dense.condensed, dense.P, dense.n, dense.c
        inverse = np.linalg.pinv(
            dense.starts / (unit := np.maximum(np.linalg.norm(dense.starts, axis=0), 1e-30))
        )
        follow = -(inverse / unit[:, None]) @ dense.shared
        left = dense.shared + dense.starts @ follow
        close(C.information(), left.T @ left)
        outer = C.common_rows[:, :-1]
        close(C.information(with_common_rows=False), left.T @ left - outer.T @ outer, rtol=1e-6)
        rows = np.concatenate([C.reduced_rows(), C.common_rows])
        rest = dense.r - dense.starts @ (inverse / unit[:, None]) @ dense.r
        both = np.column_stack([left, rest])
        close(rows.T @ rows, both.T @ both)
        rank = np.linalg.matrix_rank(dense.starts / unit) if n else 0
        if rank == P * n:
            close(C.private_response, follow.reshape(P, n, c), rtol=1e-6)


def test_column_norms_are_root_mean_squares_over_segments_for_private_unknowns() -> None:
    dense = problem(1)
    norms = np.linalg.norm(dense.J, axis=0)
    private = np.sqrt(np.mean(norms[: dense.P * dense.n].reshape(dense.P, dense.n) ** 2, axis=0))
    close(dense.condensed.column_norms, np.concatenate([private, norms[dense.P * dense.n :]]))


@pytest.mark.parametrize("shape", SHAPES)
def test_scores_and_information_of_blocks_sum_to_the_whole(
    shape: tuple[int, int, int],
) -> None:
    """Each block is compared with its rows, and the sum with the full problem including priors."""
    for seed in range(4):
        dense = problem(seed, *shape, inner=shape[1] + 1)
        C, n = dense.condensed, dense.n
        for b, rows in enumerate(dense.blocks):
            J = rows[:, n:-1] + rows[:, :n] @ C.private_response[C.segment_of_block[b]]
            for found, wanted in (
                (C.block_scores, J.T @ rows[:, -1]),
                (C.block_information, J.T @ J),
            ):
                size = np.abs(found).max()
                assert_allclose(found[b], wanted, rtol=1e-7, atol=1e-9 * size)
        known = np.concatenate([C.reduced_private_rows.reshape(-1, dense.c + 1), C.common_rows])
        gradient = C.block_scores.sum(axis=0) + known[:, :-1].T @ known[:, -1]
        basis = np.linalg.qr(dense.starts)[0]
        expected = (dense.shared - basis @ (basis.T @ dense.shared)).T @ dense.r
        close(gradient, expected, rtol=1e-6)
        close(
            C.block_information.sum(axis=0) + known[:, :-1].T @ known[:, :-1],
            C.information(),
            rtol=1e-6,
        )


@pytest.mark.parametrize("damping", [0.0, 1e-6])
def test_undetermined_private_unknowns_do_not_break_the_step(damping: float) -> None:
    """No row depends on one private unknown, and one segment has fewer rows than unknowns."""
    for seed in range(5):
        dense = problem(seed, P=3, n=3, c=2, inner=0, outer=3, rank_deficient=True)
        scale = np.maximum(dense.condensed.column_norms, 0.0)
        step = dense.step(damping, scale)
        assert np.isfinite(step.private).all()
        assert np.abs(step.private[:, 2]).max() == 0.0
        best = lstsq(dense.J, -dense.r)[0]
        least = 0.5 * float(np.sum((dense.J @ best + dense.r) ** 2))
        assert dense.halves(step) == pytest.approx(least, rel=1e-4, abs=1e-4)
        assert np.isfinite(dense.condensed.information()).all()


def test_a_problem_without_common_unknowns() -> None:
    """Every segment is solved separately."""
    dense = problem(2, P=3, n=2, c=0, inner=2, outer=0)
    step = dense.step()
    close(step.private.ravel(), lstsq(dense.J, -dense.r)[0])
    assert step.common_length == 0.0
    assert dense.condensed.information().shape == (0, 0)
    assert dense.condensed.block_scores.shape == (len(dense.blocks), 0)


def test_step_lengths_are_standard_deviations() -> None:
    """Common steps use the marginal information, private ones that at constant theta."""
    dense = problem(4, inner=3)
    step = dense.step()
    basis = np.linalg.qr(dense.starts)[0]
    left = dense.shared - basis @ (basis.T @ dense.shared)
    assert step.common_length == pytest.approx(float(np.linalg.norm(left @ step.common)), rel=1e-8)
    squares = np.linalg.norm(dense.starts @ step.private.ravel()) ** 2
    assert step.private_length == pytest.approx(np.sqrt(squares / step.private.size), rel=1e-8)


def test_units_of_the_unknowns_do_not_matter() -> None:
    """Columns ten orders of magnitude apart give equal steps in these units."""
    dense = problem(9, inner=3, outer=4)
    unit = np.array([1e6, 1e-4, 1e-5, 1.0, 1e5, 1.0])
    C = dense.condensed
    other = Condensed(
        blocks=C.blocks * unit,
        segment_of_block=C.segment_of_block,
        private_rows=C.private_rows * unit,
        common_rows=C.common_rows * unit[2:],
    )
    for lower in (-FREE, -0.01):
        bound = np.full(3, lower)
        one = C.step(1e-4, C.column_norms, bound, -bound)
        two = other.step(1e-4, other.column_norms, bound / unit[2:-1], -bound / unit[2:-1])
        close(two.common * unit[2:-1], one.common, rtol=1e-6)
        close(two.private * unit[:2], one.private, rtol=1e-6)
        assert two.common_length == pytest.approx(one.common_length, rel=1e-6)
    close(other.information(), C.information() * np.outer(unit[2:-1], unit[2:-1]), rtol=1e-6)


def gradients_after(condensed: Condensed, common: Array) -> Array:
    """(P, c) gradients of half of the squares of each segment after a step, without common rows."""
    rows = condensed.reduced_rows()
    J, residual = rows[:, :-1], rows[:, :-1] @ common + rows[:, -1]
    each = (J * residual[:, None]).reshape(condensed.segment_count, -1, J.shape[1])
    return np.asarray(each.sum(axis=1))


@pytest.mark.parametrize("shape", SHAPES)
def test_the_linearisation_after_a_step_has_its_residuals(shape: tuple[int, int, int]) -> None:
    """Residuals are those of the dense rows, and gradients those of the reduced ones."""
    dense = problem(2, *shape, inner=shape[1] + 1)
    C, n = dense.condensed, dense.n
    step = dense.step(1e-3, C.column_norms)
    moved = C.after(step)

    # Squares of all rows at the end of the step.
    private = moved.triangles[..., -1]
    squares = float(np.sum(private**2)) + float(np.sum(moved.common_rows[:, -1] ** 2))
    assert 0.5 * squares == pytest.approx(dense.halves(step), rel=1e-9)
    close(moved.information(), C.information())

    # The private unknowns follow, so that only the step of the common ones counts.
    before = gradients_after(C, step.common)
    after = gradients_after(moved, np.zeros(dense.c))
    scale = np.abs(before).max(initial=1e-300)
    assert_allclose(after, before, rtol=1e-6, atol=1e-7 * scale)
    scores = np.zeros((dense.P, dense.c))
    np.add.at(scores, moved.segment_of_block, moved.block_scores)
    if not n:
        of_private = moved.reduced_private_rows
        scores += np.einsum("pkc,pk->pc", of_private[..., :-1], of_private[..., -1])
        assert_allclose(after, scores, rtol=1e-6, atol=1e-7 * scale)


def test_without_some_blocks_and_segments_the_rows_of_the_others_count() -> None:
    dense = problem(5)
    left_out = np.zeros(len(dense.blocks), dtype=bool)
    left_out[[1, 3]] = True
    step = replace(dense, condensed=dense.condensed.without_blocks(left_out)).step()

    # Zero rows in place of the blocks that are left out.
    first = np.cumsum([0, *(len(block) for block in dense.blocks)])
    kept = np.ones(len(dense.J), dtype=bool)
    for block in np.flatnonzero(left_out):
        kept[first[block] : first[block + 1]] = False
    exact = lstsq(dense.J[kept], -dense.r[kept])[0]
    assert_allclose(step.common, exact[dense.P * dense.n :], rtol=1e-7)

    some = np.array([2, 0])
    part = dense.condensed.of_segments(some)
    assert part.segment_count == 2
    assert_allclose(
        np.abs(part.triangles[0]), np.abs(dense.condensed.triangles[2]), rtol=1e-9, atol=1e-9
    )


def test_private_unknowns_follow_a_given_step_of_the_common_ones() -> None:
    dense = problem(6)
    common = np.random.default_rng(0).standard_normal(dense.c) / dense.condensed.column_norms[2:]
    private = dense.condensed.step_to(common, 0.0, dense.condensed.column_norms).private
    exact = lstsq(dense.starts, -(dense.r + dense.shared @ common))[0]
    assert_allclose(private.ravel(), exact, rtol=1e-6)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_true_deviation_is_that_of_autocorrelated_residuals(correlation: float) -> None:
    """Residuals of a first-order autoregressive process, and two smooth regressors."""
    rng = np.random.default_rng(1)
    count, rows = 400, 20
    e = rng.standard_normal(count * rows)
    for k in range(1, len(e)):
        e[k] = correlation * e[k - 1] + np.sqrt(1.0 - correlation**2) * e[k]
    t = np.linspace(0.0, 1.0, len(e))
    J = np.column_stack([np.ones_like(t), t])
    r = e - J @ lstsq(J, e)[0]
    blocks = np.stack(
        [condense(np.column_stack([J, r])[i : i + rows]) for i in range(0, len(t), rows)]
    )
    found = Condensed(
        blocks=blocks,
        segment_of_block=np.zeros(count, dtype=int),
        private_rows=np.zeros((1, 0, 3)),
        common_rows=np.zeros((0, 3)),
    ).true_deviation

    # The variance of a mean is (1 + rho) / (1 - rho) times that of white noise.
    expected = np.sqrt((1.0 + correlation) / (1.0 - correlation))
    assert found == pytest.approx(expected if correlation else 1.0, rel=0.25)


@pytest.mark.parametrize("columns", [3, 40, 200])
def test_a_tall_triangle_has_the_inner_products_of_its_rows(columns: int) -> None:
    """Also with more columns than a batch of the first pass has rows."""
    rows = np.random.default_rng(0).standard_normal((2500, columns))
    R = triangle(rows)
    assert R.shape == (columns, columns)
    assert_allclose(R.T @ R, rows.T @ rows, atol=1e-9 * len(rows))
