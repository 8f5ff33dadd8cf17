"""Limits of the MJCF and of the file on joints, free bodies, tendons and actuators."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.errors import ExperimentError
from mjfim.excitation.limits.constraint_kinds import Magnitude
from mjfim.excitation.limits.limits import limits_of
from mjfim.excitation.limits.verification import require_feasible_start, verify, violations_of
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import labels_of_model
from mjfim.experiment.task_tables import Limits
from mjfim.model.coordinates import control_names
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.records.trajectory import Trajectory
from tests.support.limits import barrier_check, barrier_problem, excess_of, of_kind
from tests.support.numerics import TILT, make_task

# A hull that floats, with a mast on a ball joint and an arm on a hinge. The mast is turned by an
# actuator with three forces, the arm by two actuators on a tendon and by one on its joint.
SHIP = """
<mujoco model="ship">
  <compiler angle="degree"/>
  <option timestep="0.002" integrator="{integrator}" gravity="0.3 0 -1">
    <flag contact="disable"/>
  </option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="hull" pos="0 0 1" euler="20 -30 40">
      <freejoint name="float"/>
      <geom type="box" size="0.2 0.1 0.1" mass="3"/>
      <body name="mast" pos="0 0 0.2" euler="0 60 0">
        <joint name="wrist" type="ball" damping="0.05"{wrist}/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="0.5"/>
        <body name="fore" pos="0 0 0.3">
          <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.005"/>
          <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="rope"{rope}><joint joint="elbow" coef="0.5"/></fixed>
  </tendon>
  <actuator>
    <motor name="thrust" joint="float" gear="1 0.3 1 0.2 0.1 0.3"/>
    <orientation name="aim" joint="wrist" kp="3"{aim}/>
    <motor name="pull" tendon="rope" gear="2"/>
    <general name="ease" tendon="rope" gainprm="2" biastype="affine" biasprm="0 -2 -0.1"/>
    <motor name="push" joint="elbow"/>
  </actuator>
</mujoco>
"""


def ship(integrator: str = "implicitfast", **attributes: str) -> str:
    """The model with further attributes of its elements."""
    words = {"wrist": "", "rope": "", "aim": ""}
    words |= {name: f" {text}" for name, text in attributes.items()}
    return SHIP.format(integrator=integrator, **words)


def sines(*moved: str, **further: float) -> dict[str, Any]:
    """Sines of all actuators; those of thruster, mast and rope are moved."""
    sizes = dict(zip(moved, (3.0, 0.6, 0.3), strict=True))
    offsets = dict(zip(moved, (2.0, 0.2, 0.2), strict=True))
    amplitude = {**sizes, "ease": 0.2, "push": 0.1, **further}
    return {"kind": "sine", "frequency": 3.0, "amplitude": amplitude, "offset": offsets}


def ship_task(folder: Path, text: str | None = None, **tables: Any) -> DesignTask:
    """The ship for 0.2 s, with five engine steps in each sample; everything moves."""
    w, x, y, z = TILT
    defaults = {
        "horizon": 0.2,
        "parameters": {"m": "body/fore:mass"},
        "noise": {"qpos:elbow": 0.01},
        "initial": {
            "qpos": (0.0, 0.0, 1.0, w, x, y, z, w, y, x, z, -0.3),
            "qvel": (0.3, -0.1, 0.2, 0.5, -0.4, 0.3, 0.4, -0.8, 0.2, 1.0),
        },
        "control": sines("thrust", "aim[0]", "pull", **{"aim[1]": 0.5, "aim[2]": 0.4}),
    }
    return make_task(text or ship(), folder, **{**defaults, **tables})


# Limits that the motion of the ship partly violates.
KINDS = {
    "place": {"position": {"float": ((-0.1, 0.02), (-0.1, 0.1), (0.9, 1.02))}},
    "height": {"position": {"float.z": (0.9, 1.03)}},
    "turn": {"position": {"wrist": (0.0, 0.8)}},
    "tilt": {"tilt": {"float": 0.4, "wrist": 1.0}},
    "velocity": {"velocity": {"float": 0.5, "wrist": 1.2, "elbow": 2.0}},
    "velocity of a coordinate": {"velocity": {"float.y": (-0.2, 0.1)}},
    "angular velocity": {"angular_velocity": {"float": 1.0, "wrist.rz": 0.3}},
    "acceleration": {"acceleration": {"float": 2.0, "wrist": 30.0, "float.x": 3.0}},
    "force": {"force": {"aim": 2.2, "aim[1]": 1.0, "ease": 0.5}},
    "force on a joint": {"joint_force": {"elbow": 0.5}},
    "force on a tendon": {"tendon_force": {"rope": (-0.1, 0.4)}},
    "length of a tendon": {"tendon_length": {"rope": (-0.2, -0.1)}},
}
EVERY = {
    "position": {**KINDS["place"]["position"], **KINDS["turn"]["position"]},
    **{
        key: value
        for name, table in KINDS.items()
        if name not in ("place", "height", "turn", "velocity of a coordinate")
        for key, value in table.items()
    },
}


# A ball joint first, so that addresses of positions, velocities and joints all differ.
XML = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body><joint name="ball" type="ball"/><geom size=".1"/>
      <body pos="0 0 1"><joint name="lift" type="slide" range="-0.5 0.25"/><geom size=".1"/>
        <body pos="0 0 1"><joint name="turn" type="hinge"/><geom size=".1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="lift" ctrlrange="-2 3"/>
    <motor name="twist" joint="turn"/>
  </actuator>
</mujoco>
"""


