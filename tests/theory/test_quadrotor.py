"""A free-floating body with thrusters on a tumbling flight.

psi is compared with simulations of recompiled models.
"""

from __future__ import annotations

import mujoco
import numpy as np

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


def simulated_states(task: DesignTask, **changes: float) -> tuple[Loop, Array]:
    """(N+1, ns) states of a model that is compiled anew with relative changes of its parameters."""
    spec = mujoco.MjSpec.from_file(str(task.system.model_path))
    body = spec.body("quadrotor")
    factors = {name: 1.0 + changes.get(name, 0.0) for name in PARAMETERS}
    body.mass *= factors["mass"]
    body.inertia = np.array(body.inertia) * [1.0, factors["inertia"], 1.0]
    body.ipos = np.array(body.ipos) * [1.0, 1.0, factors["com"]]
    for rotor in ROTORS:
        actuator = spec.actuator(rotor)
        actuator.gear = np.array(actuator.gear) * [1.0, 1.0, factors["thrust"], 1.0, 1.0, 1.0]
    loop, states = Loop(spec.compile(), task.system.grid.substeps), [task.initial.state[0]]
    for u in task.initial.ctrl:
        states.append(loop.F(states[-1], u))
    return loop, np.array(states)


def test_psi_of_a_tumbling_flight_agrees_with_re_simulation() -> None:
    task = tumbling_task()
    assert np.abs(task.initial.qvel[:, 3:]).max() > 3.0  # [rad/s] it does tumble
    psi = task.plant.derivatives.sensitivity(task.theta, task.initial).psi
    for j, (name, value) in enumerate(zip(PARAMETERS, task.theta, strict=True)):

        def difference(h: float, name: str = name, value: float = value) -> Array:
            (loop, up), (_, down) = (simulated_states(task, **{name: sign * h}) for sign in (1, -1))
            moved = [loop.minus(a, b) for a, b in zip(up, down, strict=True)]
            return np.array(moved) / (2.0 * h * value)

        reference = (4.0 * difference(5e-4) - difference(1e-3)) / 3.0
        size = np.abs(reference).max(axis=0)
        size = np.maximum(size, 1e-3 * size.max())  # mass, say, turns nothing
        assert (np.abs(psi[..., j] - reference) / size).max() < 1e-6
