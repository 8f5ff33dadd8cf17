"""Tests of whiteness against theory: the statistic and its times."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from mjfim.identification.assessment import residual_tests
from mjfim.identification.assessment.residual_tests import LAGS, whiteness_of
from mjfim.records.estimate import Whiteness
from tests.support.numerics import Array


def autoregressive(phi: float, count: int, rng: np.random.Generator) -> Array:
    """AR(1) noise of unit variance, from its stationary distribution."""
    e = rng.standard_normal(count) * np.sqrt(1.0 - phi**2)
    e[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -phi], e)


def seen(seed: int, count: int, phi: float = 0.0) -> Whiteness:
    """Test of one series of noise."""
    return whiteness_of("y", [autoregressive(phi, count, np.random.default_rng(seed))])


def test_borders_of_recordings_are_not_crossed() -> None:
    """Only products of two measured values of one recording count."""
    a, b = np.array([1.0, 2.0, -1.0, 0.5] * 5), np.array([3.0, -2.0, 1.0, 4.0] * 5)
    rho = (np.sum(a[1:] * a[:-1]) + np.sum(b[1:] * b[:-1])) / (a @ a + b @ b)
    found = whiteness_of("y", [np.append(a, np.nan), b])
    assert found.count == 40
    assert found.correlation == pytest.approx(rho, rel=1e-10)


def test_the_statistic_is_that_of_ljung_and_box() -> None:
    """The statistic equals plain sums; p is its tail times the number of tests.

    A fast oscillation keeps means over runs small, and a slow drift makes them large.
    """
    rng = np.random.default_rng(0)
    for phi in (-0.1, 0.06):
        y, n = autoregressive(phi, 600, rng), 600
        rho = np.array([y[k:] @ y[: n - k] for k in range(LAGS + 1)]) / (y @ y)
        lags = np.arange(1, LAGS + 1)
        tails = [chi2.sf(n * (n + 2) * np.sum(rho[1:] ** 2 / (n - lags)), LAGS)]
        ratios = []
        for w in (4, 16, 64):
            means = y[: n // w * w].reshape(-1, w).mean(axis=1)
            ratios.append(w * np.mean(means**2) / np.mean(y**2))
            tails.append(chi2.sf(len(means) * ratios[-1], len(means)))
        found = whiteness_of("y", [y])
        assert found.p == pytest.approx(min(4 * min(tails), 1.0), rel=1e-8)
        assert found.correlation == pytest.approx(rho[1], rel=1e-10)
        assert found.inflation == pytest.approx(max(1.0, *ratios), rel=1e-10)
        assert found.variance == pytest.approx(np.mean(y**2), rel=1e-10)
        # Alternating noise has no memory.
        assert phi > 0.0 or found.time == 1.0


@pytest.mark.parametrize(
    ("phi", "time"), [(0.3, 1.857), (0.7, 5.667), (0.9, 19.0), (0.97, 65.67), (0.0, 1.0)]
)
def test_the_integrated_time_is_that_of_theory(phi: float, time: float) -> None:
    """The mean over draws is (1 + phi) / (1 - phi)."""
    times = [seen(seed, phi=phi, count=30_000).time for seed in range(12)]
    assert np.mean(times) == pytest.approx(time, rel=0.12 if phi else 0.02)


@pytest.mark.parametrize(
    "parts",
    [[], [np.zeros(0)], [np.full(9, np.nan)], [np.ones(5)], [np.zeros(100)], [np.ones(1)] * 50],
)
def test_too_few_residuals_pass(parts: list[Array]) -> None:
    """There are no values, few values, or only zeros."""
    found = whiteness_of("y", parts)
    assert (found.p, found.inflation, found.time) == (1.0, 1.0, 1.0)


def test_lagged_products_do_not_depend_on_the_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few lags are computed first, part by part; slow residuals need more of them."""
    cases = [{"phi": 0.98, "count": 3000}, {"count": 3000}]
    whole = [seen(3, **case) for case in cases]
    monkeypatch.setattr(residual_tests, "FIRST_LAGS", 5)
    monkeypatch.setattr(residual_tests, "VALUES_AT_ONCE", 100)
    for expected, case in zip(whole, cases, strict=True):
        found = seen(3, **case)
        assert (found.time, found.correlation) == pytest.approx(
            (expected.time, expected.correlation), rel=1e-9
        )
        assert found.p == pytest.approx(expected.p, rel=1e-6)