def limits(text: str, **tables: Any) -> dict[str, tuple[float, float, str]]:
    """Range and unit of all limits of a model by title."""
    model = mujoco.MjModel.from_xml_string(text)
    found = limits_of(model, control_names(model), Limits(**tables), 0.01)
    return {each.title: (each.lower, each.upper, each.unit) for each in found}


# Elements without a range in the model are free.
LIFT = {"position of lift": (-0.5, 0.25, "m")}
PUSH = {"control of push": (-2.0, 3.0, "N")}
BOX = ((-1.0, 1.0), (-2.0, 2.0), (0.5, 3.0))
HEIGHT = {"float.z": (0.0, 2.0)}
NARROWER = {
    "position of float.x": (-1.0, 1.0, "m"),
    "position of float.y": (-2.0, 2.0, "m"),
    "position of float.z": (0.5, 2.0, "m"),
}
RANGED = ship(
    wrist='range="0 50"', rope='range="-1 2" actuatorfrcrange="-3 4"', aim='forcerange="0 5"'
)
OF_MJCF = {
    "position of wrist": (0.0, pytest.approx(np.deg2rad(50.0)), "rad"),
    "force of aim": (0.0, 5.0, ""),
    "tendon force of rope": (-3.0, 4.0, ""),
    "tendon length of rope": (-1.0, 2.0, ""),
}
FORCED = XML.replace('type="hinge"', 'type="hinge" actuatorfrcrange="-6 7"').replace(
    'joint="turn"/>', 'joint="turn" forcerange="-1 8"/>'
)


@pytest.mark.parametrize(
    ("text", "tables", "expected"),
    [
        (XML, {}, {**LIFT, **PUSH}),
        (
            XML,
            {
                "position": {"lift": (-0.1, 0.1), "turn": (-1, 2)},
                "velocity": {"lift": 2.0, "turn": (-1.0, 4.0)},
                "control": {"twist": (-5, 5), "push": (-9, 1)},
            },
            {
                "position of lift": (-0.1, 0.1, "m"),
                "position of turn": (-1.0, 2.0, "rad"),
                "velocity of lift": (-2.0, 2.0, "m/s"),
                "velocity of turn": (-1.0, 4.0, "rad/s"),
                "control of push": (-2.0, 1.0, "N"),
                "control of twist": (-5.0, 5.0, "N m"),
            },
        ),
        (
            XML,
            {"control_rate": 7.0},
            {
                **LIFT,
                **PUSH,
                "control rate of push": (-7.0, 7.0, "N/s"),
                "control rate of twist": (-7.0, 7.0, "N m/s"),
            },
        ),
        (
            FORCED,
            {"force": 5.0},
            {
                **LIFT,
                **PUSH,
                "force of push": (-5.0, 5.0, "N"),
                "force of twist": (-1.0, 5.0, "N m"),
                "joint force of turn": (-6.0, 7.0, "N m"),
            },
        ),
        (
            ship(),
            {"velocity": 1.5, "acceleration": 9.0, "angular_velocity": 2.0, "tilt": 0.3},
            {
                "velocity of float": (0.0, 1.5, "m/s"),
                "velocity of wrist": (0.0, 1.5, "rad/s"),
                "velocity of elbow": (-1.5, 1.5, "rad/s"),
                "acceleration of float": (0.0, 9.0, "m/s²"),
                "acceleration of wrist": (0.0, 9.0, "rad/s²"),
                "acceleration of elbow": (-9.0, 9.0, "rad/s²"),
                "angular velocity of float": (0.0, 2.0, "rad/s"),
                "angular velocity of wrist": (0.0, 2.0, "rad/s"),
                "tilt of float": (0.0, 0.3, "rad"),
                "tilt of wrist": (0.0, 0.3, "rad"),
            },
        ),
        (ship(), {"position": {"float": BOX, **HEIGHT}}, NARROWER),
        (ship(), {"position": {**HEIGHT, "float": BOX}}, NARROWER),
        (
            ship(),
            {
                "velocity": {"float.z": (-0.5, 1.0)},
                "angular_velocity": {"float.rz": 1.0},
                "force": {"aim[0]": 1.0, "push": 1.0},
            },
            {
                "velocity of float.z": (-0.5, 1.0, "m/s"),
                "angular velocity of float.rz": (-1.0, 1.0, "rad/s"),
                "force of aim[0]": (-1.0, 1.0, ""),
                "force of push": (-1.0, 1.0, "N m"),
            },
        ),
        (RANGED, {}, OF_MJCF),
        (
            RANGED,
            {"tendon_force": 2.0, "force": {"aim": 1.0}},
            OF_MJCF | {"tendon force of rope": (-2.0, 2.0, ""), "force of aim": (0.0, 1.0, "")},
        ),
    ],
)
def test_ranges_of_the_model_and_of_the_file_hold(text: str, tables: Any, expected: Any) -> None:
    """The file narrows the ranges of the model. One number holds for every name: it is the largest
    speed of a free body and the largest angular speed of a ball. A box is three ranges, and a
    coordinate narrows it.
    """
    assert limits(text, **tables) == expected


