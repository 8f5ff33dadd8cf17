"""Sensitivities of parameters that follow from those of others."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.excitation.search.levels import DescentLevel
from mjfim.plant.plant import LumpedParameters
from tests.support.numerics import PRODUCT, cart_task

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
    assert len(lumped.base) == 2

    full = derivatives.sensitivity(task.theta, task.initial, central=central)
    found = derivatives.sensitivity(task.theta, task.initial, central=central, lumped=lumped)
    assert found.is_lumped

    # One-sided differences are accurate to their step only.
    accuracy = 1e-8 if central else 1e-4
    assert_array_equal(found.G[..., lumped.base], full.G[..., lumped.base])
    for few, all_moved in ((found.G, full.G), (found.psi, full.psi)):
        assert_allclose(few, all_moved, rtol=accuracy, atol=accuracy * np.abs(all_moved).max())


def test_a_combination_that_has_an_effect_is_found_out_and_all_parameters_are_moved(
    tmp_path,
) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT)
    derivatives = task.plant.derivatives
    lumped = LumpedParameters.of(WITH_EFFECT, task.parameters.magnitude)

    full = derivatives.sensitivity(task.theta, task.initial)
    found = derivatives.sensitivity(task.theta, task.initial, lumped=lumped)
    assert not found.is_lumped
    assert_array_equal(found.G, full.G)
    assert_array_equal(found.psi, full.psi)


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
    assert point.lumps


def test_nearly_dependent_directions_are_not_lumped() -> None:
    direction = np.array([[1.0], [-1.0], [0.5]])
    twice = np.concatenate([direction, direction * (1.0 + 1e-9)], axis=1)
    assert LumpedParameters.of(twice, np.ones(3)) is None
    assert LumpedParameters.of(np.zeros((3, 0)), np.ones(3)) is None
