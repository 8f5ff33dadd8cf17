"""Draws of robots: their moments against the honest covariance, their bounds and their inertias."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.stats import chi2, kstest, truncnorm

import mjfim
from mjfim.arrays import scaled_to_unit_diagonal
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System, labels_of_system
from mjfim.identification.assessment.honest_covariance import honest_covariance
from mjfim.identification.assessment.parameter_draws import (
    draw_parameters,
    draw_parameters_system,
)
from mjfim.identification.linear_coordinates import CadPrior, UnknownBody, unknown_bodies
from mjfim.model.inertia import barycentric_of, logcholesky_derivatives
from mjfim.records.estimate import ParameterDraws
from mjfim.records.events import stages_observed_by
from tests.support.cart_pendulum import cart_pendulum
from tests.support.hinged_arm import arm_experiment
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
    guess = system.parameters.guess
    values = {
        "parameters": system.parameters.names,
        "labels": labels_of_system(system),
        "theta": guess,
        "std": np.sqrt(np.diag(covariance)),
        "covariance": covariance,
        "initial_theta": guess,
        "chi2": 1.0,
        "dof": 1,
        "status": "",
        "converged": True,
        "misfit": False,
        "iterations": 1,
        "residual_rms": {},
        "at_bound": (),
        "predicted": (),
        "recordings": (),
    }
    return mjfim.Estimate(**{**values, **fields})


def drawn(system: System, estimate: mjfim.Estimate, count: int, seed: int = 0) -> ParameterDraws:
    """Robots drawn from an estimate."""
    return draw_parameters_system(system, estimate, count, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def system() -> System:
    return System.resolve(cart_pendulum())


@pytest.mark.slow
def test_the_moments_are_those_of_the_formal_covariance(system: System) -> None:
    estimate = estimated(system, COVARIANCE)
    draws = draw_parameters(cart_pendulum(), estimate, 2000, np.random.default_rng(1))
    assert draws.parameters == ("m", "l", "c")
    assert draws.units == ("kg", "m", "N m s/rad")
    assert len(draws) == 2000
    first, again, other = (drawn(system, estimate, 3, seed).values for seed in (0, 0, 1))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    np.testing.assert_allclose(draws.std, STD, rtol=1e-3)

    deviation = draws.values - estimate.theta
    distance = np.einsum("ni,ij,nj->n", deviation, np.linalg.inv(COVARIANCE), deviation)
    assert kstest(distance, chi2(3).cdf).pvalue > 1e-3

    # The test can fail: other correlations do not fit.
    wrong = np.einsum("ni,ij,nj->n", deviation, np.diag(STD**-2), deviation)
    assert kstest(wrong, chi2(3).cdf).pvalue < 1e-6


def test_wide_intervals_stretch_the_covariance_of_earlier_versions(system: System) -> None:
    """The intervals are twice and three times as wide as the formal ones."""
    factor = np.array([2.0, 3.0, 1.0])
    theta = system.parameters.guess
    half = 1.959964 * factor * STD
    estimate = estimated(system, COVARIANCE, interval=np.column_stack([theta - half, theta + half]))
    found = honest_covariance(system.parameters, estimate)
    np.testing.assert_allclose(found, COVARIANCE * np.outer(factor, factor), rtol=1e-5)


@pytest.mark.slow
def test_the_side_that_a_bound_cuts_off_does_not_count(system: System) -> None:
    """The damping ends at its lower bound, and cannot be negative."""
    bounded = estimated(
        system,
        COVARIANCE,
        theta=np.array([2.0, 1.0, 0.0]),
        interval=np.array([[1.9, 2.1], [0.9, 1.1], [0.0, 0.4]]),
    )
    found = honest_covariance(system.parameters, bounded)
    np.testing.assert_allclose(np.sqrt(found[2, 2]), 0.4 / 1.959964, rtol=1e-5)
    draws = drawn(system, bounded, 1000, 2)
    half_normal = truncnorm(0.0, np.inf, scale=0.4 / 1.959964)
    assert kstest(draws.values[:, 2], half_normal.cdf).pvalue > 1e-3

    # Both sides cut off: the deviations that led to the interval remain.
    narrow = System.resolve(cart_pendulum(parameters={"c": {"bounds": [0.9, 1.5]}}))
    cut = replace(bounded, theta=np.array([2.0, 1.0, 1.0]), std=np.array([0.1, 0.1, 2.0]))
    cut = replace(cut, interval=np.array([[1.9, 2.1], [0.9, 1.1], [0.9, 1.5]]))
    assert np.sqrt(honest_covariance(narrow.parameters, cut)[2, 2]) == 2.0
    damping = drawn(narrow, cut, 500, 2).values[:, 2]
    assert 0.9 <= damping.min() < 0.92 and 1.48 < damping.max() <= 1.5


def test_deviations_between_recordings_count(system: System) -> None:
    estimate = estimated(
        system, COVARIANCE, std_sandwich=2.0 * STD, between_recordings=np.array([0.0, 0.0, 0.3])
    )
    found = np.sqrt(np.diag(honest_covariance(system.parameters, estimate)))
    np.testing.assert_allclose(found, [0.04, 0.06, np.hypot(0.2, 0.3)], rtol=1e-3)

    # A parameter with a value for each recording is centred at their mean, and scatters as they do.
    differing = estimated(system, COVARIANCE, per_recording={"c": (1.0, 2.0)})
    draws = drawn(system, differing, 10)
    assert draws.centre[2] == 1.5
    np.testing.assert_allclose(draws.std[2], np.hypot(0.1, np.sqrt(0.5)), rtol=1e-3)


def test_undetermined_parameters_are_named(system: System) -> None:
    infinite = np.array([0.02, np.inf, 0.1])
    covariance = np.diag(infinite**2)
    with pytest.raises(ExperimentError, match=r"do not determine l, so that .*prior"):
        drawn(system, estimated(system, covariance), 5)


@pytest.mark.parametrize("count", [0, -3, 10_001])
def test_counts_out_of_range(system: System, count: int) -> None:
    with pytest.raises(ExperimentError, match=rf"robots is {count}; it must be from 1 to 10000"):
        drawn(system, estimated(system, COVARIANCE), count)


def test_an_estimate_of_another_experiment(system: System) -> None:
    other = replace(estimated(system, COVARIANCE), parameters=("m", "l", "d"))
    with pytest.raises(ExperimentError, match=r"other parameters \(m, l, d\)"):
        drawn(system, other, 5)
    outside = replace(estimated(system, COVARIANCE), theta=np.array([2.0, 1.0, -1.0]))
    with pytest.raises(ExperimentError, match="c lies outside of its bounds"):
        drawn(system, outside, 5)


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
    """Central moments may break the triangle inequality; log-Cholesky coordinates cannot."""
    central = {
        "Ixx": {"target": "body/cart:inertia[0]", "guess": 0.01},
        "Iyy": {"target": "body/cart:inertia[1]", "guess": 0.01},
        "Izz": {"target": "body/cart:inertia[2]", "guess": 0.01},
    }
    base = cart_pendulum()
    values = {**base.model_dump(exclude_unset=True), "directory": MODELS}
    system = System.resolve(mjfim.Experiment(**{**values, "parameters": central}))
    assert system.parameters.names == ("Ixx", "Iyy", "Izz")
    estimate = estimated(system, np.diag(np.full(3, 0.006**2)))
    draws = drawn(system, estimate, 200, 3)
    assert draws.replaced > 20
    assert "replaced" in str(draws)
    moments = np.sort(draws.values, axis=1)
    assert (moments[:, 0] > 0.0).all()
    assert (moments[:, 2] <= (moments[:, 0] + moments[:, 1])).all()

    hopeless = estimated(system, np.diag([0.006**2, 0.006**2, 1e12]))
    with pytest.raises(ExperimentError, match=r"1 of 1 drawn robots still .*cad_prior"):
        drawn(system, hopeless, 1, 3)

    whole = {"cart": {"inertial": "cart"}}
    system = System.resolve(mjfim.Experiment(**{**values, "parameters": whole}))
    covariance: Array = np.diag((0.1 * system.parameters.magnitude) ** 2)
    draws = drawn(system, estimated(system, covariance), 50, 3)
    assert draws.replaced < 10
    for values_of_robot in draws.values:
        model = system.model_at(values_of_robot)
        mujoco.mj_forward(model, mujoco.MjData(model))
        assert model.body("cart").mass[0] > 0.0


# ---- inertias with a CAD prior


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownMoment:
    """A link of which recordings tell the first moment m x and the moment of inertia of its joint.

    Attributes:
        system: The link, with the armature of its joint.
        estimate: Its estimate.
        body: The link.
        moment: (11,) derivatives of m x, to whose value its standard deviation is 0.1 %.
        inertia: (11,) derivatives of the moment of inertia of link and rotor, likewise.
    """

    system: System
    estimate: mjfim.Estimate
    body: UnknownBody
    moment: Array
    inertia: Array

    @staticmethod
    def of(folder: Path, **prior: Any) -> KnownMoment:
        """The estimate with the model as prior knowledge, or with stated priors."""
        tables = {
            "link1": {"inertial": "link1", **prior},
            "armature": {"target": "joint/joint1:armature"},
        }
        system = System.resolve(arm_experiment(folder, 1, parameters=tables))
        parameters = system.parameters
        (body,) = unknown_bodies(parameters)
        guess = parameters.guess
        by_linear = barycentric_of(logcholesky_derivatives(guess[body.columns]))
        linear = body.linear(guess[body.columns])

        # Barycentric coordinates begin with the mass and the first moments.
        moment, inertia = np.zeros((2, 11))
        moment[body.columns] = by_linear[:, 1] / linear[1]
        inertia[body.columns] = by_linear[:, 9] / (linear[9] + guess[10])
        inertia[10] = 1.0 / (linear[9] + guess[10])
        data = sum(np.outer(row, row) / KNOWN**2 for row in (moment, inertia))
        known = CadPrior.of(parameters).information(guess) + parameters.prior_information

        # The coordinates differ in their units, so that the inverse of the scaled matrix is exact.
        scaled, scale = scaled_to_unit_diagonal(data + known)
        inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
        covariance = np.asarray(0.5 * (inverse + inverse.T), dtype=np.float64)
        estimate = estimated(system, covariance, data=data, honest_covariance=covariance)
        return KnownMoment(
            system=system, estimate=estimate, body=body, moment=moment, inertia=inertia
        )

    def relative(self, robots: Array) -> tuple[Array, Array, Array]:
        """(n, 10) linear coordinates of robots, and both known combinations over the estimate's."""
        linear = np.array([self.body.linear(robot[self.body.columns]) for robot in robots])
        theta = self.estimate.theta
        begin = self.body.linear(theta[self.body.columns])
        inertia = (linear[:, 9] + robots[:, 10]) / (begin[9] + theta[10])
        return linear, linear[:, 1] / begin[1], inertia


