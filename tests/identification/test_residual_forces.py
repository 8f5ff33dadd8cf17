"""Residual forces along measured motions: dry friction that the model lacks, and the noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import align
from mjfim.identification.inverse_dynamics import inverse_dynamics, residual_forces
from mjfim.output.plots.draw import figure_of
from mjfim.output.plots.estimate import MAX_JOINTS, residual_torque
from mjfim.records.estimate_parts import ResidualForce
from mjfim.records.trajectory import Recording
from tests.identification.test_inverse_dynamics import (
    CART_PENDULUM,
    STATE,
    cart,
    cart_log,
    servo,
    servo_log,
)

# Dry friction of the robot's slide, which the model lacks [N].
FRICTION = 0.5


def forces_along(experiment: Experiment, log: Recording) -> tuple[ResidualForce, ...]:
    """Residual forces at the guess."""
    system = System.resolve(experiment, threads=1)
    return residual_forces(system, [align(system, log)], [system.parameters.guess])


def rough_log(folder: Path, sigma: float) -> Recording:
    """A log of the cart whose slide has dry friction."""
    text = CART_PENDULUM.replace('type="slide"', f'type="slide" frictionloss="{FRICTION}"')
    return cart_log(cart(folder / "robot", text), sigma, seconds=10.0)


def test_medians_step_by_the_friction_that_the_model_lacks(tmp_path: Path) -> None:
    slide, hinge = forces_along(cart(tmp_path), rough_log(tmp_path, 1e-3))
    assert [slide.joint, slide.unit, hinge.joint, hinge.unit] == ["slide", "N", "hinge", "N m"]
    for sign in (1.0, -1.0):
        for each, friction in ((slide, sign * FRICTION), (hinge, 0.0)):
            # Without the slowest median, in which noise mixes the directions.
            speed, force = each.medians(each.speed, sign * each.speed > 0.0)
            fast = force[np.abs(speed) > np.abs(speed).min()]
            assert np.median(fast) == pytest.approx(friction, abs=0.1 * FRICTION)
    step, slope = slide.friction
    assert step == pytest.approx(FRICTION, rel=0.1)
    assert abs(slope) * np.abs(slide.speed).max() < 0.2 * FRICTION
    assert slide.noise_ratio > 3.0


@pytest.mark.parametrize("sigma", [1e-3, 1e-2])
def test_of_the_right_model_only_noise_remains(sigma: float, tmp_path: Path) -> None:
    experiment = cart(tmp_path)
    for each in forces_along(experiment, cart_log(experiment, sigma)):
        assert each.noise_ratio == pytest.approx(1.0, abs=0.5)


def test_measured_forces_replace_those_of_the_model(tmp_path: Path) -> None:
    """A log whose control is wrong by a factor, but whose force was measured."""
    measured = (*STATE, "drive")
    experiment = cart(tmp_path, noise=dict.fromkeys(measured, 0.01))
    log = cart_log(experiment, 1e-3, measured=measured)
    wrong = replace(log, ctrl=0.5 * log.ctrl)
    without = replace(wrong, y=wrong.y[:, :4], outputs=STATE)
    shares = [forces_along(experiment, each)[0].share for each in (wrong, without)]
    assert shares[0] < 0.1 and shares[1] > 0.5


def test_controls_of_a_law_follow_from_the_measured_motion(tmp_path: Path) -> None:
    """A servo whose log has references alone, with dry friction that one of two models lacks."""
    law, damping = {"kp": 30.0, "kd": 1.0, "latency": 0.01}, {"c": {"target": "joint/j:damping"}}
    tables = {"controllers": {"s": law}, "noise": {"qpos:j": 1e-4}}
    log = servo_log(servo(tmp_path, damping, friction=FRICTION, **tables), [0.3], 20.0)
    for friction in (FRICTION, 0.0):
        (joint,) = forces_along(servo(tmp_path, damping, friction=friction, **tables), log)
        assert joint.friction[0] == pytest.approx(FRICTION - friction, abs=0.1 * FRICTION)


def test_each_recording_has_its_own_parameters(tmp_path: Path) -> None:
    log = rough_log(tmp_path, 1e-3)
    system = System.resolve(cart(tmp_path), threads=1)
    theta, aligned = system.parameters.guess, align(system, log)
    heavy = theta * np.array([2.0, 1.0, 1.0, 1.0])
    one, other, both = (
        residual_forces(system, [aligned] * len(at), at)[0]
        for at in ([theta], [heavy], [theta, heavy])
    )
    assert both.rms**2 == pytest.approx(0.5 * (one.rms**2 + other.rms**2), rel=1e-9)


def test_the_picture_shows_the_medians_and_the_worst_joints(tmp_path: Path) -> None:
    fit = inverse_dynamics(cart(tmp_path), [rough_log(tmp_path, 1e-3)])
    slide, hinge = fit.residual_forces
    assert fit.pictures == ("residual_torque",)
    picture = residual_torque(fit.residual_forces)
    median = next(m for m in picture.panels[0].marks if m.label == "median, forwards")
    assert_array_equal(median.y, slide.medians(slide.speed, slide.speed > 0.0)[1])
    written = [each["rms"] for each in fit.summary()["residual_forces"]]
    assert written == [slide.rms, hinge.rms]

    many = [replace(hinge, joint=str(k)) for k in range(MAX_JOINTS)]
    picture = residual_torque([*many, slide])
    assert picture.title.startswith("Residual torque:") and "at slide" in picture.title
    assert picture.panels[-1].y.label == "slide [N]"
    assert len(picture.panels) == 2 * MAX_JOINTS and f"Shown: {MAX_JOINTS} of 7" in picture.note


def test_a_joint_without_residuals_or_directions_is_drawn() -> None:
    speed = np.linspace(0.1, 1.0, 30)
    still = ResidualForce(
        joint="a", unit="N", position=speed, speed=speed, force=0.0 * speed, sigma=0.0, size=0.0
    )
    assert np.isnan(still.friction).all() and np.isinf(still.share)
    picture = residual_torque([still])
    assert picture.title == "Residual torque: 0.0 N rms at a"
    assert picture.panels[0].title == "too few points in both directions"
    figure_of(picture)
