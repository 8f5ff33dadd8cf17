"""Variants of a task: one experiment on plants that are quicker to step, or smoother."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mjfim.arrays import Array
from mjfim.excitation.search.levels import DescentLevel, first_point
from mjfim.excitation.task import DesignTask
from mjfim.model.variants import RELAXED, SMOOTHING_SPEED_FRACTION
from mjfim.plant.active_constraints import nothing_acts_along
from mjfim.plant.mixed_derivatives import SHARED_ORIGIN, SHARED_ORIGIN_SHORT
from tests.support.numerics import make_task

ARM = """
<mujoco model="dry">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02" frictionloss="{friction}"
        range="-2 2"/>
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


def arm(folder: Path, friction: float = 0.1, model: str = ARM, **tables: Any) -> DesignTask:
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
    return make_task(model.format(friction=friction), folder, **{**stated, **tables})


def test_only_plants_with_dry_friction_have_smoothing_speeds(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    smooth = arm(tmp_path, 0.0, parameters={name: DRY[name] for name in ("mass", "drag")}).relaxed()
    assert smooth.system.variant == RELAXED
    assert smooth.plant.smooth is smooth.plant
    assert smooth.plant.derivatives.quickest_accuracy is SHARED_ORIGIN
    limits = {
        "control": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)},
        "velocity": {"elbow": 20.0},
    }
    task = arm(tmp_path / "a", limits=limits).relaxed()
    fastest = np.abs(task.initial.qvel[:, 0]).max()
    assert task.system.variant.smoothing_speeds[1] == pytest.approx(SMOOTHING_SPEED_FRACTION * 20.0)
    assert task.system.variant.smoothing_speeds[0] >= SMOOTHING_SPEED_FRACTION * fastest
    assert task.plant.derivatives.quickest_accuracy is SHARED_ORIGIN_SHORT
    assert not task.plant.source.smoothing_speeds
    assert task.plant.smooth.source.smoothing_speeds
    assert task.smoothed().plant.source.smoothing_speeds


def test_the_smoothed_variant_of_a_plant_with_dry_friction_moves_nearly_alike(
    tmp_path: Path,
) -> None:
    free = arm(tmp_path).relaxed()
    own, softened = (
        task.plant.simulate(task.theta, task.control).qpos[-1] for task in (free, free.smoothed())
    )
    assert 1e-5 < np.abs(softened - own).max() < 0.02


def test_a_longer_timestep_keeps_the_samples_and_gives_nearly_equal_states(tmp_path: Path) -> None:
    task = arm(tmp_path, 0.0, parameters={"mass": DRY["mass"]})
    long = task.stretched(5)
    assert (long.samples, long.dt, long.system.grid.substeps) == (task.samples, task.dt, 1)
    assert long.system.variant == replace(task.system.variant, timestep_factor=5)
    assert long.plant.source.model.opt.timestep == pytest.approx(0.01)
    near, far = (s.plant.simulate(s.theta, s.control).qpos for s in (task, long))
    assert 1e-6 < np.abs(near - far).max() < 0.05
    with pytest.raises(ValueError, match="do not divide by 3"):
        task.stretched(3)


def test_clamps_may_act_at_the_samples_of_a_robust_design_only(tmp_path: Path) -> None:
    """The clamp of a servo just lets the expected arm move freely, but not a heavier one."""
    mass = {"mass": {**DRY["mass"], "bounds": (0.1, 2.0)}}
    model = ARM.replace('kp="30"', 'kp="30" forcerange="-13 13"')
    robust = {"over": "mean", "samples": 3}
    task = arm(tmp_path, 0.0, model, parameters=mass, robust=robust)
    first = DescentLevel(task, None).problem.point(task.initial)

    free = DescentLevel(task.relaxed(), None)
    assert free.task.initial.moves_as(task.initial)
    point = first_point(free, first)
    assert point.cost != first.cost


# Edits of an arm whose joints turn freely.
RANGE = ('name="elbow"', 'name="elbow" range="-2 2"')
FORCE_RANGE = ('kp="30"', 'kp="30" forcerange="-50 50"')
JOINT_FORCE_RANGE = ('name="elbow"', 'name="elbow" actuatorfrcrange="-50 50"')


@pytest.mark.parametrize(
    ("edit", "rate", "is_compared"),
    [
        (("", ""), 100.0, False),
        (('damping="0.05"', 'damping="0.05" frictionloss="0.1"'), 100.0, True),
        (RANGE, 500.0, False),
        (RANGE, 100.0, True),
        (FORCE_RANGE, 500.0, False),
        (FORCE_RANGE, 100.0, True),
        (JOINT_FORCE_RANGE, 500.0, True),
    ],
)
def test_derivatives_are_compared_unless_nothing_can_rub_touch_or_clamp(
    edit: tuple[str, str], rate: float, is_compared: bool, tmp_path: Path
) -> None:
    """A smooth motion needs no second sensitivity, which takes as long as an iteration.

    Between samples of several engine steps, limits may act that do not act at any sample.
    """
    free = ARM.replace('range="-2 2"', "", 1).replace('frictionloss="{friction}"', "")
    one_parameter = {"mass": DRY["mass"]}
    task = arm(tmp_path, parameters=one_parameter, rate=rate, model=free.replace(*edit, 1))
    model = task.system.model_at(task.theta)
    acts = not nothing_acts_along(model, task.initial, task.system.grid.substeps)
    assert acts == is_compared


def test_with_sensors_only_mixed_differences_are_taken_on_the_smoothed_plant(
    tmp_path: Path,
) -> None:
    task = arm(tmp_path).relaxed()
    psi = np.random.default_rng(0).normal(size=(task.samples + 1, task.space.nx, 3))
    quickest = task.plant.derivatives.quickest_accuracy
    for accuracy in (quickest, replace(quickest, shared_origin=False)):
        both, soft = (
            plant.derivatives.bilinear(task.theta, task.initial, psi, np.eye(3)[:1], accuracy)
            for plant in (task.plant, task.plant.smooth)
        )
        assert_array_equal(both.F_mixed, soft.F_mixed)
        assert np.abs(both.A - soft.A).max() > 1e-3


# ---- derivatives where joints reverse


def test_the_gradient_of_the_smoothed_variant_is_that_of_its_cost(tmp_path: Path) -> None:
    """Long moves shift the reversals of joints by several engine steps; short moves do not."""
    task = arm(tmp_path).relaxed().smoothed()
    wave = np.sin(np.pi * task.t)[:, None] ** 2 * np.array([1.0, -0.5])
    found = slope(task, wave)
    for h in (1e-5, 1e-3, 3e-3):
        assert found == pytest.approx(difference(task, wave, h), rel=0.15)


def slope(task: DesignTask, wave: Array) -> float:
    """Change of log J per unit of a control's change."""
    point = task.problem.point(task.initial, task.plant.derivatives.quickest_accuracy)
    open_loop = np.zeros((task.samples, len(task.controls), task.space.nx))
    return float(np.sum(task.problem.expand(point).gradient(open_loop) * wave)) / point.cost


def difference(task: DesignTask, wave: Array, h: float) -> float:
    """Change of log J per unit of a control's change, by two evaluations."""
    there, back = (
        task.problem.point(
            task.plant.simulate(task.theta, task.control + s * wave),
            task.plant.derivatives.quickest_accuracy,
        ).cost
        for s in (h, -h)
    )
    return float(np.log(there / back) / (2.0 * h))
