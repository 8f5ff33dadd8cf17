"""A fit over a whole recording that ends in a local minimum is restarted from short segments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import identify_system
from mjfim.records.trajectory import Recording
from tests.support.numerics import require_found
from tests.support.terms import recorded

# A pendulum that swings about once per second, measured with an error of 0.01 rad.
PENDULUM = """<mujoco>
  <option timestep="0.02" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.4" mass="0.5" diaginertia="0.004 0.004 0.0004"/>
      <joint name="hinge" axis="0 1 0" damping="0.002"/>
      <geom type="sphere" size="0.01" mass="0"/>
    </body>
  </worldbody>
  <sensor><jointpos name="angle" joint="hinge" noise="0.01"/></sensor>
</mujoco>
"""
RATE = 50.0

# Factors by which the start is wrong, of the centre of mass and of the damping.
START = (0.5, 0.5)


def pendulum(folder: Path, seconds: float, **tables: object) -> System:
    """The pendulum, released at 1.5 rad."""
    (folder / "pendulum.xml").write_text(PENDULUM, encoding="utf-8")
    parameters = {
        "com": {"target": "body/arm:ipos[2]"},
        "damping": {"target": "joint/hinge:damping", "bounds": [0.0, 1.0]},
    }
    experiment = mjfim.Experiment(
        model="pendulum.xml",
        directory=folder,
        rate=RATE,
        horizon=seconds,
        initial={"qpos": [1.5]},
        parameters=parameters,
        fit={"bootstrap": 0},
        **tables,
    )
    return System.resolve(experiment, threads=1)


def swings(system: System, seconds: float) -> Recording:
    """A log of many swings at the true parameters, with noise."""
    return recorded(system, np.zeros((round(seconds * RATE), 0)), 0)


@pytest.mark.slow
@pytest.mark.parametrize("start", [(0.5, 0.5), (1.5, 2.0), (0.4, 3.0)])
def test_a_wrong_start_finds_the_truth_over_many_swings(
    tmp_path: Path, start: tuple[float, float]
) -> None:
    """The factors are those of the centre of mass and of the damping."""
    seconds = 12.0 if start == START else 20.0
    system = pendulum(tmp_path, seconds)
    found = identify_system(system, [swings(system, seconds)], start=system.parameters.true * start)
    require_found(found, system.parameters.true)
    assert not found.missing_terms


@pytest.mark.slow
def test_deviations_of_the_initial_state_and_biases_are_continued_too(tmp_path: Path) -> None:
    """Parameters of the initial state are no unknowns of segments, the others are."""
    nuisance = {"initial": {"qpos:hinge": 0.05}, "bias": 0.05, "per_recording": True}
    system = pendulum(tmp_path, 20.0, nuisance=nuisance)
    recording = swings(system, 20.0)
    other = replace(recording, y=recording.y + 0.03)
    start = system.parameters.true.copy()
    start[:2] *= START
    phases: dict[str, None] = {}
    found = identify_system(
        system,
        [recording, other],
        start=start,
        callback=lambda event: phases.setdefault(event.phase),
    )
    require_found(found, system.parameters.true)
    first, then, *_, last = phases
    assert (first, last) == ("all data", "again all data")
    assert then.startswith("segments of")

    # The result says what happened.
    assert found.restart is not None
    assert found.restart.cost < 1e-2 * found.restart.cost_before
    assert "fell from" in found.summary()["restart"]["words"]
    assert_allclose(found.per_recording["bias angle"], [0.0, 0.03], atol=0.005)


@pytest.mark.slow
def test_a_wrong_model_keeps_the_lower_cost_of_all_fits(tmp_path: Path) -> None:
    """Dry friction that the model lacks is no local minimum: the first result stands."""
    system = pendulum(tmp_path, 12.0)
    rub = {"target": "joint/hinge:frictionloss", "guess": 0.02}
    robot = System.resolve(system.experiment.replace(parameters={"rub": rub}), threads=1)
    found = identify_system(system, [swings(robot, 12.0)])
    assert found.misfit
    assert found.restart.cost <= found.restart.cost_before
    assert found.missing_terms[0].path == "joint/hinge:frictionloss"


def test_segments_of_a_problem_are_cut_where_they_are_long_enough(tmp_path: Path) -> None:
    system = pendulum(tmp_path, 4.0)
    problem = FitProblem.of(system, [swings(system, 4.0)])
    part = problem.cut(1.0)
    assert len(part.segments) == 4
    assert part.recordings is problem.recordings
    assert problem.cut(0.01) is None
