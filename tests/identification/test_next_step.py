"""A search over much data ends after one linearisation of all of it where the rest is linear."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.budget import Budget
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import next_step, searches
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.next_step import next_step_on_part
from mjfim.identification.task import FitTask
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from tests.support.paths import MODELS

# Segments of the cart-pendulum, whose initial states are free.
FIT: dict[str, Any] = {"segments": 0.25, "start": "measured"}


@pytest.fixture(scope="module")
def task() -> FitTask:
    """A fit of two recordings."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    experiment = experiment.replace(horizon=2.0, fit=FIT)
    design = DesignTask.resolve(experiment, threads=1)
    recordings = [simulate_system(design.system, design.initial, seed) for seed in range(2)]
    return FitTask.resolve(experiment, recordings, threads=1)


@pytest.fixture(autouse=True)
def few_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few segments are tested."""
    monkeypatch.setattr(next_step, "TESTED_SHARE", 0.5)
    monkeypatch.setattr(next_step, "MIN_TESTED_SEGMENTS", 4)


class Counting:
    """A problem that counts its linearisations."""

    def __init__(self, problem: FitProblem) -> None:
        self.problem = problem
        self.linearisations = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.problem, name)

    def condense(self, at: UnknownValues) -> Condensed | None:
        """Linearise, and count."""
        self.linearisations += 1
        return self.problem.condense(at)


@pytest.mark.slow
def test_the_first_step_ends_a_search_that_began_near_the_minimum(task: FitTask) -> None:
    problem = task.problem()
    exact = minimise(problem, problem.begin(task.start), SearchSettings(), Budget())
    assert exact is not None and exact.success
    sigma = np.sqrt(np.diag(np.linalg.inv(exact.condensed.information())))

    # A step of 0.35 standard deviations beside the minimum.
    away = np.linalg.cholesky(np.linalg.inv(exact.condensed.information())) @ np.full(3, 0.2)
    near = replace(exact.unknowns, theta=exact.unknowns.theta + away)
    settings = SearchSettings(tolerance=0.1, relinearise_at_end=False)
    fast = replace(settings, next_step_length=next_step_on_part(problem))
    counting = Counting(problem)
    found = minimise(counting, near, fast, Budget())
    assert found is not None and found.success
    assert counting.linearisations == 1
    assert (np.abs(found.unknowns.theta - exact.unknowns.theta) < 0.1 * sigma).all()

    # The residuals of its linearisation are those at its end.
    anew = problem.condense(found.unknowns)
    assert anew is not None
    scale = np.abs(anew.block_scores).max(axis=0)
    assert (np.abs(found.condensed.block_scores - anew.block_scores) < 0.1 * scale).all()
    gradient = found.condensed.gradients_after(np.zeros(3)).sum(axis=0)
    assert (np.abs(gradient) < 1e-3 / sigma).all()

    # Without the test, the search linearises once more.
    counting = Counting(problem)
    assert minimise(counting, near, settings, Budget()) is not None
    assert counting.linearisations > 1


@pytest.mark.slow
def test_a_search_from_far_away_linearises_again(task: FitTask) -> None:
    problem = task.problem()
    settings = SearchSettings(
        tolerance=1e-2, relinearise_at_end=False, next_step_length=next_step_on_part(problem)
    )
    counting = Counting(problem)
    found = minimise(counting, problem.begin(task.start), settings, Budget())
    assert found is not None and found.success
    assert counting.linearisations > 1


def test_few_segments_are_not_tested(task: FitTask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(next_step, "MIN_TESTED_SEGMENTS", 100)
    assert next_step_on_part(task.problem()) is None


@pytest.mark.slow
def test_much_data_give_the_same_estimate(task: FitTask, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search begins on a part of the data, and ends after few linearisations of all of it."""
    exact = mjfim.identify(task.system.experiment, task.recordings, threads=1)
    monkeypatch.setattr(searches, "SUBSET_SAMPLES", 100)
    monkeypatch.setattr(searches, "SAMPLES_OF_MUCH_DATA", 100)
    found = mjfim.identify(task.system.experiment, task.recordings, threads=1)
    assert found.success
    assert (np.abs(found.theta - exact.theta) < 0.1 * exact.std).all()
    np.testing.assert_allclose(found.std_sandwich, exact.std_sandwich, rtol=0.05)
