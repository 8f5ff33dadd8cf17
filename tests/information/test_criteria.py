"""Optimality criteria against their definitions, their derivatives against differences, and where
eigenvalues meet.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

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


def matrix(values: Array, seed: int = 0) -> Array:
    """Symmetric matrix with these eigenvalues and random eigenvectors."""
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))[0]
    return Q @ np.diag(values) @ Q.T


def symmetric(rng: np.random.Generator) -> Array:
    """Random direction of unit norm in the symmetric matrices."""
    d = rng.normal(size=(4, 4))
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
    values = np.linalg.eigvalsh(info)
    h = 1e-3 * min(values[0], np.diff(values).min())
    for d in (symmetric(rng) for _ in range(6)):
        measured = richardson(lambda t, d=d: ALL[name](info + t * d).value, h)
        assert np.sum(M * d) == pytest.approx(measured, rel=1e-6, abs=1e-6 * np.abs(M).max())


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("least", [0.0, 1e-16, -1e-9, -1.0])
def test_singular_information_has_an_infinite_criterion_without_a_warning(
    name: str, least: float
) -> None:
    found = ALL[name](matrix(np.array([least, 1.0, 2.0, 3.0])))
    assert found.value == np.inf
    assert np.isfinite(found.directions).all()
    assert ALL[name](np.zeros((4, 4))).value == np.inf


def test_the_smooth_criterion_is_above_the_exact_one_and_converges_to_it() -> None:
    powers = np.array([1.0, 4.0, 40.0, 160.0, 1e4])
    for values in (SPECTRA["spread"], SPECTRA["close"], np.ones(4)):
        info = matrix(values)
        exact = e_optimality(info).value
        ratios = np.array([smooth_e_optimality(info, q).value for q in powers]) / exact
        assert (ratios >= 1.0 - 1e-12).all()
        assert (np.diff(ratios) < 1e-12).all()
        assert (ratios <= 4.0 ** (1.0 / powers) * (1.0 + 1e-12)).all()
        assert ratios[-1] < 1.0 + 2e-4
        assert ratios[0] * exact == pytest.approx(CRITERIA["A"](info).value, rel=1e-12)
    # the bound p^(1/q) is reached where all eigenvalues are one
    assert_allclose(ratios, 4.0 ** (1.0 / powers), rtol=1e-12)


def test_powers_do_not_overflow_on_tiny_or_huge_information() -> None:
    info = matrix(SPECTRA["spread"])
    expected = smooth_e_optimality(info, 160.0).value
    for factor in (1e-100, 1e100):
        found = smooth_e_optimality(factor * info, 160.0).value
        assert factor * found == pytest.approx(expected, rel=1e-9)


def test_where_two_eigenvalues_coincide_only_the_smooth_criterion_is_differentiable() -> None:
    info = matrix(np.array([1.0, 1.0, 3.0, 8.0]))
    rng, h = np.random.default_rng(3), 1e-6
    for d in (symmetric(rng) for _ in range(6)):
        here, ahead, behind = (e_optimality(info + t * d).value for t in (0.0, h, -h))
        assert abs(ahead + behind - 2.0 * here) > 0.05 * h
        for power in (2.0, 40.0):
            M = derivative(smooth_e_optimality(info, power))
            measured = richardson(
                lambda t, d=d, q=power: smooth_e_optimality(info + t * d, q).value, 1e-4
            )
            assert np.sum(M * d) == pytest.approx(measured, abs=1e-8)


def test_c_is_the_summed_variance_of_the_combinations() -> None:
    info = matrix(SPECTRA["spread"])
    exact = np.trace(CONTRAST.T @ np.linalg.inv(info) @ CONTRAST)
    assert c_optimality(info, CONTRAST).value == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("name", sorted(set(ALL) - {"c"}))
def test_the_criterion_of_one_parameter_is_its_variance_or_the_logarithm(name: str) -> None:
    found = ALL[name](np.array([[4.0]]))
    assert found.value == pytest.approx(-np.log(4.0) if name == "D" else 0.25, rel=1e-12)
