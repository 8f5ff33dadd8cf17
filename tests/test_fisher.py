"""Fisher information against its sum, criteria against differences, and what cannot be identified by its name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics import CART_PARAMETERS, cart_setup, relative_error, richardson

from mjfim.designer import design, evaluate_trajectory, standard_deviations
from mjfim.errors import UnidentifiableError
from mjfim.fisher import CRITERIA, Information
from mjfim.plant import CENTRAL
from mjfim.trajectory import Sensitivity

SIGMA = np.array([0.1, 0.5, 2.0])


def random_sensitivity(seed: int, N: int = 12, p: int = 4, nx: int = 5) -> Sensitivity:
    """Any psi and G."""
    rng = np.random.default_rng(seed)
    return Sensitivity(rng.normal(size=(N + 1, nx, p)), rng.normal(size=(N + 1, 3, p)))


def information(stride: int = 1, criterion: str = "E", **changes) -> Information:
    """Three outputs, four parameters of different scale, no prior."""
    base = Information(SIGMA, stride, 50.0, np.array([1.0, 2.0, 0.1, 5.0]), np.zeros((4, 4)), criterion, 1.0)
    return replace(base, **changes)


def spread_matrix(rng: np.random.Generator, p: int = 4) -> np.ndarray:
    """Symmetric positive definite with well separated eigenvalues."""
    Q, _ = np.linalg.qr(rng.normal(size=(p, p)))
    return Q @ np.diag(3.0 ** np.arange(p)) @ Q.T


@pytest.mark.parametrize("stride", [1, 2, 4, 5, 12])
def test_information_is_the_sum_over_measured_samples(stride: int) -> None:
    S, prior = random_sensitivity(1), np.diag([4.0, 0.0, 1.0, 0.0])
    total = prior.copy()
    for k in range(1, 13):
        if k % stride == 0:
            total += S.G[k].T @ np.diag(SIGMA**-2) @ S.G[k]
    made = information(stride, prior=prior)
    assert relative_error(made.matrix(S), total) < 1e-14
    assert made.measured(12).sum() == 12 // stride


def test_information_leaves_out_the_known_start() -> None:
    S = random_sensitivity(2)
    G = np.array(S.G)
    G[0] += 100.0
    np.testing.assert_array_equal(information().matrix(Sensitivity(S.psi, G)), information().matrix(S))
    G[1] += 100.0
    assert np.abs(information().matrix(Sensitivity(S.psi, G)) - information().matrix(S)).max() > 1.0


@pytest.mark.parametrize("criterion", ["E", "A", "D"])
def test_criterion_is_that_of_the_scaled_information_per_second(criterion: str) -> None:
    made, matrix = information(criterion=criterion, weight=3.0), spread_matrix(np.random.default_rng(3))
    S = np.diag(made.scale)
    values = np.linalg.eigvalsh(S @ matrix @ S / 50.0)
    expected = {"E": 1 / values[0], "A": np.sum(1 / values), "D": -np.sum(np.log(values))}[criterion]
    found = made.evaluate(matrix)
    assert found.value == pytest.approx(3.0 * expected, rel=1e-12)
    np.testing.assert_allclose(found.eigenvalues, values, rtol=1e-12)


@pytest.mark.parametrize("criterion", ["E", "A", "D"])
def test_criterion_derivative_is_that_of_differences_in_random_symmetric_directions(criterion: str) -> None:
    rng, made = np.random.default_rng(4), information(criterion=criterion, weight=2.0)
    matrix = spread_matrix(rng)
    found = made.evaluate(matrix)
    M = np.einsum("r,ri,rj->ij", found.weights, found.directions, found.directions) / made.measure_rate
    for _ in range(8):
        d = rng.normal(size=(4, 4))
        d = 0.01 * (d + d.T)
        measured = richardson(lambda t, d=d: made.evaluate(matrix + t * d).value, 0.1)
        assert np.sum(M * d) == pytest.approx(measured, rel=1e-7)
        assert np.sum(1.001 * M * d) != pytest.approx(measured, rel=1e-4)


@pytest.mark.parametrize("criterion", ["E", "A", "D"])
def test_more_information_never_costs_more(criterion: str) -> None:
    rng, made = np.random.default_rng(5), information(criterion=criterion)
    matrix = spread_matrix(rng)
    for _ in range(10):
        g = 0.1 * rng.normal(size=4)
        assert made.evaluate(matrix + np.outer(g, g)).value <= made.evaluate(matrix).value


@pytest.mark.parametrize(("criterion", "rank"), [("E", 1), ("A", 4), ("D", 4)])
def test_criterion_says_how_many_directions_its_gradient_needs(criterion: str, rank: int) -> None:
    found = CRITERIA[criterion](spread_matrix(np.random.default_rng(6)))
    assert found.weights.shape == (rank,)
    assert found.directions.shape == (rank, 4)
    assert (found.weights < 0).all()  # information only ever lowers the cost


@pytest.mark.parametrize("criterion", ["E", "A", "D"])
def test_singular_information_costs_infinity_without_a_warning(criterion: str) -> None:
    for matrix in (np.zeros((4, 4)), np.diag([0.0, 1.0, 2.0, 3.0]), np.diag([-1e-9, 1.0, 1.0, 1.0])):
        assert information(criterion=criterion).evaluate(matrix).value == np.inf


def test_accumulated_smallest_eigenvalue_is_monotone_and_ends_at_the_whole() -> None:
    for stride in (1, 3):
        S, made = random_sensitivity(7), information(stride)
        series = made.accumulated(S)
        assert series.shape == (13,)
        assert (np.diff(series) >= -1e-12 * series[-1]).all()
        assert series[0] == 0.0
        assert series[-1] == pytest.approx(made.evaluate(made.matrix(S)).eigenvalues[0], rel=1e-10)
        half = replace(made, prior=np.zeros((4, 4))).matrix(Sensitivity(S.psi[:7], S.G[:7]))
        assert series[6] == pytest.approx(np.linalg.eigvalsh(made.scaled(half))[0], rel=1e-9, abs=1e-12)


def test_accumulated_starts_at_the_prior() -> None:
    prior = np.diag([9.0, 4.0, 400.0, 1.0])
    made = information(prior=prior)
    assert made.accumulated(random_sensitivity(8))[0] == pytest.approx(4.0 / 50.0)


def test_the_stated_rate_divides_the_sum_so_that_weights_mean_the_same_at_every_rate(tmp_path) -> None:
    (tmp_path / "b").mkdir()
    dense, thin = cart_setup(tmp_path), cart_setup(tmp_path / "b", measure_rate=25.0)
    a, b = (s.problem.point(s.initial) for s in (dense, thin))
    assert relative_error(a.information, b.information) > 1.0  # four times the samples
    assert b.criterion.value == pytest.approx(a.criterion.value, rel=0.3)


def test_information_of_a_real_experiment_is_the_sum_with_its_noise_and_scale(tmp_path) -> None:
    setup = cart_setup(tmp_path, noise={"angle": 0.01, "acc": 0.3}, measure_rate=50.0)
    S = setup.plant.sensitivity(setup.theta, setup.initial)
    sigma = np.array([0.01, 0.3, 0.3, 0.3])
    total = sum(S.G[k].T @ np.diag(sigma**-2) @ S.G[k] for k in range(2, 51, 2))
    evaluation = evaluate_trajectory(setup, setup.initial)
    assert relative_error(evaluation.information, total) < 1e-12
    scaled = total * np.outer(setup.theta, setup.theta) / 50.0  # relative to the guess by default
    assert relative_error(evaluation.eigenvalues, np.linalg.eigvalsh(scaled)) < 1e-9
    assert evaluation.criterion == pytest.approx(1.0 / np.linalg.eigvalsh(scaled)[0], rel=1e-9)
    assert relative_error(evaluation.std, np.sqrt(np.diag(np.linalg.inv(total)))) < 1e-8


def test_noise_of_sensors_defaults_to_the_mjcf(tmp_path) -> None:
    setup = cart_setup(tmp_path, noise={})
    assert setup.outputs.names == ("angle", "rate", "acc[0]", "acc[1]", "acc[2]", "drive")
    np.testing.assert_array_equal(setup.outputs.sigma, [0.01, 0.05, 0.3, 0.3, 0.3, 0.1])


def test_standard_deviations_survive_parameters_of_very_different_size() -> None:
    rng = np.random.default_rng(9)
    unit = spread_matrix(rng)
    scale = np.array([1.0, 1e6, 1e-6, 1.0])
    expected = np.sqrt(np.diag(np.linalg.inv(unit))) / scale
    np.testing.assert_allclose(standard_deviations(unit * np.outer(scale, scale)), expected, rtol=1e-9)
    assert np.isinf(standard_deviations(np.diag([0.0, 1.0]))).all()


PRODUCT = {
    "gear": {"target": "actuator/force:gear[0]"},
    "gain": {"target": "actuator/force:gainprm[0]"},
    "mass": {"target": "body/bob:mass"},
}


def test_two_parameters_that_act_only_as_a_product_are_named(tmp_path) -> None:
    setup = cart_setup(tmp_path, parameters=PRODUCT)
    with pytest.raises(UnidentifiableError) as caught:
        design(setup)
    message = str(caught.value)
    assert "gear" in message
    assert "gain" in message
    assert "mass" not in message
    signs = [message[message.index(f" {name}") - 2 :] for name in ("gear", "gain")]
    assert len(signs) == 2
    # the product is kept when one grows and the other shrinks by as much
    words = message.split()
    values = [float(words[words.index(name) - 1]) for name in ("gear", "gain")]
    assert values[0] == pytest.approx(-values[1], rel=1e-2)


def test_a_prior_on_one_factor_of_the_product_makes_it_identifiable(tmp_path) -> None:
    known = {**PRODUCT, "gear": {"target": "actuator/force:gear[0]", "prior": 0.01}}
    setup = cart_setup(tmp_path, parameters=known)
    point = setup.problem.point(setup.initial, CENTRAL)
    setup.information.require_identifiable(point.information, setup.parameters.names, setup.parameters.step)
    assert np.isfinite(point.cost)


def test_the_null_direction_is_told_in_the_parameters_own_units(tmp_path) -> None:
    changed = {**PRODUCT, "gear": {"target": "actuator/force:gear[0]", "guess": 4.0}}
    setup = cart_setup(tmp_path, parameters=changed)
    with pytest.raises(UnidentifiableError) as caught:
        design(setup)
    words = str(caught.value).split()
    gear, gain = (float(words[words.index(name) - 1]) for name in ("gear", "gain"))
    assert gear / gain == pytest.approx(-4.0, rel=1e-2)  # d(gear gain) = 0 where gear = 4, gain = 1


@pytest.mark.parametrize("angle", [0.0, np.pi], ids=["upright", "hanging, rounded"])
@pytest.mark.parametrize("count", [1, 3])
def test_a_start_at_rest_without_control_is_unidentifiable(count: int, angle: float, tmp_path) -> None:
    rest = {"qpos": (0.0, angle), "control": {"kind": "constant", "amplitude": 0.0}}
    parameters = dict(list(CART_PARAMETERS.items())[-count:])
    setup = cart_setup(tmp_path, initial=rest, parameters=parameters, descent={"max_iterations": 5})
    with pytest.raises(UnidentifiableError):
        design(setup)
