"""Fisher information against its sum, nuisance and combinations against the full inverse, and what
cannot be identified.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from mjfim.excitation.design import design_task
from mjfim.excitation.evaluation import evaluate_task
from mjfim.information.criteria import standard_deviations
from mjfim.information.fisher import FisherInformation
from mjfim.plant.outputs import Noise
from mjfim.records.trajectory import Sensitivity
from tests.support.numerics import (
    PRODUCT,
    cart_task,
    relative_error,
    richardson,
    sensitivity_of,
)

SIGMA = np.array([0.1, 0.5, 2.0])


def information(stride: int = 1, criterion: str = "E", **changes) -> FisherInformation:
    """Three outputs, four parameters of different scale, no prior."""
    noise = Noise(covariance=np.diag(SIGMA**2), strides=np.full(len(SIGMA), stride))
    base = FisherInformation(
        noise=noise,
        measure_rate=50.0,
        scale=np.array([1.0, 2.0, 0.1, 5.0]),
        prior=np.zeros((4, 4)),
        criterion=criterion,
        weight=1.0,
    )
    return replace(base, **changes)


def spread_matrix(rng: np.random.Generator) -> np.ndarray:
    """Symmetric positive definite with well separated eigenvalues."""
    Q, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return Q @ np.diag(3.0 ** np.arange(4)) @ Q.T


@pytest.mark.parametrize("criterion", ["E", "A", "D"])
def test_criterion_is_that_of_the_scaled_information_per_second(criterion: str) -> None:
    made = information(criterion=criterion, weight=3.0)
    matrix = spread_matrix(default_rng(3))
    S = np.diag(made.scale)
    values = np.linalg.eigvalsh(S @ matrix @ S / 50.0)
    expected = {"E": 1 / values[0], "A": np.sum(1 / values), "D": -np.sum(np.log(values))}
    found = made.evaluate(matrix)
    assert found.value == pytest.approx(3.0 * expected[criterion], rel=1e-12)
    assert_allclose(found.eigenvalues, values, rtol=1e-12)


NUISANCE = {"interest": np.array([0, 2])}
TILTED = np.linalg.qr(default_rng(12).normal(size=(2, 1)))[0]
SEEN = {
    "everything": {},
    "nuisance": NUISANCE,
    "combinations": {"basis": np.linalg.qr(default_rng(11).normal(size=(4, 2)))[0]},
    "both": {**NUISANCE, "basis": TILTED},
}
PHI = {
    "E": {},
    "E smooth": {"power": 3.0},
    "A": {"criterion": "A"},
    "D": {"criterion": "D"},
    "c": {"criterion": "c"},
}


def seeing(phi: str, seen: str) -> FisherInformation:
    """A criterion of the wanted parameters or of some combinations only."""
    wanted = 4 if seen in ("everything", "combinations") else 2
    contrast = {"contrast": np.arange(1.0, 2 * wanted + 1).reshape(wanted, 2)} if phi == "c" else {}
    return information(weight=2.0, **PHI[phi], **SEEN[seen], **contrast)


@pytest.mark.parametrize("seen", SEEN)
@pytest.mark.parametrize("phi", PHI)
def test_derivative_through_nuisance_and_combinations_is_that_of_differences(
    phi: str, seen: str
) -> None:
    rng, made = default_rng(4), seeing(phi, seen)
    matrix = spread_matrix(rng)
    found = made.evaluate(matrix)
    M = (found.directions.T * found.weights) @ found.directions / made.measure_rate
    for d in 0.01 * rng.normal(size=(6, 4, 4)):
        d = d + d.T
        measured = richardson(lambda t, d=d: made.evaluate(matrix + t * d).value, 0.1)
        assert np.sum(M * d) == pytest.approx(measured, rel=1e-7)


def test_the_information_without_nuisance_is_the_inverse_of_the_block_of_the_full_inverse() -> None:
    matrix, t = spread_matrix(default_rng(13)), NUISANCE["interest"]
    made = information(**NUISANCE)
    scaled = made.scaled(matrix)
    R, P = made.reduced(matrix)
    assert_allclose(np.linalg.inv(R), np.linalg.inv(scaled)[np.ix_(t, t)], rtol=1e-10)
    assert_allclose(R, P @ scaled @ P.T, rtol=1e-10)
    assert_allclose(made.covariance(matrix), np.linalg.inv(matrix)[np.ix_(t, t)], rtol=1e-10)


def test_nuisances_that_are_confounded_with_each_other_do_not_matter() -> None:
    """There is twice one nuisance, and one of no effect."""
    J = default_rng(15).normal(size=(20, 3))
    same = np.column_stack([J[:, :2], 1e3 * J[:, 1], J[:, 2], np.zeros(20)])
    found, plain = (
        information(
            prior=np.zeros((p, p)), scale=np.ones(p), interest=np.array([0, last])
        ).evaluate(rows.T @ rows)
        for rows, p, last in ((same, 5, 3), (J, 3, 2))
    )
    assert found.value == pytest.approx(plain.value, rel=1e-7)
    assert np.isfinite(found.directions).all()


def test_a_wanted_parameter_confounded_with_a_nuisance_has_an_infinite_criterion() -> None:
    J = default_rng(16).normal(size=(20, 3))
    J[:, 1] = 2.0 * J[:, 2]
    made = information(prior=np.zeros((3, 3)), scale=np.ones(3), interest=np.array([0, 1]))
    assert made.evaluate(J.T @ J).value == np.inf
    assert np.isnan(made.covariance(J.T @ J)).all()


def test_combinations_project_the_information_and_show_which_parameters_are_identifiable() -> None:
    """The experiment tells three numbers: the first and last parameter, and the sum of others."""
    told = default_rng(17).normal(size=(30, 3))
    J = told[:, [0, 1, 1, 2]]
    half = np.sqrt(0.5)
    basis = np.array([[1.0, 0.0, 0.0], [0.0, half, 0.0], [0.0, half, 0.0], [0.0, 0.0, 1.0]])
    made = information(basis=basis, scale=np.array([1.0, 2.0, 2.0, 5.0]))
    matrix, exact = J.T @ J, np.linalg.inv(told.T @ told)
    covariance, known = made.covariance(matrix), np.ix_([0, 3], [0, 3])
    assert_allclose(covariance[known], exact[np.ix_([0, 2], [0, 2])], rtol=1e-9)
    assert np.isnan(covariance[1:3]).all()
    std = np.sqrt(np.diag(exact))
    assert_allclose(made.std(matrix), [std[0], np.inf, np.inf, std[2]], rtol=1e-9)
    with_prior = replace(made, prior=np.diag([0.0, 4.0, 0.0, 0.0]))
    total = matrix + with_prior.prior
    assert_allclose(with_prior.covariance(total), np.linalg.inv(total), rtol=1e-7, atol=1e-12)


def test_criterion_c_without_a_contrast_is_refused() -> None:
    with pytest.raises(ValueError, match="contrast"):
        information(criterion="c").evaluate(np.eye(4))


def test_long_trajectories_have_accumulated_standard_deviations_that_are_not_too_small() -> None:
    rng = default_rng(3)
    S = Sensitivity(psi=np.zeros((1501, 1, 4)), G=rng.normal(size=(1501, 3, 4)))
    made = information()
    found = made.accumulated_std(S)
    assert (np.diff(found[10:], axis=0) <= 0.0).all()
    assert_allclose(found[-1], made.std(made.matrix(S)), rtol=1e-10)
    for k in (100, 777, 1403):
        upto = made.std(made.matrix(Sensitivity(psi=S.psi[: k + 1], G=S.G[: k + 1])))
        assert (found[k] >= upto * (1.0 - 1e-12)).all()
        assert_allclose(found[k], upto, rtol=0.03)


def test_information_of_a_real_experiment_is_the_sum_with_its_noise_and_scale(tmp_path) -> None:
    task = cart_task(tmp_path, noise={"angle": 0.01, "acc": 0.3}, measure_rate=50.0)
    S = sensitivity_of(task)
    sigma = np.array([0.01, 0.3, 0.3, 0.3])
    total = sum(S.G[k].T @ np.diag(sigma**-2) @ S.G[k] for k in range(2, 51, 2))
    evaluation = evaluate_task(task, task.initial)
    assert relative_error(evaluation.information, total) < 1e-12
    scaled = total * np.outer(task.theta, task.theta) / 50.0  # relative to the guess by default
    assert relative_error(evaluation.eigenvalues, np.linalg.eigvalsh(scaled)) < 1e-9
    assert evaluation.criterion == pytest.approx(1.0 / np.linalg.eigvalsh(scaled)[0], rel=1e-9)
    assert relative_error(evaluation.std, np.sqrt(np.diag(np.linalg.inv(total)))) < 1e-8


def test_standard_deviations_survive_parameters_of_very_different_size() -> None:
    rng = default_rng(9)
    unit = spread_matrix(rng)
    scale = np.array([1.0, 1e6, 1e-6, 1.0])
    expected = np.sqrt(np.diag(np.linalg.inv(unit))) / scale
    assert_allclose(standard_deviations(unit * np.outer(scale, scale)), expected, rtol=1e-9)
    assert np.isinf(standard_deviations(np.diag([0.0, 1.0]))).all()


@pytest.mark.parametrize("interest", [None, np.array([0, 2])])
def test_information_and_accumulated_deviations_are_those_of_a_plain_sum(
    interest: np.ndarray | None,
) -> None:
    """Priors, correlated noise and nuisance parameters count; the known start does not."""
    rng, strides = default_rng(7), np.array([1, 2, 3])
    S = Sensitivity(psi=rng.normal(size=(13, 5, 4)), G=rng.normal(size=(13, 3, 4)))
    covariance = np.array([[0.01, 0.03, 0.0], [0.03, 0.25, 0.0], [0.0, 0.0, 4.0]])
    made = replace(
        information(),
        noise=Noise(covariance=covariance, strides=strides),
        prior=np.diag([0.0, 4.0, 400.0, 1.0]),
        interest=interest,
    )
    found, total = made.accumulated_std(S), np.array(made.prior)
    assert found.shape == (13, 4)
    assert np.isinf(found[0]).all()
    for k in range(1, 13):
        rows = np.flatnonzero(k % strides == 0)
        total += S.G[k][rows].T @ np.linalg.inv(covariance[np.ix_(rows, rows)]) @ S.G[k][rows]
        if np.linalg.matrix_rank(total) == 4:
            assert_allclose(found[k], np.sqrt(np.diag(np.linalg.inv(total))), rtol=1e-8)
    assert relative_error(made.matrix(S), total) < 1e-13
    assert_allclose(found[-1], made.std(total), rtol=1e-10)
    assert made.noise.measured(12).sum() == 12 + 6 + 4


def test_a_product_is_designed_on_what_can_be_identified_of_it(tmp_path) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT, descent={"max_iterations": 4})
    result = design_task(task)
    assert result.combinations == ("gear and gain only as gear + gain",)
    assert result.final.cost < 0.9 * result.initial.cost
    assert np.isinf(result.final.std[:2]).all()
    # one factor alone tells as much about the mass as both
    alone = {name: PRODUCT[name] for name in ("gain", "mass")}
    single = evaluate_task(cart_task(tmp_path, parameters=alone), result.trajectory)
    assert result.final.std[2] == pytest.approx(single.std[1], rel=1e-5)
    # the criterion sees (gear + gain) / sqrt(2) and the mass, in units of their guesses
    T = np.array([[np.sqrt(0.5), 0.0], [np.sqrt(0.5), 0.0], [0.0, 1.5]])
    seen = np.linalg.eigvalsh(T.T @ result.final.information @ T / task.system.measure_rate)
    assert_allclose(result.final.eigenvalues, seen, rtol=1e-6)

    # coefficients are in the units of the parameters: d(gear gain) = d gear + 4 d gain
    changed = {**PRODUCT, "gear": {**PRODUCT["gear"], "guess": 4.0}}
    four = design_task(cart_task(tmp_path, parameters=changed, descent={"max_iterations": 0}))
    assert four.combinations == ("gear and gain only as gear + 4 gain",)
