"""Fits that start from a fit to the equation of motion, stated or to leave a local minimum."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.output.pages import page_of
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording
from tests.identification.test_inverse_dynamics import STATE, cart, cart_log, true_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cart")


@pytest.fixture(scope="module")
def log(folder: Path) -> Recording:
    return cart_log(cart(folder), 0.01, seconds=5.0)


@pytest.fixture(scope="module")
def estimate(folder: Path, log: Recording) -> Estimate:
    experiment = cart(folder, fit={"start": "inverse_dynamics", "bootstrap": 0})
    true = true_of(experiment)
    wrong = true * np.array([8.0, 3.0, 9.0, 0.1])
    return mjfim.identify(experiment, [log], start=wrong, progress=False)


@pytest.mark.slow
def test_the_estimate_starts_from_the_equation_of_motion(folder: Path, estimate: Estimate) -> None:
    true = true_of(cart(folder))
    assert estimate.converged and not estimate.misfit
    assert (np.abs(estimate.theta - true) < 5.0 * estimate.std).all()
    assert estimate.restart is None

    # The guess remains the one that the user stated, and the search began elsewhere.
    np.testing.assert_allclose(estimate.initial_theta, true * [8.0, 3.0, 9.0, 0.1])
    fit = estimate.inverse_dynamics
    assert fit is not None
    assert (np.abs(fit.theta / true - 1.0) < 0.1).all()


@pytest.mark.slow
def test_it_is_saved_shown_and_drawn(estimate: Estimate, tmp_path: Path) -> None:
    estimate.save(tmp_path)
    loaded = Estimate.load(tmp_path)
    assert loaded.inverse_dynamics is not None and estimate.inverse_dynamics is not None
    first, second = loaded.residual_forces[0], estimate.residual_forces[0]
    np.testing.assert_array_equal(first.force, second.force)
    assert loaded.summary()["inverse_dynamics"]["equations"][1]["name"] == "hinge"

    assert "Residual torque" in [section.title for section in page_of(loaded).sections]
    loaded.plot("residual_torque", file=tmp_path / "forces.png")
    assert (tmp_path / "forces.png").stat().st_size > 10_000
    assert "The equation of motion holds" in loaded.inverse_dynamics._repr_html_()


@pytest.mark.slow
def test_a_local_minimum_is_left_by_the_equation_of_motion(folder: Path, log: Recording) -> None:
    experiment = cart(folder, fit={"bootstrap": 0})
    true = true_of(experiment)
    found = mjfim.identify(experiment, [log], start=0.1 * true, progress=False)
    assert (np.abs(found.theta - true) < 5.0 * found.std).all()
    assert found.restart is not None
    assert found.restart.by_dynamics
    assert found.restart.cost < 0.01 * found.restart.cost_before
    assert "began at a fit to the equation of motion" in str(found.restart)
    assert found.inverse_dynamics is not None


@pytest.mark.slow
def test_a_model_that_diverges_at_the_start_begins_at_the_equation_of_motion(
    folder: Path, log: Recording
) -> None:
    experiment = cart(folder, fit={"bootstrap": 0})
    true = true_of(experiment)
    wrong = true * np.array([10.0, 0.1, 10.0, 0.1])
    found = mjfim.identify(experiment, [log], start=wrong, progress=False)
    assert found.converged and not found.misfit
    assert (np.abs(found.theta - true) < 5.0 * found.std).all()
    assert found.restart is None
    assert found.inverse_dynamics is not None
    np.testing.assert_allclose(found.initial_theta, wrong)
    assert found.warnings[0].startswith("the model diverges at the start (m = 15, l = 0.08, ")

    # The paper's method starts where it is told.
    with pytest.raises(SimulationDivergedError, match="diverges at the start"):
        mjfim.identify(experiment, [log], start=wrong, method="newton", progress=False)


def test_what_it_needs_is_said(folder: Path, log: Recording) -> None:
    experiment = cart(folder, fit={"start": "inverse_dynamics"})
    kept = [i for i, name in enumerate(STATE) if not name.endswith("hinge")]
    outputs = tuple(STATE[i] for i in kept)
    part = replace(log, y=log.y[:, kept], outputs=outputs, name="part.csv")
    with pytest.raises(RecordingError, match=r"part\.csv: no measured position or velocity of h"):
        mjfim.identify(experiment, [part], progress=False)

    moved = experiment.replace(nuisance={"initial": 0.1})
    with pytest.raises(ExperimentError, match=r'fit\.start = "inverse_dynamics" is stated'):
        mjfim.identify(moved, [log], progress=False)
