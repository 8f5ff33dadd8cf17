"""The equation of motion of an engine step against MuJoCo's own inverse dynamics and steps."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.model.variants import RELAXED, Relaxation
from mjfim.plant.equation_of_motion import EquationOfMotion, MotionPoints, activations
from tests.support.numerics import (
    Array,
    body_task,
    cart_task,
    filtered_task,
    make_task,
    relative_error,
)

# Motor, servo with damping, and a tendon with dry friction on two hinges.
SERVOS = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.3" frictionloss="0.2"/>
      <inertial pos="0.02 0 -0.2" mass="1.1" diaginertia="0.02 0.03 0.01"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.02"/>
        <inertial pos="0 0.01 -0.1" mass="0.7" diaginertia="0.01 0.01 0.005"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="belt" frictionloss="0.4">
      <joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-0.5"/>
    </fixed>
  </tendon>
  <actuator>
    <motor name="push" joint="shoulder" gear="2"/>
    <position name="servo" joint="elbow" kp="20" kv="2"/>
  </actuator>
</mujoco>
"""


def servo_task(folder: Path, text: str, **tables: Any) -> Any:
    """A task for the two hinges."""
    parameters = {"m": {"target": "body/fore:mass"}}
    return make_task(
        text, folder, parameters=parameters, noise={"state": 0.01}, rate=250.0, **tables
    )


def unconstrained(task: Any) -> tuple[EquationOfMotion, Any]:
    """The equation of motion of a task with little smoothing of friction, and its model."""
    system = task.system.with_variant(RELAXED, Relaxation(constraints=True))
    equation = EquationOfMotion(
        simulator=system.plant.simulator.with_substeps(1),
        friction_speeds=np.full(system.space.nv, 1e-3),
    )
    return equation, system.plant.model(task.parameters.guess)


def random_points(task: Any) -> MotionPoints:
    """Points with random states, accelerations and controls."""
    rng = np.random.default_rng(3)
    space, start = task.system.space, task.system.nominal_initial_state
    states = space.plus(np.tile(start, (5, 1)), 0.5 * rng.standard_normal((5, space.nx)))
    acceleration = rng.standard_normal((5, space.nv))
    return states, acceleration, 0.3 * rng.standard_normal((5, task.system.plant.nu))


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast", "RK4"])
@pytest.mark.parametrize("build", [cart_task, body_task])
def test_needed_forces_are_those_of_mujocos_inverse_dynamics(
    build: Any, integrator: str, tmp_path: Path
) -> None:
    task = build(tmp_path, integrator=integrator)
    equation, model = unconstrained(task)
    points = random_points(task)
    needed, _, _ = equation.terms(model, points)

    # For the steps of the engine, `mj_inverse` takes the mean acceleration of the step. The
    # gyroscopic derivative of free bodies is no damping of forces.
    inverse = copy.copy(model)
    if integrator != "RK4":
        inverse.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    data = mujoco.MjData(inverse)
    nv = model.nv
    for k, (state, acceleration, ctrl) in enumerate(zip(*points, strict=True)):
        data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq : model.nq + nv]
        data.ctrl[:] = ctrl
        data.qacc[:] = acceleration
        mujoco.mj_inverse(inverse, data)
        free = 6 if build is body_task and integrator.startswith("implicit") else 0
        found, expected = needed[k][free:], data.qfrc_inverse[free:]
        assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_steps_of_the_engine_fulfil_the_equation(integrator: str, tmp_path: Path) -> None:
    control = {"kind": "multisine", "amplitude": 2.0}
    task = servo_task(tmp_path, SERVOS.format(integrator=integrator), control=control)
    equation, model = unconstrained(task)
    trajectory = task.plant.simulate(task.parameters.guess, task.control)
    timestep = float(model.opt.timestep)
    states, acceleration = trajectory.state[:-1], np.diff(trajectory.qvel, axis=0) / timestep
    points = states, acceleration, task.control
    needed, _, forces = equation.terms(model, points)
    actuation, by_address = np.hsplit(forces, [model.nv])

    # Near rest, the friction of the engine is not that of sliding.
    belt = states[:, 2] - 0.5 * states[:, 3]
    moves = (np.abs(states[:, 2]) > 0.05) & (np.abs(belt) > 0.05)
    assert moves.sum() > 40
    error = np.abs(needed - actuation)[moves]
    assert np.quantile(error, 0.9) < 1e-6 * np.abs(needed).max()
    assert (actuation[:, 1] == by_address[:, 1]).all()

    arms = equation.moments(model, points, [0, 1])
    assert (arms == np.array([[2.0, 0.0], [0.0, 1.0]])).all()


def test_stops_are_found_and_friction_is_not_a_stop(tmp_path: Path) -> None:
    text = SERVOS.format(integrator="implicitfast").replace(
        'name="elbow"', 'name="elbow" range="-50 50"'
    )
    task = servo_task(tmp_path, text)
    equation, _ = unconstrained(task)
    points = random_points(task)
    states, acceleration, _ = points
    states[:, 1] = [0.0, 1.0, 0.0, -1.0, 0.0]
    ctrl = np.outer(states[:, 1], [0.0, 1.0])
    moved = states, acceleration, ctrl
    found = equation.constrained(task.plant.model(task.theta), moved)
    assert_array_equal(found[:, 1], [False, True, False, True, False])


def test_activations_are_those_of_a_simulation(tmp_path: Path) -> None:
    task = filtered_task(tmp_path)
    system = task.system.with_variant(RELAXED, Relaxation(constraints=True))
    theta = task.parameters.guess
    found = activations(
        system.plant.simulator,
        [system.plant.model(theta)],
        system.nominal_initial_state,
        task.control,
    )
    expected: Array = task.plant.simulate(theta, task.control).act
    assert relative_error(found[0], expected) < 1e-9
