"""Control laws in the loop, against a plain loop over engine steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.experiment.system import System
from mjfim.model.loading import silence_mujoco_log
from mjfim.plant.running_law import InputContext
from tests.support.closed_loop import ARM, PlainLaw, arm_experiment, simulate

# The arm with a sensor of the torque of the shoulder's motor.
SENSED_ARM = ARM.read_text().replace(
    "<keyframe>",
    '<sensor><actuatorfrc name="torque" actuator="shoulder" noise="0.1"/></sensor><keyframe>',
)

SAMPLES = 120
START = np.array([0.3, -0.2, 0.5, -0.8])

# Laws of the shoulder, with the keys of the experiment file.
LAWS: dict[str, dict[str, Any]] = {
    "pd": {"kp": 60.0, "kd": 4.0},
    "slow": {"kp": 30.0, "kd": 2.0, "rate": 100.0},
    "unequal": {"kp": 30.0, "kd": 2.0, "rate": 1000.0 / 3.0},
    "late": {"kp": 60.0, "kd": 4.0, "rate": 250.0, "latency": 0.0137},
    "linear": {"kp": 60.0, "kd": 4.0, "rate": 1000.0, "latency": 0.0031, "interpolation": "linear"},
    "shaped": {"kp": 60.0, "kd": 4.0, "time_constant": 0.02, "latency": 0.005},
    "profiled": {
        "kp": 60.0,
        "kd": 4.0,
        "acceleration": 40.0,
        "jump": 0.3,
        "reference_velocity": "difference",
        "time_constant": 0.002,
        "latency": 0.0053,
    },
    "profile of all changes": {
        "kp": 60.0,
        "kd": 4.0,
        "rate": 250.0,
        "acceleration": 60.0,
        "latency": 0.0033,
        "reference_velocity": "difference",
    },
    "late feedback": {"kp": 40.0, "kd": 1.0, "rate": 250.0, "feedback_latency": 0.0063},
    "differences": {
        "kp": 40.0,
        "kd": 2.0,
        "rate": 250.0,
        "velocity": "difference",
        "velocity_time_constant": 0.006,
        "feedback_latency": 0.0013,
        "reference_velocity": "difference",
    },
    "integral": {"kp": 40.0, "kd": 3.0, "ki": 200.0, "integral": 1.5, "integral_limit": 4.0},
    "limited": {"kp": 60.0, "kd": 4.0, "saturation": (-3.0, 5.0), "slew": 150.0, "latency": 0.0033},
    "columns": {
        "kp": 20.0,
        "kd": 2.0,
        "ki": 50.0,
        "feedforward": True,
        "gain": True,
        "enable": True,
        "reference_velocity": "column",
        "latency": 0.0027,
        "time_constant": 0.01,
    },
}


# Five ticks in a sample of 200 Hz.
FAST = {"rate": 1000.0}


def plain(law: dict[str, Any], joint: str) -> PlainLaw:
    """The law of a table for the plain loop."""
    values = dict(law)
    low, high = values.pop("saturation", (-20.0, 20.0))
    made = PlainLaw(joint=joint, tick=round(1000.0 / values.pop("rate", 500.0)), low=low, high=high)
    made.linear = values.pop("interpolation", "held") == "linear"
    made.difference = values.pop("velocity", "model") == "difference"
    made.reference_difference = values.pop("reference_velocity", "none") == "difference"
    for name in ("feedforward", "gain", "enable"):
        values.pop(name, None)
    for name, value in values.items():
        assert hasattr(made, name)
        setattr(made, name, value)
    return made


def signals(system: System, seed: int = 0) -> np.ndarray:
    """(SAMPLES, w) inputs that change all the time: references with steps, factors, controls."""
    rng = np.random.default_rng(seed)
    t = np.arange(SAMPLES) * system.dt
    others = {"gain": 1.0 + 0.5 * (t > 0.1), "enable": 1.0 * ((t < 0.08) | (t > 0.14))}
    inputs = []
    for name in system.inputs:
        frequency, begin = rng.uniform([2.0, 0.05], [5.0, 0.15])
        wave = 0.3 * np.sin(2 * np.pi * frequency * t) + 0.4 * (t > begin)
        inputs.append(others.get(name.partition(":")[0], wave))
    return np.stack(inputs, axis=1)


def prepared(controllers: dict[str, Any], **tables: Any) -> tuple[System, Any, np.ndarray]:
    """The arm with some laws, its model, and inputs."""
    system = System.resolve(arm_experiment(controllers, **tables))
    return system, system.plant.model(system.parameters.guess), signals(system)


def oracle(
    system: System, law: dict[str, Any], inputs: np.ndarray, start: np.ndarray = START
) -> tuple[np.ndarray, np.ndarray]:
    """(SAMPLES + 1, ns) states and (SAMPLES, nu) mean controls by the plain loop."""
    theta = system.parameters.guess
    columns: dict[int, dict[str, np.ndarray]] = {0: {}, 1: {}}
    for name, column in zip(system.inputs, inputs.T, strict=True):
        quantity, _, actuator = name.partition(":")
        columns[("shoulder", "elbow").index(actuator)][quantity] = column
    states, controls = simulate(
        system.plant.model(theta), {0: plain(law, "shoulder")}, columns, system.dt, SAMPLES, start
    )
    return states, controls.reshape(SAMPLES, -1, 2).mean(axis=1)


@pytest.mark.parametrize(("name", "more"), [*((name, {}) for name in LAWS), ("profiled", FAST)])
def test_a_law_equals_a_plain_loop(name: str, more: dict[str, float]) -> None:
    law = LAWS[name] | more
    system, model, inputs = prepared({"shoulder": law}, **({"rate": 200.0} if more else {}))
    simulator = system.plant.simulator
    found = simulator.rollout([model], START[None], inputs[None])

    assert found.finite.all()
    expected, controls = oracle(system, law, inputs)
    assert_allclose(found.states[0], expected, atol=1e-11)

    # Along the same motion, controls are the same. Between samples, the motion is a spline.
    t = system.dt * np.arange(SAMPLES + 1)
    atol = 0.03 if name in ("unequal", "linear") or more else 1e-9
    assert_allclose(simulator.controls_along(model, t, expected, inputs), controls, atol=atol)

    # The law has an effect, so that a wrong law would be seen.
    assert np.abs(expected - oracle(system, {"kp": 0.0}, inputs)[0]).max() > 0.05


@pytest.mark.parametrize("jump", [{"jump": 0.15}, {}])
def test_a_step_has_its_effect_at_any_latency(jump: dict[str, float]) -> None:
    """The motion is continuous in the latency, wherever the step arrives inside a tick."""
    law = {"kp": 50.0, "kd": 4.0, "rate": 250.0, "acceleration": 39.0, **jump}
    system = System.resolve(arm_experiment({"shoulder": law}))
    inputs = np.zeros((SAMPLES, 2))
    inputs[20:, 0] = 0.24
    late = np.arange(0.008, 0.0161, 0.0005)
    models = [prepared({"shoulder": law | {"latency": latency}})[1] for latency in late]

    m = len(models)
    starts, logs = np.zeros((m, 4)), np.repeat(inputs[None], m, axis=0)
    q = system.plant.simulator.rollout(models, starts, logs).states[:, 45, 0]

    # A jump acts at once: a profile needs 0.16 s.
    assert (q.min() > 0.015) == bool(jump)
    assert np.diff(q).max() < 0.5 * np.diff(q).min()


def test_simulations_of_one_batch_have_their_own_numbers() -> None:
    law = LAWS["late feedback"] | {"latency": 0.003, "time_constant": 0.01, "ki": 20.0}
    system = System.resolve(arm_experiment({"shoulder": law, "elbow": LAWS["slow"]}))
    numbers = [{}, {"kp": 55.0}, {"latency": 0.0081}, {"feedback_latency": 0.0139, "ki": 40.0}]
    models, expected = [], []
    inputs = np.stack([signals(system, seed) for seed in range(4)])
    starts = np.outer([1.0, 1.1, 1.2, 1.3], START)
    for changed, start, own in zip(numbers, starts, inputs, strict=True):
        _, model, _ = prepared({"shoulder": law | changed, "elbow": LAWS["slow"]})
        columns = {a: {"reference": own[:, a]} for a in (0, 1)}
        laws = {0: plain(law | changed, "shoulder"), 1: plain(LAWS["slow"], "elbow")}
        models.append(model)
        expected.append(simulate(model, laws, columns, system.dt, SAMPLES, start)[0])

    found = system.plant.simulator.rollout(models, starts, inputs)

    assert_allclose(found.states, expected, atol=1e-11)
    assert np.abs(np.diff(found.states, axis=0)).max(axis=(1, 2)).min() > 1e-3


def test_a_law_on_the_voltage_of_a_motor_with_a_current(tmp_path: Path) -> None:
    """A <dcmotor> turns the voltage into a torque, with back-EMF and inductance."""
    motor = (
        '<dcmotor name="shoulder" joint="shoulder" motorconst="0.8 0.8" resistance="2" '
        'inductance="0.01 0" ctrlrange="-24 24"/>'
    )
    path = tmp_path / "electric.xml"
    path.write_text(ARM.read_text().replace('<motor name="shoulder" joint="shoulder"/>', motor))
    law = {"kp": 80.0, "kd": 2.0, "rate": 250.0}
    stated = {"shoulder": {**law, "kind": "voltage"}}
    system, model, inputs = prepared(stated, model=str(path))
    assert model.na == 1
    start = np.append(START, 0.4)

    found = system.plant.simulator.rollout([model], start[None], inputs[None])

    expected, _ = oracle(system, {**law, "saturation": (-24.0, 24.0)}, inputs, start)
    assert_allclose(found.states[0], expected, atol=1e-11)


def test_measured_forces_are_those_of_the_law(tmp_path: Path) -> None:
    """A force sensor shows the control that the law has computed at the same instant."""
    path = tmp_path / "sensed.xml"
    path.write_text(SENSED_ARM)
    noise = {"state": 1e-4, "torque": 0.1}
    system, model, inputs = prepared({"shoulder": LAWS["pd"]}, model=str(path), noise=noise)
    found = system.plant.simulator.rollout([model], START[None], inputs[None])
    q, v = found.states[0, :-1, 0], found.states[0, :-1, 2]
    expected = np.clip(60.0 * (inputs[:, 0] - q) - 4.0 * v, -20.0, 20.0)
    assert_allclose(found.sensors[0, :-1, 0], expected, atol=1e-11)
    assert np.ptp(expected) > 10.0


@pytest.mark.parametrize("name", LAWS)
def test_intervals_equal_one_rollout(name: str) -> None:
    """Long curves are simulated in intervals, between which laws remember everything."""
    system, model, inputs = prepared({"shoulder": LAWS[name], "elbow": LAWS["slow"]})
    plant, theta = system.plant, system.parameters.guess
    whole, lead = plant.simulator.rollout([model], START[None], inputs[None]), plant.lead(theta)

    # Memory for 7 samples, of which an interval takes whole ticks of both laws.
    numbers = 7 * system.grid.substeps * (1 + len(START))
    padded = np.concatenate([np.repeat(inputs[:1], lead, axis=0), inputs])
    parts = list(
        plant.derivatives.responses(
            theta,
            START[None],
            padded[None],
            lead=lead,
            samples=np.array([-lead]),
            max_numbers=numbers,
        )
    )

    ticks = plant.tick_samples
    assert len(parts) == -(-SAMPLES // (max(7 // ticks, 1) * ticks))
    first = 0
    for (y,), _, _ in parts:
        assert_allclose(y, whole.states[0, first : first + len(y)], atol=1e-11)
        first += len(y) - 1


@pytest.mark.parametrize("name", ["pd", "slow", "late", "linear", "shaped", "profiled", "columns"])
def test_a_curve_may_begin_inside_a_recording(name: str) -> None:
    """A curve that begins at a tick continues the motion; laws here remember commands only."""
    system, model, inputs = prepared({"shoulder": {**LAWS[name], "ki": 0.0}})
    plant, begin = system.plant, 60
    whole = plant.simulator.rollout([model], START[None], inputs[None]).states[0]

    before = max(begin - plant.lead(system.parameters.guess), 0)
    context = InputContext(
        before=inputs[None, before:begin], after=inputs[None, :0], samples=np.array([begin])
    )
    found = plant.simulator.rollout(
        [model], whole[None, begin], inputs[None, begin:], context=context
    )
    assert_allclose(found.states[0], whole[begin:], atol=1e-9)


def test_a_diverging_loop_is_found() -> None:
    """A gain that is too large for the period of the law makes one of two loops unstable."""
    law = {"kp": 1.0, "kd": 1e4, "saturation": (-1e9, 1e9)}
    _, wild, _ = prepared({"shoulder": law})
    system, stable, inputs = prepared({"shoulder": LAWS["pd"]})
    for model in (wild, stable):
        model.actuator_ctrllimited[:] = 0
    pair = (np.stack([each] * 2) for each in (START, inputs))
    with silence_mujoco_log():
        found = system.plant.simulator.rollout([wild, stable], *pair)
    assert found.finite.tolist() == [False, True]
