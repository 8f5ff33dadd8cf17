"""A search over much data ends after one linearisation of all of it where the rest is linear."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.budget import Budget, StopToken
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import next_step, searches, subsets
from mjfim.identification.estimated_noise import EstimatedNoiseProblem
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import _first_fit
from mjfim.identification.next_step import next_step_on_part, spread_over_data
from mjfim.identification.searches import FitSearch
from mjfim.identification.task import FitTask
from mjfim.optimize.condensed_least_squares import Condensed, Step
from mjfim.optimize.levenberg_marquardt import (
    Problem,
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.plant.noise import Noise
from mjfim.records.events import FitEvent
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
    monkeypatch.setattr(next_step, "LARGEST_TESTED_SHARE", 1.0)


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
    fast = replace(settings, begins_near=True, next_step_length=next_step_on_part(problem))
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

    # Without the test, a search linearises once more where it begins a little farther away.
    farther = replace(exact.unknowns, theta=exact.unknowns.theta + 2.0 * away)
    counting = Counting(problem)
    assert minimise(counting, farther, settings, Budget()) is not None
    assert counting.linearisations > 1


@pytest.mark.slow
def test_the_test_of_estimated_noise_is_weighted_as_the_linearisation(
    task: FitTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gradients with the stated noise are no continuation of those with the estimated one."""
    problem = task.problem()
    stated = problem.with_noise(_scaled(problem.noise, 10.0))
    exact = minimise(problem, problem.begin(task.start), SearchSettings(), Budget())
    assert exact is not None
    likelihood = EstimatedNoiseProblem(stated, 1e-3 * stated.noise.sigma)
    estimate = next_step_on_part(stated, likelihood.lasting_noise)
    assert estimate is not None

    # A step of 0.35 standard deviations to the minimum, and the one that follows.
    away = np.linalg.cholesky(np.linalg.inv(exact.condensed.information())) @ np.full(3, 0.2)
    near = replace(exact.unknowns, theta=exact.unknowns.theta + away)
    condensed, step = first_step(likelihood, near)
    at = problem.moved(near, step, 1.0)
    found = estimate(condensed, step, at)
    with_stated = next_step_on_part(stated)
    assert with_stated is not None
    wrong = with_stated(condensed, step, at)
    _, following = first_step(likelihood, at)
    assert found == pytest.approx(following.common_length, rel=0.4)
    assert wrong > 3.0 * following.common_length


@pytest.mark.slow
def test_the_search_for_estimated_noise_has_a_test_that_is_weighted_so(
    task: FitTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subsets, "SUBSET_SAMPLES", 100)
    monkeypatch.setattr(searches, "SAMPLES_OF_MUCH_DATA", 100)
    searched = []

    def recorded(
        problem: FitProblem, begin: UnknownValues, settings: SearchSettings, *more: Any
    ) -> Solution | None:
        """Search, and keep the linearisation and the settings."""
        found = minimise(problem, begin, settings, *more)
        searched.append((problem, settings.next_step_length, begin))
        return found

    monkeypatch.setattr(searches, "minimise", recorded)
    experiment = task.system.experiment.replace(fit={**FIT, "noise": "estimated"})
    estimated = FitTask.resolve(experiment, task.recordings, threads=1)
    search = FitSearch(task=estimated, budget=Budget(), callback=None)
    problem = estimated.problem()
    search.solve(problem, problem.begin(task.start))
    (_, without, _), (likelihood, estimate, begin) = searched
    assert isinstance(likelihood, EstimatedNoiseProblem)
    assert without is None and estimate is not None

    # Where the noise becomes another one, the linearisation does not hold.
    condensed, step = first_step(likelihood, begin)
    assert np.isfinite(estimate(condensed, step, problem.moved(begin, step, 1.0)))
    first_step(likelihood, problem.begin(1.2 * task.start))
    assert estimate(condensed, step, problem.moved(begin, step, 1.0)) == np.inf


@pytest.mark.slow
def test_a_search_that_is_stopped_reports_on_the_segments_that_it_has_seen(
    task: FitTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subsets, "MIN_FIRST_SAMPLES", 10)
    monkeypatch.setattr(subsets, "MIN_FIRST_SEGMENTS", 2)
    stop = StopToken()

    def callback(event: FitEvent) -> None:
        """Stop at the first step of theta."""
        if event.phase == "part of the data":
            stop.request()

    problem = task.problem()
    seen = subsets.first_subset(problem)
    assert len(seen) < len(problem.segments)
    search = FitSearch(task=task, budget=Budget(stop=stop), callback=callback)
    begin = problem.begin(task.start)
    whole = np.arange(len(problem.segments))
    part, subset, (_, found) = _first_fit(search, problem, whole, begin)
    assert [segment.begin for segment in part.segments] == [problem.segments[i].begin for i in seen]
    assert len(subset) == len(seen)

    # Their initial states are no longer the measured ones.
    assert found.interrupted and f"from {len(seen)} of {len(whole)} segments" in found.status
    assert found.unknowns.private.any(axis=1).all()


