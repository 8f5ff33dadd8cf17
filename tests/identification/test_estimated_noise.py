"""Parameters and noise are found by one search, and agree with searches in turn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification.estimated_noise import EstimatedNoiseProblem
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.searches import FitSearch
from mjfim.identification.task import FitTask
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from mjfim.plant.noise import Noise
from mjfim.records.events import FitEvent
from tests.support.paths import MODELS

# Error of the readings that the model cannot explain, so that the outputs contradict each other.
DRIFT = 0.1


@pytest.fixture(scope="module")
def task() -> FitTask:
    """A fit with estimated noise; the outputs contradict each other, because one reading drifts."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    experiment = experiment.replace(horizon=2.0, fit={"noise": "estimated"})
    design = DesignTask.resolve(experiment, threads=1)
    recording = simulate_system(design.system, design.initial, 0)
    y = np.array(recording.y)
    y[:, 0] += DRIFT * recording.t
    return FitTask.resolve(experiment, [replace(recording, y=y)], threads=1)


@pytest.fixture(scope="module")
def problem(task: FitTask) -> FitProblem:
    return task.problem()


def likelihood_of(problem: FitProblem, share: float = 1e-3) -> EstimatedNoiseProblem:
    return EstimatedNoiseProblem(problem, share * problem.noise.sigma)


def shifted(problem: FitProblem, change: Array) -> UnknownValues:
    return problem.begin(problem.system.parameters.guess + change)


def minimum(problem: Any, begin: UnknownValues) -> UnknownValues:
    found = minimise(problem, begin, SearchSettings(tolerance=1e-5), Budget())
    assert found is not None and found.success
    return found.unknowns


def test_the_gradient_is_that_of_the_squares_with_the_noise_of_the_residuals(
    problem: FitProblem,
) -> None:
    likelihood = likelihood_of(problem)
    guess = problem.system.parameters.guess
    condensed = likelihood.condense(problem.begin(guess))
    assert condensed is not None
    gradient = condensed.gradients_after(np.zeros(len(guess))).sum(axis=0)
    step = 1e-5 * problem.system.parameters.magnitude
    for j, size in enumerate(step):
        change = np.zeros(len(guess))
        change[j] = size
        rise = likelihood.cost(shifted(problem, change)) - likelihood.cost(
            shifted(problem, -change)
        )
        np.testing.assert_allclose(rise / (2.0 * size), gradient[j], rtol=1e-4)


@pytest.mark.slow
def test_one_search_finds_what_searches_in_turn_with_the_noise_find(problem: FitProblem) -> None:
    likelihood = likelihood_of(problem)
    found = minimum(likelihood, problem.begin(problem.system.parameters.guess))
    other, weighted, sigma = in_turn(problem, found.theta)
    assert (np.abs(found.theta - other) < 1e-3 * sigma).all()
    np.testing.assert_allclose(
        likelihood.weighted(found).noise.sigma, weighted.noise.sigma, rtol=1e-4
    )


def in_turn(problem: FitProblem, theta: Array) -> tuple[Array, FitProblem, Array]:
    """The oracle: the noise of the residuals, and a fit with this noise, in turn.

    It begins a little beside theta, so that a wrong theta shows. Returned are theta, the problem
    with the last noise, and the standard deviations of theta.
    """
    found = problem.begin(theta * 1.01)
    weighted = problem
    for _ in range(6):
        errors = problem.errors_at(found)
        assert errors is not None
        count = problem.value_count
        correction = count / (count - problem.unknown_count)
        variances = [float(np.mean(e**2)) * correction for e in errors]
        noise = Noise(covariance=np.diag(variances), strides=problem.noise.strides)
        weighted = problem.with_noise(noise)
        found = minimum(weighted, found)

    condensed = weighted.condense(found)
    assert condensed is not None
    return found.theta, weighted, np.sqrt(np.diag(np.linalg.inv(condensed.information())))