def test_combinations_that_recordings_know_stay_known(tmp_path: Path) -> None:
    known = KnownMoment.of(tmp_path)
    system, estimate = known.system, known.estimate
    for row in (known.moment, known.inertia):
        np.testing.assert_allclose(
            np.sqrt(row @ estimate.honest_covariance @ row), KNOWN, rtol=1e-3
        )
    draws = drawn(system, estimate, 400, 7)
    assert draws.held_combinations == 9
    assert "9 combinations of inertias that the recordings do not determine" in str(draws)

    # Standard deviations of 400 draws scatter by 3.5 %.
    linear, *combinations = known.relative(draws.values)
    for values in combinations:
        assert np.std(values) == pytest.approx(KNOWN, rel=0.12)
        assert np.mean(values) == pytest.approx(1.0, abs=4 * KNOWN / 20)
    assert all(known.body.is_physical(each) for each in linear)

    # Along straight lines of log-Cholesky coordinates, they are lost.
    curved = np.random.default_rng(7).multivariate_normal(
        estimate.theta, estimate.honest_covariance, 400, method="eigh"
    )
    assert np.std(known.relative(curved)[1]) > 50 * KNOWN


@pytest.mark.parametrize("prior", [0.5, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_wide_prior_on_a_whole_inertia_gives_physical_robots(
    tmp_path: Path, prior: float
) -> None:
    """Nearly all draws of the normal distribution are no bodies, so that replacing them failed."""
    known = KnownMoment.of(tmp_path, cad_prior=False, prior=prior)
    system = known.system
    stages: list[str] = []
    with stages_observed_by(lambda name, *_: stages.append(name)):
        draws = drawn(system, known.estimate, 50, 7)
    assert set(stages) == {"drawing robots inside the physical inertias"}
    linear, *combinations = known.relative(draws.values)
    assert all(known.body.is_physical(each) for each in linear)
    for values_of_robot in draws.values[:5]:
        assert system.model_at(values_of_robot).body("link1").mass[0] > 0.0

    # The combinations that the recordings determine stay known, and the mass is not.
    for values in combinations:
        assert 0.65 * KNOWN < np.std(values) < 1.4 * KNOWN
        assert np.mean(values) == pytest.approx(1.0, abs=KNOWN)
    assert np.std(linear[:, 0]) > 0.1 * np.mean(linear[:, 0])
