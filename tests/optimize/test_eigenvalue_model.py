"""The model of the smooth E-criterion: its derivatives, its derivation and its proximal step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm, logm
from scipy.optimize import minimize

from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.information.criteria import smooth_e_optimality
from mjfim.optimize.cost_models import EigenvalueModel, symmetric_matrix
from tests.support.numerics import Array, cart_task, relative_error

LIMITS = {"control": {"force": (-9.0, 9.0)}}
VALUES = {"apart": [0.5, 0.85, 2.0], "meeting": [0.5, 0.5 + 5e-10, 0.525]}


def model_of(values: list[float], power: float = 12.0) -> EigenvalueModel:
    """A model without derivatives by state and control."""
    m = len(values) * (len(values) + 1) // 2
    return EigenvalueModel(
        eigenvalues=np.array(values),
        power=power,
        weight=0.6,
        a=np.zeros((m, 2, 1)),
        b=np.zeros((m, 1, 1)),
    )


def value(model: EigenvalueModel, d: Array) -> float:
    """Change of a model from the point about which it was made, at coordinates of B."""
    return model._expanded(d)[0] - model._expanded(np.zeros_like(d))[0]


def coordinates(full: Array) -> Array:
    """Coordinates of a symmetric matrix: its upper triangle, with entries that occur twice."""
    rows, columns = np.triu_indices(len(full))
    return full[rows, columns] * np.where(rows == columns, 1.0, np.sqrt(2.0))


def test_coordinates_keep_scalar_products() -> None:
    rng = np.random.default_rng(0)
    for r in (1, 2, 4):
        d, e = rng.normal(size=(2, r * (r + 1) // 2))
        assert_allclose(coordinates(symmetric_matrix(d, r)), d)
        assert_array_equal(symmetric_matrix(d, r), symmetric_matrix(d, r).T)
        assert np.sum(symmetric_matrix(d, r) * symmetric_matrix(e, r)) == pytest.approx(d @ e)


@pytest.mark.parametrize("values", VALUES)
def test_the_model_is_the_criterion_of_changed_information(values: str) -> None:
    """It is the weighted `log phi` of an information whose logarithm changes by B."""
    rng, model = np.random.default_rng(1), model_of(VALUES[values])

    def expected(d: Array) -> float:
        moved = np.diag(np.log(model.eigenvalues)) + symmetric_matrix(d, 3)
        return model.weight * np.log(
            smooth_e_optimality(np.asarray(expm(moved)), model.power).value
        )

    zero = np.zeros(6)
    assert value(model, zero) == 0.0
    for size in (1e-3, 0.3, 3.0):
        d = size * rng.normal(size=6)
        assert value(model, d) == pytest.approx(expected(d) - expected(zero), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("values", [*VALUES.values(), [0.5]])
def test_derivatives_agree_with_differences_and_the_model_is_convex(values: list[float]) -> None:
    rng, model = np.random.default_rng(2), model_of(values)
    units = np.eye(len(model.a))
    for size in (0.0, 0.05, 1.0):
        d, e = rng.normal(size=(2, len(units)))
        d = size * d
        slopes = [(value(model, d + h) - value(model, d - h)) / 2e-5 for h in 1e-5 * units]
        assert relative_error(model.gradient(d), np.array(slopes)) < 1e-6
        bends = [(model.gradient(d + h) - model.gradient(d - h)) / 2e-6 for h in 1e-6 * units]
        assert_allclose(model._expanded(d)[2], bends, rtol=0, atol=1e-6)
        assert value(model, d + e) + value(model, d - e) >= 2 * value(model, d) - 1e-12


@pytest.mark.parametrize("values", VALUES)
def test_the_minimising_gradient_solves_the_proximal_problem(values: str) -> None:
    """With a singular spread, coordinates that no step can change keep their values."""
    rng, model = np.random.default_rng(3), model_of(VALUES[values][:2])
    for rank in (3, 1):
        root = rng.normal(size=(3, rank))
        spread, d0 = root @ root.T, 0.2 * rng.normal(size=3)

        def cost(y: Array, root: Array = root, d0: Array = d0) -> float:
            return value(model, d0 + root @ y) + 0.5 * (y @ y)

        w = model.minimising_gradient(d0, spread)
        best = minimize(cost, np.zeros(rank), method="BFGS", options={"gtol": 1e-10})
        assert_allclose(d0 - spread @ w, d0 + root @ best.x, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "tables",
    [
        {},
        {"nuisance": {"initial": {"qpos:slide": 0.05}}},
        {
            "nuisance": {"delay": 0.02},
            "noise": {"angle": 0.05, "acc": 0.3},
            "measure_rate": 50.0,
        },
    ],
    ids=["plain", "nuisance", "delay and sensors"],
)
def test_slopes_agree_with_the_logarithm_of_simulated_information(
    tables: Any, tmp_path: Path
) -> None:
    """Compare along random controls, in the eigenvectors of the point, also off the diagonal."""
    task = cart_task(tmp_path, limits=LIMITS, **tables).relaxed()
    information = replace(task.problem.information, power=3.0, negligible_weight=0.0)
    problem = replace(task.problem, information=information)
    point = problem.point(task.initial)
    expansion, _ = problem.expand_observed(point, constraint_set_of(task).observations)
    model = expansion.eigenvalue_model
    assert len(model.eigenvalues) == 3
    vectors = np.linalg.eigh(information.reduced(point.information)[0])[1]

    def logarithm(ctrl: Array) -> Array:
        moved = problem.point(task.plant.simulate(task.theta, ctrl)).information
        inside = logm(information.reduced(moved)[0])
        return coordinates(np.real(vectors.T @ inside @ vectors))

    rng, open_loop = np.random.default_rng(5), np.zeros((task.samples, 1, 4))
    for _ in range(3):
        way = np.cos(2 * np.pi * rng.uniform(0.3, 3.0) * task.t + rng.uniform(0, 6))[:, None]
        zeta = expansion.lift(open_loop, way)
        found = np.sum(model.a * zeta.z, axis=(1, 2)) + np.sum(model.b * zeta.v, axis=(1, 2))
        slope = (logarithm(task.control + 1e-3 * way) - logarithm(task.control - 1e-3 * way)) / 2e-3
        assert relative_error(found, slope) < 5e-3


def test_other_criteria_and_expansions_without_limits_have_no_model(tmp_path: Path) -> None:
    task = cart_task(tmp_path, limits=LIMITS).relaxed()
    point = task.problem.point(task.initial)
    expansion, _ = task.problem.expand_observed(point, constraint_set_of(task).observations)
    assert expansion.eigenvalue_model is None  # 1 / lambda_min itself
    smooth = replace(task.problem, information=replace(task.problem.information, power=40.0))
    assert smooth.expand(smooth.reevaluated(point)).eigenvalue_model is None
