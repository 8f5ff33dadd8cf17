"""Parameters that are identifiable only in combination: in designs, joint designs, prior
information, estimates and criteria.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import UnidentifiableError
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.identification.identify import identify_system
from mjfim.output import archive
from mjfim.studies.check import check_recordings, check_task
from tests.support.numerics import make_task, relative_error

# A double pendulum whose first link holds a mass that no motion tells from the second one's.
PENDULUM = """
<mujoco>
  <option timestep="0.005" integrator="RK4"/>
  <worldbody>
    <body name="upper">
      <inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.01 0.01 0.002"/>
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <body name="lower" pos="0 0 -0.3">
        <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.008 0.008 0.001"/>
        <joint name="elbow" axis="0 1 0" damping="0.05"/>
        <site name="tip" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
  <sensor><framequat name="tip" objtype="site" objname="tip"/></sensor>
</mujoco>
"""
PARAMETERS = {
    "m1r1": {"target": "body/upper:firstmoment[2]"},
    "I1": {"target": "body/upper:origininertia[1]"},
    "m2": {"target": "body/lower:mass"},
    "m2r2": {"target": "body/lower:firstmoment[2]"},
    "d": {"target": "joint/shoulder:damping"},
}
SINE = {"kind": "multisine", "amplitude": 1.0, "frequency": 0.5}


def pendulum(folder: Path, **tables) -> DesignTask:
    """One second of a double pendulum, all states measured."""
    defaults = {
        "parameters": PARAMETERS,
        "noise": {"state": 0.01},
        "horizon": 1.0,
        "control": SINE,
        "cost": {"control": 1e-3},
        "descent": {"max_iterations": 5},
        "fit": {"bootstrap": 0},
    }
    return make_task(PENDULUM, folder, **{**defaults, **tables})


def lost(names: tuple[str, ...], std: np.ndarray) -> set[str]:
    """Parameters without a finite standard deviation."""
    return {name for name, value in zip(names, std, strict=True) if not np.isfinite(value)}


INVISIBLE = {"m1r1", "I1", "m2"}


@pytest.mark.slow
def test_joint_experiments_do_not_take_round_off_for_information(tmp_path) -> None:
    first = pendulum(tmp_path).experiment
    second = pendulum(tmp_path, initial={"qpos": (0.5, -0.4), "control": SINE}).experiment
    for design in mjfim.design_jointly([first, second], rounds=1):
        assert lost(design.parameters, design.final.std) == INVISIBLE
        assert len(design.combined) == 2
        assert len(design.final.eigenvalues) == 4
    direction = np.array([-0.3, 0.09, -1.0, 0.0, 0.0])  # m1r1 along -z
    assert direction @ design.data @ direction < 1e-9 * np.abs(design.data).max()


@pytest.mark.slow
def test_earlier_information_of_a_design_leaves_every_sigma_known(tmp_path) -> None:
    task = pendulum(tmp_path)
    design = design_task(task)
    archive.write_data(tmp_path, design, task.system)
    again = DesignTask.resolve(task.experiment.replace(earlier=[str(tmp_path / "design.json")]))
    alone, told = (
        np.array([row.std for row in check_task(each, trajectory=design.trajectory).rows])
        for each in (task, again)
    )
    assert lost(tuple(PARAMETERS), told) == INVISIBLE
    assert_allclose(told[3:], alone[3:] * np.sqrt(0.5), rtol=1e-4)  # the data twice


@pytest.mark.slow
def test_an_estimate_keeps_what_no_recording_shows_and_determines_the_rest(tmp_path) -> None:
    parameters = {**PARAMETERS, "d": {**PARAMETERS["d"], "guess": 0.15, "true": 0.1}}
    task = pendulum(tmp_path, parameters=parameters)
    recording = simulate_system(task.system, task.initial, seed=3)
    estimate = identify_system(task.system, [recording])
    assert lost(estimate.parameters, estimate.std) == INVISIBLE
    assert not estimate.converged  # declared one by one, not all of them can be told
    assert "m1r1" in estimate.combinations[0]
    assert not estimate.misfit
    assert abs(estimate.theta[4] - 0.1) < 4.0 * estimate.std[4]
    # not run away along what is invisible
    assert_allclose(estimate.theta[:3], task.parameters.guess[:3], rtol=0.1)
    told = [row.std for row in check_recordings(task.system, [recording]).rows[3:]]
    assert_allclose(estimate.std[3:], told, rtol=0.3)  # there at the guess

    # it serves as earlier information
    estimate.save(tmp_path)
    again = DesignTask.resolve(task.experiment.replace(earlier=[str(tmp_path / "estimate.json")]))
    assert relative_error(again.prior_information, estimate.data) < 1e-12
    assert {row.name for row in check_task(again).rows if np.isfinite(row.std)} == {"m2r2", "d"}


@pytest.mark.slow
def test_criterion_c_refuses_what_cannot_be_identified(tmp_path) -> None:
    with pytest.raises(UnidentifiableError, match=r"m1r1 .* m2"):
        design_task(pendulum(tmp_path, cost={"criterion": "c", "subset": ["m2"]}))
    visible = {"criterion": "c", "combination": {"I1": 1.0, "m2": 0.09}}
    design = design_task(pendulum(tmp_path, cost=visible))
    (known,) = (c.std for c in design.combined if c.name.startswith("I1 "))
    assert design.final.criterion == pytest.approx(known**2 * 100.0, rel=1e-6)  # per second, 100 Hz


def test_parameters_that_are_all_invisible_are_reported(tmp_path) -> None:
    found = check_task(
        pendulum(tmp_path, parameters={"wind": {"target": "option:wind[0]", "guess": 1.0}})
    )
    assert not found.verdict.ok
    assert any("no parameter can be identified" in sentence for sentence in found.findings)


def test_a_prior_on_one_member_makes_the_others_identifiable(tmp_path) -> None:
    parameters = {**PARAMETERS, "m2": {"target": "body/lower:mass", "prior": 0.01}}
    found = check_task(pendulum(tmp_path, parameters=parameters))
    assert all(np.isfinite(row.std) for row in found.rows)
    assert found.rows[2].std == pytest.approx(0.01, rel=1e-3)
    assert found.verdict.ok
    assert any("by priors only" in sentence for sentence in found.findings)


@pytest.mark.slow
def test_check_and_identify_estimate_an_initial_state_per_recording(tmp_path) -> None:
    task = pendulum(tmp_path, parameters={"d": PARAMETERS["d"]}, nuisance={"initial": 0.05})
    recordings = [simulate_system(task.system, task.initial, seed=s) for s in range(3)]
    estimate = identify_system(task.system, recordings)
    single, told = (check_recordings(task.system, recordings[:n]).rows[0].std for n in (1, 3))
    assert told == pytest.approx(estimate.std[0], rel=0.02)
    assert told == pytest.approx(single / np.sqrt(3.0), rel=1e-6)
