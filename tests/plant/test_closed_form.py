"""Derivatives in closed form of arms and other rigid bodies, against differences of the engine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.excitation.task import DesignTask
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.closed_form import closed_form_tree
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES, FORWARD_DIFFERENCES
from mjfim.records.trajectory import Trajectory
from tests.support.numerics import make_task

# A tree of hinges and slides: two joints on one body, a branch, a welded body, springs and dampers,
# servos whose forces are clamped, and a motor whose control is clamped.
TREE = """
<mujoco model="tree">
  <option timestep="0.005" {option}><flag contact="disable"/></option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="base" pos="0.1 -0.2 0.3" euler="10 0 20">
      <joint name="yaw" axis="0 0 1" damping="0.3" armature="0.02"/>
      <joint name="lift" type="slide" axis="0 0.2 1" stiffness="200" damping="4"/>
      <inertial pos="0.02 0.01 0.1" mass="2" diaginertia="0.03 0.02 0.025"/>
      <body name="upper" pos="0.05 0 0.2">
        <joint name="shoulder" axis="0 1 0.3" pos="0.01 0 0.02" damping="0.2" armature="0.01"/>
        <inertial pos="0.03 0.02 0.15" mass="1.2" euler="20 30 10" diaginertia="0.02 0.018 0.004"/>
        <body name="fore" pos="0 0.03 0.3">
          <joint name="elbow" axis="1 0.2 0" damping="0.1" {joint}/>
          <inertial pos="0 0.01 0.12" mass="0.8" diaginertia="0.01 0.011 0.003"/>
          <body name="load" pos="0.02 0 0.25" euler="0 40 0" {load}>
            <inertial pos="0.01 0 0.02" mass="0.4" diaginertia="0.001 0.0012 0.0008"/>
          </body>
        </body>
      </body>
      <body name="tail" pos="-0.2 0 0">
        <joint name="slider" type="slide" axis="1 1 0" stiffness="30" damping="1"/>
        <inertial pos="0 0 0.05" mass="0.5" diaginertia="0.002 0.002 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw" joint="yaw" kp="40" kv="3"/>
    <position name="shoulder" joint="shoulder" kp="60" kv="2" forcerange="-9 9"/>
    <position name="elbow" joint="elbow" kp="30" kv="1"/>
    <motor name="push" joint="slider" gear="2" ctrlrange="-0.5 0.5"/>
  </actuator>
