"""Baselines: their curves, their budgets, their limits by an independent simulation, and their
gradients.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.excitation.limits.verification import verify
from mjfim.excitation.search.levels import DescentLevel
from mjfim.experiment.initial import fourier_basis
from mjfim.parallel.budget import StopToken, measured_by
from mjfim.studies.baselines import (
    MAX_LEVELS,
    METHODS,
    BaselineSearch,
    ExcitationSettings,
    chirp,
    multisine,
    random_steps,
    reflected,
    run_baseline,
    schroeder_phases,
)
from tests.support.limits import cart_inside

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

FRAME = ExcitationSettings(
    t=np.arange(500) * 0.01, horizon=5.0, nu=2, min_frequency=0.1, max_frequency=5.0, may_jump=True
)


# ---- shapes


def test_schroeder_phases_of_equal_powers_are_the_known_ones() -> None:
    k = np.arange(1, 9)
    turns = (schroeder_phases(np.ones(8)) + np.pi * k * (k - 1) / 8) / (2.0 * np.pi)
    assert_allclose(turns, np.round(turns), atol=1e-12)


@pytest.mark.parametrize(
    ("made", "count"), [(chirp, 10), (multisine, 7), (random_steps, 2 + 2 * MAX_LEVELS)]
)
def test_waves_are_of_size_one_for_any_numbers(made: Any, count: int) -> None:
    rng = np.random.default_rng(0)
    for z in (np.zeros(count), np.ones(count), *rng.random((20, count))):
        wave = made(FRAME, z)
        assert wave.shape == (500, 2)
        assert np.isfinite(wave).all()
        assert np.abs(wave).max() <= 1.5 + 1e-9
        assert_array_equal(wave, made(FRAME, z))


def test_chirps_stay_within_their_band() -> None:
    wave = chirp(FRAME, np.repeat([1.0, 0.3, 0.8, 0.25, 0.5], 2))[:, 0]
    periods = 0.02 * np.diff(np.flatnonzero(np.diff(np.sign(wave))))
    low, high = FRAME.frequency(np.array([0.3, 0.8]))
    assert 0.9 * low <= 1.0 / periods.max()
    assert 1.0 / periods.min() <= 1.3 * high


def test_steps_are_held_or_pass_smoothly() -> None:
    z = np.random.default_rng(3).random(2 + 2 * MAX_LEVELS)
    z[:2] = 0.5, 1.0
    smooth = random_steps(replace(FRAME, may_jump=False), z)
    jumps, changes = (np.abs(np.diff(each, axis=0)) for each in (random_steps(FRAME, z), smooth))
    assert np.mean(jumps > 0.0) < 0.05
    assert jumps.max() > 10.0 * changes.max()
    assert np.abs(smooth[0]).max() < 1e-3  # it begins at rest


# ---- searches


@pytest.mark.parametrize(
    ("method", "limited"),
    [*((name, True) for name in METHODS), ("steps", False), ("fourier5", False)],
)
def test_every_baseline_keeps_the_limits_and_its_time(
    method: str, limited: bool, tmp_path: Path
) -> None:
    """A random search verifies its controls on the plant of the search; a series on the model."""
    tables: dict[str, Any] = {} if limited else {"limits": {}, "cost": {"control": 1e-3}}
    task = cart_inside(tmp_path, **tables)
    clock = itertools.count(step=0.02)
    with measured_by(lambda: float(next(clock))):
        order = BaselineSearch(experiment=task.experiment, method=method, seconds=0.6, threads=1)
        found = run_baseline(order, stop=StopToken())
    assert found.seconds < 12.0
    assert found.steps > 0
    played = task.plant.simulate(task.theta, found.control)
    assert min(verify(task, played).relative_margins.values(), default=0.0) > -0.05
    point = DescentLevel(task, None).problem.point(played)
    assert found.cost == pytest.approx(point.cost, rel=1e-3)


def test_series_remain_sums_of_their_curves(tmp_path: Path) -> None:
    task = cart_inside(tmp_path, descent={"max_iterations": 4})
    order = BaselineSearch(experiment=task.experiment, method="fourier5", seconds=0.3, threads=1)
    found = run_baseline(order, stop=StopToken())
    frequency = float(found.found_by.split(" Hz")[0].split()[-1])
    curves = fourier_basis(task.t, task.horizon, frequency, 5, False, False)
    deviation = found.control - task.centre
    fitted = curves @ np.linalg.lstsq(curves, deviation)[0]
    assert np.abs(fitted - deviation).max() < 0.02 * np.abs(deviation).max()


def test_numbers_are_reflected_at_their_ends() -> None:
    assert_allclose(reflected(np.array([-0.2, 0.3, 1.1, 2.3])), [0.2, 0.3, 0.9, 0.3])
