"""The CAD prior of a fit: its rows, steps of inertias, and fits of what no data show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import prior_directions
from mjfim.identification.assessment.honest_covariance import interval_std
from mjfim.identification.assessment.report import _implausible_estimates
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import _unseen_directions
from mjfim.identification.linear_coordinates import CadPrior
from mjfim.identification.search import FitTask
from mjfim.model.inertia import logcholesky_factor
from mjfim.optimize.condensed_least_squares import Step
from mjfim.records.trajectory import Recording
from tests.support.hinged_arm import arm_experiment, arm_log
from tests.support.numerics import Array

JOINTS = 2


@pytest.fixture(scope="module")
def log() -> Recording:
    """A log of the arm under its own controller."""
    return arm_log(JOINTS, 2.0, np.random.default_rng(4), sigma=1e-4)[0]


def arm(folder: Path, **of_inertia: Any) -> mjfim.Experiment:
    """The arm with unknown inertias only."""
    parameters = {f"link{i}": {"inertial": f"link{i}", **of_inertia} for i in (1, 2)}
    return arm_experiment(
        folder, JOINTS, parameters=parameters, fit={"segments": 0.5, "bootstrap": 0}
    )


def moved(theta: Array, spread: float = 0.2) -> Array:
    """Parameters near others."""
    return theta + spread * np.random.default_rng(5).standard_normal(len(theta))


def residual_by_logarithm(theta: Array, reference: Array) -> Array:
    """Entries of the logarithms of the pseudo-inertias relative to the model's, by SciPy."""
    rows, columns = np.triu_indices(4)
    found = []
    for values, model in zip(np.split(theta, JOINTS), np.split(reference, JOINTS), strict=True):
        inverse = np.linalg.inv(logcholesky_factor(model))
        factor = inverse @ logcholesky_factor(values)
        logarithm = np.real(scipy.linalg.logm(factor @ factor.T))
        found.append(np.where(rows == columns, 1.0, np.sqrt(2.0)) * logarithm[rows, columns])
    return np.concatenate(found)


def test_rows_are_the_logarithm_and_its_differences(tmp_path: Path) -> None:
    parameters = System.resolve(arm(tmp_path, cad_prior=0.5)).parameters
    prior = CadPrior.of(parameters)
    reference, theta = parameters.guess, moved(parameters.guess)
    assert list(prior.columns) == list(range(20))

    rows = prior.rows(theta)
    np.testing.assert_allclose(
        rows[:, -1], residual_by_logarithm(theta, reference) / 0.5, atol=1e-9
    )
    step = 1e-6
    for j in range(20):
        ends = [theta + sign * step * np.eye(20)[j] for sign in (1, -1)]
        above, below = (residual_by_logarithm(end, reference) / 0.5 for end in ends)
        np.testing.assert_allclose(rows[:, j], (above - below) / (2 * step), atol=1e-5)
    np.testing.assert_allclose(prior.information(theta), rows[:, :-1].T @ rows[:, :-1])

    # An inertia that no computer holds is infinitely far.
    assert np.isinf(prior.rows(theta + 1000.0)[:, -1]).all()


def test_a_prior_is_stated_switched_off_or_left_to_the_default(tmp_path: Path) -> None:
    def count(**of_inertia: Any) -> int:
        return len(CadPrior.of(System.resolve(arm(tmp_path, **of_inertia)).parameters).bodies)

    assert count() == count(coordinates="barycentric") == 2
    assert count(cad_prior=False) == count(prior=0.1) == 0


def test_the_prior_of_barycentric_coordinates_is_that_metric_to_second_order(
    tmp_path: Path,
) -> None:
    system = System.resolve(arm(tmp_path, coordinates="barycentric"))
    parameters = system.parameters
    prior = CadPrior.of(parameters)
    body = prior.bodies[0]
    values = parameters.guess[body.columns]
    near = values + 1e-5 * body.sizes
    exact = body.linear_difference(near).residual
    np.testing.assert_allclose(body.difference(near).residual, exact, atol=2e-6)

    # It also exists where no body has the coordinates.
    assert np.isfinite(body.difference(-values).residual).all()


def test_inertias_move_along_straight_lines_of_barycentric_coordinates(
    tmp_path: Path, log: Recording
) -> None:
    problem = FitProblem.of(System.resolve(arm(tmp_path)), [log])
    begin = problem.begin(problem.system.parameters.guess)
    sizes = problem.system.parameters.magnitude
    common = 0.02 * sizes * np.random.default_rng(6).standard_normal(20)
    step = Step(
        common=common,
        private=np.zeros_like(begin.private),
        predicted_decrease=0.0,
        common_length=1.0,
        private_length=0.0,
    )
    body = problem.shared_bodies[0]
    points = [problem.moved(begin, step, share).theta[body.columns] for share in (0.0, 0.5, 1.0)]
    first, middle, last = (body.linear(point) for point in points)
    np.testing.assert_allclose(middle, 0.5 * (first + last), rtol=1e-9, atol=1e-12)

    # The step begins in the direction of the parameters.
    begun = problem.moved(begin, step, 1e-5).theta[body.columns] - points[0]
    error = (begun / 1e-5 - common[:10]) / sizes[:10]
    assert np.abs(error).max() < 1e-5

    # A step to where no body is ends before it.
    far = problem.moved(begin, replace(step, common=100.0 * common), 1.0).theta
    assert not body.is_physical_after(begin.theta[body.columns], 100.0 * common[:10])
    assert body.is_physical(body.linear(far[body.columns]))
    assert problem.common_rows_after(begin, 100.0 * common) is None


