"""Numbers of an experiment file that are stated with a unit, and angles that look like degrees."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from mjfim.errors import ExperimentError
from mjfim.excitation.evaluation import open_boundary_warnings
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System
from mjfim.studies.inventory import stated_experiment
from tests.support.messages import unsaid

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="rail" type="slide" axis="1 0 0"/>
      <body name="arm">
        <inertial pos="0 0 0.3" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="hinge" axis="0 1 0" damping="0.1" range="-90 90"/>
        <body name="ball" pos="0 0 0.4">
          <inertial pos="0 0 0.1" mass="0.2" diaginertia="1e-3 1e-3 1e-3"/>
          <joint name="wrist" type="ball" damping="0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="rail"/>
    <position name="servo" joint="hinge" kp="20" kv="1"/>
    <motor name="geared" joint="hinge" gear="5"/>
  </actuator>
  <sensor><gyro name="gyro" site="tip"/></sensor>
</mujoco>
""".replace('<joint name="wrist"', '<site name="tip"/><joint name="wrist"')

BASE: dict[str, Any] = {
    "model": "arm.xml",
    "rate": 50.0,
    "horizon": 1.0,
    "initial": {"control": {"kind": "sine", "amplitude": 0.1}},
    "parameters": {"m": {"target": "body/arm:mass"}},
    "noise": {"state": 0.01},
}


def experiment(folder: Path, **tables: Any) -> Experiment:
    """An experiment with some of its tables replaced."""
    (folder / "arm.xml").write_text(MODEL, encoding="utf-8")
    return Experiment(**{**BASE, **tables}, directory=folder, source="arm.toml")


START = ["5 cm", "30 deg", 1.0, 0.0, 0.0, 0.0]

# The same experiment twice: with units, and with plain numbers in the units of the model.
WITH_UNITS: dict[str, Any] = {
    "rate": "0.05 kHz",
    "horizon": "1000 ms",
    "initial": {
        "qpos": START,
        "qvel": ["10 cm/s", "30 deg/s", "1 rpm", 0.0, 0.0],
        "control": {
            "kind": "sine",
            "amplitude": {"push": "500 mN", "servo": "5 deg"},
            "frequency": "2 Hz",
        },
    },
    "parameters": {
        "m": {"target": "body/arm:mass", "guess": "900 g", "true": "1 kg", "bounds": ["1 g", 5.0]},
        "c": {"target": "joint/hinge:damping", "guess": "100 mN m s/rad", "prior": "1 N m s"},
        "z": {
            "targets": [{"path": "body/arm:ipos[2]", "scale": -1.0, "offset": "1 cm"}],
            "guess": "-30 cm",
            "wanted": "1 mm",
            "published": "-31 cm",
        },
    },
    "noise": {
        "qpos:rail": "1 mm",
        "qpos:hinge": {"sigma": "0.1 deg", "rate": "25 Hz"},
        "qpos:wrist": "1 deg",
        "gyro": {"sigma": ["1 deg/s", 0.01, "1 rpm"]},
    },
    "nuisance": {"initial": {"qpos:hinge": "1 deg", "qvel:hinge": True}, "delay": "3 ms"},
    "limits": {
        "position": {"rail": ["-50 cm", "50 cm"], "hinge": ["-80 deg", 1.2]},
        "velocity": {"hinge": "1 rev/s", "rail": ["-1 m/s", math.inf]},
        "acceleration": {"hinge": "100 rad/s^2"},
        "control": {"servo": ["-45 deg", "45 deg"]},
        "control_rate": {"servo": "90 deg/s"},
        "force": {"servo": "10 Nm"},
        "bandwidth": "5 Hz",
    },
    "descent": {"seconds": "2 min"},
}


