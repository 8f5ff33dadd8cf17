"""Samples of the parameters, pooled criteria, and designs for the worst parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation.design import design_task
from mjfim.excitation.objective import ParameterSamples
from mjfim.excitation.task import DesignTask
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.model.parameters import Parameter, ParameterSet, sample_parameters
from mjfim.records.design import Design
from tests.support.numerics import CART_PARAMETERS, Array, body_task, cart_task

KINDS = {
    "mean": ("mean", False),
    "worst": ("worst", False),
    "worst D": ("worst", True),
    "mean D": ("mean", True),
}


def pool(kind: str, count: int = 4) -> ParameterSamples:
    """Samples with any parameter values."""
    over, logarithmic = KINDS[kind]
    return ParameterSamples(thetas=np.zeros((count, 1)), over=over, logarithmic=logarithmic)


def unknowns(*parameters: dict) -> ParameterSet:
    """Parameters without targets."""
    built = tuple(
        Parameter(name=f"p{i}", targets=(), **{"guess": 0.0, **p}) for i, p in enumerate(parameters)
    )
    return ParameterSet(built)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e9])
@pytest.mark.parametrize("kind", KINDS)
def test_weights_are_the_derivative_of_the_pooled_value(kind: str, size: float) -> None:
    size = 1.0 if KINDS[kind][1] else size  # the logarithm of D has no scale
    phi, made = size * np.array([1.0, 1.05, 0.7, 1.1]), pool(kind)
    for j, weight in enumerate(made.weights(phi)):
        h = 1e-5 * size * np.eye(4)[j]
        measured = (made.value(phi + h) - made.value(phi - h)) / (2e-5 * size)
        assert weight == pytest.approx(measured, rel=1e-6)
        assert 1.01 * weight != pytest.approx(measured, rel=1e-3)


def test_the_mean_is_the_mean_and_the_worst_lies_just_below_the_largest() -> None:
    """D is a logarithm, so its pool is that of exp(phi)."""
    phi = np.array([1.0, 2.0, 10.0, 3.0])
    assert pool("mean").value(phi) == 4.0
    assert pool("worst").value(phi) == pytest.approx(4.0 ** (-1.0 / 20.0) * 10.0, rel=1e-9)
    expected = np.log(pool("worst").value(np.exp(phi)))
    assert pool("worst D").value(phi) == pytest.approx(expected, rel=1e-9)
    for made in map(pool, KINDS):
        assert made.value(np.full(4, 3.0)) == pytest.approx(3.0)
        assert made.weights(np.full(4, 3.0)) == pytest.approx(0.25)
        for bad in (np.inf, np.nan):
            assert made.value([1.0, bad, 2.0, 3.0]) == np.inf


@pytest.mark.parametrize("shift", [-900.0, 900.0])
def test_pooling_a_logarithm_below_zero_works_and_does_not_overflow(shift: float) -> None:
    phi, made = np.array([0.0, 0.5, 1.0, 0.2]), pool("worst D")
    assert made.value(shift + phi) - shift == pytest.approx(made.value(phi), rel=1e-9)
    assert_allclose(made.weights(shift + phi), made.weights(phi), rtol=1e-9)


def test_samples_fill_bounds_evenly_and_begin_with_the_guess() -> None:
    parameters = unknowns(
        {"bounds": (1.0, 3.0), "guess": 2.5}, {"bounds": (-1e6, 1e6)}, {"guess": 7.0}
    )
    drawn = sample_parameters(parameters, parameters.guess, 21, seed=3)
    again, other = (sample_parameters(parameters, parameters.guess, 21, seed) for seed in (3, 2))
    assert_array_equal(drawn, again)
    assert not np.array_equal(drawn, other)
    assert_array_equal(drawn[0], [2.5, 0.0, 7.0])
    assert_array_equal(drawn[:, 2], 7.0)  # neither prior nor bounds: it stays
    shares = (drawn[1:, :2] - [1.0, -1e6]) / [2.0, 2e6]
    strata = np.sort(np.floor(20 * shares), axis=0)
    assert_array_equal(strata, np.arange(20)[:, None] * [1, 1])  # a Latin hypercube
    assert abs(np.corrcoef(shares.T)[0, 1]) < 0.7


def test_samples_of_a_prior_are_normal_and_within_bounds() -> None:
    parameters = unknowns(
        {"prior": 0.5, "guess": 2.0}, {"prior": 1.0, "bounds": (-0.2, np.inf)}, {"prior": 1e3}
    )
    drawn = sample_parameters(parameters, parameters.guess, 2001, seed=0)[1:]
    z = (drawn - parameters.guess) / [0.5, 1.0, 1e3]
    assert np.abs(z).max() == 2.5
    assert drawn[:, 1].min() == -0.2
    inside = z[np.abs(z[:, 0]) < 2.5, 0]
    strata = np.floor(norm.cdf(inside) * 2000)
    assert len(np.unique(strata)) == len(inside)
    assert z[:, 0].std() == pytest.approx(1.0, rel=0.03)


def test_parameters_without_prior_and_bounds_cannot_be_sampled(tmp_path) -> None:
    for half in ({}, {"bounds": (0.0, np.inf)}):
        with pytest.raises(ExperimentError, match="prior or bounds"):
            sample_parameters(unknowns(half), np.zeros(1), 3, 0)
    bounded = {"m": {**CART_PARAMETERS["m"], "bounds": (1.0, 2.0)}}
    metric = {"method": "metric", "psi_weight": 1.0}
    for tables, message in (
        ({"robust": {"samples": 3}}, "robust: no parameter has"),
        ({"robust": {"samples": 1}}, "samples"),
        ({"parameters": bounded, "robust": {}, "descent": metric}, "psi_weight"),
    ):
        with pytest.raises(ExperimentError, match=message):
            cart_task(tmp_path, **tables)


# Wide bounds: the length of the pendulum is known within a factor of three only, and a control that
# suits one length does not suit another.
VAGUE = {
    "m": {**CART_PARAMETERS["m"], "bounds": (1.0, 2.2)},
    "l": {**CART_PARAMETERS["l"], "bounds": (0.5, 1.4)},
    "c": {**CART_PARAMETERS["c"], "bounds": (0.2, 0.8)},
}


def vague_task(folder: Path, **tables: object) -> DesignTask:
    """Cart-pendulum for two seconds."""
    shared = {"parameters": VAGUE, "horizon": 2.0, "cost": {"control": 1e-4}}
    return cart_task(folder, **{**shared, **tables})


def phis(task: DesignTask, control: Array, thetas: Array) -> Array:
    """The criterion at several parameter values, each along its trajectory."""
    found = []
    for theta in thetas:
        sensitivity = task.plant.derivatives.sensitivity(theta, task.plant.simulate(theta, control))
        found.append(task.information.evaluate(task.information.matrix(sensitivity)).value)
    return np.array(found)


@pytest.mark.slow
def test_the_cost_is_the_pooled_criterion_of_separate_experiments_at_the_samples(tmp_path) -> None:
    task = vague_task(tmp_path, robust={"over": "worst", "samples": 5, "seed": 2})
    thetas = task.samples_of_parameters.thetas
    assert thetas.shape == (5, 3)
    assert (thetas >= task.parameters.lower).all() and (thetas <= task.parameters.upper).all()
    point = task.problem.point(task.initial)
    alone = phis(task, task.control, thetas)
    assert_allclose(point.phi, alone, rtol=1e-6)
    running = task.problem.running.value(task.initial)
    assert point.cost == pytest.approx(task.samples_of_parameters.value(alone) + running, rel=1e-6)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[DesignTask, Design]:
    """The task of a design at the guess, and its design."""
    task = vague_task(tmp_path_factory.mktemp("nominal"))
    return task, design_task(task)


@pytest.mark.slow
@pytest.mark.parametrize(("over", "pooled"), [("worst", np.max), ("mean", np.mean)])
def test_a_robust_design_is_better_at_its_samples_than_the_nominal_design(
    over: str, pooled: Any, plain: Any, tmp_path
) -> None:
    nominal, plain = plain
    robust = vague_task(tmp_path, robust={"over": over, "samples": 5, "seed": 2})
    made = design_task(robust, initial_control=plain.trajectory.ctrl)
    assert plain.status.success and made.status.success

    # It is better at its samples, and at samples that neither design knows.
    fresh = sample_parameters(robust.parameters, robust.theta, 9, seed=7)[1:]
    for thetas in (robust.samples_of_parameters.thetas, fresh):
        ours, theirs = (phis(nominal, each.trajectory.ctrl, thetas) for each in (made, plain))
        assert pooled(ours) < 0.9 * pooled(theirs)

    # Each design is the better one by the cost that it minimises.
    for task, own, other in ((robust, made, plain), (nominal, plain, made)):
        crossed = task.problem.point(task.plant.simulate(task.theta, other.trajectory.ctrl))
        assert own.final.cost < 0.9 * crossed.cost


def test_samples_of_an_inertia_are_bodies(tmp_path) -> None:
    table = {"B": {"inertial": "hull", "coordinates": "barycentric", "prior": 0.5}}
    task = body_task(tmp_path, parameters=table, robust={"samples": 8})
    thetas = task.samples_of_parameters.thetas
    writer, source = ParameterWriter(task.parameters), task.plant.source
    free = sample_parameters(task.parameters, task.theta, 8, 0)
    assert any(writer.unphysical_bodies(source, theta) for theta in free)
    moments = np.array([task.plant.model(theta).body("hull").inertia for theta in thetas])
    assert moments.min() > 0.0
    assert (2.0 * moments.max(axis=1) <= moments.sum(axis=1) * (1.0 + 1e-6)).all()
    assert len(np.unique(thetas, axis=0)) == 8

    # Where halving the distance to the guess does not help, samples end there.
    drawn = sample_parameters(task.parameters, task.theta, 3, 0, lambda row: range(len(row)))
    assert_array_equal(drawn, [task.theta] * 3)


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{}, {"control": {"force": (-15.0, 15.0)}}])
def test_workers_evaluate_the_samples_as_one_process_does(limits: Any, tmp_path: Path) -> None:
    robust = {"robust": {"samples": 3}, "parameters": VAGUE, "descent": {"max_iterations": 3}}
    task = cart_task(tmp_path, limits=limits, **robust)
    alone = design_task(task)
    with mjfim.Pool(2) as executor:
        found = design_task(DesignTask.resolve(task.experiment, threads=1), executor=executor)

    assert np.array_equal(found.trajectory.ctrl, alone.trajectory.ctrl)
    assert [row.cost for row in found.history] == [row.cost for row in alone.history]