def test_the_cost_of_squares_is_that_of_the_problem_with_this_noise(problem: FitProblem) -> None:
    likelihood = likelihood_of(problem)
    at = problem.begin(problem.system.parameters.guess)
    weighted = likelihood.weighted(at)
    np.testing.assert_allclose(likelihood.cost_of_squares(weighted.noise, at), weighted.cost(at))


def test_a_linearisation_lasts_as_long_as_the_noise_of_the_residuals(problem: FitProblem) -> None:
    likelihood = likelihood_of(problem)
    guess = problem.system.parameters.guess
    at = problem.begin(guess)
    likelihood.condense(at)
    noise = likelihood.linearised.noise
    np.testing.assert_array_equal(noise.sigma, likelihood.weighted(at).noise.sigma)
    assert likelihood.lasting_noise(problem.begin(guess * (1.0 + 1e-6))) is noise
    assert likelihood.lasting_noise(problem.begin(guess * 1.2)) is None


def test_the_noise_has_a_smallest_value_at_which_the_cost_does_not_jump(
    problem: FitProblem,
) -> None:
    at = problem.begin(problem.system.parameters.guess)
    sigma = likelihood_of(problem).weighted(at).noise.sigma
    above, below = (EstimatedNoiseProblem(problem, f * sigma) for f in (1.0 - 1e-6, 1.0 + 1e-6))
    np.testing.assert_allclose(above.cost(at), below.cost(at), rtol=1e-5)
    high = EstimatedNoiseProblem(problem, 3.0 * sigma)
    np.testing.assert_allclose(high.weighted(at).noise.sigma, 3.0 * sigma)
    np.testing.assert_allclose(high.cost(at), high.weighted(at).cost(at))


def test_a_linearisation_after_the_cost_simulates_the_residuals_no_second_time(
    problem: FitProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    original = FitProblem.squares

    def squares(self: FitProblem, at: UnknownValues) -> Array | None:
        """Sum, and count."""
        calls.append(at)
        return original(self, at)

    monkeypatch.setattr(FitProblem, "squares", squares)
    likelihood = likelihood_of(problem)
    at = problem.begin(problem.system.parameters.guess)
    likelihood.cost(at)
    likelihood.condense(at)
    likelihood.weighted(at)
    assert len(calls) == 1


@pytest.mark.slow
def test_an_estimate_with_estimated_noise_is_that_of_searches_in_turn(
    task: FitTask, problem: FitProblem
) -> None:
    """There are as much squares as degrees of freedom."""
    experiment = task.system.experiment.replace(fit={"segments": "whole"})
    found = mjfim.identify(experiment, task.recordings, threads=1)
    assert found.success
    assert abs(found.chi2 / found.dof - 1.0) < 1e-3
    theta, _, sigma = in_turn(problem, found.theta)
    assert (np.abs(found.theta - theta) < 1e-2 * sigma).all()
    np.testing.assert_allclose(found.std, sigma, rtol=1e-2)


def test_the_noise_of_a_stopped_search_is_that_of_its_linearisation(
    task: FitTask, problem: FitProblem
) -> None:
    stop = StopToken()

    def callback(event: FitEvent) -> None:
        """Stop after the first step with estimated noise."""
        if "noise estimated" in event.phase:
            stop.request()

    # The outputs contradict each other, so that this step is long.
    search = FitSearch(task=task, budget=Budget(stop=stop), callback=callback)
    begin = problem.begin(problem.system.parameters.guess)
    weighted, found = search.solve(problem, begin)
    assert found.interrupted

    # The linearisation is that before the last step.
    before = problem.begin(found.iterates[-2].theta)
    linearised = likelihood_of(problem).weighted(before)
    np.testing.assert_allclose(weighted.noise.sigma, linearised.noise.sigma)
    at_end = likelihood_of(problem).weighted(found.unknowns)
    assert (np.abs(weighted.noise.sigma / at_end.noise.sigma - 1.0) > 1e-6).any()
    anew = weighted.condense(before)
    assert anew is not None
    np.testing.assert_allclose(found.condensed.information(), anew.information(), rtol=1e-6)
    np.testing.assert_allclose(found.cost, weighted.cost(found.unknowns))
