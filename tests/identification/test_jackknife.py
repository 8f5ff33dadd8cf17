"""The jackknife gives the standard error of a mean, and no scatter from a single part."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.assessment.honest_covariance import jackknife_deviations
from mjfim.identification.assessment.robust_covariance import t_quantile
from mjfim.identification.left_out import HeldOutLosses


def standard_errors(without: Array) -> Array:
    """Standard errors of estimates without each part."""
    one = np.ones(1)
    return HeldOutLosses(
        losses=one, counts=one, parts=np.zeros(1, int), estimates=without
    ).jackknife


def test_the_deviations_and_the_standard_error_of_means() -> None:
    data = np.random.default_rng(3).normal([3.0, -1.0], [2.0, 0.1], (7, 2))
    without = np.array([np.delete(data, i, axis=0).mean(axis=0) for i in range(7)])
    np.testing.assert_allclose(standard_errors(without), data.std(axis=0, ddof=1) / np.sqrt(7.0))

    deviations = jackknife_deviations(without)
    expected = np.cov(data, rowvar=False) / 7.0
    np.testing.assert_allclose(deviations.T @ deviations, expected)


def test_a_single_part_has_no_scatter() -> None:
    assert not jackknife_deviations(np.ones((1, 3))).any()
    assert np.isnan(standard_errors(np.ones((1, 3)))).all()


def test_the_quantile_is_that_of_student() -> None:
    """Of 2 parts, 12.706 standard errors are 95 %; of many, 1.96."""
    np.testing.assert_allclose(t_quantile(1, 0.95), 12.706, rtol=1e-4)
    np.testing.assert_allclose(t_quantile(10**7 - 1, 0.95), 1.959964, rtol=1e-5)
