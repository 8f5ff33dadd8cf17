"""Fits to all data but one part, losses of their predictions, and the rule to compare them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.arrays import Array
from mjfim.identification.assessment.honest_covariance import jackknife_deviations
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from mjfim.identification.left_out import (
    HeldOutLosses,
    LeftOutPart,
    fit_without,
    held_out_losses,
    left_out_parts,
)
from mjfim.optimize.levenberg_marquardt import SearchSettings, Solution
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


def test_the_standard_error_with_blocks_of_different_sizes_is_that_of_the_scatter() -> None:
    """What both models have in common does not count."""
    rng = np.random.default_rng(1)
    counts = np.array([5, 20, 10, 40, 15, 10])
    common = 1e3 * rng.random(6)
    better = losses(common, counts)
    found = []
    for _ in range(3000):
        added = [rng.normal(0.3, 1.0, count).sum() for count in counts]
        found.append(losses(common + added, counts).reduction(better))
    means, standard_errors = np.transpose(found)
    assert np.mean(means) == pytest.approx(0.3, abs=0.01)
    assert np.mean(standard_errors**2) == pytest.approx(np.var(means), rel=0.25)


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
        assert first.is_clearly_above(second) == is_clear


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
    given = problem, solution, problem.noise.sigma, Budget()
    found = held_out_losses(*given)

    # All values are predicted once.
    assert len(found.estimates) == parts
    assert set(found.parts.tolist()) == set(range(parts))
    assert found.counts.sum() == np.sum(problem.masks)

    # The estimates without each part scatter about as much as the noise explains.
    std = np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))
    assert (found.jackknife < 4.0 * std).all()
    assert (found.jackknife > std / 4.0).all()
    assert found.error == pytest.approx(1.0, abs=0.2)

    # Parts after those that show a model to predict worse are not predicted.
    worse = held_out_losses(*given, replace(found, losses=0.2 * found.losses))
    assert len(worse.estimates) < parts
    assert found.error > worse.error > found.error * 0.2**0.5


TIGHT = SearchSettings(tolerance=1e-6)


def fitted(fit: dict[str, object]) -> tuple[FitProblem, Solution]:
    """A fit to three recordings of the cart-pendulum."""
    task = fit_of(cart_pendulum(horizon=2.0, fit={"bootstrap": 0, **fit}), 0, 1, 2)
    problem = task.problem()
    return problem, least_squares(problem, task.system.parameters.true, TIGHT)


def exact_fit(problem: FitProblem, solution: Solution, part: LeftOutPart) -> Array:
    """Parameters of the fit to the others."""
    others = problem.masked([~mask for mask in part.masks(problem)])
    others = others.of_segments(others.segments_with_values)
    return least_squares(others, problem.theta(solution.unknowns), TIGHT).unknowns.theta


@pytest.mark.parametrize("fit", [{}, pytest.param({"segments": 0.5}, marks=pytest.mark.slow)])
def test_it_is_the_fit_to_the_others(fit: dict[str, object]) -> None:
    """Theta moves by about a standard deviation, and misses a small share of it."""
    problem, solution = fitted(fit)
    for part in list(left_out_parts(problem))[:2]:
        found = fit_without(problem, Budget(), solution=solution, part=part).theta
        moved, missed = (
            np.linalg.norm((found - other) / sigma_of(solution))
            for other in (solution.unknowns.theta, exact_fit(problem, solution, part))
        )
        assert moved > 0.1
        assert missed < 0.2 * moved


def sigma_of(solution: Solution) -> Array:
    """Formal standard deviations."""
    return np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))


@pytest.mark.slow
def test_a_search_follows_where_the_linearisation_does_not_lead_there() -> None:
    """Far from the fit, the search begins at the guess, where the others cost less."""
    problem, solution = fitted({})
    part = next(left_out_parts(problem))
    unknowns = replace(solution.unknowns, theta=solution.unknowns.theta * [3.0, 1.5, 0.2])
    away = replace(solution, unknowns=unknowns, condensed=problem.condense(unknowns))
    found = fit_without(problem, Budget(), solution=away, part=part)
    missed = (found.theta - exact_fit(problem, solution, part)) / sigma_of(solution)
    assert np.linalg.norm(missed) < 0.3


def test_nothing_is_left_of_a_problem_with_one_part_only() -> None:
    problem, solution = fitted({})
    everything = replace(next(left_out_parts(problem)), recordings=(0, 1, 2))
    assert fit_without(problem, Budget(), solution=solution, part=everything) is None
