"""Optimality criteria against their definitions, their derivatives against differences, and where
eigenvalues meet.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.information.criteria import (
    CRITERIA,
    Criterion,
    c_optimality,
    e_optimality,
    smooth_e_optimality,
)
from tests.support.numerics import Array, richardson

CONTRAST = np.array([[1.0, 0.0], [-2.0, 0.0], [0.5, 1.0], [0.0, 3.0]])
ALL = {
    **CRITERIA,
    "smooth E 1": lambda info: smooth_e_optimality(info, 1.0),
    "smooth E 2.5": lambda info: smooth_e_optimality(info, 2.5),
    "smooth E 40": lambda info: smooth_e_optimality(info, 40.0),
    "smooth E 160": lambda info: smooth_e_optimality(info, 160.0),
    "c": lambda info: c_optimality(info, CONTRAST),
}


def rotation(rng: np.random.Generator, p: int = 4) -> Array:
    """Random orthogonal matrix."""
    return np.linalg.qr(rng.normal(size=(p, p)))[0]


def matrix(values: Array, seed: int = 0) -> Array:
    """Symmetric matrix with these eigenvalues and random eigenvectors."""
    Q = rotation(np.random.default_rng(seed), len(values))
    return Q @ np.diag(values) @ Q.T


def symmetric(rng: np.random.Generator, p: int = 4) -> Array:
    """Random direction of unit norm in the symmetric matrices."""
    d = rng.normal(size=(p, p))
    return (d + d.T) / np.linalg.norm(d + d.T)


def derivative(found: Criterion) -> Array:
    """M = sum_r m_r w_r w_r'."""
    return np.einsum("r,ri,rj->ij", found.weights, found.directions, found.directions)


SPECTRA = {
    "spread": np.array([0.5, 1.0, 4.0, 30.0]),
    "close": np.array([1.0, 1.01, 1.02, 5.0]),
    "four decades": np.array([0.01, 0.3, 7.0, 100.0]),
}


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("name", ALL)
def test_the_derivative_is_that_of_differences(name: str, spectrum: str) -> None:
    rng, info = np.random.default_rng(1), matrix(SPECTRA[spectrum])
    M = derivative(ALL[name](info))
    size = np.abs(M).max()
    for _ in range(6):
        d = symmetric(rng)
        h = 1e-3 * min(np.linalg.eigvalsh(info)[0], np.diff(np.linalg.eigvalsh(info)).min())
        measured = richardson(lambda t, d=d: ALL[name](info + t * d).value, h)
        assert np.sum(M * d) == pytest.approx(measured, rel=1e-6, abs=1e-6 * size)
        assert abs(np.sum(1.001 * M * d) - measured) > 1e-4 * abs(measured)


@pytest.mark.parametrize("name", ALL)
def test_more_information_never_raises_the_criterion(name: str) -> None:
    rng, info = np.random.default_rng(2), matrix(SPECTRA["spread"])
    found = ALL[name](info)
    assert (found.weights < 0.0).all()
    for _ in range(20):
        g = rng.normal(size=4)
        assert ALL[name](info + np.outer(g, g)).value < found.value


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("least", [0.0, 1e-16, -1e-9, -1.0])
def test_singular_information_has_an_infinite_criterion_without_a_warning(
    name: str, least: float
) -> None:
    found = ALL[name](matrix(np.array([least, 1.0, 2.0, 3.0])))
    assert found.value == np.inf
    assert np.isfinite(found.directions).all()
    assert ALL[name](np.zeros((4, 4))).value == np.inf


@pytest.mark.parametrize("name", sorted(set(ALL) - {"c"}))
def test_the_criterion_of_one_parameter_is_its_variance_or_the_logarithm(name: str) -> None:
    found = ALL[name](np.array([[4.0]]))
    assert found.value == pytest.approx(-np.log(4.0) if name == "D" else 0.25, rel=1e-12)


def test_the_smooth_criterion_is_above_the_exact_one_and_converges_to_it() -> None:
    for values in (SPECTRA["spread"], SPECTRA["close"], np.ones(4)):
        info = matrix(values)
        exact = e_optimality(info).value
        ratios = [smooth_e_optimality(info, q).value / exact for q in (1.0, 4.0, 40.0, 160.0, 1e4)]
        assert (np.array(ratios) >= 1.0 - 1e-12).all()
        assert (np.diff(ratios) < 1e-12).all()
        assert all(
            r <= 4.0 ** (1.0 / q) * (1.0 + 1e-12)
            for r, q in zip(ratios, (1.0, 4.0, 40.0, 160.0, 1e4), strict=True)
        )
        assert ratios[-1] < 1.0 + 2e-4
    # the bound p^(1/q) is reached where all eigenvalues are one
    assert smooth_e_optimality(np.eye(4), 40.0).value == pytest.approx(
        4.0 ** (1.0 / 40.0), rel=1e-12
    )


