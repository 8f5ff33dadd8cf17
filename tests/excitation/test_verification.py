"""Verification on the unmodified model: between samples, at clamps and stops, and divergence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.excitation.limits.verification import SAME_STATE_TOLERANCE, verify
from mjfim.excitation.task import DesignTask
from mjfim.output.archive import reference_columns, simulate_playback
from tests.support.limits import along_control, excess_of, played
from tests.support.numerics import cart_task, make_task

# A ball on a spring that swings once per sample of 0.1 s, between two walls, by a clamped motor.
SPRING = """
<mujoco model="spring">
  <option timestep="0.001" integrator="RK4" gravity="0 0 0">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <geom name="wall" type="box" size="0.01 1 1" pos="0.3 0 0"/>
    <body name="ball">
      <joint name="slide" type="slide" axis="1 0 0" stiffness="3947.84176043574" {joint}/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" {motor}/></actuator>
</mujoco>
"""
SWING = 0.15  # amplitude of the ball [m]
SPEED = SWING * 2 * np.pi * 10.0


def spring_task(folder: Path, joint: str = "", motor: str = "", **tables: Any) -> DesignTask:
    """One second of a mass on a spring, which oscillates at 10 Hz; the control is small."""
    defaults = {
        "rate": 10.0,
        "horizon": 1.0,
        "parameters": {"m": "body/ball:mass"},
        "noise": {"state": 0.01},
        "initial": {"qvel": (SPEED,)},
        "control": {"kind": "sine", "amplitude": 1e-3, "frequency": 1.0},
    }
    text = SPRING.format(joint=joint, motor=motor)
    return make_task(text, folder, **{**defaults, **tables})


def test_a_clearance_holds_between_the_samples_too(tmp_path: Path) -> None:
    """The wall is 0.19 m from the ball in the middle, and 0.15 m nearer where it turns."""
    task = spring_task(tmp_path, limits={"clearance": 0.1})
    constraints = constraint_set_of(task)
    assert constraints.margins(along_control(task, constraints))["clearance"] > 0.05
    found = verify(task, task.initial)
    assert found.margins["clearance"] == pytest.approx(0.19 - SWING - 0.1, abs=1e-4)
    assert verify(task, task.initial, briefly=True).margins == found.margins
    assert not found.is_feasible
    assert verify(spring_task(tmp_path, limits={"clearance": 0.035}), task.initial).is_feasible
    # Where another limit is violated, no distance is measured.
    task = spring_task(tmp_path, limits={"clearance": 0.1, "position": {"slide": (-0.1, 0.1)}})
    assert verify(task, task.initial, briefly=True).margins.keys() == {"position"}

    # It is measured beyond the reach of distances as well.
    still = {"initial": {"qvel": (1e-9,)}, "control": {"kind": "constant", "amplitude": 0.0}}
    task = spring_task(tmp_path, limits={"clearance": 1e-4}, **still)
    assert constraint_set_of(task).clearance.distances.reach < 0.15
    margin = verify(task, task.initial).margins["clearance"]
    assert margin == pytest.approx(0.19 - 1e-4, abs=1e-6)


PUSHED = {
    "rate": 50.0,
    "initial": {"qvel": (SPEED,)},
    "control": {"kind": "sine", "amplitude": 1.0, "frequency": 1.0},
}


@pytest.mark.parametrize("clamp", ["stop", "force", "joint force", "control"])
def test_a_clamp_or_stop_of_the_model_shows_as_a_deviation(clamp: str, tmp_path: Path) -> None:
    """A design on the plant without them deviates when it is played on the model with them."""
    words = {
        "stop": {"joint": 'range="-0.1 0.1" limited="true" solreflimit="0.004 1"'},
        "force": {"motor": 'forcerange="-0.05 0.05"'},
        "joint force": {"joint": 'actuatorfrcrange="-0.05 0.05"'},
        "control": {"motor": 'ctrlrange="-0.05 0.05"'},
    }[clamp]
    task = spring_task(tmp_path, **words, **PUSHED)
    lifted = task.relaxed()
    designed = lifted.plant.simulate(lifted.theta, task.control)
    found = verify(task, designed)
    assert found.deviation > 10 * SAME_STATE_TOLERANCE
    free = verify(spring_task(tmp_path, **PUSHED), designed)
    assert free.deviation < SAME_STATE_TOLERANCE
    if clamp in ("stop", "control"):
        assert not found.is_feasible
    else:  # the clamp keeps the force at its range
        assert found.margins[clamp.replace(" ", "_")] == 0.0


@pytest.mark.parametrize("enforce", [True, False])
def test_only_enforced_limits_take_the_clamps_out_of_the_plant(
    enforce: bool, tmp_path: Path
) -> None:
    """Where limits are not enforced, the plant of the design has to clamp forces."""
    motor = 'ctrlrange="-0.05 0.05" forcerange="-0.04 0.04"'
    tables = {"boundary": {"end": "periodic"}, "cost": {"control": 1.0}}
    task = spring_task(tmp_path, motor=motor, limits={"enforce": enforce}, **PUSHED, **tables)
    assert task.is_limited
    lifted = task.relaxed()
    designed = lifted.plant.simulate(lifted.theta, task.control)
    assert (verify(task, designed).deviation < SAME_STATE_TOLERANCE) is not enforce


def test_violated_limits_that_are_only_checked_leave_a_design_feasible(tmp_path: Path) -> None:
    """A boundary at the end is enforced in any case."""
    limits = {"position": {"slide": (-0.1, 0.12)}, "clearance": 0.1, "enforce": False}
    for boundary, kept in (
        ({}, True),
        ({"end": "periodic"}, True),
        ({"end": "periodic", "position": 1e-7}, False),
    ):
        task = spring_task(tmp_path, limits=limits, boundary=boundary)
        found = verify(task, task.initial)
        assert found.margins["position"] < 0.0
        assert found.margins["clearance"] < 0.0
        assert found.is_feasible is kept


@pytest.mark.parametrize("rows", [1, 20])
def test_a_rate_of_the_control_holds_from_row_to_row_of_the_played_table(
    rows: int, tmp_path: Path
) -> None:
    """The table holds each sample for all its rows, so that the control jumps within one row."""
    task = spring_task(tmp_path, playback_rate=10.0 * rows)

    # The largest rate of the rows, from the table itself.
    gain = np.zeros((len(task.control), 1, 2))
    played, _ = simulate_playback(task.system, task.initial, gain)
    fastest = np.abs(np.diff(played.ctrl, axis=0)).max() / (played.t[1] - played.t[0])

    for share, kept in ((1.01, True), (0.99, False)):
        limits = {"control_rate": share * fastest}
        limited = spring_task(tmp_path, limits=limits, playback_rate=10.0 * rows)
        found = verify(limited, limited.initial)
        assert found.margins["control_rate"] == pytest.approx((share - 1.0) * fastest)
        assert found.is_feasible is kept


# A link whose drive is a servo or a filtered motor. It is so light against its
# damping that implicit integrators do not follow its qacc.
LIGHT_LINK = """
<mujoco model="link">
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body name="link">
      <joint name="hinge" axis="0 1 0" damping="0.3" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.2"/>
    </body>
  </worldbody>
  <actuator>{drive}</actuator>