@pytest.mark.parametrize(
    ("text", "tables", "message"),
    [
        (
            ship(),
            {"position": {"float": (-1.0, 1.0)}},
            "limits.position: 'float' is a free joint: it needs three ranges, [[lower, upper], "
            "[lower, upper], [lower, upper]] of x, y and z; or limit single coordinates: float.x, "
            "float.y, float.z",
        ),
        (
            ship(),
            {"position": {"elbow": ((-1.0, 1.0),) * 3}},
            "limits.position.elbow: three ranges are for free joints; it needs one range",
        ),
        (
            ship(),
            {"tilt": {"elbow": 0.3}},
            "limits.tilt: 'elbow' is a hinge, which can have position, velocity, acceleration, "
            "joint_force; this key limits ball joints and free joints only; valid: float, wrist",
        ),
        (
            ship(),
            {"joint_force": {"float": 1.0}},
            "limits.joint_force: 'float' is a free joint, which can have position, tilt, velocity, "
            "angular_velocity, acceleration; this key limits slides and hinges only; valid: elbow",
        ),
        (
            ship(),
            {"velocity": {"float": (-1.0, 1.0)}},
            "limits.velocity.float: [-1, 1] should be one number: this quantity is a magnitude",
        ),
        (ship(), {"tilt": {"float": 45.0}}, "limits.tilt.float: 45 rad limits nothing: this angle"),
        (ship(), {"tendon_force": {"elbow": 1.0}}, "limits.tendon_force: unknown tendon 'elbow'; "),
        (XML, {"acceleration": {"turm": 1.0}}, "unknown joint 'turm' (did you mean 'turn'?)"),
        (
            XML,
            {"control": {"lift": (-1, 1)}},
            "limits.control: unknown actuator 'lift'; valid: push, twist",
        ),
        (
            XML,
            {"position": {"lift": (1, -1)}},
            "limits.position.lift: [1, -1] is inverted; needs lower < upper",
        ),
        (XML, {"velocity": {"turn": (1.0, 1.0)}}, "limits.velocity.turn: [1, 1]"),
        (XML, {"control": {"push": (0.0, float("nan"))}}, "limits.control.push: [0, nan]"),
        (
            XML,
            {"position": {"lift": (0.3, 1.0)}},
            "limits.position.lift: [0.3, 1] and the MJCF's range [-0.5, 0.25] excl",
        ),
        (
            '<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>',
            {"tilt": 0.5},
            "limits.tilt applies to nothing in this model: 'joint0' is a hinge. It limits ball",
        ),
    ],
)
def test_wrong_limits_are_refused(text: str, tables: Any, message: str) -> None:
    """The message names the key, the fault and the valid alternatives."""
    with pytest.raises(ExperimentError, match=re.escape(message)):
        limits(text, **tables)


# An actuator with three controls and three forces before one with one of each.
SERVOED = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body><joint name="ball" type="ball"/><geom size=".1"/>
      <body pos="0 0 1"><joint name="turn" type="hinge"/><geom size=".1"/></body>
    </body>
  </worldbody>
  <actuator>
    <orientation name="aim" joint="ball" kp="10" ctrlrange="-1 1" forcerange="0 2"/>
    <motor joint="turn" ctrlrange="-5 5" forcerange="-3 4"/>
  </actuator>
