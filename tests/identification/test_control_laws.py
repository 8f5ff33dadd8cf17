"""Fits of closed loops from logs that hold references: laws, gains and latencies as unknowns."""

from __future__ import annotations

from dataclasses import replace
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.fit_problem import FitProblem
from mjfim.plant.plant import Derivatives
from mjfim.records.trajectory import Recording
from tests.support import terms
from tests.support.closed_loop import ARM, PlainLaw, arm_experiment, simulate
from tests.support.numerics import require_found

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

NOISE = {"qpos:shoulder": 1e-3, "qpos:elbow": 1e-3}

# Laws of both joints; the driver of the elbow takes commands faster than that of the shoulder.
SHOULDER = {"kp": 50.0, "kd": 3.0, "rate": 250.0, "saturation": (-15.0, 15.0)}
ELBOW = {"kp": 25.0, "kd": 1.0, "rate": 500.0}

# The plant and nuisance gains, with guesses that are wrong by some ten percent.
PLANT = {
    "mass": {"target": "body/fore:mass", "true": 1.2, "guess": 1.0},
    "damping": {"target": "joint/elbow:damping", "true": 0.3, "guess": 0.5},
}


def references(samples: int, seed: int, width: int = 2, steps: float = 0.3) -> np.ndarray:
    """(samples, width) smooth references with steps of this size, at 500 Hz [rad]."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples)[:, None] / 500.0
    waves = sum(np.sin(2 * np.pi * 0.7 * k * t + rng.uniform(0, 6, width)) / k for k in range(1, 6))
    jumps = t > rng.uniform(0.1, 0.9, width) * samples / 500.0
    return 0.25 * waves + jumps * rng.uniform(-steps, steps, width)


def log_of(experiment: mjfim.Experiment, samples: int, seed: int) -> Recording:
    """A noisy log of a closed loop at the true parameters."""
    width = len(System.resolve(experiment).inputs)
    return mjfim.simulate(experiment, references(samples, seed, width), seed)


def test_a_limit_that_the_law_hardly_reaches_leaves_the_others_determined(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It clips the control at the guess, and at the estimate only after a long difference."""
    monkeypatch.setattr("mjfim.identification.fit_problem.SENSITIVITY_STEP", 0.1)
    limit = {"target": "controller/shoulder:saturation", "guess": 3.0, "true": 40.0}
    limit |= {"bounds": [1.0, 60.0], "scale": 30.0}
    experiment = arm_experiment(
        {"shoulder": SHOULDER, "elbow": ELBOW},
        parameters={**PLANT, "limit": limit},
        noise=NOISE,
        fit={"bootstrap": 0, "segments": "whole"},
    )
    found = mjfim.identify(experiment, [log_of(experiment, 400, 2)], progress=False)
    assert np.isinf(found.std[2])
    true = System.resolve(experiment).parameters.true
    assert (np.abs(found.theta - true)[:2] < 4.0 * found.std[:2]).all()
    assert (found.std[:2] < 0.01 * true[:2]).all()
    assert any("not identifiable separately: limit" in sentence for sentence in found.warnings)


