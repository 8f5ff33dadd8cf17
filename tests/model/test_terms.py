"""Physical terms of the library in MuJoCo: their equations, their writing, and their text."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import pytest
import scipy

import mjfim
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.experiment.system_tables import TermKind
from mjfim.model.terms.library import KINDS
from mjfim.output.export.mjcf import write_identified
from tests.support.terms import (
    DAMPING,
    EXAMPLES,
    INERTIA,
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


def equation_of(kind: str, values: dict[str, float]) -> tuple[Any, list[float]]:
    """Derivative of the state with a term, and the initial state."""
    if kind == "back_emf":
        return (
            lambda x, u: [x[1], rigid(x[0], x[1], u - values["constant"] * x[1])],
            [0.5, 0.0],
        )
    if kind == "actuator_lag":
        return (
            lambda x, u: [x[1], rigid(x[0], x[1], x[2]), (u - x[2]) / values["time_constant"]],
            [0.5, 0.0, 0.3],
        )
    if kind == "tilt":
        return (
            lambda x, u: [
                x[1],
                (u - WEIGHT * np.sin(x[0] - values["y"]) - DAMPING * x[1]) / INERTIA,
            ],
            [0.5, 0.0],
        )
    if kind == "payload":
        mass, arm = values["mass"], -values["z"]
        inertia, weight = INERTIA + mass * arm**2, WEIGHT + mass * 9.81 * arm
        return (
            lambda x, u: [x[1], (u - weight * np.sin(x[0]) - DAMPING * x[1]) / inertia],
            [0.5, 0.0],
        )
    raise AssertionError(kind)


@pytest.mark.parametrize("kind", ["back_emf", "actuator_lag", "tilt", "payload"])
def test_smooth_terms_move_as_their_equation_says(tmp_path: Path, kind: str) -> None:
    system = System.resolve(experiment_of(tmp_path, kind, initial={"keyframe": "start"}))
    ctrl = motor_torque(1.0, 100.0)
    derivative, start = equation_of(kind, EXAMPLES[kind][1])
    expected = integrated(derivative, ctrl, 0.01, start)[:, :2]
    span = np.ptp(expected, axis=0)

    # The engine is of first order: with a quarter of the timestep a quarter of the error remains.
    errors = []
    for timestep in (0.001, 0.00025):
        text = (tmp_path / "pendulum.xml").read_text(encoding="utf-8")
        finer = text.replace('timestep="0.001"', f'timestep="{timestep}"')
        (tmp_path / "pendulum.xml").write_text(finer, encoding="utf-8")
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


def steady_force(system: System, speed: float) -> float:
    """Force of the passive device after sliding at a constant speed for a while."""
    model = system.model_at(system.parameters.true)
    data = mujoco.MjData(model)
    for _ in range(200):
        data.qpos[0], data.qvel[0] = 0.0, speed
        mujoco.mj_step(model, data)
    data.qpos[0], data.qvel[0] = 0.0, speed
    mujoco.mj_forward(model, data)
    return float(data.actuator_force[1])


@pytest.mark.parametrize("kind", ["stribeck", "lugre"])
@pytest.mark.parametrize("speed", [-3.0, -0.6, -0.1, 0.05, 0.5, 2.0])
def test_steady_friction_is_the_stribeck_curve(tmp_path: Path, kind: str, speed: float) -> None:
    system = System.resolve(experiment_of(tmp_path, kind))
    values = {"coulomb": 0.0, **EXAMPLES[kind][1]}
    drop = values["excess"] * np.exp(-((speed / values["speed"]) ** 2))
    expected = -(values["coulomb"] + drop) * np.sign(speed)
    assert steady_force(system, speed) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def lugre_motion(values: dict[str, float], ctrl: Any, start: Any) -> Any:
    """Motion of the pendulum with the LuGre equation, by SciPy."""

    def derivative(x: Any, u: float) -> list[float]:
        angle, speed, z = x
        g = values["coulomb"] + values["excess"] * np.exp(-((speed / values["speed"]) ** 2))
        rate = speed - values["stiffness"] * abs(speed) / g * z
        friction = -values["stiffness"] * z - values["damping"] * rate
        return [speed, rigid(angle, speed, u + friction), rate]

    return integrated(derivative, ctrl, 0.01, [*start, 0.0])


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_dynamic_friction_moves_as_lugre_says(tmp_path: Path, integrator: str) -> None:
    values = {"coulomb": 0.03, "excess": 0.03, "speed": 0.5, "stiffness": 30.0, "damping": 0.1}
    path = write_pendulum(tmp_path, timestep=0.0005, integrator=integrator)
    stated = mjfim.Experiment(
        model=path.name,
        rate=100.0,
        noise={"angle": 0.001},
        terms={"extra": {"kind": "lugre", "joint": "pivot", "values": values}},
        parameters={"d": {"target": "joint/pivot:damping"}},
        directory=tmp_path,
    )
    ctrl = motor_torque(2.0, 100.0)
    found = simulated(System.resolve(stated), ctrl)
    expected = lugre_motion(values, ctrl, [0.0, 0.0])[:, :2]
    assert_near(found, expected, 0.02)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_stribeck_friction_moves_like_a_stiff_bristle(tmp_path: Path, integrator: str) -> None:
    """The bristle of the library is short; SciPy integrates one that is shorter still."""
    experiment = experiment_of(tmp_path, "stribeck")
    write_pendulum(tmp_path, integrator=integrator, joint='frictionloss="0.03"')
    ctrl = motor_torque(2.0, 100.0)
    found = simulated(System.resolve(experiment), ctrl)

    stiff = {**EXAMPLES["stribeck"][1], "coulomb": 0.03, "stiffness": 2e3, "damping": 2.0}
    expected = lugre_motion(stiff, ctrl, [0.0, 0.0])[:, :2]
    assert_near(found, expected, 0.02)


@pytest.mark.parametrize("timestep", [0.001, 0.002])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_friction_grows_with_the_torque_of_the_motor(
    tmp_path: Path, integrator: str, timestep: float
) -> None:
    system = System.resolve(experiment_of(tmp_path, "load_dependent_friction"))
    write_pendulum(tmp_path, timestep=timestep, integrator=integrator)
    system = System.resolve(system.experiment)
    ctrl = motor_torque(1.5, 100.0)

    def derivative(x: Any, u: float) -> list[float]:
        friction = 0.2 * abs(u) * np.tanh(x[1] / 1e-3)
        return [x[1], rigid(x[0], x[1], u - friction)]

    expected = integrated(derivative, ctrl, 0.01, [0.0, 0.0])
    found = simulated(system, ctrl)
    assert_near(found, expected, 0.005)
    without = simulated(system, ctrl, system.parameters.guess)
    assert np.abs(without - expected)[:, 0].max() > 0.1 * np.ptp(expected[:, 0])


def test_friction_of_the_load_needs_direct_drives_only(tmp_path: Path) -> None:
    """The friction would contain the feedback of a servo beside the motor."""
    experiment = experiment_of(tmp_path, "load_dependent_friction")
    path = tmp_path / "pendulum.xml"
    servo = '<position name="servo" joint="pivot"/></actuator>'
    path.write_text(path.read_text(encoding="utf-8").replace("</actuator>", servo))
    with pytest.raises(ExperimentError, match="'servo' is no direct drive at a hinge"):
        System.resolve(experiment)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_friction_with_an_offset_differs_by_direction(tmp_path: Path, direction: float) -> None:
    experiment = experiment_of(
        tmp_path, "asymmetric_friction", initial={"qpos": [0.0], "qvel": [6.0 * direction]}
    )
    ctrl = np.zeros((20, 1))
    found = simulated(System.resolve(experiment), ctrl)

    torque = -0.03 * direction + EXAMPLES["asymmetric_friction"][1]["offset"]
    expected = integrated(
        lambda x, u: [x[1], rigid(x[0], x[1], torque)], ctrl, 0.01, [0.0, 6.0 * direction]
    )
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.parametrize("encoder", ["motor", "link"])
@pytest.mark.parametrize("kind", ["joint_elasticity", "backlash"])
def test_motor_and_link_move_as_two_inertias(tmp_path: Path, kind: str, encoder: str) -> None:
    values = {"compliance": 0.05, "damping": 0.004, **EXAMPLES[kind][1]}
    terms = {"extra": {"kind": kind, "joint": "pivot", "encoder": encoder, "values": values}}
    experiment = experiment_of(
        tmp_path, kind, initial={"keyframe": "start"}, terms=terms, noise={"state": 0.001}
    )
    write_pendulum(tmp_path, timestep=0.0005, joint=f'armature="{ROTOR}"')
    system = System.resolve(experiment)
    assert system.outputs.names == ("qpos:pivot", "qvel:pivot")
    np.testing.assert_array_equal(system.nominal_initial_state, [0.5, 0.0, 0.0, 0.0])

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
    sides = np.stack([found[:, 0], found.sum(axis=1)], axis=1)
    motor, link = sides.T if encoder == "motor" else sides.T[::-1]
    span = np.ptp(expected[:, 2])
    assert np.abs(motor - expected[:, 0]).max() < 0.005 * span
    assert np.abs(link - expected[:, 2]).max() < 0.005 * span
    deflection = expected[:, 0] - expected[:, 2]
    assert np.abs(motor - link - deflection).max() < 0.1 * np.ptp(deflection)


def test_a_keyframe_of_the_file_gets_the_new_joint(tmp_path: Path) -> None:
    experiment = experiment_of(tmp_path, "joint_elasticity")
    source = System.resolve(experiment).source
    np.testing.assert_array_equal(source.model.key_qpos, [[0.5, 0.0]])
    np.testing.assert_array_equal(source.stated.model.key_qpos, [[0.5]])

    # Stated positions may leave out the joint that the term adds.
    for qpos in ([0.7], [0.7, 0.0]):
        start = System.resolve(experiment.replace(initial={"qpos": qpos})).nominal_initial_state
        np.testing.assert_array_equal(start, [0.7, 0.0, 0.0, 0.0])
    with pytest.raises(ExperimentError, match=r"initial\.qpos: 3 numbers; this model needs 2"):
        System.resolve(experiment.replace(initial={"qpos": [0.7, 0.0, 0.0]}))


# ---- writing into the model, and into the text


def arrays_of(model: Any) -> dict[str, Any]:
    """All numeric arrays of a model and of its options."""
    names = [name for name in dir(model) if not name.startswith("_")]
    arrays = {name: getattr(model, name) for name in names}
    arrays["gravity"] = model.opt.gravity
    numeric = {
        k: v for k, v in arrays.items() if isinstance(v, np.ndarray) and v.dtype.kind in "fi"
    }
    return {name: np.array(value) for name, value in numeric.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_values_written_in_place_equal_a_compile(tmp_path: Path, kind: str) -> None:
    experiment = experiment_of(tmp_path, kind)
    system = System.resolve(experiment)
    assert not system.parameters.needs_compile.any()
    written = arrays_of(system.model_at(system.parameters.true))

    table, true = EXAMPLES[kind]
    compiled = System.resolve(
        experiment.restated(
            {
                **experiment.model_dump(exclude_unset=True),
                "terms": {"extra": {"kind": kind, **table, "values": true}},
                "parameters": {"d": {"target": "joint/pivot:damping"}},
            }
        )
    )
    expected = arrays_of(compiled.model_at(compiled.parameters.guess))
    assert set(written) == set(expected)
    for name, value in expected.items():
        scale = (
            np.abs(value[np.isfinite(value)]).max(initial=1e-300) if value.dtype.kind == "f" else 1
        )
        np.testing.assert_allclose(
            written[name], value, rtol=1e-12, atol=1e-14 * scale, err_msg=name
        )

    # The guess is the value in the model.
    for field, value in true.items():
        assert System.resolve(
            experiment.replace(
                terms={"extra": {"kind": kind, **table, "values": {field: value}}},
            )
        ).parameters.guess[list(true).index(field)] == pytest.approx(value, rel=1e-15)


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
    np.testing.assert_allclose(angles, simulated(system, ctrl)[:, 0], atol=1e-8)


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
