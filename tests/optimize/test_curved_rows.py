"""Steps over curved priors against a general minimiser and against linear steps."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.testing import assert_allclose

from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import step_over_curved_rows
from tests.support.numerics import Array

COUNT = 3


def test_over_a_barrier_it_is_the_minimum_inside() -> None:
    pull = np.array([60.0, 0.0, 0.0, 120.0])

    def curved(step: Array) -> Array | None:
        """Logarithms of the distances from the region's end, where each step is -1."""
        if (step <= -1.0).any():
            return None
        barrier = np.column_stack([np.diag(1.0 / (1.0 + step)), np.log(1.0 + step)])
        straight = np.append(pull[:-1], pull[:-1] @ step + pull[-1])
        return np.concatenate([barrier, straight[None]])

    zero, infinite = np.zeros(COUNT), np.full(COUNT, np.inf)
    # Random rows of two segments with two private unknowns each.
    m = 2 + COUNT + 1
    condensed = Condensed(
        blocks=np.linalg.qr(np.random.default_rng(1).normal(size=(2, 9, m)), mode="r"),
        segment_of_block=np.arange(2),
        private_rows=np.zeros((2, 0, m)),
        common_rows=curved(zero),
    )
    scale, data = condensed.column_norms, condensed.reduced_rows()
    found = step_over_curved_rows(condensed, curved, 0.0, scale, -infinite, infinite)

    def cost(step: Array) -> float:
        rows = curved(step)
        if rows is None:
            return np.inf
        residual = data[:, :-1] @ step + data[:, -1]
        return 0.5 * (residual @ residual + rows[:, -1] @ rows[:, -1])

    sharp = {"xatol": 1e-9, "fatol": 1e-12}
    best = scipy.optimize.minimize(cost, zero, method="Nelder-Mead", options=sharp)
    assert -1.0 < found.common[0] < -0.99
    assert cost(found.common) <= best.fun * (1.0 + 1e-5)
    of_private = condensed.step_to(zero, 0.0, scale).predicted_decrease
    decrease = cost(zero) - cost(found.common) + of_private
    assert np.isclose(found.predicted_decrease, decrease, rtol=1e-6)

    # The linear step leaves the region.
    assert condensed.step(0.0, scale, -infinite, infinite).common[0] < -1.0

    # Over straight rows it is the linear step, also within bounds.
    rows, bound = condensed.common_rows, np.full(COUNT, 0.2)

    def straight(step: Array) -> Array:
        return np.column_stack([rows[:, :-1], rows[:, :-1] @ step + rows[:, -1]])

    linear = condensed.step(1e-3, scale, -bound, bound)
    found = step_over_curved_rows(condensed, straight, 1e-3, scale, -bound, bound)
    for name in ("common", "private", "predicted_decrease"):
        assert_allclose(getattr(found, name), getattr(linear, name), atol=1e-10)
