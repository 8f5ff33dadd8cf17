"""Fits to all data but one part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.arrays import Array
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from mjfim.identification.left_out import LeftOutPart, fit_without, left_out_parts
from mjfim.optimize.levenberg_marquardt import SearchSettings, Solution
from mjfim.parallel.budget import Budget
from tests.support.cart_pendulum import cart_pendulum, fit_of

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
