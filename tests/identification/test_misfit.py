"""Largest residuals and reasons for a misfit: planted faults are found, noise gives none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.assessment.residual_tests import (
    autocorrelated,
    is_larger_than_noise,
    is_smaller_than_noise,
    largest_interval,
    misfit_reasons,
    worst_residual,
)
from mjfim.output.pages.estimate import estimate_page
from mjfim.records.base import Level
from mjfim.records.estimate import Whiteness, WorstResidual
from tests.support.cart_pendulum import cart_pendulum
from tests.support.numerics import Array
from tests.support.terms import recorded

NAMES = ("angle", "speed", "force")


def worst_of(times: list[Array], z: list[Array]) -> WorstResidual | None:
    """The interval with the largest residuals, found output by output as a fit does."""
    return worst_residual(
        largest_interval(output, name, t, part[:, j])
        for j, output in enumerate(NAMES)
        for name, t, part in zip("abc", times, z, strict=False)
    )


def white(seed: int = 0) -> tuple[list[Array], list[Array]]:
    """Times and whitened residuals of three recordings of different length and rate."""
    rng = np.random.default_rng(seed)
    times = [np.arange(1000) * 0.01, np.sort(rng.uniform(0.0, 4.0, 600)), np.arange(250) * 0.02]
    return times, [rng.standard_normal((len(t), 3)) for t in times]


@pytest.mark.parametrize(("recording", "output"), [(0, 2), (1, 0), (2, 1)])
def test_a_planted_burst_is_found(recording: int, output: int) -> None:
    """Output, recording and time agree within two windows; size and share are the interval's."""
    times, z = white()
    t, own = times[recording], z[recording][:, output]
    burst = np.array([0.55, 0.67]) * t[-1]
    own += 8.0 * np.sin(40.0 * t) * ((t >= burst[0]) & (t < burst[1]))
    worst = worst_of(times, z)
    assert (worst.output, worst.recording) == (NAMES[output], "abc"[recording])
    assert (worst.begin, worst.end) == pytest.approx(burst, abs=0.06 * t[-1])
    inside = own[(t >= worst.begin) & (t < worst.end)]
    assert worst.size == pytest.approx(np.sqrt(np.mean(inside**2)), rel=1e-9)
    share = np.sum(inside**2) / np.sum(np.concatenate(z) ** 2)
    assert worst.share == pytest.approx(share, rel=1e-9)
    assert f"{worst.size:.2g} σ, {100 * share:.0f} % of the sum of squares" in str(worst)


def test_an_output_with_uniformly_large_residuals_is_named_as_a_whole() -> None:
    """The interval is the whole recording, not the window in which noise is largest by chance."""
    times, z = white()
    z[1][:, 2] *= 3.0
    worst = worst_of(times, z)
    assert (worst.output, worst.recording, worst.begin) == ("force", "b", times[1][0])
    assert worst.end == pytest.approx(times[1][-1])
    assert worst.size == pytest.approx(3.0, rel=0.1)


def test_gaps_and_outputs_that_are_not_measured() -> None:
    """Missing values do not count; a burst next to a gap is found."""
    times, z = white()
    z[0][:, 1] = np.nan
    z[0][200:700, 0] = np.nan
    z[0][720:780, 0] += 7.0
    worst = worst_of(times, z)
    assert (worst.output, worst.recording) == ("angle", "a")
    assert worst.begin <= 7.2 + 0.4
    assert worst.end >= 7.8 - 0.4
    assert worst_of(times, [np.full(part.shape, np.nan) for part in z]) is None


def test_a_single_value_is_not_an_interval() -> None:
    """A burst of a hundred values is worse than a single value that is large by chance.

    The single value belongs to a rarely measured output.
    """
    for seed in range(20):
        times, z = white(seed)
        rows = np.arange(1000)
        is_measured = (rows < 100) | (rows < 300) & (rows % 40 == 0) | (rows == 700)
        z[0][~is_measured, 1] = np.nan
        z[0][700, 1] = 3.6
        z[0][500:600, 0] += 2.5
        assert worst_of(times, z).output == "angle"


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_short_recordings(count: int) -> None:
    """The interval is the whole recording."""
    worst = worst_of([np.arange(count) * 0.1 + 0.5], [np.tile([0.1, 2.0, 0.1], (count, 1))])
    assert (worst.output, worst.begin) == ("speed", 0.5)
    assert worst.size == pytest.approx(2.0)


def seen(output: str = "y", p: float = 1.0, inflation: float = 1.0, **fields: Any) -> Whiteness:
    """A test of whiteness, by default of white noise of the stated size."""
    white = {"count": 1000, "variance": 1.0, "correlation": 0.3, "time": 1.0, **fields}
    return Whiteness(output=output, p=p, inflation=inflation, **white)


