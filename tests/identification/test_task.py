"""Tasks of identifications: a model, parameters, noise and recordings are enough."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import mjfim
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.search import FitTask
from mjfim.records.trajectory import Recording
from tests.support.numerics import Loop, require_found
from tests.support.paths import MODELS
from tests.support.terms import recorded

MINIMAL: dict[str, Any] = {
    "rate": 100.0,
    "parameters": {
        "m": {"target": "body/bob:mass", "guess": 2.5, "true": 2.0, "bounds": [0.1, 10.0]},
        "c": {"target": "joint/hinge:damping", "guess": 1.4, "true": 1.0, "bounds": [0.0, 10.0]},
    },
    "noise": {"state": 0.05},
}


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """An experiment without horizon, initial state, control, cost or settings of a design."""
    return mjfim.Experiment(model=str(MODELS / "cart_pendulum.xml"), **MINIMAL)


@pytest.fixture(scope="module")
def recording(experiment: mjfim.Experiment) -> Recording:
    """A noisy recording at the true parameters."""
    system = System.resolve(experiment)
    ctrl = 10.0 * np.sin(2.0 * np.pi * 0.7 * np.arange(300) * system.dt)[:, None]
    return dataclasses.replace(recorded(system, ctrl, 0), name="log")


def test_a_design_of_a_minimal_experiment_says_what_is_missing(
    experiment: mjfim.Experiment,
) -> None:
    with pytest.raises(ExperimentError, match="design needs `horizon`"):
        mjfim.design(experiment)
    with pytest.raises(ExperimentError, match="check without recordings needs `horizon`"):
        mjfim.check(experiment)


def test_the_start_is_moved_inside_the_bounds_of_a_bounded_method(
    experiment: mjfim.Experiment, recording: Recording
) -> None:
    start = np.array([50.0, -1.0])
    bounded = FitTask.of(System.resolve(experiment), [recording], start=start)
    assert_array_equal(bounded.start, [10.0, 0.0])
    unbounded = FitTask.of(System.resolve(experiment), [recording], start=start, method="newton")
    assert_array_equal(unbounded.start, start)


def test_recordings_that_count_twice_are_refused(
    experiment: mjfim.Experiment, recording: Recording
) -> None:
    """The same data twice, or fitted and predicted."""
    with pytest.raises(RecordingError, match="log is given twice: a fitted recording"):
        mjfim.identify(experiment, [recording], held_out=[recording])
    with pytest.raises(RecordingError, match="log is given twice"):
        mjfim.check(experiment, recordings=[recording, recording])


@pytest.mark.parametrize(("name", "row"), [("ctrl:force", 57), ("qvel:slide", 301)])
def test_one_extreme_value_is_named_where_the_simulation_diverges(
    experiment: mjfim.Experiment, recording: Recording, name: str, row: int
) -> None:
    """A fault of the log is the likely cause, so the message says where it is."""
    field, column = ("ctrl", 0) if name == "ctrl:force" else ("y", 2)
    values = np.array(getattr(recording, field))
    values[row - 1, column] = 1e200
    message = rf"diverges at the start .*; log: column '{name}' holds 1e\+200 in row {row} of"
    with pytest.raises(SimulationDivergedError, match=message):
        mjfim.identify(experiment, [dataclasses.replace(recording, **{field: values})], threads=1)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["whole steps", "irregular", "inside steps"])
def test_a_log_of_any_rate_is_fitted_where_engine_steps_end_at_its_rows(
    case: str, tmp_path: Path
) -> None:
    """Controls jump between the samples at 100 Hz, and act there.

    Held as a mean over each sample they gave a misfit, with the warning to state the rate. Jumps
    inside engine steps are a misfit with this remedy. The log is a simulation in plain MuJoCo,
    whose steps end at the rows of the log.
    """
    count = 200 if case == "irregular" else 125
    t, rng = np.arange(count + 1) / count, np.random.default_rng(2)
    if case == "irregular":
        t[1:-1] += rng.choice([-0.0015, 0.0, 0.0005], count - 1)
    is_inside = case == "inside steps"
    timestep = 0.01 if is_inside else 0.0005
    model = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    model = model.replace('timestep="0.01"', f'timestep="{timestep}"')
    (tmp_path / "other.xml").write_text(model, encoding="utf-8")
    stated = {**MINIMAL, "noise": {"state": 0.001}}
    experiment = mjfim.Experiment(model=str(tmp_path / "other.xml"), **stated)
    system = System.resolve(experiment, threads=1)

    truth = system.model_at(system.parameters.true)
    ctrl = 10.0 * rng.standard_normal((count, 1))
    y = [system.nominal_initial_state]
    for u, period in zip(ctrl, np.diff(t), strict=True):
        steps = int(np.ceil(period / timestep - 1e-6))
        truth.opt.timestep = period / steps
        y.append(Loop(truth, steps).F(y[-1], u))
    noisy = np.array(y) + 0.001 * rng.standard_normal((count + 1, 4))
    log = Recording(t=t, ctrl=ctrl, y=noisy, outputs=system.outputs.names, name="log")

    estimate = mjfim.identify(experiment, [log], threads=1)
    assert estimate.misfit == is_inside
    if is_inside:
        (cause,) = [w for w in estimate.warnings if 'timestep="0.008", and rate = 125' in w]
        assert "lie inside the engine steps of the model (0.01 s)" in cause
    else:
        assert abs(estimate.chi2 / estimate.dof - 1.0) < 5.0 * np.sqrt(2.0 / estimate.dof)
        require_found(estimate, np.array([2.0, 1.0]))
