"""Regression splines: they follow the motion and not the noise, whatever is measured when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.identification.inverse_dynamics.motion import Readings, RegressionSpline, fit_spline
from tests.support.numerics import Array

GRID = np.arange(2000) / 200.0


SECONDS = 10.0


def curve(t: Array, derivative: int = 0) -> Array:
    """A sum of two sines, or its derivative."""
    total = np.zeros(len(t))
    for amplitude, frequency, phase in ((1.0, 0.4, 0.3), (0.3, 1.7, 1.0)):
        omega = 2 * np.pi * frequency
        total += amplitude * omega**derivative * np.sin(omega * t + phase + derivative * np.pi / 2)
    return total


def readings(t: Array, sigma: float, derivative: int = 0, seed: int = 0) -> Readings:
    """Noisy readings of the curve or of its slope."""
    noise = np.random.default_rng(seed).standard_normal(len(t))
    values = curve(t, derivative) + sigma * noise
    return Readings(t=t, values=values, sigma=sigma or 1.0, derivative=derivative)


def inner_error(spline: RegressionSpline, derivative: int) -> float:
    """Root mean square error of a derivative away from the ends."""
    t = np.linspace(0.5, SECONDS - 0.5, 500)
    error = spline.at(t, derivative) - curve(t, derivative)
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("sigma", [1e-4, 1e-2])
def test_noise_is_averaged_and_its_size_found(sigma: float, derivative: int) -> None:
    inner = np.linspace(0.5, SECONDS - 0.5, 300)
    squares, splines = [], []
    for seed in range(8):
        noisy = fit_spline([readings(GRID, sigma, seed=seed)])
        exact = fit_spline([readings(GRID, 0.0)], spacing=noisy.spacing)
        squares.append(np.mean((noisy.at(inner, derivative) - exact.at(inner, derivative)) ** 2))
        splines.append(noisy)
    assert inner_error(splines[0], 0) < 0.5 * sigma
    assert np.mean([spline.variance for spline in splines]) == pytest.approx(1.0, abs=0.1)

    # The predicted noise of a derivative is that of the fits.
    predicted = np.mean([spline.sigma(derivative) for spline in splines])
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted, rel=0.35)


def test_irregular_times_gaps_and_outliers() -> None:
    t = np.sort(np.random.default_rng(4).uniform(0.0, SECONDS, 1500))
    t = t[(t < 3.0) | (t > 3.4)]
    given = readings(t, 1e-3)
    outliers = 5.0 * (np.arange(len(t)) % 200 == 0)
    spline = fit_spline([replace(given, values=given.values + outliers)])
    inner = np.concatenate([np.linspace(0.5, 2.5, 100), np.linspace(4.0, 9.5, 100)])
    assert np.abs(spline.at(inner) - curve(inner)).max() < 3e-3
    assert np.isfinite(spline.at(np.linspace(3.0, 3.4, 50))).all()
