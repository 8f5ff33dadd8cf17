"""A free-floating body with thrusters on a tumbling flight.

psi is compared with simulations of recompiled models.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
from mjfim.excitation.task import DesignTask
from tests.support.numerics import Loop
from tests.support.paths import MODELS

TUMBLE = {
    "qpos": (0.0, 0.0, 2.0, 0.8, 0.4, -0.4, 0.2),
    "qvel": (0.5, -0.3, 1.0, 4.0, -3.0, 2.0),
    "control": {"kind": "sine", "amplitude": 0.3, "frequency": 1.5, "offset": 0.5},
}
ROTORS = ("fl", "fr", "rl", "rr")
PARAMETERS = {
    "mass": {"target": "body/quadrotor:mass"},
    "inertia": {"target": "body/quadrotor:inertia[1]"},
    "thrust": {"targets": [{"path": f"actuator/{rotor}:gear[2]"} for rotor in ROTORS]},
    "com": {"target": "body/quadrotor:ipos[2]"},
}


def tumbling_task() -> DesignTask:
    """One second of tumbling, driven by all four rotors."""
    return DesignTask.resolve(
        mjfim.Experiment(
            model="quadrotor.xml",
            directory=MODELS,
            rate=100.0,
            horizon=1.0,
            initial=TUMBLE,
            parameters=PARAMETERS,
            noise={"state": 0.01, "imu_gyro": 0.01, "imu_accelerometer": 0.1},
        )
    )


def simulated_states(
    path: Path, change: dict[str, float], ctrl: Array, start: Array, substeps: int
) -> tuple[Loop, Array]:
    """(N+1, ns) states of a model that is compiled anew with relative changes of its parameters."""
    spec = mujoco.MjSpec.from_file(str(path))
    body = spec.body("quadrotor")
    body.mass *= 1.0 + change.get("mass", 0.0)
    body.inertia = np.array(body.inertia) * [1.0, 1.0 + change.get("inertia", 0.0), 1.0]
    body.ipos = np.array(body.ipos) * [1.0, 1.0, 1.0 + change.get("com", 0.0)]
    for rotor in ROTORS:
        gear = np.array(spec.actuator(rotor).gear)
        gear[2] *= 1.0 + change.get("thrust", 0.0)
        spec.actuator(rotor).gear = gear
    loop, states = Loop(spec.compile(), substeps), [start]
    for u in ctrl:
        states.append(loop.F(states[-1], u))
    return loop, np.array(states)


@pytest.mark.parametrize("name", PARAMETERS)
def test_psi_of_a_tumbling_flight_agrees_with_re_simulation(name: str) -> None:
    task = tumbling_task()
    curve, j = task.initial, list(PARAMETERS).index(name)
    turned = np.abs(curve.qvel[:, 3:]).max()
    assert turned > 3.0  # [rad/s] it does tumble
    found = task.plant.derivatives.sensitivity(task.theta, curve)
    start, value = curve.state[0], task.theta[j]

    def difference(h: float) -> Array:
        loop, up = simulated_states(
            task.system.model_path, {name: h}, curve.ctrl, start, task.system.grid.substeps
        )
        _, down = simulated_states(
            task.system.model_path, {name: -h}, curve.ctrl, start, task.system.grid.substeps
        )
        return np.array([loop.minus(a, b) for a, b in zip(up, down, strict=True)]) / (
            2.0 * h * value
        )

    reference = (4.0 * difference(5e-4) - difference(1e-3)) / 3.0
    size = np.abs(reference).max(axis=0)
    size = np.maximum(size, 1e-3 * size.max())  # mass, say, turns nothing
    assert (np.abs(found.psi[..., j] - reference) / size).max() < 1e-6
    assert (
        np.abs(1.00001 * found.psi[..., j] - reference) / size
    ).max() > 1e-6  # an error of 1e-5 would be seen
