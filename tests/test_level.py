"""Levels of a descent: the same experiment on plants that are quicker to step or smoother, and what they leave alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numerics import cart_setup, make_setup

import mjfim
from mjfim.level import FREE, STATED
from mjfim.objective import DesignProblem
from mjfim.plant import DRAFT, KINKED, Accuracy
from mjfim.setup import Setup
from mjfim.trajectory import Status

ARM = """
<mujoco model="dry">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02" frictionloss="{friction}" range="-2 2"/>
      <inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.004 0.004 0.001"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01" frictionloss="{friction}"/>
        <inertial pos="0 0 -0.15" mass="0.4" diaginertia="0.002 0.002 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="30" kv="1" ctrlrange="-1 1"/>
    <position name="elbow" joint="elbow" kp="20" kv="0.5" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
DRY: dict[str, Any] = {
    "mass": {"target": "body/fore:mass"},
    "drag": {"target": "joint/elbow:damping"},
    "dry": {"target": "joint/elbow:frictionloss"},
}


def arm(folder: Path, friction: float = 0.1, **tables: Any) -> Setup:
    """Two links with servos and dry joints, for a second."""
    stated: dict[str, Any] = {
        "horizon": 1.0,
        "rate": 100.0,
        "parameters": DRY,
        "noise": {"state": 0.01},
        "initial": {"control": {"kind": "sine", "amplitude": 0.4, "frequency": 1.0}},
        "cost": {"control": 0.0},
        "limits": {"control": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)}},
    }
    return make_setup(ARM.format(friction=friction), folder, **{**stated, **tables})


def test_a_level_without_friction_steps_as_the_model_without_frictionloss(tmp_path: Path) -> None:
    setup = arm(tmp_path).free()
    level = setup.frictionless()
    assert level is not None
    assert level.parameters.names == ("mass", "drag")
    assert level.level == replace(FREE, frictionless=True)
    model = mujoco.MjModel.from_xml_string(ARM.format(friction=0.0))
    data, ctrl = mujoco.MjData(model), setup.control
    for u in ctrl:
        data.ctrl[:] = u
        mujoco.mj_step(model, data, setup.substeps)
    found = level.plant.simulate(level.theta, ctrl)
    np.testing.assert_allclose(found.qpos[-1], data.qpos, rtol=0, atol=1e-9)
    dry = setup.plant.simulate(setup.theta, ctrl)
    assert np.abs(dry.qpos[-1] - data.qpos).max() > 1e-3  # friction matters here
    assert setup.model.dof_frictionloss.tolist() == [0.1, 0.1]


def test_there_is_none_where_it_would_be_the_same_or_something_rests_on_friction(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    smooth = {name: DRY[name] for name in ("mass", "drag")}
    assert arm(tmp_path, 0.0, parameters=smooth).frictionless() is None
    other = tmp_path / "a"
    assert arm(other, parameters={"dry": DRY["dry"]}).frictionless() is None
    cost = {"criterion": "c", "subset": ["mass"], "control": 0.0}
    assert arm(other, cost=cost).frictionless() is None
    told = Setup(arm(other).experiment, added=np.eye(3))
    assert told.frictionless() is None
    assert cart_setup(tmp_path).frictionless() is None


def test_a_longer_timestep_keeps_the_samples_and_stays_near(tmp_path: Path) -> None:
    setup = arm(tmp_path, 0.0, parameters={"mass": DRY["mass"]})
    long = setup.stretched(5)
    assert (long.samples, long.dt, long.substeps) == (setup.samples, setup.dt, 1)
    assert (setup.level, long.level) == (STATED, replace(STATED, stretch=5))
    assert long.plant.source.model.opt.timestep == pytest.approx(0.01)
    near, far = (s.plant.simulate(s.theta, s.control).qpos for s in (setup, long))
    assert 1e-6 < np.abs(near - far).max() < 0.05
    with pytest.raises(ValueError, match="do not divide by 3"):
        setup.stretched(3)


def test_a_design_with_dry_joints_gains_and_keeps_its_limits(tmp_path: Path) -> None:
    limits = {"control": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)}, "control_rate": 20.0, "velocity": 6.0}
    setup = arm(tmp_path, limits=limits, descent={"max_iterations": 60})
    design = mjfim.design(setup)
    assert design.status is not Status.INFEASIBLE
    assert min(design.limits.values()) >= 0.0
    assert design.final.cost < 0.5 * design.initial.cost
    assert design.parameters == ("mass", "drag", "dry")


# ---- differences across kinks


def test_differences_that_straddle_a_kink_count_as_nothing() -> None:
    """Slopes of a parabola, and of one sample at which the function has a kink between the two."""
    rng = np.random.default_rng(0)
    first, width = rng.normal(size=(1, 5, 2)), np.full((1, 1, 1), 1e-6)
    second = 3.0 * rng.normal(size=first.shape)
    slopes = np.concatenate([first + width * second, first])
    slopes[0, 3, 1] += 0.2
    plain, careful = (Accuracy(False, 1e-6, 1e-5, steepest=limit).mixed(slopes, width) for limit in (np.inf, 5e3))
    assert plain[0, 3, 1] > 1e5
    assert careful[0, 3, 1] == 0.0
    kept = np.ones(plain.shape, dtype=bool)
    kept[0, 3, 1] = False
    np.testing.assert_allclose(careful[kept], second[kept], rtol=1e-6)


def test_dry_plants_are_drafted_with_care(tmp_path: Path) -> None:
    setup = arm(tmp_path)
    assert setup.plant.draft is KINKED
    level = setup.frictionless()
    assert level is not None
    assert level.plant.draft is DRAFT


def test_and_their_gradient_is_that_between_the_kinks(tmp_path: Path) -> None:
    """Differences of J over moves that are short enough not to shift when joints stick."""
    setup = arm(tmp_path)
    problem: DesignProblem = setup.problem
    wave = np.sin(np.pi * setup.t)[:, None] ** 2 * np.array([1.0, -0.5])
    shape = (setup.samples, len(setup.controls), setup.space.nx)

    def cost(h: float) -> float:
        return problem.point(setup.plant.simulate(setup.theta, setup.control + h * wave)).cost

    def slope(accuracy: Accuracy) -> float:
        point = problem.point(setup.initial, accuracy)
        return float(np.sum(problem.expand(point).gradient(np.zeros(shape)) * wave))

    real = np.median([(cost(h) - cost(-h)) / (2.0 * h) for h in (1e-6, 3e-6, 1e-5, 3e-5, 1e-4)])
    assert slope(KINKED) == pytest.approx(real, rel=0.1)