def test_larger_and_smaller_need_probability_and_size() -> None:
    """The probability is below 0.1 %, and the ratio is relevant.

    With much data, a small probability alone is not enough.
    """
    for dof in (10, 300):
        for share in (0.99, 1.01):
            top, bottom = share * chi2.isf(1e-3, dof), share * chi2.ppf(1e-3, dof)
            assert is_larger_than_noise(top, dof) == (share > 1.0)
            assert is_smaller_than_noise(bottom, dof) == (share < 1.0)
    for ratio in (0.9, 0.98, 1.0, 1.02, 1.07):
        assert is_larger_than_noise(ratio * 1e5, 100_000) == (ratio == 1.07)
        assert is_smaller_than_noise(ratio * 1e5, 100_000) == (ratio == 0.9)


def test_autocorrelation_matters_where_it_is_large_enough() -> None:
    """It is significant for the number of outputs, and relevant against the noise.

    The strongest autocorrelation comes first.
    """
    several = [seen("a", 1e-9, 2.0), seen("b", 1e-9, 5.0), seen("c", 0.1, 9.0)]
    assert [each.output for each in autocorrelated(several)] == ["b", "a"]
    assert not autocorrelated([seen(p=1e-9, inflation=1.1)])
    assert not autocorrelated([seen(p=1e-9, inflation=5.0, variance=0.01)]), "far below the noise"
    assert autocorrelated([seen(p=1e-9, time=3.0)])
    assert autocorrelated([seen(p=5e-4, inflation=2.0)])
    assert not autocorrelated([seen(p=5e-4, inflation=2.0), seen("z")])


def test_reasons_in_sentences() -> None:
    """There is one sentence for each cause, and none for the stated noise."""
    larger = "residuals are 2.00 times the stated noise"
    coloured = "residuals are autocorrelated: speed (lag-1 correlation +0.30)"
    slow = (
        "residuals are autocorrelated: speed (long-run variance is 16.0 times that of white noise)"
    )
    speed = seen("speed", 1e-9, 4.0)
    burst = WorstResidual(output="y", recording="log", begin=0.0, end=0.1, size=9.0, share=0.5)
    for squares, is_stated, test, worst, reasons in (
        (1000.0, True, seen(), None, ()),
        # White residuals of another size are larger noise, but for a burst or few values.
        (4000.0, True, seen(), None, ()),
        (4000.0, True, seen(), burst, (larger,)),
        (4000.0, True, seen(count=20), None, (larger,)),
        # Where sigmas are estimated, the size tells nothing.
        (4000.0, False, seen(), burst, ()),
        (1000.0, False, speed, None, (coloured,)),
        (1000.0, True, seen("speed", 1e-9, 16.0, correlation=0.001), None, (slow,)),
        (4000.0, True, speed, None, (larger, coloured)),
    ):
        assert misfit_reasons(squares, 1000, is_stated, [test], (), worst) == reasons
    several = [seen(f"y{i}", 1e-9, 9.0 - i) for i in range(6)]
    (many,) = misfit_reasons(1000.0, 1000, True, several, ())
    assert "y3 (" in many and "y4" not in many and "and 2 more" in many
    assert "model lacks" in misfit_reasons(1000.0, 1000, True, [seen()], ["dry friction"])[0]


@pytest.mark.parametrize(
    ("filtered", "ratio", "said"),
    [
        (False, 2.05, "the noise is 2.0"),
        (False, 0.5, "the stated σ is too large"),
        pytest.param(True, 2.05, "misfit", marks=pytest.mark.slow),
    ],
)
def test_white_noise_of_another_size_is_no_misfit(filtered: bool, ratio: float, said: str) -> None:
    """The verdict says the size; coloured residuals remain a misfit."""
    experiment = cart_pendulum(noise={"state": 0.01}, fit={"bootstrap": 0})
    system = System.resolve(experiment, threads=1)
    control = 5.0 * np.sin(0.04 * np.arange(400))[:, None]
    log, clean = (recorded(system, control, share=share) for share in (ratio, 0.0))
    noise = log.y - clean.y
    if filtered:
        noise[1:] = (noise[1:] + noise[:-1]) / np.sqrt(2.0)
    found = mjfim.identify(experiment, [replace(log, y=clean.y + noise)])
    assert found.misfit == filtered
    page = estimate_page(found)
    sentence = page.verdict.sentence
    assert said in sentence or any(said in warning for warning in found.warnings)
    # It is said once.
    assert sum(each.count("noise is") for each in (sentence, *page.warnings)) <= 1
    assert (page.verdict.level is Level.GOOD) != filtered
    # Larger noise counts in what is known about every parameter.
    wider = np.sqrt(np.diag(found.honest_covariance)) / found.std
    assert filtered or (wider > 0.9 * max(ratio, 1.0)).all()
