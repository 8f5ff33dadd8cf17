"""Fits that start from a fit to the equation of motion, stated or to leave a local minimum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import MjfimError, SimulationDivergedError
from mjfim.output.pages import page_of
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording
from tests.identification.test_inverse_dynamics import cart, cart_log, true_of
from tests.support.numerics import require_found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cart")


@pytest.fixture(scope="module")
def log(folder: Path) -> Recording:
    return cart_log(cart(folder), 0.01, seconds=5.0)


def started(
    folder: Path, log: Recording, factors: list[float], **fit: object
) -> tuple[Estimate, mjfim.Experiment]:
    """An estimate from a start that is wrong by factors, which finds the truth."""
    experiment = cart(folder, fit={"bootstrap": 0, **fit})
    true = true_of(experiment)
    found = mjfim.identify(experiment, [log], start=true * factors)
    require_found(found, true, 5.0)
    # The guess remains the one that the user stated.
    assert_allclose(found.initial_theta, true * factors)
    return found, experiment


@pytest.mark.slow
def test_the_estimate_starts_from_the_equation_of_motion_and_is_shown(
    folder: Path, log: Recording
) -> None:
    estimate, experiment = started(folder, log, [8.0, 3.0, 9.0, 0.1], start="inverse_dynamics")
    assert estimate.restart is None
    fit = estimate.inverse_dynamics
    assert (np.abs(fit.theta / true_of(experiment) - 1.0) < 0.1).all()
    assert "Residual torque" in page_of(estimate).sections
    assert "The equation of motion holds" in fit._repr_html_()


@pytest.mark.slow
def test_a_local_minimum_is_left_by_the_equation_of_motion(folder: Path, log: Recording) -> None:
    found, _ = started(folder, log, [0.1, 0.1, 0.1, 0.1])
    assert found.restart.by_dynamics
    assert found.restart.cost < 0.01 * found.restart.cost_before
    assert "began at a fit to the equation of motion" in str(found.restart)
    assert found.inverse_dynamics is not None


@pytest.mark.slow
def test_a_model_that_diverges_at_the_start_begins_at_the_equation_of_motion(
    folder: Path, log: Recording
) -> None:
    found, experiment = started(folder, log, [10.0, 0.1, 10.0, 0.1])
    assert found.restart is None
    assert found.inverse_dynamics is not None
    assert found.warnings[0].startswith("the model diverges at the start (m = 15, l = 0.08, ")

    # The paper's method starts where it is told.
    with pytest.raises(SimulationDivergedError, match="diverges at the start"):
        mjfim.identify(experiment, [log], start=found.initial_theta, method="newton")


def test_what_it_needs_is_said(folder: Path, log: Recording) -> None:
    experiment = cart(folder, fit={"start": "inverse_dynamics"})
    moved = experiment.replace(nuisance={"initial": 0.1})
    with pytest.raises(MjfimError, match=r'fit\.start = "inverse_dynamics" is stated'):
        mjfim.identify(moved, [log])
