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
from mjfim.output.mjcf.write import write_identified
from tests.support.terms import (
    DAMPING,
    EXAMPLES,
    INERTIA,
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
    if kind == "asymmetric_friction":
        return None, []
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
