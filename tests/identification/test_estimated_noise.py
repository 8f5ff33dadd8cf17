"""Parameters and noise are found by searches in turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
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
        solved = minimise(weighted, found, SearchSettings(tolerance=1e-5), Budget())
        assert solved is not None and solved.success
        found = solved.unknowns

    condensed = weighted.condense(found)
    assert condensed is not None
    return found.theta, weighted, np.sqrt(np.diag(np.linalg.inv(condensed.information())))


@pytest.mark.slow
def test_an_estimate_with_estimated_noise_is_that_of_searches_in_turn(
    task: FitTask, problem: FitProblem
) -> None:
    """There are as much squares as degrees of freedom."""
    experiment = task.system.experiment.replace(fit={"segments": "whole"})
    found = mjfim.identify(experiment, task.recordings, threads=1)
    assert found.converged
    assert abs(found.chi2 / found.dof - 1.0) < 1e-3
    theta, _, sigma = in_turn(problem, found.theta)
    assert (np.abs(found.theta - theta) < 1e-2 * sigma).all()
    np.testing.assert_allclose(found.std, sigma, rtol=1e-2)


def test_the_noise_of_a_stopped_search_is_that_of_its_linearisation(
    task: FitTask, problem: FitProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, condense = StopToken(), FitProblem.condense
    points: list[UnknownValues] = []

    def recorded(self: FitProblem, at: UnknownValues) -> Condensed | None:
        """Linearise as always."""
        points.append(at)
        return condense(self, at)

    monkeypatch.setattr(FitProblem, "condense", recorded)

    def callback(event: FitEvent) -> None:
        """Stop after the first step with estimated noise."""
        if "noise estimated" in event.phase:
            stop.request()

    # The outputs contradict each other, so that this step is long.
    search = FitSearch(task=task, budget=Budget(stop=stop), callback=callback)
    weighted, found = search.solve(problem, problem.begin(problem.system.parameters.guess))
    assert found.interrupted
    anew = condense(weighted, points[-1])
    assert anew is not None
    np.testing.assert_allclose(found.condensed.information(), anew.information(), rtol=1e-6)
    np.testing.assert_allclose(found.cost, weighted.cost(found.unknowns))


def test_the_noise_has_a_smallest_value(task: FitTask, problem: FitProblem) -> None:
    """Without a limit, an output without any error would outweigh all others."""
    exact = problem.predict(problem.begin(problem.system.parameters.guess))
    assert exact is not None
    recording = replace(task.recordings[0], y=exact[0])
    silent = replace(task, recordings=(recording,)).problem()
    begin = silent.begin(problem.system.parameters.guess)
    weighted, _ = FitSearch(task=task, budget=Budget()).solve(silent, begin)
    np.testing.assert_allclose(weighted.noise.sigma, 1e-3 * problem.noise.sigma)
