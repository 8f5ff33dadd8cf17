"""Condensed least squares against dense linear algebra on the full stacked Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import lstsq
from scipy.signal import lfilter

from mjfim.optimize.condensed_least_squares import Condensed, Step, triangle
from tests.support.numerics import Array

# Segments, private unknowns of each, and common unknowns.
SHAPES = [(4, 2, 3), (1, 3, 2), (5, 0, 3), (3, 4, 1), (6, 1, 5), (3, 2, 0)]
FREE = np.inf


@dataclass(frozen=True, eq=False)
class Dense:
    """A problem in condensed and in dense form.

    Attributes:
        condensed: Condensed form.
        starts: (rows, P n) derivatives by the private unknowns.
        shared: (rows, c) derivatives by the common unknowns.
        r: (rows,) residuals.
        blocks: Rows `[private, common, r]` of every block.
    """

    condensed: Condensed
    starts: Array
    shared: Array
    r: Array
    blocks: list[Array]

    @property
    def J(self) -> Array:
        """Derivatives by all unknowns."""
        return np.concatenate([self.starts, self.shared], axis=1)

    def step(self, damping: float = 0.0) -> Step:
        """The step without bounds."""
        free = np.full(self.shared.shape[1], FREE)
        return self.condensed.step(damping, self.condensed.column_norms, -free, free)

    def halves(self, step: Step) -> float:
        """Half of the squares after a step."""
        return 0.5 * np.sum((self.J @ of_all(step) + self.r) ** 2)

    def left_of_shared(self) -> Array:
        """What the private unknowns cannot explain of the columns of the common ones."""
        basis = np.linalg.svd(self.starts, full_matrices=False)[0]
        basis = basis[:, : np.linalg.matrix_rank(self.starts / self.norms)]
        return self.shared - basis @ (basis.T @ self.shared)

    @property
    def norms(self) -> Array:
        """Norms of the private columns, or 1."""
        norms = np.linalg.norm(self.starts, axis=0)
        return np.where(norms > 0.0, norms, 1.0)


def of_all(step: Step) -> Array:
    """Step of the private unknowns, then of the common ones."""
    return np.concatenate([step.private.ravel(), step.common])


def condense(rows: Array) -> Array:
    """(m, m) matrix with the inner products of (k, m) rows."""
    return np.linalg.qr(np.concatenate([rows, np.zeros((rows.shape[1],) * 2)]), mode="r")


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
    owner = rng.permutation(np.repeat(np.arange(P), rng.integers(1, 4, P)))
    units = np.append(10.0 ** rng.uniform(-2, 2, m - 1), 1.0)
    blocks = [rng.standard_normal((rng.integers(1, 9), m)) * units for _ in owner]
    inside = rng.standard_normal((P, inner, m)) * units
    outside = rng.standard_normal((outer, c + 1)) * units[n:]
    if rank_deficient:
        for each in (inside, *blocks):
            each[..., n - 1 : n] = 0.0

    rows, owners = [*blocks, *inside], [*owner, *range(P)]
    starts = [np.kron(np.arange(P) == i, each[:, :n]) for each, i in zip(rows, owners, strict=True)]
    common = np.concatenate([outside, *(each[:, n:] for each in rows)])
    return Dense(
        condensed=Condensed(
            blocks=np.stack([condense(block) for block in blocks]),
            segment_of_block=owner,
            private_rows=inside,
            common_rows=outside,
        ),
        starts=np.concatenate([np.zeros((outer, P * n)), *starts]),
        shared=common[:, :-1],
        r=common[:, -1],
        blocks=blocks,
    )


def close(value: Array, expected: Array, rtol: float = 1e-7) -> None:
    """Equal up to round-off of the largest entry."""
    assert value.shape == expected.shape
    size = max(np.abs(expected).max(initial=0.0), 1e-12)
    assert_allclose(value, expected, rtol=rtol, atol=rtol * size)


def assert_least(J: Array, r: Array, x: Array, lower: Array, upper: Array) -> None:
    """The conditions of optimality of |J x + r| within bounds."""
    slope = J.T @ (J @ x + r) / (np.abs(J).sum(axis=0) * np.linalg.norm(r))
    assert ((x >= lower) & (x <= upper)).all()
    assert slope[x > lower].max(initial=0.0) < 1e-8, "could go further down"
    assert slope[x < upper].min(initial=0.0) > -1e-8, "could go further up"


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_step_solves_the_full_stacked_problem(shape: Any, damping: float, bounded: bool) -> None:
    """The dense problem has one further row per unknown for the damping."""
    P, n, c = shape
    for seed in range(6):
        dense, rng = problem(seed, *shape, inner=n + 1, outer=c + 1), np.random.default_rng(seed)
        scale = rng.uniform(0.5, 2.0, n + c)
        bounds = np.full((2, c), FREE)
        if bounded:
            best = np.abs(dense.step(damping).common)
            bounds = best * rng.uniform(0.0, 1.5, (2, c))
            bounds[:, :1] *= rng.integers(0, 2, (2, 1))  # at a bound already
        step = dense.condensed.step(damping, scale, -bounds[0], bounds[1])
        wide = np.concatenate([np.tile(scale[:n], P), scale[n:]])
        rows = np.concatenate([dense.J, np.sqrt(damping) * np.diag(wide)])
        lower, upper = (np.concatenate([np.full(P * n, FREE), each]) for each in bounds)
        r = np.concatenate([dense.r, np.zeros(len(wide))])
        assert_least(rows, r, of_all(step), -lower, upper)
        decrease = 0.5 * (dense.r @ dense.r) - dense.halves(step)
        assert step.predicted_decrease == pytest.approx(decrease, rel=1e-8)


def test_many_active_bounds_satisfy_the_optimality_conditions() -> None:
    """Unknowns are strongly correlated, and most of them end at a bound."""
    # The first three take more exchanges than there are unknowns.
    for seed in (4, 1188, 1211, *range(100, 140)):
        rng = np.random.default_rng(seed)
        c = int(rng.integers(2, 20))
        A = np.triu(rng.standard_normal((c + 1, c)))
        rng.standard_normal((c, c))
        size = rng.choice([0, 1, 5])
        A = A + size * np.outer(A @ rng.standard_normal(c), rng.standard_normal(c))
        b = rng.standard_normal(c + 1) * 10
        lower = -rng.uniform(0, 2, c) * (rng.random(c) < 0.7)
        upper = rng.uniform(0, 2, c) * (rng.random(c) < 0.7)
        step = alone(np.column_stack([A, -b])[None]).step(0.0, np.ones(c), lower, upper)
        assert_least(A, -b, step.common, lower, upper)


def alone(blocks: Array) -> Condensed:
    """Blocks of one segment without private unknowns."""
    m = blocks.shape[2]
    return Condensed(
        blocks=blocks,
        segment_of_block=np.zeros(len(blocks), int),
        private_rows=np.zeros((1, 0, m)),
        common_rows=np.zeros((0, m)),
    )


@pytest.mark.parametrize("rank_deficient", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_elimination_gives_the_schur_complement(shape: Any, rank_deficient: bool) -> None:
    """Compare response, information and reduced rows with the full normal matrix."""
    P, n, c = shape
    for seed in range(4):
        dense = problem(seed, *shape, rank_deficient=rank_deficient)
        C = dense.condensed
        inverse = np.linalg.pinv(dense.starts / dense.norms) / dense.norms[:, None]
        follow = -inverse @ dense.shared
        left = dense.shared + dense.starts @ follow
        close(C.information(), left.T @ left)
        outer = C.common_rows[:, :-1]
        close(C.information(with_common_rows=False), left.T @ left - outer.T @ outer, rtol=1e-6)
        rows = np.concatenate([C.reduced_rows(), C.common_rows])
        both = np.column_stack([left, dense.r - dense.starts @ inverse @ dense.r])
        close(rows.T @ rows, both.T @ both)
        if n and np.linalg.matrix_rank(dense.starts / dense.norms) == P * n:
            close(C.private_response, follow.reshape(P, n, c), rtol=1e-6)


def test_column_norms_are_root_mean_squares_over_segments_for_private_unknowns() -> None:
    dense = problem(1)
    squares = np.mean(np.sum(dense.starts**2, axis=0).reshape(4, 2), axis=0)
    shared = np.linalg.norm(dense.shared, axis=0)
    close(dense.condensed.column_norms, np.concatenate([np.sqrt(squares), shared]))


@pytest.mark.parametrize("shape", SHAPES)
def test_scores_and_information_of_blocks_sum_to_the_whole(shape: Any) -> None:
    """Each block is compared with its rows, and the sum with the full problem including priors."""
    n, c = shape[1:]
    for seed in range(4):
        dense = problem(seed, *shape, inner=n + 1)
        C = dense.condensed
        for k, (rows, i) in enumerate(zip(dense.blocks, C.segment_of_block, strict=True)):
            J = rows[:, n:-1] + rows[:, :n] @ C.private_response[i]
            close(C.block_scores[k], J.T @ rows[:, -1], rtol=1e-6)
            close(C.block_information[k], J.T @ J)
        known = np.concatenate([C.reduced_private_rows.reshape(-1, c + 1), C.common_rows])
        A, left = known[:, :-1], dense.left_of_shared()
        close(C.block_scores.sum(axis=0) + A.T @ known[:, -1], left.T @ dense.r, rtol=1e-6)
        close(C.block_information.sum(axis=0) + A.T @ A, C.information(), rtol=1e-6)


@pytest.mark.parametrize("damping", [0.0, 1e-6])
def test_undetermined_private_unknowns_do_not_break_the_step(damping: float) -> None:
    """No row depends on one private unknown, and one segment has fewer rows than unknowns."""
    for seed in range(5):
        dense = problem(seed, P=3, n=3, c=2, inner=0, outer=3, rank_deficient=True)
        step = dense.step(damping)
        assert not step.private[:, 2].any()
        least = 0.5 * np.sum((dense.J @ lstsq(dense.J, -dense.r)[0] + dense.r) ** 2)
        assert dense.halves(step) == pytest.approx(least, rel=1e-4, abs=1e-4)
        assert np.isfinite(dense.condensed.information()).all()


def gradients_after(condensed: Condensed, common: Array) -> Array:
    """(P, c) gradients of half of the squares of each segment after a step, without common rows."""
    rows = condensed.reduced_rows().reshape(condensed.segment_count, -1, len(common) + 1)
    J = rows[..., :-1]
    return np.einsum("pkc,pk->pc", J, J @ common + rows[..., -1])


@pytest.mark.parametrize("shape", SHAPES)
def test_the_linearisation_after_a_step_has_its_residuals(shape: Any) -> None:
    """Residuals are those of the dense rows, and gradients those of the reduced ones."""
    dense = problem(2, *shape, inner=shape[1] + 1)
    C = dense.condensed
    step = dense.step(1e-3)
    moved = C.after(step)

    # Squares of all rows at the end of the step.
    squares = np.sum(moved.triangles[..., -1] ** 2) + np.sum(moved.common_rows[:, -1] ** 2)
    assert 0.5 * squares == pytest.approx(dense.halves(step), rel=1e-9)
    close(moved.information(), C.information())

    # The private unknowns follow, so that only the step of the common ones counts.
    after = gradients_after(moved, 0.0 * step.common)
    close(after, gradients_after(C, step.common), rtol=1e-6)


def test_without_some_blocks_and_segments_the_rows_of_the_others_count() -> None:
    dense = problem(5)
    left_out = np.zeros(len(dense.blocks), dtype=bool)
    left_out[[1, 3]] = True
    step = replace(dense, condensed=dense.condensed.without_blocks(left_out)).step()

    # Two common rows, the rows of the blocks, and the private rows.
    sizes = [len(block) for block in dense.blocks]
    of_blocks = np.repeat(~left_out, sizes)
    kept = np.concatenate([[True] * 2, of_blocks, [True] * 4])
    exact = lstsq(dense.J[kept], -dense.r[kept])[0]
    assert_allclose(step.common, exact[-3:], rtol=1e-7)

    part = dense.condensed.of_segments(np.array([2, 0]))
    assert part.segment_count == 2
    of_third = np.abs(dense.condensed.triangles[2])
    assert_allclose(np.abs(part.triangles[0]), of_third, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_true_deviation_is_that_of_autocorrelated_residuals(correlation: float) -> None:
    """Residuals of a first-order autoregressive process, and two smooth regressors."""
    count, rows = 400, 20
    white = np.random.default_rng(1).standard_normal(count * rows)
    e = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white)
    J = np.column_stack([np.ones(len(e)), np.linspace(0.0, 1.0, len(e))])
    r = e - J @ lstsq(J, e)[0]
    blocks = np.column_stack([J, r]).reshape(count, rows, 3)

    # The variance of a mean is (1 + rho) / (1 - rho) times that of white noise.
    expected = np.sqrt((1.0 + correlation) / (1.0 - correlation))
    found = alone(np.stack([condense(block) for block in blocks])).true_deviation
    assert found == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("columns", [3, 40, 200])
def test_a_tall_triangle_has_the_inner_products_of_its_rows(columns: int) -> None:
    """Also with more columns than a batch of the first pass has rows."""
    rows = np.random.default_rng(0).standard_normal((2500, columns))
    R = triangle(rows)
    assert R.shape == (columns, columns)
    assert_allclose(R.T @ R, rows.T @ rows, atol=1e-9 * len(rows))