</mujoco>
"""


def test_every_control_of_an_actuator_has_its_range_and_label() -> None:
    """MuJoCo has one range per control; the range of several forces is that of their norm."""
    controls = labels_of_model(mujoco.MjModel.from_xml_string(SERVOED)).controls
    assert controls == (*(f"aim[{i}] (control)" for i in range(3)), "actuator1 [N m]")
    assert limits(SERVOED) == {
        **{f"control of aim[{i}]": (-1.0, 1.0, "") for i in range(3)},
        "control of actuator1": (-5.0, 5.0, "N m"),
        "force of aim": (0.0, 2.0, ""),
        "force of actuator1": (-3.0, 4.0, "N m"),
    }


@pytest.mark.parametrize(
    ("ctrl", "names"),
    [
        ([0.1, 0.1, 0.1, 2.0], ()),
        # The norm of three forces is clamped, none of them alone is that large.
        ([0.15, 0.15, 0.0, -2.0], ("aim",)),
        ([0.1, 0.1, 0.1, -3.5], ("actuator1",)),
        ([-0.5, 0.0, 0.0, 4.5], ("aim", "actuator1")),
    ],
)
def test_clamped_forces_are_found_beside_actuators_with_several(
    ctrl: list[float], names: Any
) -> None:
    model = mujoco.MjModel.from_xml_string(SERVOED)
    still = Trajectory(
        t=np.arange(3) * 0.1,
        qpos=np.tile(model.qpos0, (3, 1)),
        qvel=np.zeros((3, 4)),
        act=np.zeros((3, 0)),
        ctrl=np.array([ctrl] * 2),
    )
    assert saturated_actuators(model, still) == names


@pytest.mark.parametrize("delta", [0.1, 3e-3])
@pytest.mark.parametrize("name", KINDS)
def test_the_slope_of_the_barrier_is_that_of_simulated_controls(
    name: str, delta: float, tmp_path: Path
) -> None:
    task = ship_task(tmp_path, limits=KINDS[name], horizon=0.1).relaxed()
    assert barrier_check(task, delta) < 2e-3


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_the_slope_of_all_limits_together_holds_with_every_integrator(
    integrator: str, tmp_path: Path
) -> None:
    task = ship_task(tmp_path, ship(integrator), limits=EVERY, horizon=0.1).relaxed()
    assert barrier_check(task, 0.05) < 2e-3


@pytest.mark.parametrize("is_angle", [False, True])
def test_the_curvature_of_the_barrier_of_a_norm_is_that_of_differences(is_angle: bool) -> None:
    """Also at the norm zero and beyond the bound."""
    magnitude = Magnitude(columns=(0, 1, 2), is_angle=is_angle)
    share = magnitude.norm_at(0.7)
    moves = 1e-5 * share * np.eye(3)
    for norm in (0.0, 1e-6, 0.3, 0.995, 1.2):
        here = share * norm * np.array([2.0, -1.0, 2.0]) / 3.0
        found, up, down = (
            magnitude.barrier(here + each, 0.7, 0.8, delta=0.01, weight=0.5)
            for each in (0.0, moves, -moves)
        )
        bend, size = (up[1] - down[1]) / (2e-5 * share), np.abs(found[2]).max()
        assert_allclose(found[2], bend, rtol=1e-4, atol=1e-4 * size)


def test_every_engine_step_of_the_unmodified_model_is_checked(tmp_path: Path) -> None:
    """Margins, usage and violations are those of a player that shares no code with the package."""
    one_motor = ship().replace("<orientation", "<motor").replace('kp="3"', 'gear="2 1 0.5"')
    limits = {**EVERY, "force": {"aim": 0.4, "ease": 0.5}}
    task = ship_task(tmp_path, one_motor, limits=limits, control=sines("thrust", "aim", "pull"))
    excess = excess_of(task, task.control)
    found = verify(task, task.initial)
    for usage in found.usage:
        worst = np.abs(usage.share).max() - 1.0
        assert worst == pytest.approx(excess[usage.kind, usage.name], abs=1e-6), usage.title
    for kind, margin in found.relative_margins.items():
        assert margin == pytest.approx(-of_kind(excess, kind), abs=1e-6)
    assert {(v.kind, v.name) for v in violations_of(task, found)} == {
        key for key, value in excess.items() if value > 0.0
    }


def test_a_start_outside_is_refused_with_its_unit(tmp_path: Path) -> None:
    for tables, message in (
        ({"tilt": {"float": 0.1}}, r"limits\.tilt\.float: the initial state is at 0\.\d+ rad"),
        ({"velocity": {"float": 0.1}}, r"limits\.velocity\.float: the initial state is at 0\.37\d"),
        (
            {"position": {"float.z": (1.5, 2.0)}},
            r"limits\.position\.float\.z: the initial state is at 1 m, outside \[1\.5, 2\]",
        ),
        ({"tendon_length": {"rope": (0.0, 1.0)}}, r"limits\.tendon_length\.rope: .* at -0\.15"),
    ):
        with pytest.raises(ExperimentError, match=message):
            require_feasible_start(ship_task(tmp_path, limits=tables))


# A quadrotor: a box with a thruster at each corner, whose drag turns it about its axis.
QUADROTOR = """
<mujoco model="quadrotor">
  <option timestep="{timestep}" integrator="implicitfast" gravity="0 0 {gravity}"/>
  <default><motor ctrlrange="0 {thrust}"/></default>
  <worldbody>
    <body name="drone" pos="0 0 {height}" euler="0 0 30">
      <freejoint name="float"/>
      <geom type="box" size="{half} {half} {thin}" mass="{mass}" contype="0" conaffinity="0"/>
      <site name="front" pos="{arm} {arm} 0"/>
      <site name="left" pos="-{arm} {arm} 0"/>
      <site name="back" pos="-{arm} -{arm} 0"/>
      <site name="right" pos="{arm} -{arm} 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="front" site="front" gear="0 0 1 0 0 {drag}"/>
    <motor name="left" site="left" gear="0 0 1 0 0 -{drag}"/>
    <motor name="back" site="back" gear="0 0 1 0 0 {drag}"/>
    <motor name="right" site="right" gear="0 0 1 0 0 -{drag}"/>
  </actuator>
