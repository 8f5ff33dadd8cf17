"""Physical terms of the library in MuJoCo: their equations, their writing, and their text."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError
from mjfim.excitation.limits.limits import limits_of
from mjfim.experiment.system import System
from mjfim.experiment.system_tables import TermKind
from mjfim.experiment.task_tables import Limits
from mjfim.model.terms.library import KINDS
from mjfim.output.export.mjcf import write_identified
from tests.support.specs import arrays_of
from tests.support.terms import (
    DAMPING,
    EXAMPLES,
    INERTIA,
    JOINTS,
    ROTOR,
    WEIGHT,
    experiment_of,
    motor_torque,
    write_pendulum,
)

INTEGRATORS = ("Euler", "implicitfast", "RK4")


def simulated(system: System, ctrl: Any, theta: Any = None) -> Any:
    """(N+1, 2) angle and speed of a system at the true values."""
    found = system.plant.simulate(system.parameters.true if theta is None else theta, ctrl)
    return np.hstack([found.qpos[:, :1], found.qvel[:, :1]])


def integrated(force: Any, ctrl: Any, dt: float, start: Any) -> Any:
    """(N+1, n) states from another solver.

    force: accelerations and further derivatives, f(state, control) -> derivative of the state.
    """
    rows = [np.array(start, dtype=float)]
    for u in ctrl[:, 0]:
        solution = scipy.integrate.solve_ivp(
            lambda t, x, u=u: force(x, u), (0.0, dt), rows[-1], method="LSODA", rtol=1e-8, atol=1e-9
        )
        rows.append(solution.y[:, -1])
    return np.array(rows)


def test_every_kind_is_in_the_experiment_file_and_tested() -> None:
    assert set(get_args(TermKind)) == set(KINDS) == set(EXAMPLES)
    for kind in KINDS.values():
        assert kind.description.endswith(".")
        assert kind.equation
        assert kind.elements
        assert kind.sources
        assert kind.fields


# ---- the equations, against an integration by SciPy


def rigid(angle: float, speed: float, torque: float) -> float:
    """Acceleration of the pendulum under a torque at its pivot."""
    return (torque - WEIGHT * np.sin(angle) - DAMPING * speed) / INERTIA


def payload(x: Any, u: float, v: dict[str, float]) -> list[float]:
    """Derivative of the state with a point mass on the rod."""
    weight = WEIGHT - v["mass"] * 9.81 * v["z"]
    torque = u - weight * np.sin(x[0]) - DAMPING * x[1]
    return [x[1], torque / (INERTIA + v["mass"] * v["z"] ** 2)]


# Kind -> derivative of the state (angle, speed, torque) by a term with the values v.
EQUATIONS: dict[str, Any] = {
    "back_emf": lambda x, u, v: [x[1], rigid(x[0], x[1], u - v["constant"] * x[1]), 0.0],
    "actuator_lag": lambda x, u, v: [x[1], rigid(*x), (u - x[2]) / v["time_constant"]],
    "tilt": lambda x, u, v: [
        x[1],
        (u - WEIGHT * np.sin(x[0] - v["y"]) - DAMPING * x[1]) / INERTIA,
        0.0,
    ],
    "payload": lambda x, u, v: [*payload(x, u, v), 0.0],
    "asymmetric_friction": lambda x, u, v: [
        x[1],
        rigid(x[0], x[1], u + v["offset"] - 0.03 * np.tanh(x[1] / 1e-3)),
        0.0,
    ],
    "load_dependent_friction": lambda x, u, v: [
        x[1],
        rigid(x[0], x[1], u - v["coefficient"] * abs(u) * np.tanh(x[1] / 1e-3)),
        0.0,
    ],
}


@pytest.mark.parametrize("kind", ["back_emf", "actuator_lag", "tilt", "payload"])
def test_smooth_terms_move_as_their_equation_says(tmp_path: Path, kind: str) -> None:
    system = System.resolve(experiment_of(tmp_path, kind, initial={"keyframe": "start"}))
    ctrl, values = motor_torque(1.0, 100.0), EXAMPLES[kind][1]
    expected = integrated(lambda x, u: EQUATIONS[kind](x, u, values), ctrl, 0.01, [0.5, 0.0, 0.3])[
        :, :2
    ]
    span = np.ptp(expected, axis=0)

    # The engine is of first order: with a quarter of the timestep a quarter of the error remains.
    errors = []
    for timestep in (0.001, 0.00025):
        write_pendulum(tmp_path, timestep=timestep, joint=JOINTS.get(kind, ""))
        found = simulated(System.resolve(system.experiment), ctrl)
        errors.append(np.abs(found - expected).max(axis=0) / span)
    assert (errors[0] < 0.02).all()
    assert (errors[1] < 0.35 * errors[0]).all()

    # Without the term, the motion is another one.
    without = simulated(system, ctrl, system.parameters.guess)
    assert (np.abs(without - expected).max(axis=0) > 0.02 * span).all()


def assert_near(found: Any, expected: Any, tolerance: float) -> None:
    """The error of each column is small against its range."""
    error = np.sqrt(np.mean((found - expected) ** 2, axis=0)) / np.ptp(expected, axis=0)
    assert (error < tolerance).all()


# The bristle of the term "stribeck" is short; SciPy integrates one that is shorter still.
BRISTLE = {"stribeck": (0.03, 2e3, 2.0), "lugre": (0.0, 30.0, 0.1)}


@pytest.mark.parametrize(
    ("kind", "integrator"),
    [
        *(("lugre", integrator) for integrator in INTEGRATORS),
        ("stribeck", "Euler"),
        ("stribeck", "implicitfast"),
    ],
)
def test_dynamic_friction_moves_as_lugre_says(tmp_path: Path, kind: str, integrator: str) -> None:
    coulomb, stiffness, damping = BRISTLE[kind]
    v = {"coulomb": coulomb, **EXAMPLES[kind][1]}
    values = {"stiffness": stiffness, "damping": damping} if kind == "lugre" else {}
    terms = {"extra": {"kind": kind, "joint": "pivot", "values": values}}
    experiment = experiment_of(tmp_path, kind, terms=terms)
    write_pendulum(tmp_path, timestep=0.0005, integrator=integrator, joint=JOINTS.get(kind, ""))

    def derivative(x: Any, u: float) -> list[float]:
        angle, speed, z = x
        g = v["coulomb"] + v["excess"] * np.exp(-((speed / v["speed"]) ** 2))
        rate = speed - stiffness * abs(speed) / g * z
        return [speed, rigid(angle, speed, u - stiffness * z - damping * rate), rate]

    ctrl = motor_torque(2.0, 100.0)
    expected = integrated(derivative, ctrl, 0.01, [0.0, 0.0, 0.0])[:, :2]
    assert_near(simulated(System.resolve(experiment), ctrl), expected, 0.02)


@pytest.mark.parametrize("timestep", [0.001, 0.002])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kind", ["load_dependent_friction", "asymmetric_friction"])
def test_friction_moves_as_its_equation_says(
    tmp_path: Path, kind: str, integrator: str, timestep: float
) -> None:
    experiment = experiment_of(tmp_path, kind)
    write_pendulum(tmp_path, timestep=timestep, integrator=integrator, joint=JOINTS.get(kind, ""))
    system, ctrl = System.resolve(experiment), motor_torque(1.5, 100.0)
    values = EXAMPLES[kind][1]
    expected = integrated(lambda x, u: EQUATIONS[kind](x, u, values), ctrl, 0.01, [0.0] * 3)[:, :2]
    assert_near(simulated(system, ctrl), expected, 0.005)
    without = simulated(system, ctrl, system.parameters.guess)
    assert np.abs(without - expected)[:, 0].max() > 0.1 * np.ptp(expected[:, 0])

    # Impacts of the ball would have derivatives of 1e4. Some Euler steps show a part of them.
    true = system.parameters.true
    motion = system.plant.simulate(true, ctrl)
    linear = system.plant.derivatives.linearize(true, motion)
    dx = np.zeros(system.plant.space.nx)
    for A, B, u in zip(linear.A, linear.B, ctrl, strict=True):
        dx = A @ dx + B @ u
    change = (simulated(system, 1.01 * ctrl)[-1, 0] - motion.qpos[-1, 0]) / 0.01
    assert dx[0] == pytest.approx(change, rel=0.15 if integrator == "RK4" else 1.0)


def test_friction_of_the_load_needs_direct_drives_only(tmp_path: Path) -> None:
    """The friction would contain the feedback of a servo beside the motor."""
    experiment = experiment_of(tmp_path, "load_dependent_friction")
    path = tmp_path / "pendulum.xml"
    servo = '<position name="servo" joint="pivot"/></actuator>'
    path.write_text(path.read_text(encoding="utf-8").replace("</actuator>", servo))
    with pytest.raises(ExperimentError, match="'servo' is no direct drive at a hinge"):
        System.resolve(experiment)


@pytest.mark.parametrize("encoder", ["motor", "link"])
@pytest.mark.parametrize("kind", ["joint_elasticity", "backlash"])
def test_motor_and_link_move_as_two_inertias(tmp_path: Path, kind: str, encoder: str) -> None:
    values = {"compliance": 0.05, "damping": 0.004, **EXAMPLES[kind][1]}
    terms = {"extra": {"kind": kind, "joint": "pivot", "encoder": encoder, "values": values}}
    experiment = experiment_of(tmp_path, kind, initial={"keyframe": "start"}, terms=terms)
    write_pendulum(tmp_path, timestep=0.0005, joint=f'armature="{ROTOR}"')
    system = System.resolve(experiment)

    # The friction of the joint is on its side.
    of_motor, of_link = (DAMPING, 0.0) if encoder == "motor" else (0.0, DAMPING)

    def derivative(x: Any, u: float) -> list[float]:
        motor, motor_speed, link, speed = x
        deflection = motor - link
        beyond = np.sign(deflection) * max(abs(deflection) - values.get("gap", 0.0) / 2.0, 0.0)
        torque = beyond / values["compliance"] + values["damping"] * (motor_speed - speed)
        return [
            motor_speed,
            (u - torque - of_motor * motor_speed) / ROTOR,
            speed,
            (torque - WEIGHT * np.sin(link) - of_link * speed) / INERTIA,
        ]

    ctrl = motor_torque(2.0, 100.0)
    expected = integrated(derivative, ctrl, 0.01, [0.5, 0.0, 0.5, 0.0])
    found = system.plant.simulate(system.parameters.guess, ctrl).qpos
    sides = np.stack([found[:, 0], found.sum(axis=1)])[:: 1 if encoder == "motor" else -1]
    wanted = expected.T[[0, 2]]
    assert np.abs(sides - wanted).max() < 0.005 * np.ptp(wanted[1])
    deflection = wanted[0] - wanted[1]
    assert np.abs(sides[0] - sides[1] - deflection).max() < 0.1 * np.ptp(deflection)


def test_a_keyframe_of_the_file_gets_the_new_joint(tmp_path: Path) -> None:
    experiment = experiment_of(tmp_path, "joint_elasticity")
    system = System.resolve(experiment.replace(noise={"state": 0.1}))
    assert system.outputs.names == ("qpos:pivot", "qvel:pivot", "angle")
    source = system.source
    assert_array_equal(source.model.key_qpos, [[0.5, 0.0]])
    assert_array_equal(source.stated.model.key_qpos, [[0.5]])
    (limit,) = limits_of(source.model, system.controls, Limits(velocity=1.0), 0.01, source.added)
    assert limit.name == "pivot"

    # Stated positions may leave out the joint that the term adds.
    for qpos in ([0.7], [0.7, 0.0]):
        start = System.resolve(experiment.replace(initial={"qpos": qpos})).nominal_initial_state
        assert_array_equal(start, [0.7, 0.0, 0.0, 0.0])
    with pytest.raises(ExperimentError, match=r"initial\.qpos: 3 numbers; this model needs 2"):
        System.resolve(experiment.replace(initial={"qpos": [0.7, 0.0, 0.0]}))


# ---- writing into the model, and into the text


@pytest.mark.parametrize("kind", KINDS)
def test_values_written_in_place_equal_a_compile(tmp_path: Path, kind: str) -> None:
    experiment = experiment_of(tmp_path, kind)
    system = System.resolve(experiment)
    assert not system.parameters.needs_compile.any()
    written = arrays_of(system.model_at(system.parameters.true))

    table, true = EXAMPLES[kind]
    stated = experiment.replace(terms={"extra": {"kind": kind, **table, "values": true}})
    compiled = System.resolve(stated)
    expected = arrays_of(compiled.model_at(compiled.parameters.guess))
    assert set(written) == set(expected)
    for name, value in expected.items():
        assert_allclose(written[name], value, rtol=1e-12, atol=1e-16, err_msg=name)

    # The guess is the value in the model.
    assert compiled.parameters.guess == pytest.approx([*true.values()], rel=1e-15)


@pytest.mark.parametrize("kind", KINDS)
def test_the_identified_text_moves_as_the_identified_model(tmp_path: Path, kind: str) -> None:
    experiment = experiment_of(tmp_path, kind, initial={"keyframe": "start"})
    system = System.resolve(experiment)
    path = tmp_path / "out" / "identified.xml"
    path.parent.mkdir()
    assert write_identified(path, system, system.parameters.true) == []

    # The user's comments and spelling stay.
    text = path.read_text(encoding="utf-8")
    assert '<!-- a rod with a weight; "pivot" is the motor\'s joint -->' in text
    assert 'diaginertia="0.0105 0.0105 0.001"' in text

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    ctrl = motor_torque(0.5, 100.0)
    angles = [data.qpos[0]]
    for u in ctrl[:, 0]:
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 10)
        angles.append(data.qpos[0])
    assert_allclose(angles, simulated(system, ctrl)[:, 0], atol=1e-8)


# ---- wrong tables


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"kind": "stribeck"}, "needs 'joint'; valid: pivot"),
        ({"kind": "stribeck", "joint": "pivt"}, "did you mean 'pivot'|valid: pivot"),
        ({"kind": "stribeck", "actuator": "motor"}, "takes 'joint', not 'actuator'"),
        ({"kind": "actuator_lag", "actuator": "motr"}, "motor"),
        ({"kind": "tilt", "joint": "pivot"}, "acts on the base"),
        ({"kind": "payload", "body": "world"}, "does not move"),
        ({"kind": "stribeck", "joint": "pivot", "values": {"static": 1.0}}, "excess, speed"),
        ({"kind": "stribeck", "joint": "pivot", "values": {"speed": "3 N m"}}, "rad/s"),
    ],
)
def test_a_wrong_table_is_one_clear_message(
    tmp_path: Path, table: dict[str, Any], message: str
) -> None:
    experiment = experiment_of(tmp_path, "stribeck")
    tables = {
        **experiment.model_dump(exclude_unset=True),
        "terms": {"extra": table},
        "parameters": {"d": {"target": "joint/pivot:damping"}},
    }
    with pytest.raises(ExperimentError, match=message) as caught:
        System.resolve(experiment.restated(tables))
    assert "terms.extra" in str(caught.value)
    assert "\n" not in str(caught.value)
