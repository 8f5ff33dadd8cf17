"""Hard limits along a trajectory: margins and the expansion of the barrier, checked by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.excitation.task import DesignTask
from mjfim.optimize.cost_models import relaxed_log_barrier
from mjfim.optimize.directions import StructuredBFGS
from tests.support.limits import (
    ARM,
    along_control,
    arm_task,
    barrier_check,
    barrier_problem,
    directions_of,
    excess_of,
    floating_task,
    of_kind,
    played,
)
from tests.support.numerics import relative_error

# Wide tolerances, so that a missed final state does not dominate the barrier.
WIDE = {"position": 0.5, "velocity": 5.0}

# Tight limits: the motion below violates some of them and is close to others.
ALONE = {
    "position": {"limits": {"position": {"shoulder": (-0.3, 0.7), "elbow": (-0.3, 0.5)}}},
    "velocity": {"limits": {"velocity": {"shoulder": 4.6, "elbow": (-5.0, 4.8)}}},
    "acceleration": {"limits": {"acceleration": 300.0}},
    "control": {"limits": {"control": {"shoulder": (-0.3, 0.4), "elbow": (-0.1, 0.7)}}},
    "control_rate": {"limits": {"control_rate": {"shoulder": 2.5, "elbow": (-3.0, 5.0)}}},
    "force": {"limits": {"force": {"shoulder": 11.0, "elbow": (-4.0, 4.5)}}},
    "clearance": {"limits": {"clearance": 0.03}},
    "end": {"boundary": {"end": "periodic", "position": 0.1, "velocity": 2.0}},
    "rest": {"boundary": {"start": "rest", "end": "rest", **WIDE}, "limits": {"control_rate": 4.0}},
    "seam": {
        "boundary": {"end": "periodic", **WIDE},
        "limits": {"control_rate": {"elbow": 2.0, "shoulder": (-9.0, 2.0)}},
    },
    "rest and seam": {
        "boundary": {"start": "rest", "end": "periodic", **WIDE},
        "limits": {"control_rate": 4.0},
    },
}
EVERY = {key: value for name in list(ALONE)[:7] for key, value in ALONE[name]["limits"].items()}
TOGETHER = {
    "every kind, anywhere": {"limits": EVERY},
    "every kind, rest to rest": {
        "limits": EVERY,
        "boundary": {"start": "rest", "end": "rest", **WIDE},
    },
    "every kind, periodic": {"limits": EVERY, "boundary": {"end": "periodic", **WIDE}},
}
KINDS = {"position", "velocity", "acceleration", "control", "control_rate", "force", "clearance"}


# The search takes contacts out of the model; the player does not.
WITHOUT_CONTACTS = ARM.replace(
    'integrator="implicitfast"/>', 'integrator="implicitfast"><flag contact="disable"/></option>'
)


SWING = {
    "kind": "sine",
    "amplitude": {"shoulder": 0.25, "elbow": 0.35},
    "offset": {"shoulder": 0.1, "elbow": 0.2},
    "frequency": 1.5,
}


def swinging(folder: Path, **tables: Any) -> DesignTask:
    """The relaxed arm, which starts at rest and is moved by sines for 0.4 s."""
    tables = {"horizon": 0.4, "control": SWING, **tables}
    return arm_task(folder, WITHOUT_CONTACTS, **tables).relaxed()


@pytest.mark.parametrize("delta", [0.1, 3e-3])
@pytest.mark.parametrize("name", [*ALONE, *TOGETHER])
def test_the_slope_of_the_barrier_is_that_of_simulated_controls(
    name: str, delta: float, tmp_path: Path
) -> None:
    task = swinging(tmp_path, **{**ALONE, **TOGETHER}[name])
    constraints = constraint_set_of(task)
    margins = constraints.margins(along_control(task, constraints))
    if name in KINDS:
        assert set(margins) == {name}
    elif name in TOGETHER:
        assert set(margins) >= KINDS
        assert min(margins.values()) < 0.0 < max(margins.values())
    assert barrier_check(task, delta) < 2e-3


def test_the_slope_of_an_end_holds_for_quaternions_far_from_it(tmp_path: Path) -> None:
    """Half a turn away, the difference of two rotations is not linear in the state."""
    wild = {
        "initial": {
            "qvel": (0.1, 0.0, 0.2, 3.5, -2.4, 4.3, 1.0, -2.0),
            "control": {"kind": "sine", "amplitude": 0.3},
        }
    }
    task = floating_task(
        tmp_path, boundary={"end": "periodic", "position": 0.5, "velocity": 50.0}, **wild
    ).relaxed()
    rotation = task.space.minus(task.initial.state[-1], task.target)[3:6]
    assert np.linalg.norm(rotation) > 1.0
    assert barrier_check(task, 0.1) < 2e-3


@pytest.mark.parametrize("name", TOGETHER)
def test_the_gauss_newton_hessian_of_the_barrier_is_a_sum_of_weighted_squares(
    name: str, tmp_path: Path
) -> None:
    """The squares are those of the changes of distances to bounds along a tangent curve, the
    weights the curvatures. The changes are those of the simulation.
    """
    task = swinging(tmp_path, **TOGETHER[name])
    constraints, problem = constraint_set_of(task), barrier_problem(task, 0.05)
    expansion = problem.expand(problem.point(task.control))
    values = along_control(task, constraints, slopes=True)
    _, _, rise = task.plant.derivatives.observation_jacobians(
        task.theta, values.trajectory, constraints.observations
    )
    values = replace(values, observation_jacobian=rise)
    open_loop = np.zeros((task.samples, 2, task.space.nx))
    for way in 1e-4 * directions_of(task, 3, seed=5):
        up, down = (along_control(task, constraints, task.control + s * way) for s in (1.0, -1.0))
        zeta = expansion.lift(open_loop, way)
        for member in constraints.members:
            high, low = member.slacks(up), member.slacks(down)
            bounded = np.isfinite(high)
            found = member.slack_changes(values, zeta)[bounded]
            assert relative_error(found, 0.5 * (high[bounded] - low[bounded])) < 5e-3

        # Of a periodic control the Hessian leaves out the change of the first sample.
        way[0] = 0.0
        zeta, wanted = expansion.lift(open_loop, way), []
        for member in constraints.members:
            slacks, changes = member.slacks(values), member.slack_changes(values, zeta)
            bounded = np.isfinite(slacks)
            curvature = relaxed_log_barrier(slacks[bounded], 0.05)[2]
            wanted.append(member.weight(values) * (curvature @ changes[bounded] ** 2))
        assert min(wanted) > 1e-6 * sum(wanted)
        a, b = expansion.barrier.weights.half_gradient(zeta)
        found = np.sum(a * zeta.z) + np.sum(b * zeta.v)
        assert found == pytest.approx(sum(wanted), rel=1e-9)


@pytest.mark.parametrize("name", TOGETHER)
def test_the_curvature_along_a_step_is_that_of_its_factors(name: str, tmp_path: Path) -> None:
    """A step that changes nothing has the curvature at its beginning; a second model continues with
    the factors of the first one."""
    task = swinging(tmp_path, **TOGETHER[name])
    problem = barrier_problem(task, 0.05, mu=3e-3, follows_curvature=True)
    expansion = problem.expand(problem.point(task.control))
    barrier = expansion.barrier
    K, way = np.zeros((task.samples, 2, task.space.nx)), directions_of(task, 1, seed=6)[0]
    weights, _, growth = barrier.curvature(expansion.lift(K, 0.0 * way), None)
    weights = weights.scaled(barrier.mu)
    assert (growth, barrier.mu) == (1.0, 3e-3)
    for each in "QRW":
        assert_allclose(getattr(weights, each), getattr(barrier.weights, each), rtol=1e-9)

    step = expansion.lift(K, way)
    _, once, growth = barrier.curvature(step, None)
    assert 1.0 < growth == pytest.approx(max(each.max() for each in once))
    _, again, growth = barrier.curvature(step, once)
    ratios = [b / a for a, b in zip(once, again, strict=True)]
    assert growth == pytest.approx(max(each.max() for each in ratios))
    # A search that follows it has another step, which is a descent as well.
    straight, bent = (
        StructuredBFGS(np.full(2, 1e-4), is_bent=each)(expansion, K) for each in (False, True)
    )
    assert expansion.slope(bent) < 0.0
    assert np.abs(bent.v - straight.v).max() > 1e-3 * np.abs(straight.v).max()

    # with a smooth barrier, or where it is not asked for, the curvature is not followed
    for change in ({"mu": 0.1}, {"follows_curvature": False}):
        other = replace(problem, **change)
        assert other.expand(other.point(task.control)).barrier.curvature is None


@pytest.mark.parametrize("end", ["rest", "periodic"])
def test_margins_along_a_trajectory_are_those_of_single_engine_steps(
    end: str, tmp_path: Path
) -> None:
    """All kinds at every engine step; relative margins are divided by half of the range.

    Rates at both ends follow the boundary.
    """
    boundary = {"start": "rest", "end": end, "position": 0.2, "velocity": 3.0}
    task = swinging(tmp_path, limits=EVERY, boundary=boundary)
    constraints, ctrl = constraint_set_of(task), task.control
    excess = excess_of(task, ctrl)
    wanted = {kind: -of_kind(excess, kind) for kind, _ in excess}

    after = task.final_hold if end == "rest" else ctrl[0]
    rates = np.diff([task.initial_hold, *ctrl, after], axis=0) / 0.01
    wanted["control_rate"] = min(
        np.minimum(rates[:, x.index] - x.lower, x.upper - rates[:, x.index]).min()
        / (0.5 * (x.upper - x.lower))
        for x in task.limits
        if x.kind == "control_rate"
    )
    # The search looks at distances at the samples only.
    values = along_control(task, constraints)
    found = constraints.relative_margins(values)
    assert found["clearance"] == pytest.approx(wanted["clearance"], abs=0.01)
    wanted["clearance"] = found["clearance"]
    assert found == pytest.approx(wanted, rel=1e-5, abs=1e-7)
    sizes = {"clearance": 0.03, "end_position": 0.2, "end_velocity": 3.0, "acceleration": 300.0}
    margins = constraints.margins(values)
    for kind, size in sizes.items():
        assert margins[kind] == pytest.approx(size * wanted[kind], rel=1e-5, abs=1e-7)


def test_a_tightened_constraint_set_has_smaller_relative_margins(tmp_path: Path) -> None:
    """The fraction of a clearance is relative to the least distance, which is raised."""
    boundary = {"end": "periodic", "position": 0.2, "velocity": 3.0}
    task = swinging(tmp_path, limits=EVERY, boundary=boundary)
    constraints = constraint_set_of(task)
    values = along_control(task, constraints)
    before = constraints.relative_margins(values)
    shares = {kind: 0.01 * (i + 1) for i, kind in enumerate(sorted(before))}
    tighter = {kind: before[kind] - share for kind, share in shares.items()}
    tighter["clearance"] = values.distances.min() / (0.03 * (1.0 + shares["clearance"])) - 1.0
    found = constraints.tightened(shares).relative_margins(values)
    assert found == pytest.approx(tighter, abs=1e-12)
    assert constraints.tightened({}).relative_margins(values) == pytest.approx(before)

    # Not so far that nothing is left between the least distance and where it no longer matters.
    far = constraints.tightened({"clearance": 50.0})
    assert far.clearance.least < far.clearance.distances.reach
    assert far.value(values, 0.1) > constraints.value(values, 0.1)


SPEEDS = {"limits": {"velocity": 2.0, "angular_velocity": 6.0}}


@pytest.mark.parametrize(
    ("make", "tables"), [(swinging, {"limits": EVERY}), (floating_task, SPEEDS)]
)
def test_the_derivative_by_a_range_is_that_of_a_narrower_range(
    make: Any, tables: Any, tmp_path: Path
) -> None:
    task = make(tmp_path, **tables)
    constraints, delta, h = constraint_set_of(task), 0.01, 1e-6
    values = along_control(task, constraints)
    found = constraints.narrowing(values, delta, task.controls)
    assert set(found) >= {limit.title for limit in task.limits}
    for kind in {limit.kind for limit in task.limits}:
        of_kind = [found[limit.title] for limit in task.limits if limit.kind == kind]
        narrow, wide = (constraints.tightened({kind: s}).value(values, delta) for s in (h, -h))
        assert sum(of_kind) == pytest.approx((narrow - wide) / (2.0 * h), rel=1e-5)


ROD = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="rod" pos="0 0 0.3" euler="0 90 0">
      <joint name="hinge" axis="0 1 0" damping="0.1" ref="0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.5" contype="0"
            conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-9 9"/></actuator>
</mujoco>
"""


@pytest.mark.slow
def test_a_design_stays_above_a_floor_that_only_the_file_states(tmp_path: Path) -> None:
    """The lowest point of the swinging rod, which collides with nothing, in plain MuJoCo."""
    (tmp_path / "rod.xml").write_text(ROD, encoding="utf-8")
    stated = mjfim.Experiment(
        model="rod.xml",
        rate=50.0,
        horizon=0.6,
        initial={"control": {"kind": "sine", "amplitude": 0.5, "offset": -1.2, "frequency": 2.0}},
        parameters={"c": "joint/hinge:damping"},
        noise={"state": 0.01},
        cost={"control": 0.0},
        descent={"max_iterations": 8},
        directory=tmp_path,
    )

    def lowest(**limits: object) -> float:
        """Height of the lowest point of the rod along a design [m]."""
        ctrl = mjfim.design(stated.replace(limits=limits)).trajectory.ctrl
        angles = played(mujoco.MjModel.from_xml_string(ROD), (0.0, 0.0), ctrl, 4)["q"]
        return 0.3 - 0.02 + min(0.0, 0.5 * np.min(-np.sin(angles)))

    assert lowest() < 0.0
    assert lowest(clearance=0.05, floor=0.0) >= 0.05 - 1e-6
