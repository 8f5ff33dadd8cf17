"""Draws of robots: their moments against the honest covariance, their bounds and their inertias."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.arrays import scaled_to_unit_diagonal
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System, labels_of_system
from mjfim.identification.assessment.honest_covariance import honest_covariance
from mjfim.identification.assessment.parameter_draws import (
    draw_parameters,
    draw_parameters_system,
)
from mjfim.identification.linear_coordinates import cad_bodies, cad_information, unknown_bodies
from mjfim.model.inertia import barycentric_of, logcholesky_derivatives
from mjfim.records.estimate import ParameterDraws
from mjfim.records.events import stages_observed_by
from tests.support.cart_pendulum import cart_pendulum
from tests.support.hinged_arm import arm_experiment
from tests.support.made_records import bare_estimate
from tests.support.numerics import Array
from tests.support.paths import MODELS

# Relative standard deviation of what recordings know well.
KNOWN = 1e-3

# Standard deviations of mass, length and damping, and a correlation of the first two.
STD = np.array([0.02, 0.03, 0.1])
COVARIANCE = np.diag(STD**2)
COVARIANCE[0, 1] = COVARIANCE[1, 0] = -0.8 * STD[0] * STD[1]


def estimated(system: System, covariance: Array, **fields: Any) -> mjfim.Estimate:
    """An estimate of a system at its guess with a formal covariance."""
    std = np.sqrt(np.diag(covariance))
    found = bare_estimate(system.parameters.names, system.parameters.guess, std)
    return replace(found, labels=labels_of_system(system), covariance=covariance, **fields)


def drawn(system: System, estimate: mjfim.Estimate, count: int, seed: int = 0) -> ParameterDraws:
    """Robots drawn from an estimate."""
    return draw_parameters_system(system, estimate, count, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def system() -> System:
    return System.resolve(cart_pendulum())


@pytest.mark.slow
def test_the_side_that_a_bound_cuts_off_does_not_count(system: System) -> None:
    """The damping ends at its lower bound, and cannot be negative."""
    interval = np.array([[1.9, 2.1], [0.9, 1.1], [0.0, 0.4]])
    theta = np.array([2.0, 1.0, 0.0])
    bounded = estimated(system, COVARIANCE, theta=theta, interval=interval)
    found = honest_covariance(system.parameters, bounded)
    assert np.sqrt(found[2, 2]) == pytest.approx(0.4 / 1.959964, rel=1e-5)

    # Both sides cut off: the deviations that led to the interval remain.
    narrow = System.resolve(cart_pendulum(parameters={"c": {"bounds": [0.9, 1.5]}}))
    cut = estimated(
        narrow,
        np.diag([0.01, 0.01, 4.0]),
        theta=np.array([2.0, 1.0, 1.0]),
        interval=np.array([[1.9, 2.1], [0.9, 1.1], [0.9, 1.5]]),
    )
    assert np.sqrt(honest_covariance(narrow.parameters, cut)[2, 2]) == 2.0
    damping = drawn(narrow, cut, 500, 2).values[:, 2]
    assert 0.9 <= damping.min() < 0.92 and 1.48 < damping.max() <= 1.5


def test_deviations_between_recordings_count(system: System) -> None:
    estimate = estimated(
        system, COVARIANCE, std_sandwich=2.0 * STD, between_recordings=np.array([0.0, 0.0, 0.3])
    )
    found = np.sqrt(np.diag(honest_covariance(system.parameters, estimate)))
    assert_allclose(found, [0.04, 0.06, np.hypot(0.2, 0.3)], rtol=1e-3)

    # A parameter with a value for each recording is centred at their mean, and scatters as they do.
    differing = estimated(system, COVARIANCE, per_recording={"c": (1.0, 2.0)})
    draws = draw_parameters(cart_pendulum(), differing, 10, np.random.default_rng(0))
    assert draws.centre[2] == 1.5
    assert_allclose(draws.std[2], np.hypot(0.1, np.sqrt(0.5)), rtol=1e-3)


@pytest.mark.parametrize(
    ("count", "theta", "std", "said"),
    [
        (0, [2.0, 1.0, 1.0], STD, "robots is 0; it must be from 1 to 10000"),
        (10_001, [2.0, 1.0, 1.0], STD, "robots is 10001; it must be from 1 to 10000"),
        (5, [2.0, 1.0, -1.0], STD, "c lies outside of its bounds"),
        (5, [2.0, 1.0, 1.0], [0.02, np.inf, 0.1], r"do not determine l, so that .*prior"),
    ],
)
def test_misuse_is_explained(
    system: System, count: int, theta: list[float], std: list[float], said: str
) -> None:
    estimate = estimated(system, np.diag(np.square(std)), theta=np.array(theta))
    with pytest.raises(ExperimentError, match=said):
        drawn(system, estimate, count)


def test_an_estimate_of_another_experiment(system: System) -> None:
    other = replace(estimated(system, COVARIANCE), parameters=("m", "l", "d"))
    with pytest.raises(ExperimentError, match=r"other parameters \(m, l, d\)"):
        drawn(system, other, 5)


def test_initial_states_are_no_properties_of_a_robot() -> None:
    system = System.resolve(cart_pendulum(nuisance={"initial": 0.1, "delay": 0.01}))
    names = system.parameters.names
    covariance = np.diag(np.full(len(names), 1e-4))
    # Nobody asks how well an initial state is known.
    covariance[3, 3] = np.inf
    assert names[3].startswith("initial")
    estimate = estimated(system, covariance)
    draws = drawn(system, estimate, 4)
    assert draws.parameters == ("m", "l", "c", "delay")


def test_unphysical_inertias_are_replaced() -> None:
    """Central moments may break the triangle inequality."""
    central = {
        name: {"target": f"body/cart:inertia[{axis}]", "guess": 0.01}
        for axis, name in enumerate(("Ixx", "Iyy", "Izz"))
    }
    base = cart_pendulum()
    values = {**base.model_dump(exclude_unset=True), "parameters": central}
    system = System.resolve(mjfim.Experiment(**values, directory=MODELS))
    draws = drawn(system, estimated(system, np.diag([0.006**2] * 3)), 200, 3)
    assert draws.replaced > 20
    assert "replaced" in str(draws)
    moments = np.sort(draws.values, axis=1)
    assert (moments[:, 0] > 0.0).all()
    assert (moments[:, 2] <= (moments[:, 0] + moments[:, 1])).all()

    hopeless = estimated(system, np.diag([0.006**2, 0.006**2, 1e12]))
    with pytest.raises(ExperimentError, match=r"1 of 1 drawn robots still .*cad_prior"):
        drawn(system, hopeless, 1, 3)


# ---- inertias with a CAD prior


class KnownMoment:
    """A link of which recordings tell the first moment m x and the moment of inertia of its joint.

    Both are known to 0.1 %; the other prior knowledge is the model, or what the table states.

    Attributes:
        system: The link, with the armature of its joint.
        estimate: Its estimate.
        body: The link.
        rows: (2, 11) derivatives of both combinations over their values.
    """

    def __init__(self, folder: Path, **prior: Any) -> None:
        tables = {
            "link1": {"inertial": "link1", **prior},
            "armature": {"target": "joint/joint1:armature"},
        }
        self.system = System.resolve(arm_experiment(folder, 1, parameters=tables))
        parameters = self.system.parameters
        (self.body,) = unknown_bodies(parameters)
        guess = parameters.guess
        by_linear = barycentric_of(logcholesky_derivatives(guess[self.body.columns]))

        # Barycentric coordinates begin with the mass and the first moments.
        self.rows = np.zeros((2, 11))
        self.rows[:, self.body.columns] = by_linear[:, [1, 9]].T
        self.rows[1, 10] = 1.0
        self.rows /= self.combinations(guess[None])[:, 0, None]
        data = self.rows.T @ self.rows / KNOWN**2
        known = cad_information(cad_bodies(parameters), guess) + parameters.prior_information

        # The coordinates differ in their units, so that the inverse of the scaled matrix is exact.
        scaled, scale = scaled_to_unit_diagonal(data + known)
        inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
        covariance = np.asarray(0.5 * (inverse + inverse.T), dtype=np.float64)
        self.estimate = estimated(self.system, covariance, data=data, honest_covariance=covariance)

    def linear(self, robots: Array) -> Array:
        """(n, 10) linear coordinates of robots."""
        return np.array([self.body.linear(robot[self.body.columns]) for robot in robots])

    def combinations(self, robots: Array) -> Array:
        """(2, n) both known combinations of robots."""
        linear = self.linear(robots)
        return np.array([linear[:, 1], linear[:, 9] + robots[:, 10]])

    def relative(self, robots: Array) -> Array:
        """(2, n) both known combinations of robots over those of the estimate."""
        return self.combinations(robots) / self.combinations(self.estimate.theta[None])


def test_combinations_that_recordings_know_stay_known(tmp_path: Path) -> None:
    known = KnownMoment(tmp_path)
    estimate = known.estimate
    of_rows = known.rows @ estimate.honest_covariance @ known.rows.T
    assert_allclose(np.sqrt(np.diag(of_rows)), KNOWN, rtol=1e-3)
    draws = drawn(known.system, estimate, 400, 7)
    assert draws.held_combinations == 9
    assert "9 combinations of inertias that the recordings do not determine" in str(draws)

    # Standard deviations of 400 draws scatter by 3.5 %.
    found = known.relative(draws.values)
    assert_allclose(found.std(axis=1), KNOWN, rtol=0.12)
    assert_allclose(found.mean(axis=1), 1.0, atol=4 * KNOWN / 20)
    assert all(map(known.body.is_physical, known.linear(draws.values)))

    # Along straight lines of log-Cholesky coordinates, they are lost.
    curved = np.random.default_rng(7).multivariate_normal(
        estimate.theta, estimate.honest_covariance, 400, method="eigh"
    )
    assert np.std(known.relative(curved)[0]) > 50 * KNOWN


@pytest.mark.parametrize("prior", [0.5, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_wide_prior_on_a_whole_inertia_gives_physical_robots(
    tmp_path: Path, prior: float
) -> None:
    """Nearly all draws of the normal distribution are no bodies, so that replacing them failed."""
    known = KnownMoment(tmp_path, cad_prior=False, prior=prior)
    stages: list[str] = []
    with stages_observed_by(lambda name, *_: stages.append(name)):
        draws = drawn(known.system, known.estimate, 50, 7)
    assert set(stages) == {"drawing robots inside the physical inertias"}
    linear = known.linear(draws.values)
    assert all(map(known.body.is_physical, linear))
    assert known.system.model_at(draws.values[0]).body("link1").mass[0] > 0.0

    # The combinations that the recordings determine stay known, and the mass is not.
    found = known.relative(draws.values)
    assert_allclose(found.std(axis=1), KNOWN, rtol=0.4)
    assert_allclose(found.mean(axis=1), 1.0, atol=KNOWN)
    assert np.std(linear[:, 0]) > 0.1 * np.mean(linear[:, 0])
