"""Fits to the equation of motion: exact without noise, from any start, of every kind of log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.errors import MjfimError, RecordingError
from mjfim.experiment.initial import multisine
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.inverse_dynamics import inverse_dynamics
from mjfim.records.estimate_parts import InverseDynamicsFit
from mjfim.records.trajectory import Recording
from tests.support.hinged_arm import arm_experiment, arm_log, arm_parameters
from tests.support.numerics import CART_PENDULUM, Array
from tests.support.rescaling import Units, rescale
from tests.support.terms import recorded

CART = {
    "m": {"target": "body/bob:mass", "unit": "kg"},
    "l": {"target": "body/bob:pos[2]", "bounds": [0.05, 10.0], "unit": "m"},
    "c": {"target": "joint/hinge:damping", "unit": "N m s/rad"},
    "d": {"target": "joint/slide:damping", "unit": "N s/m"},
}
STATE = ("qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge")


def cart(folder: Path, text: str = CART_PENDULUM, **tables: Any) -> Experiment:
    """The cart-pendulum at 100 Hz."""
    folder.mkdir(parents=True, exist_ok=True)
    text = text.replace('damping="0.1"', 'damping="0.5"').format(integrator="RK4")
    (folder / "cart.xml").write_text(text, encoding="utf-8")
    defaults: dict[str, Any] = {
        "parameters": CART,
        "noise": dict.fromkeys(STATE, 0.01),
        "initial": {"qpos": (0.1, 3.0), "qvel": (0.0, 0.4), "control": {"kind": "constant"}},
    }
    return Experiment(
        model="cart.xml", directory=folder, source="cart", rate=100.0, **{**defaults, **tables}
    )


def cart_log(
    experiment: Experiment,
    sigma: float,
    seed: int = 0,
    seconds: float = 8.0,
    theta: Array | None = None,
    measured: tuple[str, ...] = STATE,
) -> Recording:
    """A log of the model at theta (default: the guess) under a multisine."""
    system = System.resolve(experiment.replace(noise=dict.fromkeys(measured, sigma)), threads=1)
    rng = np.random.default_rng(seed)
    ctrl = 4.0 * multisine(np.arange(round(100.0 * seconds)) / 100.0, 1, 0.3, 6, rng)
    at = system.parameters.guess if theta is None else theta
    return recorded(system, ctrl, seed, theta=at)


def true_of(experiment: Experiment) -> Array:
    """(p,) values of the parameters at which logs are made."""
    return System.resolve(experiment).parameters.guess


def errors(fit: InverseDynamicsFit, true: Array) -> Array:
    """(p,) errors over the sizes of the parameters."""
    return np.abs(fit.theta - true) / np.where(true != 0.0, np.abs(true), 1.0)


@pytest.mark.parametrize(
    "measured", [STATE[:2], ("qpos:slide", "qvel:hinge", "qpos:hinge"), STATE[2:]]
)
def test_positions_or_velocities_are_enough(measured: tuple[str, ...], tmp_path: Path) -> None:
    experiment = cart(tmp_path, noise=dict.fromkeys(measured, 1e-3))
    true = true_of(experiment)
    fit = inverse_dynamics(experiment, [cart_log(experiment, 1e-3, measured=measured)])
    assert errors(fit, true).max() < 0.03


@pytest.mark.slow
def test_errors_are_those_of_the_stated_accuracy(tmp_path: Path) -> None:
    experiment = cart(tmp_path)
    true = true_of(experiment)
    fits = [
        inverse_dynamics(experiment, [cart_log(experiment, 0.01, seed)], start=2.0 * true)
        for seed in range(8)
    ]
    deviations = np.array([(fit.theta - true) / fit.std for fit in fits])
    assert np.sqrt(np.mean(deviations**2)) == pytest.approx(1.0, abs=0.5)

    # The bias is small beside the parameters, but the stated accuracy does not contain it.
    bias = np.mean([fit.theta for fit in fits], axis=0) / true - 1.0
    assert np.abs(bias).max() < 0.02


def test_irregular_rows_missing_values_and_several_recordings(tmp_path: Path) -> None:
    experiment = cart(tmp_path)
    true = true_of(experiment)
    logs = []
    for seed in range(2):
        log = cart_log(experiment, 0.005, seed)
        rng = np.random.default_rng(seed)
        y = np.where(rng.random(log.y.shape) < 0.1, np.nan, log.y)
        y[300:340, 1::2] = np.nan

        # Between rows that were dropped, the control is the mean of what acted.
        inner = 1 + rng.choice(len(log.t) - 2, 700, replace=False)
        rows = np.array([0, *np.sort(inner), len(log.t) - 1])
        means = np.add.reduceat(log.ctrl, rows[:-1]) / np.diff(rows)[:, None]
        logs.append(replace(log, t=log.t[rows], ctrl=means, y=y[rows], name=f"{seed}.csv"))
    fit = inverse_dynamics(experiment, logs, start=3.0 * true)
    assert errors(fit, true).max() < 0.05


def test_filtered_drives_and_delays(tmp_path: Path) -> None:
    experiment = cart(tmp_path, nuisance={"delay": True})
    parameters = System.resolve(experiment).parameters
    true = np.array(parameters.guess)
    true[parameters.names.index("delay")] = 0.013
    fit = inverse_dynamics(experiment, [cart_log(experiment, 0.002, theta=true)])
    assert errors(fit, true).max() < 0.05


# ---- arms


def arm_forces(joints: int, theta: Array, experiment: Experiment) -> Array:
    """(30, joints) forces that random motions of the arm need with some parameters."""
    model = System.resolve(experiment, threads=1).model_at(theta)
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    data = mujoco.MjData(model)
    found = []
    for motion in np.random.default_rng(8).uniform(-1.0, 1.0, (30, 3, joints)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion
        mujoco.mj_inverse(model, data)
        found.append(np.array(data.qfrc_inverse))
    return np.array(found)


@pytest.mark.parametrize("coordinates", ["logcholesky", "barycentric"])
@pytest.mark.slow
def test_base_parameters_of_an_arm_with_hardly_any_noise(coordinates: str, tmp_path: Path) -> None:
    joints = 3
    log, _ = arm_log(joints, 8.0, np.random.default_rng(1), sigma=1e-7)
    tables = arm_parameters(joints, coordinates=coordinates)
    experiment = arm_experiment(tmp_path, joints, parameters=tables)
    true = true_of(experiment)

    # The start is an arm that is four times as heavy, with other friction.
    start = np.array(true)
    for j, name in enumerate(System.resolve(experiment).parameters.names):
        if name.startswith(("damping", "armature")):
            start[j] *= 6.0
        elif coordinates == "barycentric":
            start[j] *= 4.0
        elif name.endswith(".alpha"):
            start[j] += 0.5 * np.log(4.0)
    fit = inverse_dynamics(experiment, [log], start=start)
    assert fit.converged
    assert fit.iterations == 1
    assert fit.determined < len(true) - 10

    # What the recording determines is right: the forces of other motions.
    expected = arm_forces(joints, true, experiment)
    error = np.abs(arm_forces(joints, fit.theta, experiment) - expected).max(axis=0)
    assert (error < 0.01 * np.abs(expected).max(axis=0)).all()
    assert np.abs(arm_forces(joints, start, experiment) - expected).max() > 10.0
    assert not System.resolve(experiment).impossible(fit.theta)


def test_measured_torques_take_the_place_of_unknown_motors(tmp_path: Path) -> None:
    joints = 2
    log, _ = arm_log(joints, 15.0, np.random.default_rng(3), sigma=2e-5, torque_sigma=0.02)
    noise = {"qpos:joint1": 2e-5, "qpos:joint2": 2e-5, "torque1": 0.06, "torque2": 0.06}
    gains = {f"gain{i}": {"target": f"actuator/joint{i}:gainprm[0]"} for i in (1, 2)}
    experiment = arm_experiment(tmp_path, joints, noise=noise)
    experiment = experiment.replace(parameters=gains)
    true = np.array(System.resolve(experiment).parameters.guess)

    # The log holds currents, of which the gains are unknown.
    true[-2:] = 0.25, 4.0
    fit = inverse_dynamics(experiment, [replace(log, ctrl=log.ctrl / true[-2:])])
    assert [each.name for each in fit.equations][2:] == ["law of joint1", "law of joint2"]
    assert errors(fit, true)[-2:].max() < 0.01
    damping = [fit.parameters.index(f"damping{i}") for i in (1, 2)]
    assert errors(fit, true)[damping].max() < 0.02


# ---- units and misuse


@pytest.mark.parametrize(
    "units", [Units(length=2.0**10), Units(mass=2.0**-20), Units(time=2.0**10)]
)
def test_a_robot_of_another_size_gives_the_same_numbers(units: Units, tmp_path: Path) -> None:
    experiment = cart(tmp_path / "own")
    log = cart_log(experiment, 0.005)
    own = inverse_dynamics(experiment, [log])
    rescaled = rescale(experiment, units, tmp_path / "rescaled")
    other = inverse_dynamics(rescaled.experiment, [rescaled.recording(log)])
    factors = [units.factor(unit) for unit in own.units]
    assert_allclose(other.theta / factors, own.theta, rtol=1e-5)
    assert_allclose(other.std / factors, own.std, rtol=1e-3)
    assert [each.rows for each in other.equations] == [each.rows for each in own.equations]


def test_misuse_is_explained(tmp_path: Path) -> None:
    experiment = cart(tmp_path)
    log = cart_log(experiment, 1e-3, seconds=3.0)
    part = replace(log.first_rows(6), name="part")
    for logs, start, said in (
        ([], None, "at least one recording"),
        ([log], np.ones(2), r"start: \(2,\) numbers; expected one per parameter"),
        ([part], None, "part: a degree of freedom has only 6 measured"),
    ):
        with pytest.raises(MjfimError, match=said):
            inverse_dynamics(experiment, logs, start=start)
    short = arm_log(2, 0.05, np.random.default_rng(1))[0]
    with pytest.raises(RecordingError, match=r"the equation of motion has only \d+ rows for"):
        inverse_dynamics(arm_experiment(tmp_path, 2), [short])


def servo(
    folder: Path,
    parameters: dict[str, Any],
    *,
    stiffness: int = 300,
    friction: float = 0.5,
    **tables: Any,
) -> Experiment:
    """A servo at 500 Hz with a gain [N m/rad] and dry friction [N m]."""
    text = f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
      <body><joint name="j" axis="0 1 0" damping="0.3" frictionloss="{friction}"/>
        <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
      <actuator><position name="s" joint="j" kp="{stiffness}" kv="{stiffness / 30}"/></actuator>
      <sensor><actuatorfrc name="torque" actuator="s"/></sensor></mujoco>"""
    (folder / "servo.xml").write_text(text, encoding="utf-8")
    stated = {"noise": {"qpos:j": 1e-5, "torque": 1e-3}, "parameters": parameters, **tables}
    return Experiment(model="servo.xml", directory=folder, source="servo", rate=500.0, **stated)


