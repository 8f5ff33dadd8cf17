"""Products with the inverse Hessian of L-BFGS, compared with dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.optimize.directions import convex_pairs, inverse_hessian_product
from tests.support.lq import positive

SHAPE = (3, 2)


def updated(H: np.ndarray, s: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The dense inverse Hessian after a BFGS update."""
    rho = 1.0 / (s @ y)
    left = np.eye(len(s)) - rho * np.outer(s, y)
    return np.asarray(left @ H @ left.T + rho * np.outer(s, s))


@pytest.mark.parametrize("count", [0, 1, 4])
def test_the_product_is_that_with_the_dense_bfgs_matrix(count: int) -> None:
    """Products with many vectors at once are those with each of them."""
    rng = np.random.default_rng(count)
    curvature, start = positive(rng, 6), positive(rng, 6)
    s = rng.normal(size=(count, *SHAPE))
    y = (s.reshape(count, 6) @ curvature).reshape(s.shape)
    pairs = convex_pairs(s, y, 1e-10) if count else []
    assert len(pairs) == count

    H = start
    for step, change, _ in pairs:
        H = updated(H, step.reshape(-1), change.reshape(-1))

    many = rng.normal(size=(5, *SHAPE))
    expected = (many.reshape(5, -1) @ H).reshape(many.shape)
    for g, product in ((many, expected), (many[0], expected[0])):
        found = inverse_hessian_product(
            g, pairs, lambda rows: (rows.reshape(-1, 6) @ start).reshape(rows.shape)
        )
        assert_allclose(found, product, rtol=1e-9)


def test_only_pairs_of_clearly_positive_curvature_are_kept() -> None:
    s = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 2.0]])
    y = np.array([[3.0, 1.0], [-1.0, 5.0], [1.0, 1.0], [1.0, 1e-9]])
    kept = convex_pairs(s, y, 1e-8)
    assert [curvature for _, _, curvature in kept] == [3.0]
    assert_array_equal(kept[0][1], y[0])

    for step, change in zip(s, y, strict=True):
        alone = convex_pairs(step[None], change[None], 1e-8)
        assert len(alone) == (float(step @ change) > 1.0)
