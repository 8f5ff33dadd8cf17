"""Gross errors of a log are named with their cure, before a fit; clean logs are fitted."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.errors import WrongLogError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.identification.aligned_recording import align
from mjfim.identification.inverse_dynamics import refuse_gross_error
from mjfim.output.archive import write_recording
from mjfim.records.trajectory import Recording
from scripts.benchmarks.starts import PENDULUM
from tests.support.cli import run
from tests.support.paths import MODELS
from tests.support.terms import recorded

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

MULTISINE = {"kind": "multisine", "amplitude": 6.0, "frequency": 0.3, "harmonics": 5}
SHOULDER, ELBOW = ["qpos:shoulder", "qvel:shoulder"], ["qpos:elbow", "qvel:elbow"]


def two_joint_arm(model: str = "two_joint_arm.xml", **changed: Any) -> mjfim.Experiment:
    """The two-joint arm with motors, under a multisine."""
    found = mjfim.Experiment.from_file(MODELS / "two_joint_arm.toml")
    control = {"control": MULTISINE}
    fit = {"segments": "whole", "bootstrap": 0}
    changed = {"rate": 200.0, "horizon": 4.0, "initial": control, "fit": fit} | changed
    return found.replace(model=model, **changed)


def servo_arm() -> mjfim.Experiment:
    """An arm with position servos whose friction is unknown."""
    return mjfim.Experiment.from_file(MODELS / "servo_arm.toml").replace(fit={"bootstrap": 0})


def logged(experiment: mjfim.Experiment, seed: int = 1) -> tuple[System, Recording]:
    """The system, and a clean log of the true robot."""
    system = System.resolve(experiment)
    return system, simulate_system(system, DesignTask.of(system).initial, seed=seed)


def refused(system: System, recording: Recording, factors: tuple[float, ...] = (1.0,)) -> str:
    """What is said about a log; empty where it would be fitted from factors of the guess."""
    start = np.array(factors) * system.parameters.guess
    try:
        refuse_gross_error(system, (align(system, recording),), start)
    except WrongLogError as error:
        return str(error)
    return ""


def cure_of(message: str) -> dict[str, Any]:
    """The lines of `[recording.columns]` in a message, as a file would state them."""
    lines = message.split("State in [recording.columns]: ")[1].replace("; ", "\n")
    return tomllib.loads(lines)


def scaled(*factors: float, name: str = "ctrl") -> Any:
    """Multiplies the controls, or the outputs, by factors."""
    return lambda log: replace(log, **{name: getattr(log, name) * factors})


# What is wrong with a log, and the entries that cure it.
ERRORS: dict[str, tuple[Any, dict[str, dict[str, Any]]]] = {
    "one control flipped": (scaled(-1.0, 1.0), {"ctrl:shoulder": {"scale": -1.0}}),
    "both controls flipped": (
        scaled(-1.0, -1.0),
        {"ctrl:shoulder": {"scale": -1.0}, "ctrl:elbow": {"scale": -1.0}},
    ),
    "currents in mA": (
        scaled(770.0, 770.0),
        {"ctrl:shoulder": {"scale": 1 / 770}, "ctrl:elbow": {"scale": 1 / 770}},
    ),
    "torques times 1.3": (
        scaled(1.3, 1.3),
        {"ctrl:shoulder": {"scale": 1 / 1.3}, "ctrl:elbow": {"scale": 1 / 1.3}},
    ),
    "controls swapped": (
        lambda log: replace(log, ctrl=log.ctrl[:, ::-1]),
        {"ctrl:shoulder": {"column": "ctrl:elbow"}, "ctrl:elbow": {"column": "ctrl:shoulder"}},
    ),
    "joints swapped": (
        lambda log: replace(log, y=log.y[:, [1, 0, 3, 2]]),
        {a: {"column": b} for a, b in zip(SHOULDER + ELBOW, ELBOW + SHOULDER, strict=True)},
    ),
    "zero of an encoder": (
        lambda log: replace(log, y=log.y + np.array([0.35, 0.0, 0.0, 0.0])),
        {"qpos:shoulder": {"offset": -0.35}},
    ),
    "joint flipped": (
        scaled(1.0, -1.0, 1.0, -1.0, name="y"),
        {name: {"scale": -1.0} for name in ELBOW},
    ),
}


@pytest.fixture(scope="module")
def arm() -> tuple[System, Recording]:
    """The two-joint arm and a clean log of it."""
    return logged(two_joint_arm())


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_is_named_with_the_lines_that_cure_it(
    name: str, arm: tuple[System, Recording]
) -> None:
    system, recording = arm
    make, cure = ERRORS[name]
    found = cure_of(refused(system, make(recording)))
    assert found.keys() == cure.keys()
    for column, entries in cure.items():
        for key, value in entries.items():
            expected = value if isinstance(value, str) else pytest.approx(value, rel=0.03)
            assert found[column][key] == expected


def test_positions_alone_and_servos_are_enough(arm: tuple[System, Recording]) -> None:
    system, recording = arm
    positions = replace(recording, y=recording.y[:, :2], outputs=recording.outputs[:2])
    flipped = refused(system, scaled(-1.0, -1.0)(positions))
    assert cure_of(flipped).keys() == {"ctrl:shoulder", "ctrl:elbow"}

    servos, commanded = logged(servo_arm())
    assert refused(servos, commanded) == ""
    flipped = refused(servos, scaled(1.0, -1.0, 1.0, 1.0)(commanded))
    assert cure_of(flipped)["ctrl:shoulder"]["scale"] == -1.0


def test_the_command_line_ends_with_exit_code_1(
    arm: tuple[System, Recording], tmp_path: Path
) -> None:
    system, recording = arm
    experiment = tmp_path / "arm.toml"
    text = (MODELS / "two_joint_arm.toml").read_text()
    experiment.write_text(text.replace('"two', f'"{MODELS}/two', 1).replace("1000.0", "200.0"))
    swapped = ERRORS["controls swapped"][0](recording)
    write_recording(tmp_path / "log.csv", swapped, system)
    result = run("identify", experiment, tmp_path / "log.csv", "-o", tmp_path / "fit")
    assert result.exit_code == 1
    assert "controls shoulder and elbow are swapped" in result.stderr


def test_a_factor_is_named_only_where_masses_are_not_free(arm: tuple[System, Recording]) -> None:
    """Bounds so wide that other masses explain the log leave nothing to name."""
    free = {
        f"free_{field}_{body}": {"target": f"body/{body}:{field}", "bounds": [0.0, 9.0]}
        for body in ("upper", "fore")
        for field in ("mass", "inertia[1]")
    }
    springs = {
        f"spring_{joint}": {"target": f"joint/{joint}:stiffness", "bounds": [0.0, 20.0]}
        for joint in ("shoulder", "elbow")
    }
    wide = two_joint_arm()
    tables = {name: each for name, each in wide.parameters.items() if name != "payload"}
    system = System.resolve(
        wide.model_copy(update={"parameters": tables}).replace(parameters=free | springs)
    )
    assert refused(system, scaled(1.3, 1.3)(arm[1])) == ""
    assert "scale = -1" in refused(system, scaled(-1.0, -1.0)(arm[1]))


def test_other_misfits_have_no_name(arm: tuple[System, Recording]) -> None:
    system, recording = arm
    noise = np.random.default_rng(0).normal(size=recording.y.shape)
    late = np.concatenate([recording.ctrl[12:], recording.ctrl[-12:]])
    for changes in (
        {"ctrl": 0.0 * recording.ctrl},
        {"ctrl": late},
        {"y": noise},
        {"y": 0.5 * recording.y},
    ):
        assert refused(system, replace(recording, **changes)) == ""


CLEAN = {
    "arm": (two_joint_arm, 0.4),
    "servos": (servo_arm, 0.08),
    "cart": (lambda: mjfim.Experiment.from_file(MODELS / "cart_pendulum_guess.toml"), 0.5),
}


@pytest.mark.parametrize("name", CLEAN)
def test_clean_logs_of_other_robots_have_no_error(name: str, tmp_path: Path) -> None:
    """Parameters are up to 50 % wrong, and every other robot has friction that the model lacks."""
    make, size = CLEAN[name]
    stated = make()
    system = System.resolve(stated)
    trajectory, parameters = DesignTask.of(system).initial, system.parameters
    for seed in range(10):
        rng = np.random.default_rng(seed)
        robot = stated
        if seed % 2:
            spec = mujoco.MjSpec.from_file(str(system.model_path))
            for joint in spec.joints:
                joint.frictionloss = size * rng.uniform(0.5, 1.5)
            spec.compile()
            (tmp_path / "robot.xml").write_text(spec.to_xml())
            robot = stated.replace(model=str(tmp_path / "robot.xml"))
        true = parameters.guess * rng.uniform(0.5, 1.5, len(parameters.guess))
        true = np.clip(true, parameters.lower, parameters.upper)
        log = recorded(System.resolve(robot), trajectory.ctrl, seed, theta=true)
        assert refused(system, log) == ""


@pytest.mark.parametrize("factors", [(0.32, 0.27, 0.13), (4.69, 0.15, 0.13), (0.14, 0.13, 6.69)])
def test_a_guess_that_is_far_off_is_no_error_of_the_log(
    factors: tuple[float, ...], tmp_path: Path
) -> None:
    """A wrong length of a pendulum looks like a wrong scale of its torque, until it is fitted."""
    (tmp_path / "pendulum.xml").write_text(PENDULUM, encoding="utf-8")
    com = {"path": "body/pole:ipos[2]", "scale": -1.0}
    unknown: dict[str, Any] = {
        "mass": {"target": "body/pole:mass", "bounds": [0.03, 12.0]},
        "com": {"targets": [com], "bounds": [0.02, 8.0]},
        "damping": {"target": "joint/hinge:damping", "bounds": [0.0025, 1.0]},
    }
    experiment = mjfim.Experiment(
        model=str(tmp_path / "pendulum.xml"),
        rate=100.0,
        horizon=8.0,
        noise={"qpos:hinge": 0.01},
        parameters=unknown,
        initial={"control": MULTISINE | {"amplitude": 1.2, "frequency": 0.4}},
    )
    system, recording = logged(experiment)
    assert refused(system, recording, factors) == ""
    assert "another sign or unit" in refused(system, scaled(-0.1)(recording))