def test_smooth_E_to_the_power_one_is_A() -> None:
    info = matrix(SPECTRA["spread"])
    assert smooth_e_optimality(info, 1.0).value == pytest.approx(
        CRITERIA["A"](info).value, rel=1e-12
    )
    assert_allclose(
        derivative(smooth_e_optimality(info, 1.0)), derivative(CRITERIA["A"](info)), rtol=1e-9
    )


def test_powers_do_not_overflow_on_tiny_or_huge_information() -> None:
    for factor in (1e-100, 1e100):
        found = smooth_e_optimality(factor * matrix(SPECTRA["spread"]), 160.0)
        assert found.value == pytest.approx(
            smooth_e_optimality(matrix(SPECTRA["spread"]), 160.0).value / factor, rel=1e-9
        )


def one_sided(phi: Callable[[Array], Criterion], info: Array, d: Array) -> tuple[float, float]:
    """Slopes of t -> phi(I + t d) at 0 from the right and from the left."""
    h = 1e-6
    here = phi(info).value
    return (phi(info + h * d).value - here) / h, (here - phi(info - h * d).value) / h


def test_where_two_eigenvalues_coincide_only_the_smooth_criterion_is_differentiable() -> None:
    info = matrix(np.array([1.0, 1.0, 3.0, 8.0]))
    rng, kinks = np.random.default_rng(3), []
    for _ in range(6):
        d = symmetric(rng)
        right, left = one_sided(e_optimality, info, d)
        kinks.append(abs(right - left))
        for power in (2.0, 40.0):
            right, left = one_sided(lambda info, q=power: smooth_e_optimality(info, q), info, d)
            assert right == pytest.approx(left, abs=1e-3)
            M = derivative(smooth_e_optimality(info, power))
            measured = richardson(
                lambda t, d=d, q=power: smooth_e_optimality(info + t * d, q).value, 1e-4
            )
            assert np.sum(M * d) == pytest.approx(measured, abs=1e-8)
    assert min(kinks) > 0.05


def test_the_smooth_derivative_does_not_depend_on_the_basis_of_a_repeated_eigenvalue() -> None:
    Q = rotation(np.random.default_rng(5))
    turned = Q @ np.diag([1.0, 1.0, 1.0, 5.0]) @ Q.T
    M = Q.T @ derivative(smooth_e_optimality(turned, 40.0)) @ Q
    assert_allclose(M[:3, :3], M[0, 0] * np.eye(3), atol=1e-9)
    assert np.abs(M[3]).max() < 1e-9


def test_directions_without_weight_are_left_out() -> None:
    assert len(smooth_e_optimality(np.diag([1.0, 1.001, 1e3, 1e4]), 40.0).weights) == 2
    assert len(CRITERIA["A"](np.diag([1.0, 2.0, 1e3, 1e6])).weights) == 3
    assert len(e_optimality(np.diag([1.0, 1.0, 1.0, 1.0])).weights) == 1


def test_c_is_the_summed_variance_of_the_combinations() -> None:
    info = matrix(SPECTRA["spread"])
    exact = sum(c @ np.linalg.inv(info) @ c for c in CONTRAST.T)
    assert c_optimality(info, CONTRAST).value == pytest.approx(exact, rel=1e-12)


def test_c_of_all_parameters_is_A_and_of_one_its_variance() -> None:
    info = matrix(SPECTRA["spread"])
    assert c_optimality(info, np.eye(4)).value == pytest.approx(
        CRITERIA["A"](info).value, rel=1e-12
    )
    assert_allclose(
        derivative(c_optimality(info, np.eye(4))), derivative(CRITERIA["A"](info)), rtol=1e-9
    )
    assert c_optimality(info, np.eye(4)[:, 2:3]).value == pytest.approx(
        np.linalg.inv(info)[2, 2], rel=1e-12
    )


def test_c_does_not_see_what_is_independent_of_the_combination() -> None:
    contrast = np.array([[1.0], [1.0], [0.0], [0.0]])
    info = np.diag([1.0, 2.0, 3.0, 4.0])
    found = c_optimality(info, contrast)
    assert c_optimality(info + np.diag([0.0, 0.0, 9.0, 9.0]), contrast).value == pytest.approx(
        found.value
    )
    assert_array_equal(derivative(found)[2:], 0.0)
