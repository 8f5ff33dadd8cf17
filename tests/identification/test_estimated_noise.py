"""Parameters and noise are found by one search, and agree with searches in turn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification.estimated_noise import EstimatedNoiseProblem
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.task import FitTask
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from mjfim.plant.noise import Noise
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

    # The oracle: the noise of the residuals, and a fit with this noise, in turn.
    # It begins a little beside the minimum, so that a wrong one shows.
    in_turn = problem.begin(found.theta * 1.01)
    weighted = problem
    for _ in range(6):
        errors = problem.errors_at(in_turn)
        assert errors is not None
        count = problem.value_count
        correction = count / (count - problem.unknown_count)
        variances = [float(np.mean(e**2)) * correction for e in errors]
        noise = Noise(covariance=np.diag(variances), strides=problem.noise.strides)
        weighted = problem.with_noise(noise)
        in_turn = minimum(weighted, in_turn)

    condensed = weighted.condense(in_turn)
    assert condensed is not None
    sigma = np.sqrt(np.diag(np.linalg.inv(condensed.information())))
    assert (np.abs(found.theta - in_turn.theta) < 1e-3 * sigma).all()
    np.testing.assert_allclose(
        likelihood.weighted(found).noise.sigma, weighted.noise.sigma, rtol=1e-4
    )


def test_the_weighted_cost_is_that_of_the_weighted_problem(problem: FitProblem) -> None:
    likelihood = likelihood_of(problem)
    at = problem.begin(problem.system.parameters.guess)
    np.testing.assert_allclose(likelihood.weighted_cost(at), likelihood.weighted(at).cost(at))


def test_the_noise_has_a_smallest_value_at_which_the_cost_does_not_jump(
    problem: FitProblem,
) -> None:
    at = problem.begin(problem.system.parameters.guess)
    sigma = likelihood_of(problem).weighted(at).noise.sigma
    above, below = (EstimatedNoiseProblem(problem, f * sigma) for f in (1.0 - 1e-6, 1.0 + 1e-6))
    np.testing.assert_allclose(above.cost(at), below.cost(at), rtol=1e-5)
    high = EstimatedNoiseProblem(problem, 3.0 * sigma)
    np.testing.assert_allclose(high.weighted(at).noise.sigma, 3.0 * sigma)
    np.testing.assert_allclose(high.cost(at), high.weighted_cost(at))


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
def test_an_estimate_with_estimated_noise_has_as_much_squares_as_degrees_of_freedom(
    task: FitTask,
) -> None:
    found = mjfim.identify(task.system.experiment, task.recordings, threads=1)
    assert found.success
    assert abs(found.chi2 / found.dof - 1.0) < 1e-3
