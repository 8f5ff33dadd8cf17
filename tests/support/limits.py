"""Models and tasks that tests of hard limits share."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.excitation.limits.constraint_kinds import ConstraintValues
from mjfim.excitation.limits.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.search.interior_problem import InteriorProblem
from mjfim.excitation.task import DesignTask
from tests.fuzz.player import NEAREST, Layout, Row, play
from tests.support.numerics import TILT, Array, cart_task, directional_check, make_task

# An arm of two servos on a floating hull: the addresses of positions, velocities, joints and
# actuators all differ. One servo has an activation state, the other a limited force; one joint
# limits the force of its actuators.
FLOATING = """
<mujoco model="floating">
  <option timestep="0.002" integrator="{integrator}" gravity="0 0 -1">
    <flag contact="disable"/>
  </option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="hull" pos="0 0 1">
      <freejoint name="float"/>
      <geom type="box" size="0.2 0.1 0.1" mass="3"/>
      <body name="upper" pos="0.2 0 0">
        <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.01"
               actuatorfrcrange="-0.9 0.9"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.5"/>
        <body name="fore" pos="0.3 0 0">
          <joint name="elbow" axis="0 0 1" damping="0.1" armature="0.005"
                 range="-3 3" limited="false"/>
          <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.3"/>
          <site name="tip" pos="0.25 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="thrust" joint="float" gear="0 0 1 0 0 0"/>
    <general name="shoulder" joint="shoulder" dyntype="filter" dynprm="0.03"
             gainprm="20" biastype="affine" biasprm="0 -20 -0.5"/>
    <position name="elbow" joint="elbow" kp="12" kv="0.3" forcerange="-0.7 0.7"/>
  </actuator>
  <sensor><gyro name="gyro" site="tip"/></sensor>
</mujoco>
"""

# Limits of several kinds for the floating arm.
FLOATING_LIMITS = {
    "position": {"elbow": (-2.0, 2.0), "shoulder": (-1.5, 2.5)},
    "velocity": {"shoulder": 9.0},
    "acceleration": {"shoulder": 300.0, "elbow": 300.0},
    "force": {"shoulder": 8.0, "thrust": 50.0},
}


def floating_task(folder: Path, integrator: str = "implicitfast", **tables: Any) -> DesignTask:
    """The floating arm, swinging for 0.3 s with five engine steps in each sample."""
    control = {
        "kind": "sine",
        "amplitude": {"thrust": 4.0, "shoulder": 0.6, "elbow": 0.5},
        "offset": {"thrust": 3.0, "shoulder": 0.2, "elbow": 0.1},
        "frequency": 2.0,
    }
    defaults = {
        "horizon": 0.3,
        "parameters": {"m": "body/fore:mass", "c": "joint/shoulder:damping"},
        "noise": {"qpos:shoulder": 0.01, "qpos:elbow": 0.01, "qvel:elbow": 0.05},
        "limits": FLOATING_LIMITS,
        "initial": {
            "qpos": (0.0, 0.0, 1.0, *TILT, 0.4, -0.3),
            "qvel": (0.1, 0.0, 0.2, 0.5, -0.4, 0.3, 1.0, -2.0),
            "act": (0.1,),
            "control": control,
        },
    }
    return make_task(FLOATING.format(integrator=integrator), folder, **{**defaults, **tables})


# A planar arm of two torque-controlled servos over a floor, with a post in its way.
ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1" pos="0 0 -0.42"/>
    <geom name="post" type="sphere" size="0.05" pos="0.56 0 -0.3"/>
    <body name="upper" pos="0 0 0">
      <joint name="shoulder" axis="0 1 0" damping="0.3" armature="0.02"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.8"/>
      <body name="fore" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.01"/>
        <geom name="fore" type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40" kv="1"/>
    <general name="elbow" joint="elbow" gainprm="25" biastype="affine" biasprm="0 -25 -0.5"/>
  </actuator>
</mujoco>
"""


def arm_task(folder: Path, model: str = ARM, **tables: Any) -> DesignTask:
    """The arm at rest for half a second, whose joints are measured."""
    defaults = {
        "parameters": {"m": "body/fore:mass", "c": "joint/elbow:damping"},
        "noise": {"qpos:shoulder": 0.01, "qpos:elbow": 0.01},
    }
    return make_task(model, folder, **{**defaults, **tables})


def played(model: Any, start: tuple[Array, Array], ctrl: Array, substeps: int) -> dict[str, Array]:
    """Positions, velocities, accelerations and actuator forces at every step of a plain loop."""
    data, rows = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = start
    for held in np.repeat(ctrl, substeps, axis=0):
        data.ctrl[:] = held
        before = data.qvel.copy()
        mujoco.mj_step(model, data)
        change = (data.qvel - before) / model.opt.timestep
        rows.append([np.array(x) for x in (data.qpos, data.qvel, change, data.actuator_force)])
    return {key: np.array(column) for key, *column in zip("qvaf", *rows, strict=True)}


