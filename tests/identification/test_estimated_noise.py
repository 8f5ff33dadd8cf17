"""Parameters and noise are found by searches in turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitSearch, FitTask
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from mjfim.parallel.budget import Budget, StopToken
from mjfim.plant.outputs import Noise
from mjfim.records.events import FitEvent
from tests.support.cart_pendulum import cart_pendulum, fit_of

# Error of the readings that the model cannot explain, so that the outputs contradict each other.
DRIFT = 0.1


@pytest.fixture(scope="module")
def task() -> FitTask:
    """A fit with estimated noise; the outputs contradict each other, because one reading drifts."""
    made = fit_of(cart_pendulum(horizon=2.0, fit={"noise": "estimated"}), 0)
    recording = made.recordings[0]
    y = np.array(recording.y)
    y[:, 0] += DRIFT * recording.t
    return FitTask.of(made.system, [replace(recording, y=y)])


@pytest.fixture(scope="module")
def problem(task: FitTask) -> FitProblem:
    return task.problem()


@pytest.mark.slow
def test_an_estimate_with_estimated_noise_is_that_of_searches_in_turn(
    task: FitTask, problem: FitProblem
) -> None:
    """There are as much squares as degrees of freedom.

    The noise of the residuals and a fit with this noise follow each other. They begin a little
    beside the estimate, so that a wrong one shows.
    """
    experiment = task.system.experiment.replace(fit={"segments": "whole"})
    found = mjfim.identify(experiment, task.recordings, threads=1)
    assert found.converged
    assert abs(found.chi2 / found.dof - 1.0) < 1e-3
    at, weighted = problem.begin(found.theta * 1.01), problem
    correction = problem.value_count / (problem.value_count - problem.unknown_count)
    for _ in range(6):
        variances = [float(np.mean(e**2)) * correction for e in problem.errors_at(at)]
        noise = Noise(covariance=np.diag(variances), strides=problem.noise.strides)
        weighted = problem.with_noise(noise)
        solved = minimise(weighted, at, SearchSettings(tolerance=1e-5), Budget())
        assert solved.success
        at = solved.unknowns
    sigma = np.sqrt(np.diag(np.linalg.inv(weighted.condense(at).information())))
    assert (np.abs(found.theta - at.theta) < 1e-2 * sigma).all()
    assert_allclose(found.std, sigma, rtol=1e-2)


def test_the_noise_of_a_stopped_search_is_that_of_its_linearisation(
    task: FitTask, problem: FitProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The outputs contradict each other, so that the first step with estimated noise is long."""
    stop, condense = StopToken(), FitProblem.condense
    points: list[UnknownValues] = []

    def recorded(self: FitProblem, at: UnknownValues) -> Condensed | None:
        """Linearise as always."""
        points.append(at)
        return condense(self, at)

    def callback(event: FitEvent) -> None:
        """Stop after the first step with estimated noise."""
        if "noise estimated" in event.phase:
            stop.request()

    monkeypatch.setattr(FitProblem, "condense", recorded)
    search = FitSearch(task=task, budget=Budget(stop=stop), callback=callback)
    weighted, found = search.solve(problem, problem.begin(problem.system.parameters.guess))
    assert found.interrupted
    anew = condense(weighted, points[-1]).information()
    assert_allclose(found.condensed.information(), anew, rtol=1e-6)
    assert_allclose(found.cost, weighted.cost(found.unknowns))


def test_the_noise_has_a_smallest_value(task: FitTask, problem: FitProblem) -> None:
    """Without a limit, an output without any error would outweigh all others."""
    guess = problem.system.parameters.guess
    (exact,) = problem.predict(problem.begin(guess))
    silent = replace(task, recordings=(replace(task.recordings[0], y=exact),)).problem()
    weighted, _ = FitSearch(task=task, budget=Budget()).solve(silent, silent.begin(guess))
    assert_allclose(weighted.noise.sigma, 1e-3 * problem.noise.sigma)