def test_a_step_to_a_rod_ends_before_it(tmp_path: Path) -> None:
    """Rounding makes a rod of a body that is one to nine digits."""
    parameters = System.resolve(arm(tmp_path)).parameters
    body = CadPrior.of(parameters).bodies[0]
    thin = np.array(parameters.guess[body.columns])
    thin[1] = thin[3] - 10.3
    linear = body.linear(thin)
    assert body.is_physical(linear)

    # Towards the rod, nothing is left, and away from it everything.
    step = np.zeros(10)
    step[1] = -1.0
    assert body.physical_share(thin, step) == 0.0
    assert not body.is_physical_after(thin, 0.49 * step)
    assert body.physical_share(thin, -step) == 1.0
    assert body.is_physical(body.linear(body.moved(thin, -step)))


def test_rows_along_a_step_have_the_derivatives_of_differences(
    tmp_path: Path, log: Recording
) -> None:
    problem = FitProblem.of(System.resolve(arm(tmp_path)), [log])
    parameters = problem.system.parameters
    begin = problem.begin(moved(parameters.guess, 0.01))
    common = 0.02 * parameters.magnitude * np.random.default_rng(7).standard_normal(20)
    along = problem.common_rows_after
    rows = along(begin, common)
    assert rows is not None
    step = 1e-6
    for j in range(20):
        above, below = (along(begin, common + sign * step * np.eye(20)[j]) for sign in (1, -1))
        assert above is not None and below is not None
        np.testing.assert_allclose(
            rows[:, j], (above[:, -1] - below[:, -1]) / (2 * step), rtol=1e-4, atol=1e-4
        )


def test_directions_without_data_have_the_prior_alone(tmp_path: Path) -> None:
    parameters = System.resolve(arm(tmp_path)).parameters
    prior = CadPrior.of(parameters)
    theta = moved(parameters.guess, 0.05)
    known = prior.information(theta)

    # The recordings know one combination a hundred times better than the prior.
    direction = np.linalg.cholesky(known)[:, 3]
    data = 1e4 * np.outer(direction, direction)
    std = np.sqrt(np.diag(np.linalg.inv(known + data)))
    found = prior_directions(parameters, theta, data, std)
    assert found is not None
    assert (found.determined, found.count, found.bodies) == (1, 20, ("link1", "link2"))
    assert "1 of 20 combinations" in str(found) and "no measurement" in str(found)
    assert found.parameters

    # Nothing is to be said where the recordings know everything.
    std = np.sqrt(np.diag(np.linalg.inv(1e4 * known)))
    assert prior_directions(parameters, theta, 1e4 * known, std) is None


def test_an_inertia_that_contradicts_the_model_is_named(tmp_path: Path) -> None:
    """A body that is f times as heavy and large in all moments is 2 ln f from the model."""
    parameters = System.resolve(arm(tmp_path, cad_prior=0.5)).parameters
    theta = np.array(parameters.guess)
    assert not list(_implausible_estimates(parameters, theta))

    # The first log-Cholesky coordinate is half of the logarithm of the mass.
    theta[0] += 0.5 * np.log(4.0)
    assert not list(_implausible_estimates(parameters, theta))
    theta[0] += 0.5 * np.log(2.0)
    (text,) = _implausible_estimates(parameters, theta)
    assert text.startswith("the inertia of link1 is 8 prior standard deviations (cad_prior)")


@pytest.mark.slow
def test_what_no_recording_shows_stays_as_in_the_model(tmp_path: Path, log: Recording) -> None:
    experiment = arm(tmp_path)
    estimate = mjfim.identify(experiment, [log], progress=False)
    assert estimate.converged and not estimate.misfit
    assert np.isfinite(estimate.std).all()

    # The first link turns about a vertical axis: its mass has no effect.
    found = estimate.prior_directions
    assert found is not None and 5 < found.determined < 15
    assert estimate.summary()["prior_directions"]["count"] == 20
    assert not estimate.sloppy and not estimate.combinations
    assert not [
        text for text in estimate.warnings if "identifiable" in text or "by these logs" in text
    ]

    system = System.resolve(experiment)
    theta = system.parameters.guess
    residual = CadPrior.of(system.parameters).rows(estimate.theta)[:, -1]
    assert np.abs(residual).max() < 1.0
    low, high = estimate.interval.T
    assert ((low <= theta) & (theta <= high)).mean() > 0.9
    assert len(estimate.prior) == 20 and np.linalg.eigvalsh(estimate.prior)[0] > 0.0

    # The covariance agrees with the intervals, and no combination is better known than formally.
    honest, std = estimate.honest_covariance, interval_std(system.parameters, estimate)
    ratio = np.sqrt(np.diag(honest)) / std
    assert ratio.min() > 1.0 - 1e-9 and ratio.max() < 1.15
    root = np.linalg.inv(np.linalg.cholesky(estimate.covariance / np.outer(std, std)))
    assert np.linalg.eigvalsh(root @ (honest / np.outer(std, std)) @ root.T).min() > 0.5

    # Without the prior, such combinations are held and said one by one.
    without = mjfim.identify(arm(tmp_path, cad_prior=False), [log], progress=False)
    assert without.combinations and without.prior_directions is None


@pytest.mark.slow
def test_no_data_are_simulated_to_test_inertias_with_a_prior(
    tmp_path: Path, log: Recording
) -> None:
    task = FitTask.of(System.resolve(arm(tmp_path), threads=1), [log])
    problem = task.problem()
    steps = problem.system.plant.engine_steps
    assert _unseen_directions(task, problem, task.start).count == 0
    assert problem.system.plant.engine_steps == steps

    # Without the prior, hardly any single inertia is determined.
    task = FitTask.of(System.resolve(arm(tmp_path, cad_prior=False), threads=1), [log])
    assert _unseen_directions(task, task.problem(), task.start).count > 5
