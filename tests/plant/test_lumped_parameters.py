"""Sensitivities of parameters that follow from those of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.excitation.levels import DescentLevel
from mjfim.optimize.lq import TangentCurve
from mjfim.plant.lumped_parameters import LumpedParameters
from tests.support.numerics import body_task, cart_task

# The force of the cart is the product of the gain and the gear of its motor.
PRODUCT = {
    "gear": {"target": "actuator/force:gear[0]"},
    "gain": {"target": "actuator/force:gainprm[0]"},
    "mass": {"target": "body/bob:mass"},
}

# The combination of gear, gain and mass that does not change the force, and one that does.
WITHOUT_EFFECT = np.array([[1.0], [-1.0], [0.0]])
WITH_EFFECT = np.array([[1.0], [1.0], [0.0]])


@pytest.mark.parametrize("central", [True, False])
def test_columns_of_lumped_parameters_follow_from_those_of_the_others(
    tmp_path, central: bool
) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT)
    derivatives = task.plant.derivatives
    lumped = LumpedParameters.of(WITHOUT_EFFECT, task.parameters.magnitude)
    assert lumped is not None and len(lumped.base) == 2

    full = derivatives.sensitivity(task.theta, task.initial, central=central)
    found = derivatives.sensitivity(task.theta, task.initial, central=central, lumped=lumped)
    assert full is not None and found is not None and found.is_lumped

    # One-sided differences are accurate to their step only.
    accuracy = 1e-8 if central else 1e-4
    np.testing.assert_array_equal(found.G[..., lumped.base], full.G[..., lumped.base])
    for few, all_moved in ((found.G, full.G), (found.psi, full.psi)):
        np.testing.assert_allclose(
            few, all_moved, rtol=accuracy, atol=accuracy * np.abs(all_moved).max()
        )


def test_a_combination_that_has_an_effect_is_found_out_and_all_parameters_are_moved(
    tmp_path,
) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT)
    derivatives = task.plant.derivatives
    lumped = LumpedParameters.of(WITH_EFFECT, task.parameters.magnitude)
    assert lumped is not None

    full = derivatives.sensitivity(task.theta, task.initial)
    found = derivatives.sensitivity(task.theta, task.initial, lumped=lumped)
    assert full is not None and found is not None and not found.is_lumped
    np.testing.assert_array_equal(found.G, full.G)
    np.testing.assert_array_equal(found.psi, full.psi)


def test_a_level_moves_only_the_parameters_that_are_not_lumped(tmp_path) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT)
    scaled = WITHOUT_EFFECT / task.parameters.scale[:, None]
    basis = np.linalg.qr(scaled, mode="complete")[0][:, 1:]
    level = DescentLevel(task, basis)

    trajectory = task.initial
    before = task.plant.engine_steps
    point = level.problem.point(trajectory)
    rollouts = (task.plant.engine_steps - before) / (task.samples * task.plant.simulator.substeps)

    # Two parameters and the probe, by one-sided or two-sided differences.
    assert rollouts in (3, 6)
    assert np.isfinite(point.cost)
    assert level.problem.lumped is not None and point.lumps


def test_a_search_that_goes_on_elsewhere_still_moves_all_parameters(tmp_path) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT)
    lumped = LumpedParameters.of(WITH_EFFECT, task.parameters.magnitude)
    point = replace(task.problem, lumped=lumped).point(task.initial)
    assert not point.lumps
    assert point.cost == task.problem.point(task.initial).cost

    # A later part of a search has a problem of its own, which does not simulate the probe again.
    N, nu = task.initial.ctrl.shape
    zeta = TangentCurve(z=np.zeros((N + 1, task.space.nx)), v=np.full((N, nu), 0.01))
    K = np.zeros((N, nu, task.space.nx))
    steps, costs = [], []
    for problem in (replace(task.problem, lumped=lumped), task.problem):
        before = task.plant.engine_steps
        moved = problem.project(point, zeta, 1.0, K)
        steps.append(task.plant.engine_steps - before)
        costs.append(moved.cost)
        assert not moved.lumps
    assert steps[0] == steps[1] and costs[0] == costs[1]


def test_an_output_that_shows_round_off_only_does_not_prevent_lumping(tmp_path) -> None:
    task = body_task(tmp_path)
    p, ny = len(task.parameters), len(task.plant.outputs)
    direction = np.eye(p)[:, :1] - np.eye(p)[:, 1:2]
    lumped = LumpedParameters.of(direction * task.parameters.magnitude[:, None], np.ones(p))
    assert lumped is not None

    # The effects cancel in every output but the last, whose values of 1 have an effect of 1e-11.
    psi = np.ones((5, task.space.nx, p)) / task.parameters.magnitude
    G = np.ones((5, ny, p)) / task.parameters.magnitude
    G[:, -1] *= 1e-11
    dx = np.zeros((5, task.space.nx))
    dy = np.zeros((5, ny))
    dy[:, -1] = 1e-11
    explained = task.plant.derivatives._is_explained
    assert explained(lumped, psi, G, np.ones(ny), dx, dy)

    # An effect that is no round-off counts.
    dy[:, 0] = 1.0
    assert not explained(lumped, psi, G, np.ones(ny), dx, dy)


def test_round_off_in_a_direction_takes_no_parameter_into_the_lumping() -> None:
    lumped = LumpedParameters.of(np.array([[1.0], [-1.0], [1e-16]]), np.ones(3))
    assert lumped is not None and lumped.probe[2] == 0.0


def test_nearly_dependent_directions_are_not_lumped() -> None:
    direction = np.array([[1.0], [-1.0], [0.5]])
    twice = np.concatenate([direction, direction * (1.0 + 1e-9)], axis=1)
    assert LumpedParameters.of(twice, np.ones(3)) is None
    assert LumpedParameters.of(np.zeros((3, 0)), np.ones(3)) is None