</mujoco>
"""

# Inertial parameters in three forms, those of springs, dampers, servos and armatures, and one that
# is none of these.
PARAMETERS: dict[str, Any] = {
    "mass": {"target": "body/upper:mass"},
    "centre": {"target": "body/fore:ipos[2]"},
    "load": {"inertial": "load", "coordinates": "barycentric"},
    "damping": {"target": "joint/elbow:damping"},
    "armature": {"target": "joint/shoulder:armature"},
    "stiffness": {"target": "joint/lift:stiffness"},
    "springref": {"target": "joint/slider:springref", "guess": 0.1},
    "kp": {"target": "actuator/shoulder:kp"},
    "kv": {"target": "actuator/elbow:kv"},
    "gear": {"target": "actuator/push:gear[0]"},
}

# A parameter that makes a force a polynomial of the speed.
DRAG = {"drag": {"target": "joint/elbow:damping[1]", "guess": 0.4}}

CHIRP = {"control": {"kind": "chirp", "amplitude": 0.8, "frequency": 1.0}}


def tree_task(
    folder: Path,
    option: str = 'integrator="implicitfast"',
    more_parameters: dict[str, Any] | None = None,
    **parts: str,
) -> DesignTask:
    """A task for the tree: 20 samples of two engine steps."""
    filled = {"joint": "", "load": "", **parts}
    return make_task(
        TREE.format(option=option, **filled),
        folder,
        rate=100.0,
        horizon=0.2,
        noise={"state": 0.01},
        parameters={**PARAMETERS, **(more_parameters or {})},
        initial=CHIRP,
        limits={"enforce": False},
    )


def with_differences(task: DesignTask) -> DesignTask:
    """The same task, all derivatives of which are differences."""
    task.plant.closed_form_memory.tree = None
    return task


def curve(task: DesignTask) -> Trajectory:
    """A motion with jumps of the controls, of which some are clamped, as are some forces."""
    rng = np.random.default_rng(1)
    return task.plant.simulate(task.theta, rng.uniform(-0.8, 0.8, (task.samples, 4)))


def assert_close(found: Any, expected: Any, accuracy: float) -> None:
    """Compare arrays, relative to the largest number of each."""
    assert_allclose(found, expected, rtol=0.0, atol=accuracy * np.abs(expected).max())


# The damping of Euler's method is implicit or explicit.
EXPLICIT = 'integrator="Euler"><flag eulerdamp="disable"/></option><option '
OPTIONS = (
    'integrator="implicitfast"',
    'integrator="Euler"',
    'integrator="Euler" gravity="3 -2 -9"',
    EXPLICIT,
)


@pytest.mark.parametrize("option", OPTIONS)
def test_first_derivatives_and_sensitivities_agree_with_differences(tmp_path, option: str) -> None:
    task = tree_task(tmp_path, option)
    trajectory, derivatives, p = curve(task), task.plant.derivatives, len(task.theta)
    psi = np.zeros((task.samples + 1, task.space.nx, p))
    found, _ = derivatives.closed_form_mixed(task.theta, trajectory, psi, np.zeros((0, p)))
    expected = derivatives.linearize(task.theta, trajectory)
    assert_close(found.A, expected.A, 1e-8)
    assert_close(found.B, expected.B, 1e-8)

    expected = derivatives.sensitivity(task.theta, trajectory)
    before = task.plant.engine_steps
    found = derivatives.sensitivity(task.theta, trajectory, closed_form=True)

    # Every engine step once, besides those from which forces are measured, and two rollouts for the
    # gear.
    engine_steps = task.samples * task.plant.simulator.substeps
    assert task.plant.engine_steps - before < 4 * engine_steps
    assert task.plant.closed_form_memory.covered.sum() == p - 1
    for column in range(p):
        assert_close(found.psi[..., column], expected.psi[..., column], 1e-6)
        assert_close(found.G[..., column], expected.G[..., column], 1e-6)
    assert_array_equal(found.psi[..., -1], expected.psi[..., -1])


def test_mixed_derivatives_agree_with_differences(tmp_path) -> None:
    task = tree_task(tmp_path)
    trajectory, derivatives = curve(task), task.plant.derivatives
    psi = derivatives.sensitivity(task.theta, trajectory).psi
    directions = np.random.default_rng(2).standard_normal((2, len(task.theta)))
    given = (task.theta, trajectory, psi, directions * task.parameters.magnitude)

    found = derivatives.bilinear(*given, FORWARD_DIFFERENCES)
    central = derivatives.bilinear(*given, CENTRAL_DIFFERENCES)
    expected = with_differences(task).plant.derivatives.bilinear(*given, CENTRAL_DIFFERENCES)

    # Central differences never come from the closed form.
    assert_array_equal(central.F_mixed, expected.F_mixed)
    assert_close(found.A, expected.A, 1e-6)
    assert_close(found.B, expected.B, 1e-6)
    assert_array_equal(found.C, expected.C)
    assert_close(found.F_mixed, expected.F_mixed, 1e-5)


def test_a_force_that_reaches_its_limit_is_no_derivative(tmp_path) -> None:
    task = tree_task(tmp_path)
    trajectory, derivatives = curve(task), task.plant.derivatives
    p, nv = len(task.theta), task.space.nv
    psi, direction = np.zeros((task.samples + 1, task.space.nx, p)), np.eye(p)[:1]
    origin, change = derivatives.closed_form_mixed(task.theta, trajectory, psi, direction)
    assert change[0, 3].any()

    # A speed of the shoulder at which its servo is nearly at the limit, and a direction beyond it.
    shoulder, limit = 2, 9.0
    row, state = origin.forces.actuators[1], np.array(origin.states[3, 0])
    state[nv + shoulder] = 0.0
    without_speed = row @ np.concatenate([[1.0], state, trajectory.ctrl[3]])
    qvel = np.array(trajectory.qvel)
    qvel[3, shoulder] = (limit * (1.0 - 1e-9) - without_speed) / row[1 + nv + shoulder]
    psi[3, nv + shoulder, 0] = -1.0

    at_limit = replace(trajectory, qvel=qvel)
    _, change = derivatives.closed_form_mixed(task.theta, at_limit, psi, direction)
    assert not change[0, 3].any()
    assert change[0, 5].any()


def test_derivatives_of_observations_agree_with_differences(tmp_path) -> None:
    task = tree_task(tmp_path)
    trajectory = curve(task)
    observations = SubstepObservations(
        positions=np.array([0, 3]),
        velocities=np.array([1, 4]),
        accelerations=np.array([0, 2, 4]),
        actuator_forces=np.array([0, 1, 3]),
        joint_forces=np.array([1, 2, 4]),
        turns=np.zeros((0, 4), np.intp),
        turn_weights=np.zeros((0, 4)),
        tendon_forces=((0, 2),),
        tendon_lengths=np.zeros(0, np.intp),
        derivative_substeps=(1, 2),
        force_rows=(1,),
        timestep=0.005,
    )
    A, B, found = task.plant.derivatives.observation_jacobians(task.theta, trajectory, observations)
    differences = with_differences(task).plant.derivatives
    expected = differences.observation_jacobians(task.theta, trajectory, observations)
    assert_close(A, expected[0], 1e-5)
    assert_close(B, expected[1], 1e-5)

    # Accelerations have other sizes than positions.
    assert found.shape == expected[2].shape
    for number in range(found.shape[2]):
        assert_close(found[:, :, number], expected[2][:, :, number], 1e-5)


# Actuators whose force or moment arm is another function of the state, and other elements.
OTHERS = (
    '<general joint="elbow" gaintype="affine" gainprm="0 0 -1"/>',
    '<motor site="tip" gear="1 0 0 0 0 0"/>',
    '<motor tendon="cable"/>',
    '<motor joint="elbow" armature="0.1"/>',
    '<motor joint="elbow" damping="0.1"/>',
)


@pytest.mark.parametrize("other", OTHERS)
def test_other_actuators_have_no_closed_form(other: str) -> None:
    text = TREE.format(option="", joint="", load="")
    assert closed_form_tree(mujoco.MjModel.from_xml_string(text)) is not None
    text = text.replace("</actuator>", f"{other}</actuator>")
    text = text.replace('<body name="load"', '<site name="tip" pos="0 0 .3"/><body name="load"')
    text = text.replace('<body name="base"', '<site name="wall" pos="1 0 1"/><body name="base"')
    cable = '<spatial name="cable"><site site="wall"/><site site="tip"/></spatial>'
    text = text.replace("<actuator>", f"<tendon>{cable}</tendon><actuator>")
    assert closed_form_tree(mujoco.MjModel.from_xml_string(text)) is None


@pytest.mark.parametrize(
    ("option", "parts"),
    [
        ('integrator="RK4"', {}),
        ('integrator="implicit"', {}),
        ('integrator="implicitfast" viscosity="0.1"', {}),
        ('integrator="implicitfast"', {"joint": 'frictionloss="0.2"'}),
        ('integrator="implicitfast"', {"load": 'gravcomp="1"'}),
        ('integrator="implicitfast"', {"joint": 'range="-0.1 0.1" limited="true"'}),
        ('integrator="implicitfast"', {"more_parameters": DRAG}),
    ],
)
def test_other_equations_of_motion_are_differentiated_by_the_engine(
    tmp_path, option: str, parts: dict[str, Any]
) -> None:
    task = tree_task(tmp_path, option, **parts)
    trajectory, derivatives = curve(task), task.plant.derivatives
    found = derivatives.sensitivity(task.theta, trajectory, closed_form=True)
    expected = derivatives.sensitivity(task.theta, trajectory)
    assert_array_equal(found.psi, expected.psi)
