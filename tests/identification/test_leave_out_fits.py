"""Fits without one part of the data: one Gauss-Newton step, or a search where it is not enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mjfim
from mjfim.budget import Budget
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from mjfim.identification.leave_out_fits import (
    fit_to_others,
    leave_out_steps,
    predicted_part,
)
from mjfim.identification.left_out_parts import left_out_parts
from mjfim.optimize.levenberg_marquardt import SearchSettings, Solution
from tests.support.paths import ROOT

TIGHT = SearchSettings(tolerance=1e-6)


def fitted(fit: dict[str, object], recordings: int) -> tuple[FitProblem, Solution]:
    """Recordings of a cart-pendulum, and the fit to all of them."""
    base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    experiment = base.replace(horizon=2.0, fit={"bootstrap": 0, **fit})
    task = DesignTask.resolve(experiment, threads=1)
    problem = FitProblem.of(
        task.system, [simulate_system(task.system, task.initial, i) for i in range(recordings)]
    )
    return problem, least_squares(problem, task.parameters.true, TIGHT)


@pytest.mark.parametrize("fit", [{}, {"segments": 0.5}])
@pytest.mark.slow
def test_the_step_leads_to_the_fit_of_the_others(fit: dict[str, object]) -> None:
    problem, solution = fitted(fit, 3)
    parts = list(left_out_parts(problem))
    for step in leave_out_steps(problem, solution, parts):
        found = fit_to_others(problem, step, Budget())
        assert found is not None and found.has_initial_states

        others = problem.masked([~mask for mask in step.part.masks(problem)])
        others = others.of_segments(others.segments_with_values)
        exact = least_squares(others, problem.theta(solution.unknowns), TIGHT)

        # The step moves theta by about a standard deviation, and misses a small share of it.
        moved = found.unknowns.theta - solution.unknowns.theta
        missed = found.unknowns.theta - exact.unknowns.theta
        sigma = np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))
        assert np.linalg.norm(moved / sigma) > 0.1
        assert np.linalg.norm(missed / sigma) < 0.2 * np.linalg.norm(moved / sigma)


@pytest.mark.slow
def test_initial_states_of_the_part_are_those_that_fit_it_best() -> None:
    problem, solution = fitted({"segments": 0.5}, 2)
    (step, _) = leave_out_steps(problem, solution, list(left_out_parts(problem)))
    found = fit_to_others(problem, step, Budget())
    assert found is not None
    masks = step.part.masks(problem)
    part, at = predicted_part(problem, found, masks, Budget())

    # A search for the initial states of the part, at the same theta, lowers the cost by less than
    # the error of one of them by one standard deviation (1/2) does.
    assert found.has_initial_states
    searched = replace(found, has_initial_states=False)
    again, best = predicted_part(problem, searched, masks, Budget())
    assert part.cost(at) == pytest.approx(again.cost(best), abs=0.2)


def test_a_step_that_misses_the_predicted_decrease_is_followed_by_a_search() -> None:
    problem, solution = fitted({}, 2)
    (step, _) = leave_out_steps(problem, solution, list(left_out_parts(problem)))
    good = fit_to_others(problem, step, Budget())
    assert good is not None

    # A wrong linearisation is noticed by the simulation of the others.
    begin = step.begin
    away = replace(begin, theta=begin.theta * 1.05)
    ends = tuple((away, decrease) for _, decrease in step.ends)
    found = fit_to_others(problem, replace(step, ends=ends), Budget())
    assert found is not None and not found.has_initial_states
    sigma = np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))
    assert np.linalg.norm((found.unknowns.theta - good.unknowns.theta) / sigma) < 0.1


def test_a_damped_step_is_enough_where_the_one_without_damping_goes_too_far() -> None:
    problem, solution = fitted({}, 2)
    (step, _) = leave_out_steps(problem, solution, list(left_out_parts(problem)))
    begin, (first, second, *_) = step.begin, step.ends
    away = (replace(begin, theta=begin.theta * 1.05), first[1])
    found = fit_to_others(problem, replace(step, ends=(away, second)), Budget())
    assert found is not None and found.has_initial_states
    np.testing.assert_array_equal(found.unknowns.theta, second[0].theta)

    # A step that promises much less is none: the search goes on.
    little = (second[0], 0.5 * first[1])
    found = fit_to_others(problem, replace(step, ends=(away, little)), Budget())
    assert found is not None and not found.has_initial_states


def test_the_search_begins_at_the_guess_where_the_others_cost_less_there() -> None:
    """The part that is left out may have led the estimate far away from where the others are."""
    problem, solution = fitted({}, 2)
    spoilt = replace(
        solution,
        unknowns=replace(solution.unknowns, theta=solution.unknowns.theta * [3.0, 1.5, 0.2]),
    )
    problem_there = problem.condense(spoilt.unknowns)
    assert problem_there is not None
    spoilt = replace(spoilt, condensed=problem_there)
    (step, _) = leave_out_steps(problem, spoilt, list(left_out_parts(problem)))
    found = fit_to_others(problem, step, Budget())
    good = leave_out_steps(problem, solution, list(left_out_parts(problem)))[0]
    sigma = np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))
    assert found is not None
    assert np.linalg.norm((found.unknowns.theta - good.ends[0][0].theta) / sigma) < 0.3


def test_nothing_is_left_of_a_problem_with_one_part_only() -> None:
    problem, solution = fitted({}, 2)
    parts = list(left_out_parts(problem))
    everything = replace(parts[0], recordings=(0, 1))
    (step,) = leave_out_steps(problem, solution, [everything])
    assert fit_to_others(problem, step, Budget()) is None
