"""Pseudo-inertias, their coordinates, and the distance of two of them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose

from mjfim.model.inertia import (
    BARYCENTRIC_DERIVATIVES,
    inertia_difference,
    is_positive_definite,
    logcholesky_derivatives,
    logcholesky_factor,
)
from tests.support.numerics import Array


def coordinates(seed: int, spread: float = 0.4) -> Array:
    """(10,) log-Cholesky coordinates of a body."""
    return spread * np.random.default_rng(seed).standard_normal(10)


def pseudo_inertia(values: Array) -> Array:
    """(4, 4) pseudo-inertia of (10,) log-Cholesky coordinates."""
    factor = logcholesky_factor(values)
    return factor @ factor.T


def test_derivatives_are_those_of_differences() -> None:
    values, reference, step = coordinates(2), coordinates(3), 1e-6
    derivatives = logcholesky_derivatives(values)
    difference = inertia_difference(pseudo_inertia(values), derivatives, reference)
    for i in range(10):
        ends = [values + sign * step * np.eye(10)[i] for sign in (1, -1)]
        matrices = [pseudo_inertia(end) for end in ends]
        slope = (matrices[0] - matrices[1]) / (2 * step)
        assert_allclose(derivatives[i], slope, atol=1e-8)

        residuals = [inertia_difference(matrix, derivatives, reference)[0] for matrix in matrices]
        slope = (residuals[0] - residuals[1]) / (2 * step)
        assert_allclose(difference[1][:, i], slope, atol=1e-7)


def test_derivative_where_eigenvalues_meet() -> None:
    reference = coordinates(4)
    found = inertia_difference(
        pseudo_inertia(reference), logcholesky_derivatives(reference), reference
    )
    assert_allclose(found[0], 0.0, atol=1e-12)
    step = 1e-5
    for i in range(10):
        moved = pseudo_inertia(reference + step * np.eye(10)[i])
        residual = inertia_difference(moved, BARYCENTRIC_DERIVATIVES, reference)[0]
        assert_allclose(found[1][:, i], residual / step, atol=1e-3)


def test_distance_is_that_of_the_metric() -> None:
    values, reference = coordinates(5), coordinates(6)
    P, C = pseudo_inertia(values), pseudo_inertia(reference)
    ratio = scipy.linalg.eigh(P, C, eigvals_only=True)
    squares = float(np.sum(np.log(ratio) ** 2))
    found = inertia_difference(P, BARYCENTRIC_DERIVATIVES, reference)[0]
    assert found @ found == pytest.approx(squares, rel=1e-10)


def test_bodies_without_volume_are_not_positive_definite() -> None:
    P = pseudo_inertia(coordinates(8))
    assert is_positive_definite(P)
    assert is_positive_definite(1e-9 * P)
    assert not is_positive_definite(-P)
    assert not is_positive_definite(np.diag([1.0, 1.0, 0.0, 1.0]))
    assert not is_positive_definite(np.full((4, 4), np.nan))
