"""Bases of signals: splines of a bandwidth, and Fourier series from rest to rest."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from mjfim.experiment.initial import fourier_basis, independent_curves, spline_basis

# Duration [s].
HORIZON = 2.0

# Bandwidth of the splines [Hz].
BANDWIDTH = 4.0

# Number of pieces of the splines, 2 * BANDWIDTH * HORIZON.
PIECES = 16

# Times of the samples [s].
T = np.arange(2000) * (HORIZON / 2000)

# Whether splines begin at rest, end at rest, are periodic; and their number.
CASES = {
    "free": (False, False, False, PIECES + 3),
    "begins": (True, False, False, PIECES + 1),
    "ends": (False, True, False, PIECES + 1),
    "rest to rest": (True, True, False, PIECES - 1),
    "periodic": (False, False, True, PIECES),
}


@pytest.mark.parametrize("name", CASES)
def test_a_spline_basis_spans_all_splines_of_its_knots_and_ends(name: str) -> None:
    """It has the rank of random cubic splines with these knots and ends, and contains them."""
    begins, ends, periodic, count = CASES[name]
    basis = spline_basis(T, HORIZON, BANDWIDTH, begins, ends, periodic)
    assert basis.shape == (len(T), count)

    # Their values and slopes are zero at an end at rest.
    values, slopes = np.random.default_rng(1).normal(size=(2, PIECES + 1, 40))
    for at, rest in ((0, begins), (-1, ends)):
        values[at] *= not rest
        slopes[at] *= not rest
    if periodic:
        values[-1] = values[0]
    knots = np.linspace(0.0, HORIZON, PIECES + 1)
    kind = "periodic" if periodic else ((1, slopes[0]), (1, slopes[-1]))
    curves = CubicSpline(knots, values, bc_type=kind)(T)
    assert np.linalg.matrix_rank(basis) == np.linalg.matrix_rank(curves) == count
    assert left_out(curves, basis) < 1e-10


def left_out(curves: np.ndarray, basis: np.ndarray) -> float:
    """Share of curves that a basis does not contain."""
    rest = curves - basis @ np.linalg.lstsq(basis, curves)[0]
    return float(np.linalg.norm(rest, 2) / np.linalg.norm(curves, 2))


def test_a_bandwidth_below_that_of_the_horizon_leaves_a_few_splines() -> None:
    assert spline_basis(T, HORIZON, 0.01, True, True, False).shape[1] == 3
    assert spline_basis(T, HORIZON, 0.01, False, False, True).shape[1] == 4


# Number of harmonics of the Fourier series.
HARMONICS = 5


@pytest.mark.parametrize(
    ("begins", "ends"), [(False, False), (True, False), (False, True), (True, True)]
)
@pytest.mark.parametrize("frequency", [0.5, 0.37], ids=["period divides", "period does not divide"])
def test_a_fourier_series_at_rest_differs_by_a_polynomial_of_lowest_degree(
    begins: bool, ends: bool, frequency: float
) -> None:
    """Value and two derivatives are zero at ends at rest and only there."""
    t = np.linspace(0.0, HORIZON, 20001)
    basis = fourier_basis(t, HORIZON, frequency, HARMONICS, begins, ends)

    # One sample from an end at rest, a curve has only the third power of a small angle.
    for rows, rest in ((basis[:2], begins), (basis[-2:], ends)):
        size = np.abs(rows).max()
        assert size < 1e-7 if rest else size > 0.1

    angle = 2 * np.pi * frequency * np.outer(t, np.arange(1, HARMONICS + 1))
    change = basis - np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    powers = (t[:, None] / HORIZON) ** np.arange(3 * (begins + ends))
    left = change - powers @ np.linalg.lstsq(powers, change)[0] if begins or ends else change
    assert np.abs(left).max() < 1e-9


@pytest.mark.parametrize(("begins", "ends"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("frequency", [0.65, 1.0], ids=["period does not divide", "period divides"])
def test_a_fourier_series_keeps_as_many_dimensions_as_it_has_waves(
    frequency: float, begins: bool, ends: bool
) -> None:
    basis = fourier_basis(T, HORIZON, frequency, HARMONICS, begins, ends)
    values = np.linalg.svd(basis, compute_uv=False)
    assert len(values) == 2 * HARMONICS
    assert values[-1] > 1e-4 * values[0]
    assert independent_curves(basis) is basis


@pytest.mark.parametrize("name", ["slow waves", "splines finer than samples"])
def test_nearly_dependent_curves_are_replaced_by_fewer_independent_ones(name: str) -> None:
    """The curves span all but negligible combinations, and no metric on them is singular."""
    curves = fourier_basis(T, HORIZON, 0.35, 15, True, True)
    if name != "slow waves":
        curves = spline_basis(T[::50], HORIZON, 15.0, False, False, False)
    N, M = curves.shape
    fewer = independent_curves(curves)
    assert 0.3 * M < fewer.shape[1] < M and fewer.shape[1] <= N
    assert np.linalg.cond(fewer) < 1.0 + 1e-9
    assert np.linalg.norm(fewer[:, 0]) == pytest.approx(np.sqrt(0.5 * N))
    assert left_out(curves, fewer) < 1e-4
    assert np.linalg.cond(curves.T @ curves) > 1e14