def directions_of(task: DesignTask, count: int, seed: int = 0) -> Array:
    """Random changes of the control, half of them smooth and half of them rough: (count, N, nu)."""
    rng = np.random.default_rng(seed)
    t = task.t[:, None] / task.experiment.horizon
    nu = task.control.shape[1]

    count, rest, phases = count // 2, count - count // 2, 2 * np.pi * t
    smooth = [
        np.sin(phases * rng.uniform(0.5, 3.0, nu) + rng.uniform(0, 6, nu)) for _ in range(count)
    ]
    return np.array([*smooth, *rng.normal(size=(rest, *task.control.shape))])


def along_control(
    task: DesignTask, constraints: ConstraintSet, ctrl: Array | None = None, slopes: bool = False
) -> ConstraintValues:
    """The limited quantities along a control, by default the initial one."""
    ctrl = task.control if ctrl is None else ctrl
    observed = task.plant.observe(task.theta, ctrl, constraints.observations)
    return constraints.evaluate(*observed, slopes=slopes)


def of_kind(excess: dict[tuple[str, str], float], kind: str) -> float:
    """Largest excess beyond the limits of one kind."""
    return max(value for (other, _), value in excess.items() if other == kind)


def barrier_problem(task: DesignTask, delta: float, **changes: Any) -> InteriorProblem:
    """The barrier of the limits of a task alone."""
    stated = {"constraints": constraint_set_of(task), "mu": 1.0, "with_cost": False, **changes}
    return InteriorProblem(base=task.problem, delta=delta, **stated)


def slope_check(
    task: DesignTask, gradient: Array, value: Callable[[Array], float], ways: Array, h: float
) -> float:
    """Largest relative error of a gradient (N, nu) against differences of a value of controls."""
    curves = [lambda s, way=way: value(task.control + s * way) for way in ways]
    return directional_check([np.sum(gradient * way) for way in ways], curves, h)


def barrier_check(task: DesignTask, delta: float) -> float:
    """Largest relative error of the slope of the barrier, against differences of simulations."""
    problem = barrier_problem(task, delta)
    expansion = problem.expand(problem.point(task.control))
    gradient = expansion.gradient(np.zeros((task.samples, len(task.controls), task.space.nx)))
    ways = directions_of(task, 6) * np.abs(task.control - task.centre).max(axis=0)
    return slope_check(task, gradient, lambda ctrl: problem.point(ctrl).barrier, ways, 2e-5)


def full_rows(model: Any, given: Sequence[dict[str, float]], period: float) -> list[Row]:
    """Rows of a design.csv whose numbers are zero unless they are given."""
    layout = Layout(model)
    names = [name for part in layout.columns for name in part]
    zero = dict.fromkeys([*names, *(f"ctrl:{name}" for name in layout.drives)], 0.0)
    zero |= {name: 1.0 for name in names if name.endswith(".qw")}
    for drive in layout.drives:
        gains = [
            f"gain:{drive}:q{kind}:{name}" for kind in ("pos", "vel") for name in layout.freedoms
        ]
        zero |= dict.fromkeys(gains, 0.0)
    assert all(set(row) <= set(zero) for row in given)
    return [{**zero, **row, "t": period * i} for i, row in enumerate(given)]


def excess_of(task: DesignTask, ctrl: Array) -> dict[tuple[str, str], float]:
    """Excess of a control beyond each limit on the model of the user, as a share of half the range.

    The player shares no code with the package. A speed or an angle is between 0 and its bound. An
    end that is not free is the initial state. What a clearance lacks is relative to it.
    """
    stated = task.experiment
    model = mujoco.MjModel.from_xml_path(str(stated.directory / stated.model))
    layout = Layout(model)
    columns = itertools.chain.from_iterable(layout.columns)
    start = dict(zip(columns, task.plant.nominal_initial_state.tolist(), strict=True))
    names = [f"ctrl:{name}" for name in task.controls]
    held = [*ctrl.tolist(), ctrl[-1].tolist()]
    given = [start | dict(zip(names, now, strict=True)) for now in held]
    ranges = {
        (limit.kind, limit.name): (-limit.upper if limit.is_magnitude else limit.lower, limit.upper)
        for limit in task.limits
    }
    least, boundary = stated.limits.clearance, stated.boundary
    if least is not None:
        ranges["clearance", NEAREST] = (least, 3.0 * least)
    if boundary.end != "free":
        for name in layout.freedoms:
            ranges["end_position", name] = (-boundary.position, boundary.position)
            ranges["end_velocity", name] = (-boundary.velocity, boundary.velocity)
    return play(model, full_rows(model, given, task.dt), ranges, task.dt).found


# Limits that the cart-pendulum meets quickly.
HARD = {
    "control": {"force": (-5.0, 5.0)},
    "position": {"slide": (-0.3, 0.5)},
    "velocity": {"hinge": 3.0},
}


def cart_inside(folder: Path, **tables: Any) -> DesignTask:
    """The cart-pendulum over one second under the limits `HARD`, without weights."""
    defaults = {
        "horizon": 1.0,
        "cost": {"control": 0.0},
        "limits": HARD,
        "descent": {"max_iterations": 30},
    }
    return cart_task(folder, **{**defaults, **tables})
