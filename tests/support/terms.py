"""Models and experiments with physical terms of the library, for several tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from mjfim.records.trajectory import Recording

Array = NDArray[np.float64]

# A pendulum with a motor, written with comments and irregular spacing. The inertia about the pivot
# is 0.0125 kg m², the gravity torque 0.2 N m at most.
PENDULUM = """<mujoco model="pendulum">
  <!-- a rod with a weight; "pivot" is the motor's joint -->
  <option timestep="{timestep}"   integrator="{integrator}" gravity="0 0 -9.81">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="rod">
      <inertial pos="0 0 -0.1" mass="0.20" diaginertia="0.0105 0.0105 0.001"/>
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.010" {joint}/>
      <site name="imu" pos="0 0 -0.1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="pivot"  gear="1"/>
  </actuator>
  <sensor>
    <jointpos name="angle" joint="pivot" noise="0.001"/>
    <accelerometer name="acc" site="imu" noise="0.05"/>
  </sensor>
  <keyframe>
    <key name="start" qpos="0.5" ctrl="0.3"/>
  </keyframe>
</mujoco>
"""

INERTIA = 0.0105 + 0.2 * 0.1**2
DAMPING = 0.01
WEIGHT = 0.2 * 9.81 * 0.1

# Kind of a term -> its table, and true values of its fields that the motion shows.
EXAMPLES = {
    "stribeck": ({"joint": "pivot"}, {"excess": 0.04, "speed": 0.5}),
    "lugre": ({"joint": "pivot"}, {"coulomb": 0.03, "excess": 0.03, "speed": 0.5}),
    "asymmetric_friction": ({"joint": "pivot"}, {"offset": 0.02}),
    "load_dependent_friction": ({"actuator": "motor"}, {"coefficient": 0.2}),
    "back_emf": ({"actuator": "motor"}, {"constant": 0.02}),
    "actuator_lag": ({"actuator": "motor"}, {"time_constant": 0.03}),
    "joint_elasticity": ({"joint": "pivot"}, {"compliance": 0.05, "damping": 0.004}),
    "backlash": ({"joint": "pivot"}, {"gap": 0.06}),
    "tilt": ({}, {"y": 0.1}),
    "payload": ({"body": "rod"}, {"mass": 0.05, "z": -0.3}),
}

# Attributes of the joint that a term needs.
JOINTS = {
    "stribeck": 'frictionloss="0.03"',
    "asymmetric_friction": 'frictionloss="0.03"',
    "joint_elasticity": 'armature="0.002"',
    "backlash": 'armature="0.002"',
}
ROTOR = 0.002


def write_pendulum(
    folder: Path, *, timestep: float = 0.001, integrator: str = "implicitfast", joint: str = ""
) -> Path:
    """Write the pendulum into a folder."""
    path = folder / "pendulum.xml"
    text = PENDULUM.format(timestep=timestep, integrator=integrator, joint=joint)
    path.write_text(text, encoding="utf-8")
    return path


def experiment_of(folder: Path, kind: str, **tables: Any) -> mjfim.Experiment:
    """An experiment with one term whose fields are unknown; its file is in the folder."""
    table, true = EXAMPLES[kind]
    parameters = {
        field: {"target": f"term/extra:{field}", "true": value} for field, value in true.items()
    }
    path = write_pendulum(folder, joint=JOINTS.get(kind, ""))
    stated = {
        "model": path.name,
        "rate": 100.0,
        "noise": {"angle": 0.001},
        "terms": {"extra": {"kind": kind, **table}},
        "parameters": parameters,
    }
    return mjfim.Experiment(**{**stated, **tables}, directory=folder)


def motor_torque(duration: float, rate: float, seed: int = 0, size: float = 0.25) -> Array:
    """(N, 1) a sum of slow sines, held over samples [N m]."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * rate)) / rate
    waves = [np.sin(2 * np.pi * f * t + rng.uniform(0.0, 2 * np.pi)) for f in (0.4, 0.9, 1.7)]
    return size * np.sum(waves, axis=0)[:, None]


def recorded(
    system: System,
    ctrl: Array,
    seed: int = 0,
    *,
    theta: Array | None = None,
    share: float = 1.0,
) -> Recording:
    """A recording of a system under a control.

    Args:
        system: The system.
        ctrl: (N, nu) control.
        seed: Seed of the noise.
        theta: Values of the parameters; default: the true ones.
        share: Size of the noise over the stated one.
    """
    values = system.parameters.true if theta is None else theta
    y, finite = system.plant.measure(values[None], ctrl)
    assert finite.all()
    noise = np.random.default_rng(seed).normal(size=y[0].shape) * system.noise.sigma
    t = np.arange(len(ctrl) + 1) * system.dt
    return Recording(t=t, y=y[0] + share * noise, ctrl=ctrl, outputs=system.outputs.names)


def small_logs(system: System, *seeds: int) -> list[Recording]:
    """Logs of small slow motions, in which friction matters."""
    return [recorded(system, motor_torque(1.5, 100.0, i, size=0.08), i) for i in seeds]


def solution_near(problem: FitProblem, theta: Array) -> UnknownValues:
    """Nearly the best unknowns, which a few steps give."""
    found = minimise(problem, problem.begin(np.array(theta)), SearchSettings(max_iterations=6))
    assert found is not None
    return found.unknowns
