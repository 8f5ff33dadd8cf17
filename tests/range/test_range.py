"""Numerical range: extreme masses, integrators, timesteps and horizons.

What works is equal to plain MuJoCo, and what does not is said.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
from mjfim.errors import MjfimError
from mjfim.excitation.task import DesignTask
from mjfim.records.design import Status
from tests.range.plants import PLANTS, Setting
from tests.range.truth import information, relative_change

# Relative error of the information that is claimed without a warning.
TOLERANCE = 0.02

# Error of an estimate [standard deviations], and of chi^2 [its standard deviations].
MAX_ERROR = 4.5

# Compares a claimed information about parameters of a size with the true one under a control.
Judge = Callable[[Array, Array], None]


def check(experiment: mjfim.Experiment, true: Array, judge: Judge) -> None:
    """Check the initial control."""
    found = mjfim.check(experiment, threads=1)
    if found.self_test.passed:
        judge(found.information, DesignTask.resolve(experiment, threads=1).initial.ctrl)
    else:
        assert any("not smooth" in each or "derivatives" in each for each in found.findings)


def design(experiment: mjfim.Experiment, true: Array, judge: Judge) -> None:
    """Design with few iterations."""
    found = mjfim.design(experiment, threads=1)
    if not found.warnings and found.status in (Status.MAX_ITERATIONS, Status.CONVERGED):
        judge(found.final.information, found.trajectory.ctrl)


def identify(experiment: mjfim.Experiment, true: Array, judge: Judge) -> None:
    """Simulate the initial control at the truth, and fit from a guess that is 10 % off."""
    motion = DesignTask.resolve(experiment, threads=1).initial
    log = mjfim.simulate(experiment, motion, seed=1, threads=1)
    found = mjfim.identify(experiment, [log], threads=1)
    if found.converged and not found.misfit and not found.warnings:
        assert np.abs((found.theta - true) / found.std).max() < MAX_ERROR
        assert abs(found.chi2 / found.dof - 1.0) < MAX_ERROR * np.sqrt(2.0 / found.dof)


@pytest.mark.slow
@pytest.mark.parametrize("verb", [check, design, identify])
@pytest.mark.parametrize(
    ("plant", "setting"),
    [
        ("cart-pendulum", Setting(mass=1e-6, horizon=1.0)),
        ("cart-pendulum", Setting(timestep=1e-4, integrator="implicitfast", horizon=0.25)),
        ("cart-pendulum", Setting(mass=1e6, timestep=0.02, integrator="implicit", horizon=1.0)),
        ("inverted pendulum", Setting(mass=1e6, integrator="implicit", horizon=1.0)),
        ("inverted pendulum", Setting(timestep=0.05, horizon=4.0)),
        ("acrobot", Setting(mass=1e-3, ratio=1e6, horizon=1.0)),
        ("acrobot", Setting(timestep=0.05, integrator="Euler", horizon=4.0)),
        ("stiff spring", Setting(mass=1e3, ratio=1e-6, horizon=0.5)),
        ("stiff spring", Setting(timestep=0.05, integrator="implicit", horizon=1.0)),
        ("bouncing ball", Setting(timestep=0.05)),
        ("bouncing ball", Setting(mass=1e3, integrator="Euler", horizon=1.0)),
        ("free body", Setting(mass=1e-6, timestep=0.02, horizon=1.0)),
    ],
)
def test_nothing_is_wrong_in_silence(
    plant: str,
    setting: Setting,
    verb: Callable[[mjfim.Experiment, Array, Judge], None],
    tmp_path: Path,
) -> None:
    xml, tables = PLANTS[plant](setting)
    (tmp_path / "plant.xml").write_text(xml, encoding="utf-8")
    experiment = mjfim.Experiment(model="plant.xml", **tables, directory=tmp_path, source="e.toml")
    true = np.array([entry["true"] for entry in tables["parameters"].values()])

    def judge(claimed: Array, ctrl: Array) -> None:
        matrix, error = information(xml, tables, ctrl, setting.substeps)
        change = relative_change(claimed * np.outer(true, true), matrix)
        assert error < 0.1 and change <= TOLERANCE + 3.0 * error, f"{change:.1e} {error:.1e}"

    # An error of the package is something that was said.
    with suppress(MjfimError):
        verb(experiment, true, judge)