def test_units_and_plain_numbers_state_the_same(tmp_path: Path) -> None:
    stated, plain = (
        experiment(tmp_path, **tables) for tables in (WITH_UNITS, converted(WITH_UNITS))
    )
    System.resolve(stated)
    System.resolve(plain)

    found, expected = (e.model_dump(mode="json", exclude_unset=True) for e in (stated, plain))
    assert rounded(found) == rounded(expected)


# Units of `WITH_UNITS` in those of the model.
FACTORS = {
    "deg": math.pi / 180.0,
    "deg/s": math.pi / 180.0,
    "rpm": math.pi / 30.0,
    "rev/s": 2.0 * math.pi,
    "rad/s^2": 1.0,
    "mm": 1e-3,
    "cm": 1e-2,
    "cm/s": 1e-2,
    "m/s": 1.0,
    "g": 1e-3,
    "kg": 1.0,
    "mN": 1e-3,
    "Nm": 1.0,
    "mN m s/rad": 1e-3,
    "N m s": 1.0,
    "ms": 1e-3,
    "min": 60.0,
    "Hz": 1.0,
    "kHz": 1e3,
}


def converted(value: Any) -> Any:
    """The tables with plain numbers."""
    if isinstance(value, dict):
        return {key: converted(each) for key, each in value.items()}
    if isinstance(value, list):
        return [converted(each) for each in value]
    number, _, unit = str(value).partition(" ")
    return float(number) * FACTORS[unit] if unit in FACTORS else value


def rounded(values: Any) -> Any:
    """The values with numbers of twelve digits."""
    return json.loads(json.dumps(values), parse_float=lambda number: float(f"{float(number):.12g}"))


