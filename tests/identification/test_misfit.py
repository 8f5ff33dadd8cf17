"""Largest residuals and reasons for a misfit: planted faults are found, noise gives none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import mjfim
from mjfim.identification.assessment.residual_tests import (
    autocorrelated,
    is_larger_than_noise,
    is_smaller_than_noise,
    largest_interval,
    misfit_reasons,
    worst_residual,
)
from mjfim.output.pages.estimate import estimate_page
from mjfim.records.estimate import Whiteness, WorstResidual
from mjfim.records.verdict import Level
from tests.support.cart_pendulum import cart_pendulum
from tests.support.numerics import Array

NAMES = ("angle", "speed", "force")


def worst_of(recordings: str, times: list[Array], z: list[Array]) -> WorstResidual | None:
    """The interval with the largest residuals, found output by output as a fit does."""
    return worst_residual(
        [
            largest_interval(output, name, t, part[:, j])
            for j, output in enumerate(NAMES)
            for name, t, part in zip(recordings, times, z, strict=True)
        ]
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
    t = times[recording]
    begin, end = 0.55 * t[-1], 0.67 * t[-1]
    burst = (t >= begin) & (t < end)
    z[recording][burst, output] += 8.0 * np.sin(40.0 * t[burst] + 1.0)
    worst = worst_of("abc", times, z)
    assert (worst.output, worst.recording) == (NAMES[output], "abc"[recording])
    window = t[-1] / 25
    assert worst.begin == pytest.approx(begin, abs=1.5 * window)
    assert worst.end == pytest.approx(end, abs=1.5 * window)
    inside = (t >= worst.begin) & (t < worst.end)
    squares = np.sum(z[recording][inside, output] ** 2)
    assert worst.size == pytest.approx(np.sqrt(squares / inside.sum()), rel=1e-9)
    assert worst.share == pytest.approx(squares / sum(np.sum(part**2) for part in z), rel=1e-9)


def test_an_output_with_uniformly_large_residuals_is_named_as_a_whole() -> None:
    """The interval is the whole recording, not the window in which noise is largest by chance."""
    times, z = white()
    z[1][:, 2] *= 3.0
    worst = worst_of("abc", times, z)
    assert (worst.output, worst.recording) == ("force", "b")
    assert worst.begin == times[1][0]
    assert worst.end == pytest.approx(times[1][-1])
    assert worst.size == pytest.approx(3.0, rel=0.1)


def test_gaps_and_outputs_that_are_not_measured() -> None:
    """Missing values do not count; a burst next to a gap is found."""
    times, z = white()
    z[0][:, 1] = np.nan
    z[0][200:700, 0] = np.nan
    z[0][720:780, 0] += 7.0
    worst = worst_of("abc", times, z)
    assert (worst.output, worst.recording) == ("angle", "a")
    assert worst.begin <= 7.2 + 0.4
    assert worst.end >= 7.8 - 0.4
    assert worst_of("abc", times, [np.full(part.shape, np.nan) for part in z]) is None
    assert worst_of("", [], []) is None


def test_a_single_value_is_not_an_interval() -> None:
    """A burst of a hundred values is worse than a single value that is large by chance.

    The single value belongs to a rarely measured output.
    """
    for seed in range(20):
        times, z = white(seed)
        sparse = np.full(1000, np.nan)
        sparse[:300:40] = z[0][:300:40, 1]
        sparse[:100] = z[0][:100, 1]
        sparse[700] = 3.6
        z[0][:, 1] = sparse
        z[0][500:600, 0] += 2.5
        assert worst_of("abc", times, z).output == "angle"


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_short_recordings(count: int) -> None:
    """The interval is the whole recording."""
    times, z = [np.arange(count) * 0.1 + 0.5], [np.tile([0.1, 2.0, 0.1], (count, 1))]
    worst = worst_of("x", times, z)
    assert worst is not None
    assert (worst.output, worst.begin) == ("speed", 0.5)
    assert worst.size == pytest.approx(2.0)


def test_a_worst_residual_in_words() -> None:
    """The sentence has output, time, recording, size and share."""
    sentence = str(
        WorstResidual(
            output="angle", recording="run.csv", begin=1.25, end=2.5, size=7.93, share=0.412
        )
    )
    assert (
        sentence
        == "largest residuals in angle, 1.25 to 2.5 s of run.csv: 7.9 σ, 41 % of the sum of squares"
    )


def seen(output: str = "y", p: float = 1.0, inflation: float = 1.0, **fields: Any) -> Whiteness:
    """A test of whiteness, by default of white noise of the stated size."""
    white = {"count": 1000, "variance": 1.0, "correlation": 0.3, "time": 1.0, **fields}
    return Whiteness(output=output, p=p, inflation=inflation, **white)


def test_larger_and_smaller_need_probability_and_size() -> None:
    """The probability is below 0.1 %, and the ratio is relevant.

    With much data, a small probability alone is not enough.
    """
    for dof in (10, 300, 10_000):
        top, bottom = chi2.isf(1e-3, dof), chi2.ppf(1e-3, dof)
        assert is_larger_than_noise(1.01 * top, dof) == (np.sqrt(1.01 * top / dof) > 1.03)
        assert not is_larger_than_noise(0.99 * top, dof)
        assert is_smaller_than_noise(0.99 * bottom, dof) == (
            np.sqrt(0.99 * bottom / dof) < 1 / 1.03
        )
        assert not is_smaller_than_noise(1.01 * bottom, dof)
        assert not (is_larger_than_noise(dof, dof) or is_smaller_than_noise(dof, dof))
    assert is_larger_than_noise(1.07 * 1e5, 100_000)
    assert not is_larger_than_noise(1.02 * 1e5, 100_000)
    assert is_smaller_than_noise(0.9 * 1e5, 100_000)
    assert not is_smaller_than_noise(0.98 * 1e5, 100_000)


def test_autocorrelation_matters_where_it_is_large_enough() -> None:
    """It is significant for the number of outputs, and relevant against the noise.

    The strongest autocorrelation comes first.
    """
    assert [
        w.output
        for w in autocorrelated([seen("a", 1e-9, 2.0), seen("b", 1e-9, 5.0), seen("c", 0.1, 9.0)])
    ] == ["b", "a"]
    assert not autocorrelated([seen(p=1e-9, inflation=1.1)])
    assert not autocorrelated([seen(p=1e-9, inflation=5.0, variance=0.01)]), (
        "far below the stated noise"
    )
    assert autocorrelated([seen(p=1e-9, inflation=1.0, time=3.0)])
    assert autocorrelated([seen(p=5e-4, inflation=2.0)])
    assert not autocorrelated([seen(p=5e-4, inflation=2.0), seen("z")])


def test_reasons_in_sentences() -> None:
    """There is one sentence for each cause, and none for the stated noise."""
    assert misfit_reasons(1000.0, 1000, True, [seen()], ()) == ()
    assert misfit_reasons(4000.0, 1000, True, [seen()], ()) == (), "white: larger noise"
    burst = WorstResidual(output="y", recording="log", begin=0.0, end=0.1, size=9.0, share=0.5)
    few = seen(count=20)
    larger = ("residuals are 2.00 times the stated noise",)
    assert misfit_reasons(4000.0, 1000, True, [seen()], (), burst) == larger
    assert misfit_reasons(4000.0, 1000, True, [few], ()) == larger
    assert misfit_reasons(4000.0, 1000, False, [seen()], (), burst) == (), (
        "where sigmas are estimated, size tells nothing"
    )
    reasons = misfit_reasons(1000.0, 1000, False, [seen("speed", 1e-9, 4.0)], ())
    assert reasons == ("residuals are autocorrelated: speed (lag-1 correlation +0.30)",)
    slow = misfit_reasons(1000.0, 1000, True, [seen("speed", 1e-9, 16.0, correlation=0.001)], ())
    assert slow == (
        "residuals are autocorrelated: speed (long-run variance is 16.0 times that of white noise)",
    )
    assert len(misfit_reasons(4000.0, 1000, True, [seen("speed", 1e-9, 4.0)], ())) == 2
    many = misfit_reasons(1000.0, 1000, True, [seen(f"y{i}", 1e-9, 9.0 - i) for i in range(6)], ())
    assert (
        "y0 (" in many[0] and "y3 (" in many[0] and "y4" not in many[0] and "and 2 more" in many[0]
    )
    lacking = misfit_reasons(1000.0, 1000, True, [seen()], ["dry friction"])
    assert len(lacking) == 1 and "model lacks" in lacking[0]


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
    control = 5.0 * np.sin(0.04 * np.arange(400))[:, None]
    log, clean = (
        mjfim.simulate(experiment.replace(noise={"state": size}), control) for size in (0.01, 1e-9)
    )
    noise = ratio * (log.y - clean.y)
    if filtered:
        noise[1:] = (noise[1:] + noise[:-1]) / np.sqrt(2.0)
    found = mjfim.identify(experiment, [replace(log, y=clean.y + noise)], progress=False)
    assert found.misfit == filtered
    page = estimate_page(found)
    verdict = page.verdict
    assert said in verdict.sentence or any(said in warning for warning in found.warnings)
    # It is said once.
    assert sum(each.count("noise is") for each in (verdict.sentence, *page.warnings)) <= 1
    assert (verdict.level is Level.GOOD) != filtered
    assert (f"the noise is {np.sqrt(found.chi2 / found.dof):.2f} times" in verdict.sentence) == (
        said.startswith("the noise")
    )