def servo_log(
    experiment: Experiment, theta: list[float], seconds: float, slowest: float = 0.1, waves: int = 4
) -> Recording:
    """A log of the servo at theta under a multisine."""
    t = np.arange(round(500.0 * seconds)) / 500.0
    ctrl = 0.6 * multisine(t, 1, slowest, waves, np.random.default_rng(0))
    return recorded(System.resolve(experiment, threads=1), ctrl, theta=np.array(theta))


def test_servo_laws_with_recorded_references(tmp_path: Path) -> None:
    parameters = {
        "kp": {"target": "actuator/s:kp"},
        "damping": {"target": "joint/j:damping"},
        "armature": {"target": "joint/j:armature", "scale": 0.01},
    }
    noise = {"qpos:j": 1e-4}
    experiment = servo(tmp_path, parameters, stiffness=30, friction=0.0, noise=noise)
    log = servo_log(experiment, [30.0, 0.3, 0.0], 10.0, 0.3, 8)
    fit = inverse_dynamics(experiment, [log], start=np.array([5.0, 2.0, 0.1]))
    assert (np.abs(fit.theta - [30.0, 0.3, 0.0]) < [0.6, 0.06, 2e-3]).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stribeck", "lugre"])
def test_stribeck_friction_is_found_without_a_first_value(kind: str, tmp_path: Path) -> None:
    coulomb = {"stribeck": "joint/j:frictionloss", "lugre": "term/bristle:coulomb"}[kind]
    parameters = {
        "damping": {"target": "joint/j:damping", "guess": 0.1},
        "coulomb": {"target": coulomb, "guess": 0.2},
        "excess": EXCESS,
        "speed": SPEED,
    }
    experiment = servo(tmp_path, parameters, terms={"bristle": {"kind": kind, "joint": "j"}})
    true = [0.3, 0.5, 0.4, 0.15]

    # The guess has no excess, so that the rows do not depend on the Stribeck speed there.
    assert System.resolve(experiment).parameters.guess[2] == 0.0
    fit = inverse_dynamics(experiment, [servo_log(experiment, true, 12.0)])
    assert_allclose(fit.theta, true, rtol=0.02)
    assert (np.abs(fit.theta - true) < 5.0 * fit.std).all()