# A changed table, and the beginning and the end of the message.
WRONG = {
    "angle": (
        {"initial": {"qpos": [0.0, "90 kg", 1.0, 0.0, 0.0, 0.0]}},
        "arm.toml: initial.qpos[1]: '90 kg' is no number in rad … the units rad, deg, rev",
    ),
    "velocity": (
        {"initial": {"qvel": [0.0, "1 deg", 0.0, 0.0, 0.0]}},
        "initial.qvel[1]: '1 deg' is no number in rad/s … deg/s",
    ),
    "quaternion": (
        {"initial": {"qpos": [0.0, 0.0, "1 rad", 0.0, 0.0, 0.0]}},
        "initial.qpos[2]: '1 rad' has a unit, but … plain number",
    ),
    "limit": (
        {"limits": {"position": {"rail": [-1.0, "90 deg"]}}},
        "limits.position.rail: '90 deg' is no number in m … m, cm, mm",
    ),
    "mixed limit": (
        {"limits": {"velocity": "30 deg/s"}},
        "limits.velocity: '30 deg/s' would stand for numbers in m/s and rad/s … by its name",
    ),
    "geared motor": (
        {"limits": {"control": {"geared": [-1.0, "1 N m"]}}},
        "limits.control.geared: '1 N m' has a unit, but the model does not say … plain number",
    ),
    "amplitude": (
        {"initial": {"control": {"kind": "sine", "amplitude": {"servo": "1 N m"}}}},
        "initial.control.amplitude.servo: '1 N m' is no number in rad … deg",
    ),
    "noise of all": (
        {"noise": {"state": "1 mm"}},
        "noise.state: '1 mm' would stand for numbers in m and rad … by its name",
    ),
    "wrong noise of all": (
        {"noise": {"state": "1 kg"}},
        "noise.state: '1 kg' is no number in m or rad … units m, cm, mm, rad, deg, rev",
    ),
    "bias": (
        {"nuisance": {"bias": {"qpos:rail": "1 s"}}},
        "nuisance.bias.qpos:rail: '1 s' is no number in m … mm",
    ),
    "guess": (
        {"parameters": {"m": {"target": "body/arm:mass", "guess": "1 m"}}},
        "parameters.m.guess: '1 m' is no number in kg … units kg, g",
    ),
    "scaled guess": (
        {
            "parameters": {
                "m": {"targets": [{"path": "body/arm:mass", "scale": 2.0}], "guess": "1 kg"}
            }
        },
        "parameters.m.guess: '1 kg' has a unit, but the model does not say … plain number",
    ),
    "weight": (
        {"cost": {"control_about": {"push": "1 rad"}}},
        "cost.control_about.push: '1 rad' is no number in N … mN",
    ),
    "fixed unit": ({"horizon": "4 m"}, "horizon: '4 m' is no number in s"),
    "angular rate": ({"rate": "60 rpm"}, "rate: '60 rpm' is no number in Hz"),
    "unknown unit": (
        {"limits": {"velocity": {"hinge": "1 furlong/s"}}},
        "limits.velocity.hinge: unknown unit 'furlong",
    ),
    "no unit": ({"noise": {"state": "0.1"}}, "noise.state: should be a number, or with its unit"),
    "sign": ({"horizon": "-4 s"}, "horizon: should be greater than 0"),
    "a number instead of a table": (
        {"limits": {"position": 1.0}},
        "limits.position: should be a table by name, for example { hinge = [-1.0, 1.0] } (got 1.0)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_unit_is_named(name: str, tmp_path: Path) -> None:
    tables, parts = WRONG[name]
    with pytest.raises(ExperimentError) as error:
        System.resolve(experiment(tmp_path, **tables))
    assert unsaid(parts, str(error.value)) == []
    assert "\n" not in str(error.value)


def test_a_changed_copy_keeps_units(tmp_path: Path) -> None:
    changed = experiment(tmp_path, initial={"qpos": START}).replace(rate=25.0)
    wrong = changed.replace(initial={"qpos": [0.0, "1 kg", 1.0, 0.0, 0.0, 0.0]}).replace(rate=50.0)
    with pytest.raises(ExperimentError, match="'1 kg' is no number in rad"):
        System.resolve(wrong)


def degrees(folder: Path, **tables: Any) -> list[str]:
    """Keys of an experiment that look like degrees."""
    stated = experiment(folder, **tables)
    return [
        text.partition(":")[0] for text in probable_degrees(stated, System.resolve(stated).source)
    ]


@pytest.mark.parametrize("angle", [180.0, -90, 45.0, 15.0, 37.5, -8.0])
def test_angles_that_look_like_degrees(angle: float, tmp_path: Path) -> None:
    """The range of the hinge is ±90 degrees, so that 37.5 and -8 are inside only in degrees.

    Metres and speeds have no such problem.
    """
    control = {"kind": "sine", "amplitude": {"servo": 30.0, "push": 30.0}}
    found = degrees(
        tmp_path,
        limits={
            "position": {"hinge": [-90.0, 90.0], "rail": [-90.0, 90.0]},
            "control": {"servo": [-90.0, 90.0]},
            "velocity": {"hinge": 180.0},
        },
        initial={"qpos": [180.0, angle, 1.0, 0.0, 0.0, 0.0], "control": control},
    )
    assert found == [
        "initial.qpos[1]",
        "initial.control.amplitude.servo",
        "limits.position.hinge",
        "limits.control.servo",
    ]


@pytest.mark.parametrize("angle", [0.0, 1.5, 3.14, 6.0, "180 rad", "90 deg", 200.5])
def test_other_angles_are_believed(angle: Any, tmp_path: Path) -> None:
    start = {**BASE["initial"], "qpos": [180.0, angle, 1.0, 0.0, 0.0, 0.0]}
    assert degrees(tmp_path, initial=start) == []


def test_design_check_and_validate_say_it(tmp_path: Path) -> None:
    stated = experiment(tmp_path, limits={"position": {"hinge": [-90.0, 90.0]}})
    sentence = (
        "limits.position.hinge: -90 rad are 14.3 turns and look like degrees; state "
        '"-90 deg" if they are, or "-90 rad" if not'
    )
    assert sentence in list(open_boundary_warnings(DesignTask.resolve(stated)))
    assert stated_experiment(stated).warnings == (sentence,)