</mujoco>
"""
DRIVES = {
    "servo": '<position name="drive" joint="hinge" kp="4" kv="0.2" gear="2"/>',
    "filtered": '<general name="drive" joint="hinge" dyntype="filter" dynprm="0.02" gear="2"/>',
}


def light_link(
    folder: Path, integrator: str, drive: str, joint: str = "", **tables: Any
) -> DesignTask:
    """The light link under a sine for 0.4 s, with two engine steps in each sample."""
    defaults = {
        "horizon": 0.4,
        "parameters": {"m": "body/link:mass"},
        "noise": {"state": 0.01},
        "control": {"kind": "sine", "amplitude": 0.4, "frequency": 2.5},
    }
    text = LIGHT_LINK.format(integrator=integrator, drive=DRIVES[drive], joint=joint)
    return make_task(text, folder, **{**defaults, **tables})


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_a_force_or_acceleration_within_its_limit_is_never_shown_above_it(
    integrator: str, drive: str, tmp_path: Path
) -> None:
    """The margin is that to the largest force of all sensors and fields."""
    limits = {"force": {"drive": 1.0}, "joint_force": {"hinge": 1.0}}
    task = light_link(tmp_path, integrator, drive, limits=limits)
    force, on_joint = (1.0 + excess for excess in excess_of(task, task.control).values())
    for share in (1.001, 0.999):
        task = light_link(tmp_path, integrator, drive, limits={"force": {"drive": share * force}})
        found = verify(task, task.initial)
        assert found.margins["force"] == pytest.approx((share - 1.0) * force, rel=1e-6)
        assert found.is_feasible is (share > 1.0)

        # The usage over time has one value for each engine step, and the same largest force.
        (usage,) = found.usage
        assert len(usage.t) == len(usage.share) == task.samples * task.system.grid.substeps
        assert np.abs(usage.share).max() == pytest.approx(1.0 / share, rel=1e-6)

    # The largest acceleration of reference.csv is that which is limited, the change of the velocity
    # in an engine step, although MuJoCo's qacc is far larger. It has one row for each engine step.
    playback = {"playback_rate": 200.0}
    task = light_link(tmp_path, integrator, drive, **playback)
    gain = np.zeros((task.samples, 1, task.space.nx))
    played, _ = simulate_playback(task.system, task.initial, gain)
    columns = reference_columns(played, task.system)
    acceleration, speed = columns["qacc:hinge"], columns["qvel:hinge"]
    assert_allclose(acceleration[:-1], np.diff(speed) / 0.005, atol=1e-9)
    largest = np.abs(acceleration).max()
    limits = {"acceleration": 1.001 * largest}
    limited = light_link(tmp_path, integrator, drive, limits=limits, **playback)
    margin = verify(limited, limited.initial).margins["acceleration"]
    assert margin == pytest.approx(0.001 * largest, rel=1e-6)

    # The MJCF's range of the force on a joint is a limit as well.
    ranged = f'actuatorfrcrange="{-2 * on_joint} {2 * on_joint}"'
    task = light_link(tmp_path, integrator, drive, joint=ranged)
    assert verify(task, task.initial).margins["joint_force"] == pytest.approx(on_joint, rel=1e-6)


# An arm with dry friction whose solver is stopped long before it has converged.
COARSE_SOLVER = """
<mujoco model="arm">
  <option timestep="0.005" solver="{solver}" iterations="{iterations}" tolerance="{tolerance}">
    <flag contact="disable"/>
  </option>
  <default>
    <joint type="hinge" axis="0 1 0" frictionloss="0.3"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1"/>
  </default>
  <worldbody>
    <body>
      <joint name="shoulder"/>
      <geom/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow"/>
        <geom/>
        <body pos="0 0 -0.4"><joint name="wrist"/><geom/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="shoulder" gear="5"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    "solver",
    [
        {"solver": "PGS", "iterations": 1, "tolerance": 1e-8},
        {"solver": "Newton", "iterations": 100, "tolerance": 0.3},
    ],
)
def test_limits_hold_with_the_solver_settings_of_the_model_too(solver: Any, tmp_path: Path) -> None:
    """The limit is between the speeds with the exact solver and with that of the model."""
    text = COARSE_SOLVER.format(**solver)
    tables = {"parameters": {"m": "body/lower:mass"}, "noise": {"state": 0.01}}
    task = make_task(text, tmp_path, **tables)

    # A plain loop over the user's file, and one with the solver settings of the design.
    stated, exact = (
        np.abs(played(model, (np.zeros(3),) * 2, task.control, 2)["v"][:, 1]).max()
        for model in (mujoco.MjModel.from_xml_string(text), task.system.model_at(task.theta))
    )
    assert abs(stated - exact) > 1e-3 * exact

    # The limit holds with one of both only.
    limit = 0.5 * (stated + exact)
    limits = {"velocity": {"elbow": limit}}
    found = verify(make_task(text, tmp_path, limits=limits, **tables), task.initial)
    assert not found.is_feasible
    assert found.margins["velocity"] == pytest.approx(-0.5 * abs(stated - exact), rel=1e-6)
    assert found.by_stated_solver == ({"velocity"} if stated > exact else set())

    (usage,) = found.usage
    assert np.abs(usage.share).max() == pytest.approx(max(stated, exact) / limit)
    assert found.deviation < SAME_STATE_TOLERANCE


def test_a_control_that_makes_the_model_diverge_violates_every_limit(tmp_path: Path) -> None:
    limits = {"position": {"slide": (-3.0, 3.0)}, "control": {"force": (-1e13, 1e13)}}
    task = cart_task(tmp_path, limits=limits)
    found = verify(task, replace(task.initial, ctrl=np.full_like(task.control, 1e12)))
    assert not found.is_feasible
    assert found.deviation == np.inf
    assert set(found.margins.values()) == {-np.inf}
