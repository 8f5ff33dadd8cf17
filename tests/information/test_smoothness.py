"""Disagreement of two difference steps: dry friction and contacts are flagged with sample and
cause, smooth models are not.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.information.smoothness import (
    DISAGREEMENT_TOLERANCE,
    disagreement,
    only_curved,
    roughness,
)
from mjfim.plant.plant import Derivatives
from mjfim.records.check import Roughness
from tests.support.numerics import Array, Loop, body_task, cart_task, filtered_task, make_task

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


def slider(folder: Path, joint: str = "", motor: str = "", amplitude: float = 3.0) -> DesignTask:
    """A block that is pushed back and forth."""
    parameters = {"mass": {"target": "body/block:mass"}, "drag": {"target": "joint/rail:damping"}}
    control = {"kind": "sine", "amplitude": amplitude, "frequency": 1.0}
    xml = SLIDER.format(joint=joint, motor=motor)
    task = {
        "parameters": parameters,
        "noise": {"state": 0.01},
        "initial": {"control": control},
        "horizon": 1.5,
    }
    return make_task(xml, folder, **task)


def ball(folder: Path, horizon: float) -> DesignTask:
    """A ball that falls on the floor at about 0.2 s."""
    parameters = {"mass": {"target": "body/ball:mass"}}
    initial = {"control": {"kind": "constant", "amplitude": 1.0}}
    return make_task(
        BALL, folder, parameters=parameters, noise={"state": 0.01}, initial=initial, horizon=horizon
    )


def along(task: DesignTask) -> Roughness | None:
    """Roughness along the initial control."""
    return roughness(
        task.plant, task.system.noise, task.system.model_at(task.theta), task.theta, task.initial
    )


@pytest.mark.parametrize(
    "make",
    [cart_task, body_task, filtered_task, slider, lambda f: ball(f, 0.15)],
    ids=["cart", "free body", "activation", "slider", "ball in the air"],
)
def test_a_smooth_motion_is_not_flagged(make, tmp_path) -> None:
    assert along(make(tmp_path)) is None


def dry(folder: Path, loss: float) -> DesignTask:
    """The block held by dry friction of this size, which is unknown."""
    task = slider(folder, f'frictionloss="{loss}"')
    parameters = {"dry": {"target": "joint/rail:frictionloss"}}
    return DesignTask.resolve(task.experiment.replace(parameters=parameters), threads=1)


def held(task: DesignTask) -> Array:
    """(N,) force of the friction along the initial trajectory [N]."""
    loop, curve = Loop(task.plant.model(task.theta), 1), task.initial
    forces = []
    for k in range(curve.samples):
        loop.h(curve.state[k], curve.ctrl[k])
        forces.append(float(loop.data.qfrc_constraint[0]))
    return np.abs(forces)


def test_dry_friction_at_the_verge_of_sliding_is_flagged_where_it_breaks_away(tmp_path) -> None:
    force = held(dry(tmp_path, 100.0))
    assert 2.0 < force.max() < 3.0  # it holds what is pushed
    task = dry(tmp_path, force.max() * (1.0 - 1e-4))
    found = along(task)
    assert found.error > DISAGREEMENT_TOLERANCE
    assert found.parameter == "dry"
    assert found.causes == ("dry friction of rail",)
    assert (
        force[found.sample - 2 : found.sample + 1].max() > 0.99 * force.max()
    )  # at a peak of the push
    assert found.time == pytest.approx(0.01 * found.sample)
    for share in (
        0.2,
        10.0,
    ):  # sliding nearly always, or never: far from the verge the derivative exists
        assert along(dry(tmp_path, share * force.max())) is None


def test_a_bouncing_ball_is_flagged_at_a_contact_and_before_the_first_it_is_not(tmp_path) -> None:
    found, height = along(ball(tmp_path, 1.0)), ball(tmp_path, 1.0).initial.qpos[:, 0]
    assert found.parameter == "mass"
    assert found.causes == ("contact floor - ball",)
    assert height[found.sample - 2 : found.sample + 1].min() < -0.19
    assert along(ball(tmp_path, 0.15)) is None


def test_a_joint_limit_is_named(tmp_path) -> None:
    found = along(slider(tmp_path, 'limited="true" range="-0.05 0.15"'))
    assert "limit of rail" in found.causes


@pytest.mark.parametrize(("amplitude", "flagged"), [(1.9, False), (2.0001, True)])
def test_a_force_that_just_meets_its_range_is_named(
    amplitude: float, flagged: bool, tmp_path
) -> None:
    task = slider(tmp_path, motor='forcelimited="true" forcerange="-2 2"', amplitude=amplitude)
    gain = {"gain": {"target": "actuator/push:gainprm[0]"}}
    found = along(DesignTask.resolve(task.experiment.replace(parameters=gain), threads=1))
    assert (found is not None) == flagged
    if flagged:
        assert found.causes == ("force range of push",)
        assert abs(found.sample - 26) <= 2  # the peak of the sine


def test_the_sentence_says_parameter_sample_time_and_cause() -> None:
    rough = Roughness(
        error=0.2345,
        parameter="mass",
        sample=17,
        time=0.17,
        causes=("contact floor - ball", "dry friction of rail"),
    )
    said = str(rough)
    for part in (
        "23 %",
        "mass",
        "sample 17",
        "t = 0.17 s",
        "contact floor - ball, dry friction of rail",
    ):
        assert part in said
    assert "dry friction of rail" in said

    # Causes of a kind stand together.
    both = replace(rough, causes=("dry friction of rail", "dry friction of hinge"))
    assert "with dry friction of rail, hinge: " in str(both)
    lost = str(Roughness(error=np.inf, parameter="mass", sample=0, time=0.0, causes=()))
    assert "an unlimited amount" in lost
    assert "chaotic" in lost


def test_the_design_warns_of_roughness(tmp_path) -> None:
    rough = DesignTask.resolve(
        ball(tmp_path, 1.0).experiment.replace(descent={"max_iterations": 0}), threads=1
    )
    assert any(
        "not smooth" in w and "contact floor - ball" in w for w in design_task(rough).warnings
    )
    assert not any(
        "not smooth" in w
        for w in design_task(cart_task(tmp_path, descent={"max_iterations": 1})).warnings
    )


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
    task = slider(tmp_path, 'frictionloss="1.5"')
    depth = {"depth": {"target": "body/block:ipos[1]", "guess": 0.1}}
    assert along(DesignTask.resolve(task.experiment.replace(parameters=depth), threads=1)) is None
    alone = make_task(
        SLIDER.format(joint="", motor=""), tmp_path, parameters=depth, noise={"state": 0.01}
    )
    assert along(alone) is None


def test_a_model_that_diverges_under_the_longer_step_is_infinitely_rough(
    tmp_path, monkeypatch
) -> None:
    task = slider(tmp_path, 'frictionloss="1.5"')
    whole = Derivatives.sensitivity

    def sensitivity(
        derivatives: Derivatives, theta: Array, curve: object, step: object = None
    ) -> object:
        return whole(derivatives, theta, curve) if step is None else None

    monkeypatch.setattr(Derivatives, "sensitivity", sensitivity)
    found = along(task)
    assert found.error == np.inf
    assert found.parameter == "mass, drag"
    assert "dry friction of rail" in found.causes


def test_disagreements_below_the_tolerance_need_not_decrease() -> None:
    # The first derivative exists, although the longer step reaches the end of a joint's range.
    assert only_curved(np.array([6e-5, 5e-9]), np.array([0.87, 2.6e-8]), 0.01)
    assert not only_curved(np.array([6e-5, 5e-9]), np.array([0.87, 2.6e-8]), 0.0)
    assert only_curved(np.array([0.12, 8e-3]), np.array([0.79, 0.037]), 0.01)
    assert not only_curved(np.array([0.5, 5e-9]), np.array([0.87, 2.6e-8]), 0.01)
    assert not only_curved(np.array([6e-5, 0.02]), np.array([0.87, 2.6e-8]), 0.01)
