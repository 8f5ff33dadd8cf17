"""Which seconds decide: information of the estimate along the recordings, and residuals there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.output.page import Table
from mjfim.output.pages import page_of
from mjfim.output.plots.estimate import deciding_seconds
from mjfim.records.estimate import Estimate
from mjfim.records.estimate_parts import InformationInTime
from tests.identification.test_inverse_dynamics import cart, cart_log
from tests.support.numerics import Array

# Standard deviation of all outputs, as the experiment states it.
SIGMA = 0.01


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cart")


def estimate_of(folder: Path, logs: int = 1, **parameter: float) -> Estimate:
    """An estimate from logs of 2 s, with further keys of the mass."""
    experiment = cart(folder, fit={"bootstrap": 0})
    mass = experiment.parameters["m"].model_copy(update=parameter)
    experiment = experiment.replace(parameters={**experiment.parameters, "m": mass})
    recordings = [
        replace(cart_log(experiment, SIGMA, seed=k, seconds=2.0), name=f"{k}.csv")
        for k in range(logs)
    ]
    return mjfim.identify(experiment, recordings, progress=False)


@pytest.fixture(scope="module")
def estimate(folder: Path) -> Estimate:
    return estimate_of(folder)


def in_time(estimate: Estimate) -> InformationInTime:
    assert estimate.in_time is not None
    return estimate.in_time


def test_information_of_all_seconds_is_that_of_the_estimate(estimate: Estimate) -> None:
    found = in_time(estimate)
    assert found.parameters == estimate.parameters
    np.testing.assert_allclose(found.shares.sum(axis=0), 1.0, rtol=1e-9)
    np.testing.assert_allclose(found.prior, 0.0, atol=1e-9)
    share, pull = found.on_grid(0, np.linspace(-0.3, 2.3, 7))
    np.testing.assert_allclose(share.sum(axis=0), 1.0, rtol=1e-9)

    # At the minimum, the residuals of all seconds together draw nowhere.
    assert np.abs(pull.sum(axis=0)).max() < 0.05 < np.abs(pull).max()


def test_information_and_pulls_are_those_of_single_rows(folder: Path, estimate: Estimate) -> None:
    """Rows by differences of simulations, and the solution of the normal equations."""
    system = System.resolve(cart(folder), threads=1)
    recording, theta = estimate.recordings[0], estimate.theta

    def outputs(at: Array) -> Array:
        return system.plant.measure(at[None], recording.ctrl)[0][0]

    steps = np.diag(1e-4 * np.abs(theta))
    J = np.stack([(outputs(theta + h) - outputs(theta - h)) / (2.0 * h.sum()) for h in steps], -1)
    r = (outputs(theta) - recording.y)[1:] / SIGMA
    J = J[1:] / SIGMA
    covariance = np.linalg.inv(np.einsum("tip,tiq->pq", J, J))

    found, t = in_time(estimate), recording.t[1:]
    middle = float(found.times[len(found.times) // 2, 0])
    share, pull = found.on_grid(0, np.array([0.0, middle, 3.0]))
    for row, part in enumerate((t < middle, t >= middle)):
        for j, std in enumerate(np.sqrt(np.diag(covariance))):
            moved = J[part] @ covariance[j]
            assert share[row, j] == pytest.approx(np.sum(moved**2) / std**2, rel=1e-3, abs=1e-4)
            drawn = -np.sum(moved * r[part]) / std
            assert pull[row, j] == pytest.approx(drawn, rel=0.02, abs=0.02)


def test_a_prior_and_several_recordings_share_the_information(folder: Path) -> None:
    estimate = estimate_of(folder, logs=2, prior=0.002)
    found = in_time(estimate)
    assert set(found.recording) == {0, 1}
    # The other parameters follow the mass, so that its prior is information on them as well.
    of_prior = (estimate.covariance[0] / 0.002 / estimate.std) ** 2
    assert 0.01 < of_prior.max() < 0.99
    np.testing.assert_allclose(found.prior, of_prior, rtol=1e-6)


def made(pulls: float) -> InformationInTime:
    """Four blocks of 1 s with 60, 30, 10 and 0 % of the information, the third with pulls [σ]."""
    edges = np.arange(5.0)
    return InformationInTime(
        parameters=("m",),
        recording=np.zeros(4),
        times=np.column_stack([edges[:-1], edges[1:]]),
        shares=np.array([[0.1], [0.6], [0.3], [0.0]]),
        pulls=np.array([[0.0], [0.0], [pulls], [0.0]]),
        scatter=1.0,
    )


def test_most_of_the_information_is_in_the_best_seconds() -> None:
    found = made(0.0)
    np.testing.assert_allclose(found.seconds_of_most, [2.0])
    np.testing.assert_allclose(found.on_grid(0, np.array([0.5, 1.5]))[0], [[0.05 + 0.3]])


@pytest.mark.parametrize(
    ("pull", "symbols"), [(2.0, {"^"}), (-2.0, {"v"}), (0.9, set()), (1.5, set())]
)
def test_residuals_that_are_larger_than_noise_are_marked(
    pull: float, symbols: set[str], estimate: Estimate
) -> None:
    """A block with 30 % of the information draws by 0.55 σ, from which 1.64 σ is marked."""
    recording = replace(estimate.recordings[0], t=2.0 * estimate.recordings[0].t)
    shown = replace(estimate, in_time=made(pull), recordings=(recording,))
    (panel,) = deciding_seconds(shown, shown.labels).panels
    assert {mark.symbol for mark in panel.marks} == symbols
    assert [mark.x.tolist() for mark in panel.marks] == [[2.5]] * len(symbols)


def test_the_title_leaves_out_what_a_prior_tells(estimate: Estimate) -> None:
    edges = np.arange(3.0)
    found = InformationInTime(
        parameters=("m", "l"),
        recording=np.zeros(2),
        times=np.column_stack([edges[:-1], edges[1:]]),
        shares=np.array([[0.1, 0.9], [0.0, 0.1]]),
        pulls=np.zeros((2, 2)),
        scatter=1.0,
    )
    shown = replace(estimate, in_time=found)
    picture = deciding_seconds(shown, shown.labels)
    assert "comes from 1 s (l) of 2 s" in picture.title
    assert picture.panels[0].beside[1] == ("priors", "muted", ["90 %", "0 %"])


def test_picture_table_and_json_have_the_same_numbers(estimate: Estimate, tmp_path: Path) -> None:
    found = in_time(estimate)
    picture = deciding_seconds(estimate, estimate.labels)
    (panel,) = picture.panels
    assert panel.cells is not None and panel.cells.edges is not None
    total = panel.cells.values @ np.diff(panel.cells.edges)
    np.testing.assert_allclose(total, 100.0, rtol=1e-9)

    estimate.save(tmp_path)
    summary = Estimate.load(tmp_path).summary()["information_in_time"]
    np.testing.assert_array_equal(summary["seconds_of_most"], found.seconds_of_most)
    parts = [part for section in page_of(estimate).sections for part in section.parts]
    table = next(p for p in parts if isinstance(p, Table) and p.title.startswith("Shortest time"))
    assert [row.cells[1] for row in table.rows] == [f"{s:.2g} s" for s in found.seconds_of_most]
    assert [f"{s:.2g} s" for s in found.seconds_of_most] == list(panel.beside[0][2])