EXCESS, SPEED = {"target": "term/bristle:excess"}, {"target": "term/bristle:speed"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "true"),
    [
        ({**SPEED, "guess": 0.2, "bounds": [0.1, 5.0]}, 0.15),
        ({**SPEED, "guess": 0.2, "prior": 0.05}, 0.15),
        ({"targets": [{"path": "term/bristle:speed", "scale": 0.01}], "guess": 20.0}, 15.0),
    ],
    ids=["bounds", "prior", "factor"],
)
def test_stated_bounds_priors_and_factors_of_stribeck_friction_hold(
    speed: dict[str, Any], true: float, tmp_path: Path
) -> None:
    parameters = {"excess": {**EXCESS, "guess": 0.3, "bounds": [0.1, 5.0]}, "speed": speed}
    terms = {"bristle": {"kind": "stribeck", "joint": "j"}}
    experiment = servo(tmp_path, parameters, terms=terms)
    fit = inverse_dynamics(experiment, [servo_log(experiment, [0.4, true], 8.0)])
    assert_allclose(fit.theta, [0.4, true], rtol=0.2)
    assert np.isfinite(fit.std).all()
    assert fit.std[1] > 0.0


def test_a_term_without_unknown_speeds_leaves_the_speeds_of_others_to_be_tried(
    tmp_path: Path,
) -> None:
    """Stribeck friction of both joints, of which the speed of one is unknown."""
    friction = {"kind": "lugre", "values": {"coulomb": 0.4, "excess": 0.4, "speed": 0.3}}
    experiment = cart(
        tmp_path,
        parameters=CART | {"speed": {"target": "term/a:speed"}},
        terms={"a": friction | {"joint": "slide"}, "b": friction | {"joint": "hinge"}},
    )
    fit = inverse_dynamics(experiment, [cart_log(experiment, 1e-6)])
    assert fit.converged
