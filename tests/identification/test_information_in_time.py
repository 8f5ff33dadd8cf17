"""Which seconds decide: information of the estimate along the recordings, and residuals there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.experiment.system import System
from mjfim.output.page import Table
from mjfim.output.pages import page_of
from mjfim.output.plots.estimate import deciding_seconds
from mjfim.records.estimate import Estimate
from mjfim.records.estimate_parts import InformationInTime
from tests.identification.test_inverse_dynamics import CART, cart, cart_log

# Standard deviation of all outputs, as the experiment states it.
SIGMA = 0.01


@pytest.fixture(scope="module")
def estimate(tmp_path_factory: pytest.TempPathFactory) -> Estimate:
    """An estimate from two logs of 2 s, with prior knowledge of the mass."""
    folder = tmp_path_factory.mktemp("cart")
    parameters = {**CART, "m": {**CART["m"], "prior": 0.002}}
    experiment = cart(folder, fit={"bootstrap": 0}, parameters=parameters)
    recordings = [
        replace(cart_log(experiment, SIGMA, seed=k, seconds=2.0), name=f"{k}.csv") for k in range(2)
    ]
    return mjfim.identify(experiment, recordings)


def test_information_of_all_seconds_is_that_of_the_estimate(estimate: Estimate) -> None:
    found = estimate.in_time
    assert found.parameters == estimate.parameters
    assert set(found.recording) == {0, 1}
    # The other parameters follow the mass, so that its prior is information on them as well.
    of_prior = (estimate.covariance[0] / 0.002 / estimate.std) ** 2
    assert 0.01 < of_prior.max() < 0.99
    assert_allclose(found.prior, of_prior, rtol=1e-6)
    assert_allclose(found.shares.sum(axis=0), 1.0 - of_prior, rtol=1e-9)


def test_information_and_pulls_are_those_of_single_rows(estimate: Estimate, tmp_path: Path) -> None:
    """They follow from the normal equations of rows of the first recording and of all."""
    system = System.resolve(cart(tmp_path), threads=1)
    rows, residuals = [], []
    for log in estimate.recordings:
        y, J = system.plant.derivatives.predict(estimate.theta, log.ctrl)
        rows.append(J[1:] / SIGMA)
        residuals.append((y - log.y)[1:] / SIGMA)
    known = np.diag([0.002**-2, 0.0, 0.0, 0.0])
    covariance = np.linalg.inv(np.einsum("ktip,ktiq->pq", rows, rows) + known)

    found, t = estimate.in_time, estimate.recordings[0].t[1:]
    middle = float(found.times[found.recording == 0][3, 0])
    share, pull = found.on_grid(0, np.array([0.0, middle, 3.0]))
    for row, part in enumerate((t < middle, t >= middle)):
        moved = rows[0][part] @ covariance / estimate.std
        assert_allclose(share[row], np.sum(moved**2, axis=(0, 1)), rtol=1e-3, atol=1e-4)
        drawn = -np.einsum("tip,ti->p", moved, residuals[0][part])
        assert_allclose(pull[row], drawn, rtol=0.02, atol=0.02)


def made(**changes: Any) -> InformationInTime:
    """Four blocks of 1 s with 60, 30, 10 and 0 % of the information, without pulls."""
    edges = np.arange(5.0)
    values: dict[str, Any] = {
        "parameters": ("m",),
        "recording": np.zeros(4),
        "times": np.column_stack([edges[:-1], edges[1:]]),
        "shares": np.array([[0.1], [0.6], [0.3], [0.0]]),
        "pulls": np.zeros((4, 1)),
        "scatter": 1.0,
    }
    return InformationInTime(**{**values, **changes})


def test_most_of_the_information_is_in_the_best_seconds() -> None:
    found = made()
    assert_allclose(found.seconds_of_most, [2.0])
    assert_allclose(found.on_grid(0, np.array([0.5, 1.5]))[0], [[0.05 + 0.3]])


def test_residuals_that_are_larger_than_noise_are_marked(estimate: Estimate) -> None:
    """A block with 30 % of the information draws by 0.55 σ, from which 1.64 σ is marked."""
    recording = replace(estimate.recordings[0], t=2.0 * estimate.recordings[0].t)
    for pull, symbols in ((2.0, ["^"]), (-2.0, ["v"]), (0.9, []), (1.5, [])):
        found = made(pulls=np.array([[0.0], [0.0], [pull], [0.0]]))
        shown = replace(estimate, in_time=found, recordings=(recording,))
        (panel,) = deciding_seconds(shown, shown.labels).panels
        assert [mark.symbol for mark in panel.marks] == symbols
        assert [mark.x.tolist() for mark in panel.marks] == [[2.5]] * len(symbols)


def test_picture_table_and_json_have_the_same_numbers(estimate: Estimate) -> None:
    found = estimate.in_time
    first, second = deciding_seconds(estimate, estimate.labels).panels
    total = sum(panel.cells.values @ np.diff(panel.cells.edges) for panel in (first, second))
    assert_allclose(total, 100.0 * (1.0 - found.prior), rtol=1e-9)

    parts = list(page_of(estimate).every_part)
    table = next(p for p in parts if isinstance(p, Table) and p.title.startswith("Shortest time"))
    seconds = [f"{s:.2g} s" for s in found.seconds_of_most]
    assert [row.cells[1] for row in table.rows] == seconds == list(first.beside[0][2])
