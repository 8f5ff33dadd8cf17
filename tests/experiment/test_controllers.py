"""The table `[controllers]`: what it states, messages about misuse, and columns of logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError
from mjfim.experiment.controls import stated_inputs
from mjfim.experiment.system import System
from mjfim.model.control_laws import Quantity
from mjfim.recordings.read import read_recording
from mjfim.recordings.section import LAW_PREFIXES
from mjfim.studies.inventory import stated_experiment
from tests.support.closed_loop import arm_experiment
from tests.support.messages import unsaid
from tests.support.paths import MODELS

PD = {"kp": 60.0, "kd": 4.0}

# Tables of an experiment, and parts of the message that refuses them.
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "actuator": (
        {"controllers": {"shouldr": PD}},
        "controllers: unknown actuator 'shouldr' … did you mean 'shoulder' … elbow, shoulder",
    ),
    "joint": (
        {"controllers": {"shoulder": PD | {"joint": "wrist"}}},
        "controllers.shoulder.joint … 'wrist' … valid: elbow, shoulder",
    ),
    "rate": (
        {"controllers": {"shoulder": PD | {"rate": 300.0}}},
        "controllers.shoulder.rate: 300 Hz does not divide … 1000 Hz … 500, 250, 200",
    ),
    "negative gain": (
        {"controllers": {"shoulder": {"kp": -1.0}}},
        "controllers.shoulder.kp … greater than or equal to 0 … -1",
    ),
    "jump without a profile": (
        {"controllers": {"shoulder": PD | {"jump": 0.1}}},
        "controllers.shoulder: jump needs acceleration",
    ),
    "nothing": (
        {"controllers": {"shoulder": {"rate": 500.0}}},
        "controllers.shoulder: the law computes nothing … kp, kd, ki or feedforward",
    ),
    "range": (
        {"controllers": {"shoulder": PD | {"saturation": (2.0, -2.0)}}},
        "controllers.shoulder: saturation [2.0, -2.0] needs lower < upper",
    ),
    "parameter without a law": (
        {"parameters": {"k": {"target": "controller/elbow:kp"}}},
        "parameters.k … unknown controller 'elbow' … valid: shoulder",
    ),
    "no law": (
        {"controllers": {}, "parameters": {"k": {"target": "controller/elbow:kp"}}},
        "states no law in [controllers]",
    ),
    "field of a parameter": (
        {"parameters": {"k": {"target": "controller/shoulder:kv"}}},
        "unknown controller field 'kv' … velocity_time_constant",
    ),
    "index of a parameter": (
        {"parameters": {"k": {"target": "controller/shoulder:saturation[2]"}}},
        "index 2 is out of range … valid: 0 to 1",
    ),
    "limit that is not stated": (
        {"parameters": {"k": {"target": "controller/shoulder:slew"}}},
        "the law states no slew … state `slew` in [controllers.shoulder]",
    ),
    "gain without a size": (
        {"parameters": {"k": {"target": "controller/shoulder:ki"}}},
        "parameters.k.scale: the guess … is 0",
    ),
    "two owners": (
        {
            "parameters": {
                "a": {"target": "controller/shoulder:kp"},
                "b": {"target": "controller/shoulder:kp"},
            }
        },
        "parameters.b: target 'controller/shoulder:kp' already belongs to parameters.a",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(name: str) -> None:
    tables, parts = FAULTS[name]
    with pytest.raises(ExperimentError) as caught:
        System.resolve(arm_experiment(**{"controllers": {"shoulder": PD}, **tables}))
    message = str(caught.value)
    assert unsaid(parts, message) == []
    assert "\n" not in message


@pytest.mark.parametrize("verb", ["design", "check", "compare"])
def test_designs_are_refused(verb: str) -> None:
    control = {"kind": "multisine", "amplitude": 0.3}
    experiment = arm_experiment({"shoulder": PD}, horizon=1.0, initial={"control": control})
    with pytest.raises(ExperimentError) as caught:
        getattr(mjfim, verb)(experiment, progress=False)
    assert "a control without a law" in str(caught.value)
    assert "<position" in str(caught.value)


def test_laws_follow_the_experiment() -> None:
    """Names, units and numbers; another experiment on the same model has its own laws."""
    law = PD | {"feedforward": True, "latency": "3 ms", "slew": 100.0, "kind": "voltage"}
    law |= {"acceleration": 40.0, "jump": 0.1}
    experiment = arm_experiment({"shoulder": law})
    system = System.resolve(experiment)

    assert system.inputs == ("reference:shoulder", "feedforward:shoulder", "ctrl:elbow")
    assert system.laws.period == 2
    paths = {"kp": "V/rad", "kd": "V s/rad", "latency": "s", "slew": "V/s", "saturation[1]": "V"}
    paths |= {"acceleration": "rad/s²", "jump": "rad"}
    for path, unit in paths.items():
        parameters = {"x": {"target": f"controller/shoulder:{path}"}}
        found = System.resolve(experiment.replace(parameters=parameters), source=system.source)
        assert found.parameters.parameters[1].unit == unit
    assert found.parameters.guess[1] == 0.1

    # Laws with these numbers need no other model.
    assert System.resolve(experiment, source=system.source).source is system.source

    # The model of another experiment holds no law any more.
    plain = System.resolve(arm_experiment({}), source=system.source)
    assert plain.inputs == ("ctrl:shoulder", "ctrl:elbow")
    assert plain.model.nnumeric == 0
    assert experiment.packed().controllers == experiment.controllers


def test_a_law_takes_the_place_of_a_position_servo(tmp_path: Path) -> None:
    """As if the MJCF had motors with its range of force; without kp, a law commands the servo."""
    text = (MODELS / "two_joint_arm.xml").read_text()
    servo = 'kp="9" ctrlrange="-1 1" forcerange="-20 20"'
    text = text.replace("<motor", "<position").replace('ctrlrange="-20 20"', servo)
    path = tmp_path / "servos.xml"
    path.write_text(text)
    laws = dict.fromkeys(("shoulder", "elbow"), PD | {"latency": "3 ms"})
    control = {"kind": "sine", "amplitude": 0.5, "frequency": 2.0}
    motor = arm_experiment(laws, horizon=0.4, initial={"control": control})
    stated = motor.replace(model=str(path))
    assert np.array_equal(mjfim.simulate(stated).y, mjfim.simulate(motor).y)
    law, _ = stated_experiment(stated).controllers
    assert (law.actuator, law.rate, law.columns) == ("shoulder", 500.0, ("reference:shoulder",))
    assert law.replaces_servo and not stated_experiment(motor).controllers[0].replaces_servo
    commanded = arm_experiment({"shoulder": {"feedforward": True}}, model=str(path))
    assert System.resolve(commanded).model.actuator_gainprm[0, 0] == 9.0

    # A motor keeps the time constant of the servo. A law over a geared servo commands it.
    text = text.replace("<position", '<position timeconst="0.05"', 1)
    path.write_text("<position gear='2'".join(text.rsplit("<position", 1)))
    model = System.resolve(stated).model
    assert model.actuator_dynprm[0, 0] == 0.05
    assert model.actuator_gainprm[:, 0].tolist() == [1.0, 9.0]


def test_the_names_of_columns_are_those_of_laws() -> None:
    assert tuple(f"{quantity}:" for quantity in get_args(Quantity)) == LAW_PREFIXES


# ---- logs

COLUMNS = ("t", "reference:shoulder", "ctrl:elbow", "qpos:shoulder", "qpos:elbow")


T = np.arange(60) * 0.002


def log(folder: Path, names: tuple[str, ...], values: list[Array] | None = None) -> Path:
    """A log with columns of these names after the time, by default sines of different phases."""
    columns = values or [np.sin(7.0 * T + i) for i in range(1, len(names))]
    path = folder / "log.csv"
    rows = np.column_stack([T, *columns])
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="")
    return path


def test_a_log_with_references_is_read(tmp_path: Path) -> None:
    system = System.resolve(arm_experiment({"shoulder": PD | {"enable": True}}))
    spec = {
        "reference:shoulder": {"column": "goal", "unit": "deg"},
        "enable:shoulder": 1.0,
        "qpos:shoulder": "qpos:shoulder",
    }
    system = System.resolve(system.experiment.replace(recording={"columns": spec}))
    names = ("t", "goal", "ctrl:elbow", "qpos:shoulder")
    found = read_recording(log(tmp_path, names), system.channels)

    goal, elbow = (np.sin(7.0 * T[:-1] + i) for i in (1, 2))
    expected = np.column_stack([np.deg2rad(goal), np.ones(59), elbow])
    assert_allclose(found.ctrl, expected)
    assert found.outputs == ("qpos:shoulder",)


# Columns of a log or of the table [recording.columns], and parts of the message.
LOG_FAULTS: dict[str, tuple[tuple[str, ...], dict[str, Any], str]] = {
    "missing": (
        ("t", "ctrl:elbow", "qpos:shoulder"),
        {},
        "column 'reference:shoulder' is missing … [recording.columns] … \"reference:shoulder\"",
    ),
    "both": (
        (*COLUMNS, "ctrl:shoulder"),
        {},
        "'ctrl:shoulder': [controllers.shoulder] computes this control",
    ),
    "not read": (
        (*COLUMNS, "feedforward:shoulder"),
        {},
        "the law of this actuator does not read it … feedforward = true",
    ),
    "no law": (
        (*COLUMNS, "reference:elbow"),
        {},
        "states no law for this actuator … [controllers.elbow]",
    ),
    "stated control": (
        COLUMNS,
        {"ctrl:shoulder": "torque"},
        "[controllers.shoulder] computes this control … <actuatorfrc>",
    ),
    "unit": (
        COLUMNS,
        {"reference:shoulder": {"column": "reference:shoulder", "unit": "m"}},
        "recording.columns.reference:shoulder.unit … valid: deg, rad, rev",
    ),
}


@pytest.mark.parametrize("name", LOG_FAULTS)
def test_faults_of_logs_are_named(name: str, tmp_path: Path) -> None:
    names, columns, parts = LOG_FAULTS[name]
    experiment = arm_experiment({"shoulder": PD}, recording={"columns": columns})
    with pytest.raises((RecordingError, ExperimentError)) as caught:
        read_recording(log(tmp_path, names), System.resolve(experiment).channels)
    message = str(caught.value)
    assert unsaid(parts, message) == []


def test_a_reference_in_degrees_is_refused(tmp_path: Path) -> None:
    wave = np.sin(9.0 * T)
    path = log(tmp_path, COLUMNS, [57.3 * wave, wave, 0.9 * wave, 0.2 * wave])
    experiment = arm_experiment({"shoulder": PD})
    with pytest.raises(RecordingError, match=r"'reference:shoulder' moves .* probably in deg"):
        read_recording(path, System.resolve(experiment).channels)

    columns = {"reference:shoulder": {"column": "reference:shoulder", "unit": "rad"}}
    believed = experiment.replace(recording={"columns": columns})
    assert read_recording(path, System.resolve(believed).channels).ctrl[:, 0].max() > 20.0


# ---- references that an experiment states


def test_a_signal_states_references_and_controls() -> None:
    law = PD | {"reference_velocity": "column", "enable": True, "gain": True, "feedforward": True}
    control = {"kind": "sine", "amplitude": {"shoulder": 0.3, "elbow": 2.0}, "frequency": 1.0}
    experiment = arm_experiment(
        {"shoulder": law}, horizon=1.0, initial={"qpos": (0.2, 0.0), "control": control}
    )
    system = System.resolve(experiment)
    inputs = dict(zip(system.inputs, stated_inputs(system).T, strict=True))

    angle = 2 * np.pi * np.arange(500) * 0.002
    expected = {
        "reference:shoulder": 0.2 + 0.3 * np.sin(angle),
        "reference_velocity:shoulder": 0.6 * np.pi * np.cos(angle),
        "enable:shoulder": 1.0,
        "gain:shoulder": 1.0,
        "feedforward:shoulder": 0.0,
        "ctrl:elbow": 2.0 * np.sin(1.17 * angle),
    }
    assert {*inputs} == {*expected}
    for name, values in expected.items():
        assert_allclose(inputs[name], values, atol=2e-2 if "velocity" in name else 1e-9)


def test_an_actuator_without_a_joint_needs_one(tmp_path: Path) -> None:
    text = (MODELS / "two_joint_arm.xml").read_text()
    text = text.replace('<geom name="fore"', '<site name="tip"/><geom name="fore"')
    text = text.replace('<motor name="elbow" joint="elbow"/>', '<motor name="elbow" site="tip"/>')
    path = tmp_path / "arm.xml"
    path.write_text(text)
    with pytest.raises(ExperimentError, match=r"controllers\.elbow\.joint = 'shoulder'"):
        System.resolve(arm_experiment({"elbow": PD}, model=str(path)))

    # A term moves the motor from its joint to a tendon.
    worm = {"worm": {"kind": "load_dependent_friction", "actuator": "elbow"}}
    for law, tables in ((PD | {"joint": "elbow"}, {"model": str(path)}), (PD, {"terms": worm})):
        system = System.resolve(arm_experiment({"elbow": law}, **tables))
        assert system.laws.laws[0].joint == "elbow"
