"""Losses of predictions of left-out data, and the rule by which they are compared."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.identification.assessment.honest_covariance import jackknife_deviations
from mjfim.identification.identify import least_squares
from mjfim.identification.left_out import HeldOutLosses, held_out_losses
from mjfim.parallel.budget import Budget
from tests.support.cart_pendulum import cart_pendulum, fit_of


def losses(values: Any, counts: Any = 1.0, parts: Any = 0) -> HeldOutLosses:
    """Losses of some blocks."""
    return HeldOutLosses(
        losses=np.array(values, dtype=float),
        counts=np.broadcast_to(np.asarray(counts, dtype=float), len(values)),
        parts=np.broadcast_to(parts, len(values)),
        estimates=np.zeros((1, 1)),
    )


def test_the_standard_error_is_that_of_paired_differences() -> None:
    rng = np.random.default_rng(0)
    common = 10.0 * rng.random(2000)
    first, second = losses(common + 1.0), losses(common + rng.normal(0.0, 0.2, 2000))
    reduction = first.reduction(second)

    # What both have in common does not count.
    assert reduction.mean == pytest.approx(1.0, abs=0.02)
    assert reduction.standard_error == pytest.approx(0.2 / np.sqrt(2000), rel=0.1)
    assert reduction.is_clear
    assert not second.reduction(first).is_clear


def test_the_standard_error_with_blocks_of_different_sizes_is_that_of_the_scatter() -> None:
    rng = np.random.default_rng(1)
    counts = np.array([5, 20, 10, 40, 15, 10])
    zero = losses(np.zeros(6), counts)
    found = [
        losses([rng.normal(0.3, 1.0, count).sum() for count in counts], counts).reduction(zero)
        for _ in range(3000)
    ]
    means = [each.mean for each in found]
    assert np.mean(means) == pytest.approx(0.3, abs=0.01)
    stated = np.mean([each.standard_error**2 for each in found])
    assert stated == pytest.approx(np.var(means), rel=0.25)


def test_a_reduction_is_clear_where_it_is_relevant_and_in_all_recordings() -> None:
    """Twenty blocks of two recordings."""
    one, parts = np.ones(20), np.repeat([0, 1], 10)
    diverged = np.append(np.ones(19), np.inf)
    one_better, both_better = np.repeat([0.7, 1.1], 10), np.repeat([0.8, 0.9], 10)
    for before, after, parts_of_blocks, is_clear in (
        (one, diverged, 0, False),
        (diverged, one, 0, True),
        (diverged, diverged, 0, False),
        # Two models that no data tell apart, whose searches ended at slightly different places.
        (one, one - 1e-6, 0, False),
        (one, one - 1e-2, 0, True),
        # Blocks agree within each recording, but the recordings contradict each other.
        (one, one_better, parts, False),
        (one, both_better, parts, True),
    ):
        first, second = losses(before, parts=parts_of_blocks), losses(after, parts=parts_of_blocks)
        assert first.reduction(second).is_clear == is_clear


def test_the_jackknife_is_the_standard_error_of_a_mean() -> None:
    data = np.random.default_rng(3).normal([3.0, -1.0], [2.0, 0.1], (7, 2))
    without = np.array([np.delete(data, i, axis=0).mean(axis=0) for i in range(7)])
    found = replace(losses([1.0]), estimates=without).jackknife
    assert_allclose(found, data.std(axis=0, ddof=1) / np.sqrt(7.0))

    deviations = jackknife_deviations(without)
    assert_allclose(deviations.T @ deviations, np.cov(data, rowvar=False) / 7.0)

    # A single part has no scatter.
    assert not jackknife_deviations(without[:1]).any()
    assert np.isnan(replace(losses([1.0]), estimates=without[:1]).jackknife).all()


@pytest.mark.parametrize(
    ("segments", "parts"),
    [
        ("whole", 5),
        pytest.param(0.75, 5, marks=pytest.mark.slow),
        pytest.param(0.2, 4, marks=pytest.mark.slow),
    ],
)
def test_a_single_recording_is_predicted_in_parts(segments: float | str, parts: int) -> None:
    """Each part is a stretch of the recording, also of a whole one or of two segments."""
    problem = fit_of(cart_pendulum(horizon=1.5, fit={"segments": segments}), 1).problem()
    solution = least_squares(problem, np.array([2.0, 1.0, 1.0]))
    found = held_out_losses(problem, solution, problem.noise.sigma, Budget())

    # All values are predicted once.
    assert len(found.estimates) == parts
    assert set(found.parts.tolist()) == set(range(parts))
    assert found.counts.sum() == np.sum(problem.masks)

    # The estimates without each part scatter about as much as the noise explains.
    std = np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))
    assert (found.jackknife < 4.0 * std).all()
    assert (found.jackknife > std / 4.0).all()
    assert found.error == pytest.approx(1.0, abs=0.2)
