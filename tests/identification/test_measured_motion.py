"""Regression splines, and motions from measured values against the motions that were measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.errors import RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.identification.aligned_recording import align
from mjfim.identification.inverse_dynamics.motion import (
    MeasuredMotion,
    Readings,
    fit_spline,
    measured_motion,
)
from tests.support.numerics import Array, body_task
from tests.support.terms import recorded


def motion_of(
    task: DesignTask, hidden: tuple[str, ...] = ()
) -> tuple[MeasuredMotion, Array, Array]:
    """Motion from positions without noise, and (N+1, nq), (N+1, nv) what was simulated."""
    guess = task.parameters.guess
    made = recorded(task.system, task.control, theta=guess, share=0.0)
    columns = [
        i for i, name in enumerate(made.outputs) if name.startswith("qpos") and name not in hidden
    ]
    outputs = tuple(made.outputs[i] for i in columns)
    recording = replace(made, y=made.y[:, columns], outputs=outputs, name="x.csv")
    motion = measured_motion(task.system, align(task.system, recording), guess, 10_000)
    nq = task.space.nq
    return motion, made.y[:, :nq], made.y[:, nq:]


def inner(motion: MeasuredMotion, samples: Array, dt: float) -> tuple[Array, Array]:
    """Values at the points of a motion away from its ends, and a mask of these points."""
    inside = (motion.t > 0.2) & (motion.t < motion.t[-1] - 0.2)
    times = dt * np.arange(len(samples))
    columns = [np.interp(motion.t[inside], times, column) for column in samples.T]
    return np.stack(columns, axis=1), inside


def test_orientations_turn_with_the_angular_velocity_of_the_body(tmp_path: Path) -> None:
    task = body_task(tmp_path, noise={"state": 0.01}, horizon=3.0)
    motion, qpos, qvel = motion_of(task)
    expected, inside = inner(motion, qvel, task.dt)
    assert np.abs(motion.qvel[inside] - expected).max() < 0.02 * np.abs(qvel).max()
    change = np.gradient(expected, motion.step, axis=0)
    assert np.abs(motion.qacc[inside] - change).max() < 0.1 * np.abs(change).max()
    for first in (3, 7):
        norm = np.linalg.norm(motion.qpos[:, first : first + 4], axis=1)
        assert_allclose(norm, 1.0, rtol=1e-12)
    places, _ = inner(motion, qpos, task.dt)
    assert np.abs(motion.qpos[inside] - places).max() < 0.01


def test_unmeasured_degrees_of_freedom_are_named(tmp_path: Path) -> None:
    body = body_task(tmp_path, noise={"state": 0.01}, horizon=1.0)
    with pytest.raises(RecordingError, match=r"x\.csv: .* of ball\.rx, ball\.ry, ball\.rz;"):
        motion_of(body, hidden=("qpos:ball.qx",))


GRID = np.arange(2000) / 200.0


SECONDS = 10.0


def curve(t: Array) -> Array:
    """A sum of two sines."""
    return np.sin(2 * np.pi * 0.4 * t + 0.3) + 0.3 * np.sin(2 * np.pi * 1.7 * t + 1.0)


def readings(t: Array, sigma: float, seed: int = 0) -> Readings:
    """Noisy readings of the curve."""
    values = curve(t) + sigma * np.random.default_rng(seed).standard_normal(len(t))
    return Readings(t=t, values=values, sigma=sigma or 1.0, derivative=0)


@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("sigma", [1e-4, 1e-2])
def test_noise_is_averaged_and_its_size_found(sigma: float, derivative: int) -> None:
    inner = np.linspace(0.5, SECONDS - 0.5, 300)
    squares, splines = [], []
    for seed in range(8):
        noisy = fit_spline([readings(GRID, sigma, seed=seed)])
        exact = fit_spline([readings(GRID, 0.0)], spacing=noisy.spacing)
        squares.append(np.mean((noisy.at(inner, derivative) - exact.at(inner, derivative)) ** 2))
        splines.append(noisy)
    errors = splines[0].at(inner, 0) - curve(inner)
    assert np.sqrt(np.mean(errors**2)) < 0.5 * sigma
    assert np.mean([spline.variance for spline in splines]) == pytest.approx(1.0, abs=0.1)

    # The predicted noise of a derivative is that of the fits.
    predicted = np.mean([spline.sigma(derivative) for spline in splines])
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted, rel=0.35)


def test_irregular_times_gaps_and_outliers() -> None:
    t = np.sort(np.random.default_rng(4).uniform(0.0, SECONDS, 1500))
    t = t[(t < 3.0) | (t > 3.4)]
    given = readings(t, 1e-3)
    outliers = 5.0 * (np.arange(len(t)) % 200 == 0)
    spline = fit_spline([replace(given, values=given.values + outliers)])
    inner = np.concatenate([np.linspace(0.5, 2.5, 100), np.linspace(4.0, 9.5, 100)])
    assert np.abs(spline.at(inner) - curve(inner)).max() < 3e-3
    assert np.isfinite(spline.at(np.linspace(3.0, 3.4, 50))).all()


def test_the_motion_of_a_joint_that_mostly_rests_is_no_outlier() -> None:
    """An encoder shows the same number most of the time, and swings for 0.6 s."""
    swing = np.where(np.abs(GRID - 5.0) < 0.3, np.cos(np.pi * (GRID - 5.0) / 0.6) ** 2, 0.0)
    counts = Readings(t=GRID, values=0.01 * np.round(100.0 * swing), sigma=0.003, derivative=0)
    spline = fit_spline([counts])
    assert np.abs(spline.at(GRID) - swing).max() < 0.02 and len(spline.t) == len(GRID)
