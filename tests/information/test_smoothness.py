"""Disagreement of two difference steps: dry friction and contacts are flagged with sample and
cause, smooth models are not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.task import DesignTask
from mjfim.information.finite_steps import (
    disagreement,
    finite_steps,
    only_curved,
    steps_disagree,
)
from mjfim.plant.plant import Derivatives
from tests.support.numerics import (
    Array,
    Loop,
    body_task,
    cart_task,
    filtered_task,
    make_task,
    sensitivity_of,
)

SLIDER = """
<mujoco model="slider">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="block">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.5" {joint}/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" {motor}/></actuator>
</mujoco>
"""

BALL = """
<mujoco model="ball">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" solref="-40000 -50"/>
    <body name="ball" pos="0 0 0.3">
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.1" mass="1" solref="-40000 -50"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="z"/></actuator>
</mujoco>
"""


def slider(
    folder: Path, joint: str = "", motor: str = "", amplitude: float = 3.0, **parameters: object
) -> DesignTask:
    """A block that is pushed back and forth; by default, its mass and damping are unknown."""
    both = {"mass": {"target": "body/block:mass"}, "drag": {"target": "joint/rail:damping"}}
    control = {"kind": "sine", "amplitude": amplitude, "frequency": 1.0}
    return make_task(
        SLIDER.format(joint=joint, motor=motor),
        folder,
        parameters=parameters or both,
        noise={"state": 0.01},
        initial={"control": control},
        horizon=1.5,
    )


def ball(folder: Path, horizon: float) -> DesignTask:
    """A ball that falls on the floor at about 0.2 s."""
    parameters = {"mass": {"target": "body/ball:mass"}}
    initial = {"control": {"kind": "constant", "amplitude": 1.0}}
    return make_task(
        BALL, folder, parameters=parameters, noise={"state": 0.01}, initial=initial, horizon=horizon
    )


def along(task: DesignTask) -> bool:
    """Roughness along the initial control."""
    return steps_disagree(task.plant, task.system.noise, task.theta, task.initial)


@pytest.mark.parametrize(
    "make",
    [cart_task, body_task, filtered_task, slider, lambda f: ball(f, 0.15)],
)
def test_a_smooth_motion_is_not_flagged(make, tmp_path) -> None:
    assert not along(make(tmp_path))


def dry(folder: Path, loss: float) -> DesignTask:
    """The block held by dry friction of this size, which is unknown."""
    return slider(folder, f'frictionloss="{loss}"', dry={"target": "joint/rail:frictionloss"})


def test_dry_friction_at_the_verge_of_sliding_is_flagged_where_it_breaks_away(tmp_path) -> None:
    task = dry(tmp_path, 100.0)
    loop, curve = Loop(task.plant.model(task.theta), 1), task.initial
    forces = []
    for k in range(curve.samples):
        loop.h(curve.state[k], curve.ctrl[k])
        forces.append(abs(float(loop.data.qfrc_constraint[0])))
    assert 2.0 < max(forces) < 3.0  # it holds what is pushed
    # sliding nearly always, or never: far from the verge the derivative exists
    for share, flagged in ((1.0 - 1e-4, True), (0.2, False), (10.0, False)):
        assert along(dry(tmp_path, share * max(forces))) == flagged


def test_contacts_and_limits_are_flagged(tmp_path) -> None:
    assert along(ball(tmp_path, 1.0))
    assert along(slider(tmp_path, 'limited="true" range="-0.05 0.15"'))


def test_a_force_that_just_meets_its_range_is_flagged(tmp_path) -> None:
    limited = 'forcelimited="true" forcerange="-2 2"'
    gain = {"target": "actuator/push:gainprm[0]"}
    for amplitude, flagged in ((1.9, False), (2.0001, True)):
        assert along(slider(tmp_path, motor=limited, amplitude=amplitude, gain=gain)) == flagged


def sensed(seed: int = 0) -> Array:
    """Random G: (21, 3, 2)."""
    return np.random.default_rng(seed).normal(size=(21, 3, 2))


def test_disagreement_is_relative_to_the_largest_value_of_each_output() -> None:
    fine = sensed() * np.array([1.0, 10.0, 0.1])[:, None]
    coarse = np.array(fine)
    coarse[7, 2, 1] += 0.1 * np.abs(fine[:, 2, 1]).max()
    found = disagreement(fine, coarse)
    assert found.shape == (21, 2)
    assert found[7, 1] == pytest.approx(0.1, rel=0.2)
    assert np.count_nonzero(found) == 1


def test_round_off_of_outputs_that_a_parameter_does_not_move_is_no_disagreement() -> None:
    fine = sensed()
    fine[:, 1] = 0.0
    coarse = np.array(fine)
    coarse[:, 1] = 1e-13 * sensed(1)[:, 1]
    assert disagreement(fine, coarse).max() < 1e-3
    # an output that shows a thousandth of a parameter's effect is weighed by what the others show
    fine[:, 1], coarse[:, 1] = 1e-6 * sensed(1)[:, 1], 1e-6 * sensed(2)[:, 1]
    assert disagreement(fine, coarse).max() < 5e-3
    assert disagreement(np.zeros((4, 2, 1)), np.zeros((4, 2, 1))).max() == 0.0


def test_a_parameter_without_effect_is_not_called_rough(tmp_path) -> None:
    depth = {"target": "body/block:ipos[1]", "guess": 0.1}
    for joint in ('frictionloss="1.5"', ""):
        assert not along(slider(tmp_path, joint, depth=depth))


def test_a_model_that_diverges_under_the_longer_step_is_rough(tmp_path, monkeypatch) -> None:
    task = slider(tmp_path, 'frictionloss="1.5"')
    whole = Derivatives.sensitivity

    def sensitivity(*arguments: Any) -> object:
        """Diverge where a step is given."""
        return whole(*arguments) if len(arguments) == 3 else None

    monkeypatch.setattr(Derivatives, "sensitivity", sensitivity)
    assert along(task)


def test_disagreements_below_the_tolerance_need_not_decrease() -> None:
    for medium, longer, tolerated, is_only_curved in (
        # The first derivative exists, although the longer step reaches the end of a joint's range.
        ((6e-5, 5e-9), (0.87, 2.6e-8), 0.01, True),
        ((6e-5, 5e-9), (0.87, 2.6e-8), 0.0, False),
        ((0.12, 8e-3), (0.79, 0.037), 0.01, True),
        ((0.5, 5e-9), (0.87, 2.6e-8), 0.01, False),
        ((6e-5, 0.02), (0.87, 2.6e-8), 0.01, False),
    ):
        assert only_curved(np.array(medium), np.array(longer), tolerated) == is_only_curved


def test_finite_steps_correct_derivatives_that_are_wrong_by_any_factor(tmp_path) -> None:
    task = slider(tmp_path)
    noise, theta = task.system.noise, task.theta
    G = noise.whiten(sensitivity_of(task).G).reshape(-1, 2)
    std, wrong = np.sqrt(np.diag(np.linalg.inv(G.T @ G))), 1e10 * np.eye(2)
    found = finite_steps(
        task.plant,
        noise,
        theta,
        task.initial,
        information=wrong,
        prior=0.0 * wrong,
        predicted=1e-4 * std,
    )
    assert_allclose(found.std, std, rtol=0.01)