def test_intervals_of_a_simulation_take_all_earlier_references(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where a search without bounds tries a latency longer than the log."""
    late = {"target": "controller/elbow:latency", "guess": 0.05}
    laws = {"shoulder": SHOULDER, "elbow": ELBOW}
    experiment = arm_experiment(laws, parameters={**PLANT, "late": late}, noise=NOISE)
    problem = FitProblem.of(System.resolve(experiment), [log_of(experiment, 200, 1)])
    at = [problem.begin(np.array([1.2, 0.3, latency])) for latency in (0.05, 1.0, 1e15)]
    costs = [problem.cost(each) for each in at]
    assert costs[0] != costs[1] == costs[2]
    intervals = partialmethod(Derivatives.responses, max_numbers=1000)
    monkeypatch.setattr(Derivatives, "responses", intervals)
    assert_allclose([problem.cost(each) for each in at], costs, rtol=1e-12)


def test_derivatives_agree_with_differences_of_a_plain_loop() -> None:
    """By gains and all times of the law, of a simulation and of a fit."""
    numbers = {
        "kp": 60.0,
        "kd": 4.0,
        "latency": 0.0051,
        "time_constant": 0.011,
        "feedback_latency": 0.0057,
        "velocity_time_constant": 0.004,
    }
    law = {**numbers, "rate": 250.0, "velocity": "difference", "saturation": (-40.0, 40.0)}
    parameters = {name: {"target": f"controller/shoulder:{name}"} for name in numbers}
    experiment = arm_experiment({"shoulder": law}, parameters=parameters, noise=NOISE)
    system = System.resolve(experiment)
    inputs = references(200, 3)
    guess = system.parameters.guess
    model = system.plant.model(guess)
    columns = {0: {"reference": inputs[:, 0]}, 1: {"ctrl": inputs[:, 1]}}

    def plain(values: np.ndarray) -> np.ndarray:
        """(samples + 1, 2) positions by the plain loop."""
        stated = dict(zip(numbers, values, strict=True))
        made = PlainLaw(joint="shoulder", tick=4, low=-40.0, high=40.0, difference=True, **stated)
        return simulate(model, {0: made}, columns, system.dt, len(inputs), np.zeros(4))[0][:, :2]

    steps = 1e-4 * np.diag(guess)
    expected = [(plain(guess + h) - plain(guess - h)) / (2.0 * h.sum()) for h in steps]
    expected = np.stack(expected, axis=-1)
    size = np.abs(expected).max(axis=(0, 1))
    assert (size * guess > 1e-4).all()

    problem = FitProblem.of(system, [terms.recorded(system, inputs, share=0.0)])
    batch = next(problem.batches(derivatives=True))
    (rows,) = problem.rows_of_batch(problem.begin(guess), batch)
    for found in (system.plant.derivatives.predict(guess, inputs)[1], rows.jacobians[0]):
        assert_allclose(found / size, expected / size, atol=2e-4)


@pytest.mark.parametrize(("off", "tolerance"), [(0, 4e-4), (50, 2e-3)])
def test_segments_know_the_integral_of_the_law(off: int, tolerance: float) -> None:
    """The log shows the integral at the begin of a segment: errors, latencies and the first one.

    What is left is the acceleration during the latency of the feedback before a segment, and
    that references count as at rest before the law was switched on.
    """
    law = {
        "kp": 40.0,
        "kd": 3.0,
        "ki": 150.0,
        "integral": 1.2,
        "rate": 250.0,
        "latency": 0.006,
        "time_constant": 0.012,
        "feedback_latency": 0.003,
        "enable": True,
    }
    parameters = {"ki": {"target": "controller/shoulder:ki"}, **PLANT}
    experiment = arm_experiment({"shoulder": law}, parameters=parameters, noise=NOISE)
    system = System.resolve(experiment.replace(fit={"segments": 0.2}))
    inputs = references(1000, 4, 3, steps=0.0)
    inputs[:, 1] = 1.0
    inputs[400 : 400 + off, 1] = 0.0
    log = terms.recorded(system, inputs, share=0.0)

    problem = FitProblem.of(system, [log])
    states = system.plant.simulate(system.parameters.true, inputs).state
    segments = tuple(replace(each, start=states[each.begin]) for each in problem.segments)
    assert len(segments) == 10

    def error(recording: AlignedRecording) -> float:
        """Largest error of the prediction from the true states at the begins."""
        known = replace(problem, segments=segments, recordings=(recording,))
        (predicted,) = known.predict(known.begin(system.parameters.true))
        return float(np.abs(predicted - log.y).max())

    (recording,) = problem.recordings
    assert error(recording) < tolerance

    # Without the integral at their begins, segments would not follow.
    forgotten = recording.ctrl * (np.arange(recording.ctrl.shape[1]) < 3)
    assert error(replace(recording, ctrl=forgotten)) > 0.02


def test_an_unstable_loop_is_explained(tmp_path: Path) -> None:
    path = tmp_path / "strong.xml"
    path.write_text(ARM.read_text().replace('<motor ctrlrange="-20 20"/>', ""))
    law = {"kp": 1.0, "kd": 1e4}
    experiment = arm_experiment({"shoulder": law}, parameters=PLANT, model=str(path))
    with pytest.raises(SimulationDivergedError, match=r"loop of the model and the control laws"):
        mjfim.simulate(experiment, references(100, 7))


# ---- the equation of motion


def arm_with_torques(folder: Path, controllers: dict[str, Any], sensors: str) -> mjfim.Experiment:
    """The arm with measured torques, and guesses of its friction and inertia that are far off."""
    text = ARM.read_text(encoding="utf-8")
    text = text.replace("</mujoco>", f"<sensor>{sensors}</sensor></mujoco>")
    (folder / "arm.xml").write_text(text, encoding="utf-8")
    torques = {name: 0.02 for name in ("torque1", "torque2") if name in sensors}
    return arm_experiment(
        controllers,
        model=str(folder / "arm.xml"),
        parameters={
            "mass": {"target": "body/fore:mass", "true": 1.2, "guess": 4.0},
            "damping1": {"target": "joint/shoulder:damping", "true": 0.8, "guess": 3.0},
            "damping2": {"target": "joint/elbow:damping", "true": 0.3, "guess": 0.05},
            "kp": {"target": "controller/shoulder:kp", "true": 50.0, "guess": 20.0},
        },
        noise={"qpos:shoulder": 1e-5, "qpos:elbow": 1e-5, **torques},
    )


TORQUE1 = '<actuatorfrc name="torque1" actuator="shoulder"/>'
TORQUE2 = '<actuatorfrc name="torque2" actuator="elbow"/>'


@pytest.mark.parametrize(
    ("controllers", "sensors"),
    [
        ({"shoulder": SHOULDER, "elbow": ELBOW}, TORQUE1 + TORQUE2),
        ({"shoulder": SHOULDER}, TORQUE1),
        ({"shoulder": SHOULDER}, '<jointactuatorfrc name="torque1" joint="shoulder"/>'),
        ({"shoulder": SHOULDER}, TORQUE1 + TORQUE2),
    ],
)
def test_measured_torques_take_the_place_of_controls_that_laws_compute(
    controllers: dict[str, Any], sensors: str, tmp_path: Path
) -> None:
    experiment = arm_with_torques(tmp_path, controllers, sensors)
    true = System.resolve(experiment).parameters.true
    log = log_of(experiment, 3000, 4)

    found = mjfim.inverse_dynamics(experiment, [log])

    assert found.converged
    assert_allclose(found.theta[:3], true[:3], rtol=0.05)
    assert found.absent == ("kp",)


def test_the_equation_of_motion_needs_the_torque_of_every_law(tmp_path: Path) -> None:
    """It needs the controls, which the log of a closed loop does not hold."""
    laws = {"shoulder": SHOULDER, "elbow": ELBOW}
    experiment = arm_with_torques(tmp_path, laws, TORQUE1)
    with pytest.raises(ExperimentError, match=r"controllers.elbow: the equation of motion needs"):
        mjfim.inverse_dynamics(experiment, [log_of(experiment, 100, 9)])

    # The torque of one recording does not help another one.
    experiment = arm_with_torques(tmp_path, {"shoulder": SHOULDER}, TORQUE1)
    log = log_of(experiment, 100, 9)
    column = log.outputs.index("torque1")
    y = np.array(log.y)
    y[:, column] = np.nan
    without = replace(log, y=y, name="without.csv")
    with pytest.raises(ExperimentError, match=r"which without.csv does not hold"):
        mjfim.inverse_dynamics(experiment, [log, without])


def test_intervals_of_a_fit_over_segments_with_a_motor_that_lags() -> None:
    """No log shows what a law commands, so that the state of the lag is free in every segment."""
    lag = {"target": "term/lag:time_constant", "true": 0.02, "guess": 0.01}
    experiment = arm_experiment(
        {"shoulder": SHOULDER},
        terms={"lag": {"kind": "actuator_lag", "actuator": "shoulder"}},
        parameters={**PLANT, "lag": lag},
        noise=NOISE,
        fit={"segments": 0.25, "bootstrap": 0},
    )
    log = log_of(experiment, 500, 8)
    true = System.resolve(experiment).parameters.true
    assert FitProblem.of(System.resolve(experiment), [log]).private_count == 5

    found = mjfim.identify(experiment, [log])
    require_found(found, true)
    assert np.abs(found.theta / true - 1.0).max() < 0.2
    assert abs(found.theta[2] - 0.02) < 1e-3