def _scaled(noise: Noise, factor: float) -> Noise:
    """Noise of other standard deviations."""
    return Noise(covariance=factor**2 * noise.covariance, strides=noise.strides)


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


def first_step(problem: Problem, at: UnknownValues) -> tuple[Condensed, Step]:
    """The linearisation at some unknowns, and the undamped step from there."""
    condensed = problem.condense(at)
    assert condensed is not None
    free = np.full(condensed.common_count, np.inf)
    return condensed, condensed.step(0.0, condensed.column_norms, -free, free)


@pytest.mark.slow
def test_the_length_is_that_of_the_step_that_follows(
    task: FitTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(next_step, "TESTED_SHARE", 1.0)
    problem = task.problem()
    estimate = next_step_on_part(problem)
    assert estimate is not None

    at = problem.begin(task.start)
    lengths = []
    for _ in range(3):
        condensed, step = first_step(problem, at)
        at = problem.moved(at, step, 1.0)
        _, following = first_step(problem, at)
        lengths.append((estimate(condensed, step, at), following.common_length))

    # The information at the begin of the step differs little from that at its end.
    relevant = [(found, true) for found, true in lengths if true > 1e-3]
    assert relevant
    for found, true in relevant:
        assert found == pytest.approx(true, rel=0.4)


@pytest.mark.slow
def test_segments_without_information_about_a_parameter_tell_nothing(task: FitTask) -> None:
    problem = task.problem()
    estimate = next_step_on_part(problem)
    assert estimate is not None
    begin = problem.begin(task.start)
    condensed, step = first_step(problem, begin)
    at = problem.moved(begin, step, 1.0)
    assert np.isfinite(estimate(condensed, step, at))

    # The first parameter acts in the other segments only.
    count = len(problem.segments)
    tested = spread_over_data(count, count // 2)
    blocks = np.array(condensed.blocks)
    of_tested = np.isin(condensed.segment_of_block, tested)
    blocks[of_tested, :, condensed.private_count] = 0.0
    assert estimate(replace(condensed, blocks=blocks), step, at) == np.inf


@pytest.mark.parametrize(("count", "wanted"), [(150, 15), (1000, 100), (205, 20), (40, 20)])
def test_each_stretch_of_the_data_is_tested_once(count: int, wanted: int) -> None:
    tested = spread_over_data(count, wanted)
    assert len(tested) == wanted
    assert tested[0] == 0 and tested[-1] < count
    assert (np.abs(tested - np.arange(wanted) * count / wanted) <= count / wanted).all()

    # Recordings of ten segments are tested at all their times.
    assert set(spread_over_data(1000, 100) % 10) == set(range(10))


@pytest.mark.slow
def test_without_a_search_over_a_part_the_search_does_not_begin_near_the_minimum(
    task: FitTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: FitProblem) -> None:
        raise AssertionError("the search begins at the stated start")

    monkeypatch.setattr(searches, "next_step_on_part", refuse)
    monkeypatch.setattr(searches, "SAMPLES_OF_MUCH_DATA", 100)
    assert mjfim.identify(task.system.experiment, task.recordings, threads=1).success


def test_few_segments_are_not_tested(task: FitTask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(next_step, "MIN_TESTED_SEGMENTS", 100)
    assert next_step_on_part(task.problem()) is None


@pytest.mark.slow
def test_much_data_give_the_same_estimate(task: FitTask, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search begins on a part of the data, and ends after few linearisations of all of it."""
    exact = mjfim.identify(task.system.experiment, task.recordings, threads=1)
    monkeypatch.setattr(subsets, "SUBSET_SAMPLES", 100)
    monkeypatch.setattr(searches, "SAMPLES_OF_MUCH_DATA", 100)
    found = mjfim.identify(task.system.experiment, task.recordings, threads=1)
    assert found.success
    assert (np.abs(found.theta - exact.theta) < 0.1 * exact.std).all()
    np.testing.assert_allclose(found.std_sandwich, exact.std_sandwich, rtol=0.05)