</mujoco>
"""
LENGTHS = {"height": 1.0, "half": 0.12, "thin": 0.03, "arm": 0.15, "drag": 0.02}


def flight(folder: Path, length: float, mass: float, time: float) -> DesignTask:
    """The quadrotor in other units flies for a second; its mass and centre are unknown."""
    speed, acceleration = length / time, length / time**2
    text = QUADROTOR.format(
        **{name: length * value for name, value in LENGTHS.items()},
        mass=0.6 * mass,
        thrust=4.0 * mass * acceleration,
        gravity=-9.81 * acceleration,
        timestep=0.005 * time,
    )
    side, height = (-0.4 * length, 0.4 * length), (0.7 * length, 2.0 * length)
    return make_task(
        text,
        folder,
        rate=50.0 / time,
        horizon=1.0 * time,
        parameters={
            "mass": "body/drone:mass",
            "centre": {"target": "body/drone:ipos[0]", "scale": 0.01},
        },
        noise={"qpos:float": 0.005, "qvel:float": 0.05},
        control={
            "kind": "multisine",
            "amplitude": 0.05 * mass * acceleration,
            "frequency": 0.5 / time,
            "offset": 0.6 * 9.81 / 4 * mass * acceleration,
        },
        cost={"control": 0.0},
        limits={
            "position": {"float": (side, side, height)},
            "velocity": 0.8 * speed,
            "angular_velocity": 2.0 / time,
            "acceleration": 9.0 * acceleration,
            "tilt": 0.3,
        },
    )


@pytest.mark.parametrize(
    ("length", "mass", "time"), [(1e3, 1.0, 1.0), (1.0, 1e-3, 1.0), (1.0, 1.0, 1e2)]
)
def test_limits_of_a_free_body_do_not_depend_on_units(
    length: float, mass: float, time: float, tmp_path: Path
) -> None:
    """Margins over the bounds, and the barrier with its slope, are those in other units."""

    def stated(*units: float) -> tuple[dict[str, float], float, float]:
        """Relative margins, the barrier and its slope along a change of the control."""
        task = flight(tmp_path, *units).relaxed()
        problem = barrier_problem(task, 0.05)
        point = problem.point(task.control)
        open_loop = np.zeros((task.samples, 4, task.space.nx))
        slope = np.sum(problem.expand(point).gradient(open_loop)[:, 0])
        margins = verify(task, task.initial).relative_margins
        return margins, point.barrier, slope * task.control.max()

    for here, there, accuracy in zip(
        stated(length, mass, time), stated(1.0, 1.0, 1.0), (1e-6, 1e-6, 1e-4), strict=True
    ):
        assert here == pytest.approx(there, rel=accuracy)
