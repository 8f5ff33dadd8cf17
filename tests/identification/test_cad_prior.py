"""The CAD prior of a fit: its rows, steps of inertias, and fits of what no data show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import prior_directions
from mjfim.identification.assessment.honest_covariance import interval_std
from mjfim.identification.assessment.report import _implausible_estimates
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.linear_coordinates import (
    cad_bodies,
    cad_information,
    cad_rows,
    columns_of,
)
from mjfim.model.inertia import logcholesky_factor
from mjfim.optimize.condensed_least_squares import Step
from mjfim.records.trajectory import Recording
from tests.support.hinged_arm import arm_experiment, arm_log
from tests.support.numerics import Array

JOINTS = 2


@pytest.fixture(scope="module")
def log() -> Recording:
    """A log of the arm under its own controller."""
    return arm_log(JOINTS, 1.0, np.random.default_rng(4), sigma=1e-4)[0]


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


def differences(f: Any, at: Array, step: float = 1e-6) -> Array:
    """Central differences of a function of 20 numbers, by number in the last axis."""
    moves = step * np.eye(20)
    return np.stack([(f(at + h) - f(at - h)) / (2.0 * step) for h in moves], axis=-1)


def test_rows_are_the_logarithm_and_its_differences(tmp_path: Path) -> None:
    parameters = System.resolve(arm(tmp_path, cad_prior=0.5)).parameters
    bodies = cad_bodies(parameters)
    reference, theta = parameters.guess, moved(parameters.guess)
    assert list(columns_of(bodies)) == list(range(20))

    def residual(values: Array) -> Array:
        return residual_by_logarithm(values, reference) / 0.5

    rows = cad_rows(bodies, theta)
    assert_allclose(rows[:, -1], residual(theta), atol=1e-9)
    assert_allclose(rows[:, :-1], differences(residual, theta), atol=1e-5)
    assert_allclose(cad_information(bodies, theta), rows[:, :-1].T @ rows[:, :-1])

    # An inertia that no computer holds is infinitely far.
    assert np.isinf(cad_rows(bodies, theta + 1000.0)[:, -1]).all()


def test_a_prior_is_stated_switched_off_or_left_to_the_default(tmp_path: Path) -> None:
    for stated, count in (
        ({}, 2),
        ({"coordinates": "barycentric"}, 2),
        ({"cad_prior": False}, 0),
        ({"prior": 0.1}, 0),
    ):
        parameters = System.resolve(arm(tmp_path, **stated)).parameters
        assert len(cad_bodies(parameters)) == count


def test_the_prior_of_barycentric_coordinates_is_that_metric_to_second_order(
    tmp_path: Path,
) -> None:
    system = System.resolve(arm(tmp_path, coordinates="barycentric"))
    parameters = system.parameters
    body = cad_bodies(parameters)[0]
    values = parameters.guess[body.columns]
    near = values + 1e-5 * body.sizes
    exact = body.linear_difference(near)[0]
    assert_allclose(body.difference(near)[0], exact, atol=2e-6)

    # It also exists where no body has the coordinates.
    assert np.isfinite(body.difference(-values)[0]).all()


def test_inertias_move_along_straight_lines_of_barycentric_coordinates(
    tmp_path: Path, log: Recording
) -> None:
    problem = FitProblem.of(System.resolve(arm(tmp_path)), [log])
    parameters = problem.system.parameters
    begin, sizes = problem.begin(parameters.guess), parameters.magnitude
    common = 0.02 * sizes * np.random.default_rng(6).standard_normal(20)
    body = problem.shared_bodies[0]

    def after(common: Array, share: float) -> Array:
        """The first body after a share of a step."""
        step = Step(
            common=common,
            private=np.zeros_like(begin.private),
            predicted_decrease=0.0,
            common_length=1.0,
            private_length=0.0,
        )
        return problem.moved(begin, step, share).theta[body.columns]

    first, middle, last = (body.linear(after(common, share)) for share in (0.0, 0.5, 1.0))
    assert_allclose(middle, 0.5 * (first + last), rtol=1e-9, atol=1e-12)

    # The step begins in the direction of the parameters.
    begun = (after(common, 1e-5) - after(common, 0.0)) / 1e-5
    assert_allclose(begun / sizes[:10], common[:10] / sizes[:10], atol=1e-5)

    # A step to where no body is ends before it.
    assert not body.is_physical_after(begin.theta[body.columns], 100.0 * common[:10])
    assert body.is_physical(body.linear(after(100.0 * common, 1.0)))
    assert problem.common_rows_after(begin, 100.0 * common) is None

    # Rows along a step have the derivatives of differences.
    near = problem.begin(moved(parameters.guess, 0.01))
    rows = problem.common_rows_after(near, common)
    expected = differences(lambda each: problem.common_rows_after(near, each)[:, -1], common)
    assert_allclose(rows[:, :-1], expected, rtol=1e-4, atol=1e-4)


def test_a_step_to_a_rod_ends_before_it(tmp_path: Path) -> None:
    """Rounding makes a rod of a body that is one to nine digits."""
    parameters = System.resolve(arm(tmp_path)).parameters
    body = cad_bodies(parameters)[0]
    thin = np.array(parameters.guess[body.columns])
    thin[1] = thin[3] - 10.3
    assert body.is_physical(body.linear(thin))

    # Towards the rod, nothing is left, and away from it everything.
    step = -np.eye(10)[1]
    assert body.physical_share(thin, step) == 0.0
    assert not body.is_physical_after(thin, 0.49 * step)
    assert body.physical_share(thin, -step) == 1.0
    assert body.is_physical(body.linear(body.moved(thin, -step)))


def test_directions_without_data_have_the_prior_alone(tmp_path: Path) -> None:
    parameters = System.resolve(arm(tmp_path)).parameters
    theta = moved(parameters.guess, 0.05)
    known = cad_information(cad_bodies(parameters), theta)

    # The recordings know one combination a hundred times better than the prior, or everything.
    direction = 100.0 * np.linalg.cholesky(known)[:, 3]
    one, nothing = (
        prior_directions(parameters, theta, data, np.sqrt(np.diag(np.linalg.inv(known + data))))
        for data in (np.outer(direction, direction), 1e4 * known)
    )
    assert (one.determined, one.count, one.bodies) == (1, 20, ("link1", "link2"))
    assert "1 of 20 combinations" in str(one) and "no measurement" in str(one)
    assert one.parameters
    assert nothing is None


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
    estimate = mjfim.identify(experiment, [log])
    assert estimate.converged and not estimate.misfit
    assert np.isfinite(estimate.std).all()

    # The first link turns about a vertical axis: its mass has no effect.
    assert 5 < estimate.prior_directions.determined < 15
    assert not estimate.sloppy and not estimate.combinations
    assert not any("identifiable" in each or "by these logs" in each for each in estimate.warnings)

    parameters = System.resolve(experiment).parameters
    residual = cad_rows(cad_bodies(parameters), estimate.theta)[:, -1]
    assert np.abs(residual).max() < 1.0
    low, high = estimate.interval.T
    assert ((low <= parameters.guess) & (parameters.guess <= high)).mean() > 0.9
    assert np.linalg.eigvalsh(estimate.prior)[0] > 0.0

    # The covariance agrees with the intervals, and no combination is better known than formally.
    std = interval_std(parameters, estimate)
    honest, formal = (
        each / np.outer(std, std) for each in (estimate.honest_covariance, estimate.covariance)
    )
    assert_allclose(np.sqrt(np.diag(honest)), 1.07, atol=0.08)
    assert scipy.linalg.eigh(honest, formal, eigvals_only=True)[0] > 0.5
