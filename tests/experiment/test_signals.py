"""Bases and signals: splines of a bandwidth, Fourier series from rest to rest, multisines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from mjfim.experiment.initial import fourier_basis, independent_curves, multisine, spline_basis

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
    """The basis has full rank and contains cubic splines with these knots, no finer ones."""
    begins, ends, periodic, count = CASES[name]
    basis = spline_basis(T, HORIZON, BANDWIDTH, begins, ends, periodic)
    assert basis.shape == (len(T), count)
    assert np.linalg.matrix_rank(basis) == count

    def left_out(pieces: int) -> float:
        """Return the share of a random spline with some pieces that the basis does not contain."""
        knots = np.linspace(0.0, HORIZON, pieces + 1)
        values = np.random.default_rng(1).normal(size=pieces + 1)
        kinds = ["clamped" if begins else "natural", "clamped" if ends else "natural"]
        conditions = [(1, 0.0) if kind == "clamped" else (2, 0.0) for kind in kinds]

        if begins:
            values[0] = 0.0
        if ends:
            values[-1] = 0.0
        if periodic:
            values[-1] = values[0]

        curve = CubicSpline(knots, values, bc_type="periodic" if periodic else tuple(conditions))(T)
        rest = curve - basis @ np.linalg.lstsq(basis, curve)[0]
        return float(np.abs(rest).max() / np.abs(curve).max())

    assert left_out(PIECES) < 1e-10
    assert left_out(PIECES + 3) > 1e-2


def ends_of(basis: np.ndarray, t: np.ndarray, at: float) -> tuple[float, float]:
    """Return the largest value and slope of any column at a time, by cubics through samples."""
    order = np.argsort(np.abs(t - at))[:4]
    fits = np.polyfit(t[order] - at, basis[order], 3)
    return float(np.abs(fits[3]).max()), float(np.abs(fits[2]).max())


@pytest.mark.parametrize("name", CASES)
def test_value_and_slope_are_zero_at_ends_at_rest_and_only_there(name: str) -> None:
    begins, ends, periodic, _ = CASES[name]
    fine = np.linspace(0.0, HORIZON, 4001)[:-1]
    basis = spline_basis(fine, HORIZON, BANDWIDTH, begins, ends, periodic)
    for at, rest in ((0.0, begins), (HORIZON, ends)):
        value, slope = ends_of(basis, fine, at)
        assert (value < 1e-9) is rest
        assert (slope < 1e-6) is rest


def test_a_periodic_basis_continues_with_two_derivatives() -> None:
    """Shifted by a knot the basis is unchanged; its third derivative is the first that jumps."""
    fine = np.linspace(0.0, HORIZON, 3201)[:-1]
    basis = spline_basis(fine, HORIZON, BANDWIDTH, False, False, True)
    turned = np.roll(basis, len(fine) // PIECES, axis=0)
    np.testing.assert_allclose(turned, np.roll(basis, -1, axis=1), rtol=0, atol=1e-12)
    assert np.abs(basis[0] - basis[-1]).max() < 0.02 * np.abs(basis).max()

    # The largest change of each derivative from sample to sample, relative to the derivative.
    jumps = []
    for order in (1, 2, 3):
        around = np.diff(np.concatenate([basis, basis[: order + 1]]), order, axis=0)
        jumps.append(np.abs(np.diff(around, axis=0)).max() / np.abs(around).max())
    assert jumps[0] < 0.02 and jumps[1] < 0.02 and jumps[2] > 0.5


def test_the_spectrum_of_splines_lies_below_the_bandwidth() -> None:
    """Random periodic splines, whose spectrum is not broadened by a window."""
    basis = spline_basis(T, HORIZON, BANDWIDTH, False, False, True)
    curves = basis @ np.random.default_rng(3).normal(size=(basis.shape[1], 20))
    power = np.abs(np.fft.rfft(curves, axis=0)) ** 2
    f = np.fft.rfftfreq(len(T), T[1])
    above = power[f > 2.0 * BANDWIDTH].sum(axis=0) / power.sum(axis=0)
    assert above.max() < 1e-2
    assert (power[f > 1.2 * BANDWIDTH].sum(axis=0) / power.sum(axis=0)).max() < 0.1
    assert (power[f <= BANDWIDTH].sum(axis=0) / power.sum(axis=0)).min() > 0.8
    narrow = spline_basis(T, HORIZON, BANDWIDTH / 4.0, False, False, True)
    wave = np.sin(2 * np.pi * BANDWIDTH * T)
    # A narrow basis does not follow a wave that is too fast.
    assert np.abs(narrow @ np.linalg.lstsq(narrow, wave)[0]).max() < 0.1


def test_a_bandwidth_below_that_of_the_horizon_leaves_a_few_splines() -> None:
    assert spline_basis(T, HORIZON, 0.01, True, True, False).shape[1] == 3
    assert spline_basis(T, HORIZON, 0.01, False, False, True).shape[1] == 4


# Number of harmonics of the Fourier series.
HARMONICS = 5


def waves(t: np.ndarray, frequency: float) -> np.ndarray:
    """Return sines and cosines without corrections: (N, 2 * HARMONICS)."""
    angle = 2 * np.pi * frequency * np.outer(t, np.arange(1, HARMONICS + 1))
    return np.concatenate([np.sin(angle), np.cos(angle)], axis=1)


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
    assert basis.shape == (len(t), 2 * HARMONICS)

    # Polynomials through the samples near the ends give the derivatives.
    for rows, rest in ((slice(None, 6), begins), (slice(None, -7, -1), ends)):
        fits = np.polyfit((t[rows] - t[rows][0]) / t[1], basis[rows], 5)[::-1]
        unit = float(2 * np.pi * frequency * HARMONICS * t[1])
        sizes = [float(np.abs(fit).max()) / unit**k for k, fit in enumerate(fits[:3])]
        assert (max(sizes) < 1e-6) is rest
        assert rest or sizes[0] > 0.1

    degree = 3 * (begins + ends)
    rest = basis - waves(t, frequency)
    powers = (t[:, None] / HORIZON) ** np.arange(degree) if degree else np.zeros((len(t), 1))
    left = rest - powers @ np.linalg.lstsq(powers, rest)[0]
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
    left = curves - fewer @ np.linalg.lstsq(fewer, curves)[0]
    assert np.linalg.norm(left, 2) < 1e-4 * np.linalg.norm(curves, 2)
    assert np.linalg.cond(curves.T @ curves) > 1e14


def test_multisine_leaves_the_global_generator_alone() -> None:
    """The generator of random numbers is an argument."""
    state = np.random.get_state()[1].tolist()  # noqa: NPY002 - the legacy state is what must not move
    wave = multisine(np.arange(400) * 0.01, 2, 0.5, 5, np.random.default_rng(0))
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002
    assert np.abs(wave).max(axis=0) == pytest.approx([1.0, 1.0])
